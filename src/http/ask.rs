//! How a mesh is asked for and answered: from the store, from a job that is waited for, or with the promise of one.

use std::sync::Arc;
use std::time::Duration;

use axum::http::header::{self, HeaderMap};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use tracing::Instrument as _;

use super::declared::Declared;
use super::kinds::Kind;
use super::problem::Problem;
use super::state::Shared;
use super::timing::Timing;
use super::wish::{PREFERENCE_APPLIED, Wish};
use super::{conditional, delivery, jobs, results};
use crate::formats::Format;
use crate::jobs::{ContentKey, Lease, Order, Task, Ticket};
use crate::pipeline::params::Request;
use crate::store::Digest;
use crate::telemetry::Scope;

/// A mesh, or its report, that somebody asks for.
pub(super) struct Ask {
    pub(super) digest: Digest,
    pub(super) request: Request,
    /// The parameters as they were given.
    pub(super) pairs: Vec<(String, String)>,
    pub(super) format: Format,
    pub(super) wish: Wish,
    /// Answer with the report instead of the mesh.
    pub(super) report: bool,
    /// How long the answer stays good; none: it belongs to this request alone.
    pub(super) cache: Option<HeaderValue>,
    /// Where the time went so far.
    pub(super) timing: Timing,
    /// What the input's type says that it is.
    pub(super) declared: Declared,
}

/// The bytes to be meshed, and the memory that they are charged to.
pub(super) struct Input {
    pub(super) bytes: Bytes,
    /// Of an archive's entry it may be another one than it was when the answer was looked for.
    pub(super) digest: Digest,
    pub(super) lease: Arc<Lease>,
}

impl Input {
    /// Bytes that are charged to the service's budget from now on.
    pub(super) fn new(app: &Shared, bytes: Bytes, digest: Digest) -> Result<Self, Problem> {
        let mut lease = app.pool.budget().lease();
        lease.grow(bytes.len() as u64)?;
        Ok(Self { bytes, digest, lease: Arc::new(lease) })
    }
}

impl Ask {
    /// The key of the answer, if the chosen backend makes it.
    pub(super) fn key(&self, app: &Shared) -> ContentKey {
        ContentKey::new(&self.digest, &self.request.job, self.format, &app.pool.maker(&self.request.job))
    }

    /// The answer that is known already.
    pub(super) async fn known(
        &self,
        app: &Shared,
        method: &Method,
        headers: &HeaderMap,
    ) -> Result<Option<Response>, Problem> {
        // A check and a report's times are those of a run; a promise has an address of its own.
        if self.request.strict || self.report || self.wish.later {
            return Ok(None);
        }
        let key = self.key(app);
        let etag = delivery::etag(&key);
        if let Some(cache) = &self.cache
            && conditional::is_unchanged(headers, &etag)
        {
            let caching = [(header::ETAG, etag), (header::CACHE_CONTROL, cache.clone())];
            return Ok(Some((StatusCode::NOT_MODIFIED, caching).into_response()));
        }
        let stored = match results::stored(app, &key, self.format, method, headers).await {
            // Nobody can tell whether it was made before, so it is made. The log has the store's words.
            Err(problem) if problem.is(Kind::StoreFailed) => None,
            stored => stored?,
        };
        let Some(mut response) = stored else { return Ok(None) };
        if let Some(cache) = &self.cache {
            response.headers_mut().insert(header::CACHE_CONTROL, cache.clone());
        } else {
            response.headers_mut().remove(header::CACHE_CONTROL);
        }
        Ok(Some(response))
    }

    /// Makes the mesh, or promises to.
    pub(super) async fn make(mut self, app: &Shared, input: Input) -> Result<Response, Problem> {
        app.admit_work(&self.wish.caller)?;
        if self.wish.later && !self.report {
            return self.promise(app, input, None).await;
        }
        let place = app.delivery()?;
        let task = self.task(&input);
        let mut ticket = app.pool.submit(task, app.config.jobs.deadline(), None)?;
        if ticket.is_shared()
            && let Some(scope) = Scope::current()
        {
            scope.link(ticket.scope().context());
        }
        let patience = match self.wish.wait {
            // A job has no report of its own to return later, so a report is waited for until the deadline.
            _ if self.report => Duration::MAX,
            Some(wait) => wait.min(app.config.jobs.sync_wait()),
            None => app.config.jobs.sync_wait(),
        };
        let Ok(outcome) = tokio::time::timeout(patience, ticket.wait()).await else {
            drop(place);
            return self.promise(app, input, Some(ticket)).await;
        };
        let digest = input.digest;
        let joined = ticket.is_shared();
        drop((ticket, input));
        let finished = outcome.map_err(|failure| self.declared.explain(failure))?;
        if joined {
            // The stages ran for somebody else too, and partly before this request was there.
            self.timing.lap("joined");
        } else {
            self.timing.job(&finished.product.report);
        }
        self.declared.check_format(finished.product.report.source_format)?;
        if self.report {
            return delivery::report(&finished, self.timing);
        }
        // Another backend may have stood in for the chosen one, and its bytes are others.
        let key = ContentKey::new(&digest, &self.request.job, self.format, &finished.product.report.maker());
        let kept = results::keep_later(app, &finished, self.format, &key);
        let mut response = delivery::mesh(app, Arc::clone(&finished), self.format, &key, self.timing, place).await?;
        let headers = response.headers_mut();
        if kept {
            headers.insert(header::CONTENT_LOCATION, delivery::text(&results::path(&key, self.format.extension())));
        }
        if let Some(cache) = self.cache {
            headers.insert(header::CACHE_CONTROL, cache);
        }
        Ok(response)
    }

    fn task(&self, input: &Input) -> Task {
        Task {
            input: input.bytes.clone(),
            digest: input.digest,
            strict: self.request.strict,
            job: self.request.job.clone(),
            rank: self.wish.rank,
            lease: Some(Arc::clone(&input.lease)),
            origin: Scope::current_origin(),
            id: None,
        }
    }

    /// A job that survives this process, and the answer that says so.
    async fn promise(self, app: &Shared, input: Input, ticket: Option<Ticket>) -> Result<Response, Problem> {
        let (task, asked) = (self.task(&input), self.wish.later);
        let order =
            Order { task, parameters: self.pairs, format: self.format, idempotency: self.wish.idempotency.clone() };
        let ticket = ticket.map(|ticket| ticket.with_time(app.config.jobs.batch_deadline()));
        let ledger = app.ledger.clone();
        // Whoever leaves now has asked nevertheless: the job is promised as a whole or not at all.
        let promised = tokio::spawn(async move { ledger.promise(order, ticket).await }.in_current_span());
        let view = promised.await.map_err(Problem::internal)??;
        let wait =
            app.pool.estimated_wait() + Duration::from_secs_f64(app.pool.expected(&input.bytes, &self.request.job));
        let mut response = jobs::accepted(&view, wait);
        if let Some(applied) = self.wish.applied(asked) {
            response.headers_mut().insert(PREFERENCE_APPLIED, applied);
        }
        Ok(response)
    }
}

/// The digest of an input. Large ones are not for the runtime's threads: they take a nanosecond a byte.
pub(super) async fn digest(bytes: &Bytes) -> Result<Digest, Problem> {
    const SMALL: usize = 128 << 10;
    if bytes.len() <= SMALL {
        return Ok(Digest::of(bytes));
    }
    let bytes = bytes.clone();
    tokio::task::spawn_blocking(move || Digest::of(&bytes)).await.map_err(Problem::internal)
}
