//! Synchronous requests whose meshes other nodes of a cluster compute. Each becomes an asynchronous job of which the
//! client does not know.

use std::time::Duration;

use axum::http::{Method, header};
use axum::response::Response;
use metrics::counter;
use tracing::Instrument as _;

use super::mesh_request::MeshRequest;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::Loaded;
use super::timing::SERVER_TIMING;
use super::{delivery, results};
use crate::config::Role;
use crate::jobs::{AcceptError, ContentKey, Failure, OwnedJob, Pool, Status};
use crate::telemetry::JOBS_TRANSFERRED;

impl MeshRequest {
    /// Returns true if other nodes compute the mesh: this node only answers requests, or its queue is long. Strict
    /// checks and reports stay, because the store does not hold their results.
    pub(super) async fn is_transferred(&self, loaded: &Loaded) -> bool {
        let Self { app, parsed, preferences, method, .. } = self;
        let limit = Duration::from_millis(app.config.broker.transfer_wait_ms);
        let lane = Pool::lane(&preferences.rank, &loaded.input, &parsed.request.job);
        let is_busy = || app.config.server.role == Role::Api || app.pool.estimated_wait(lane) > limit;
        let is_file = !parsed.report && !parsed.request.strict && !parsed.declared.is_structure();
        let is_plain = preferences.wait.is_none() && *method != Method::HEAD;
        app.config.broker.url.is_some() && is_file && is_plain && is_busy() && app.job_store.has_workers().await
    }

    /// Waits until a worker of the cluster has stored the mesh, and returns it.
    pub(super) async fn transfer(mut self, mut loaded: Loaded) -> Result<Response, Problem> {
        // Interactive requests precede the asynchronous jobs of the client.
        self.preferences.rank.urgency = 0;
        self.preferences.idempotency_key = None;
        let permit = self.app.delivery(self.preferences.caller.client)?;
        let (spec, jobs) = (self.job_spec(&mut loaded).await?, self.app.job_store.clone());
        drop(loaded);
        let accept = async move {
            let view = jobs.accept(spec, None).await?;
            Ok::<_, AcceptError>(OwnedJob::new(jobs, &view))
        };
        // If the client disconnects now, the job ends as soon as it is accepted.
        let job = tokio::spawn(accept.in_current_span()).await.map_err(Problem::internal)??;
        counter!(JOBS_TRANSFERRED).increment(1);
        let namespace = self.preferences.caller.namespace;
        let lost = || Problem::internal("the record of a transferred request was lost");
        let mut watched = job.watch().await?.ok_or_else(lost)?;
        let limit = Duration::from_millis(self.app.config.jobs.deadline_ms);
        let ended = tokio::time::timeout(limit, watched.wait_for(|view| view.record.status.is_final())).await;
        let ended = ended.map_err(|_elapsed| self.failed(Failure::Deadline { limit }))?;
        let record = ended.map_err(|_closed| lost())?.record.clone();
        drop(permit);
        self.timing.lap("transfer");
        let key = match (record.status, &record.result) {
            (Status::Successful, Some(key)) => ContentKey::parse(key, namespace).map_err(Problem::internal)?,
            (Status::Failed, _) => return Err(Problem::recorded(record.problem.as_ref())),
            _ => return Err(Problem::shutting_down("the request was cancelled".to_owned())),
        };
        let Self { app, preferences, headers, method, parsed, .. } = &self;
        super::conditional::check_match(headers, &delivery::etag(&key))?;
        let stored = results::stored(app, &preferences.caller, &key, parsed.format, method, headers).await?;
        let gone = || Problem::new(ProblemType::StoreFull, "the mesh was removed from the store before it was sent");
        let mut response = stored.ok_or_else(|| gone().retry_after(Duration::from_secs(1)))?;
        for name in [header::CACHE_CONTROL, SERVER_TIMING] {
            response.headers_mut().remove(name);
        }
        response.extensions_mut().insert(self.timing.clone());
        Ok(self.with_cache_control(response))
    }
}
