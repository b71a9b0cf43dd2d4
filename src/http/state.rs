//! State of the service that the handlers share.

use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use axum::http::HeaderMap;
use bytes::Bytes;
use quick_cache::sync::Cache;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::time::{Instant, timeout_at};

use super::kinds::Kind;
use super::probe::Probe;
use super::problem::Problem;
use super::stop::Stop;
use crate::access::Access;
use crate::archive::Archive;
use crate::client_shares::{ClientShares, Place};
use crate::config::Config;
use crate::jobs::{Budget, Client, ContentKey, Failure, JobStore, Pool, Structures};
use crate::pipeline::Job;
use crate::single_flight::SingleFlight;
use crate::store::{Namespace, Secret, Store};
use crate::surface::{CancelToken, Control, FoundDevice};
use crate::telemetry::Tracer;

/// Cancels the work when its request ends.
struct CancelOnDrop(CancelToken);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// State of the service.
pub(super) struct App {
    pub(super) config: Config,
    pub(super) access: Arc<Access>,
    pub(super) pool: Arc<Pool>,
    pub(super) archive: Archive,
    pub(super) store: Store,
    pub(super) job_store: JobStore,
    /// Secret of the store.
    pub(super) secret: Secret,
    /// Headers of recently requested results.
    pub(super) result_headers: Cache<ContentKey, Arc<HeaderMap>>,
    /// Part of the memory budget for request bodies: the rest is enough to mesh those that were received.
    pub(super) uploads: Budget,
    /// Permits to read structures outside of jobs: one per worker.
    pub(super) readers: Arc<Semaphore>,
    /// Permits of `jobs.concurrent_saves`.
    pub(super) save_permits: Arc<Semaphore>,
    /// Held while a save starts, so that its permit and its entry in `saves` appear together.
    pub(super) save_start: Mutex<()>,
    /// Results that are being stored.
    pub(super) saves: SingleFlight<ContentKey, ()>,
    /// Phase of the shutdown, which ends long answers.
    pub(super) stopping: watch::Receiver<Stop>,
    /// Permits of `jobs.deliveries`.
    pub(super) deliveries: Arc<Semaphore>,
    /// Shares of the clients in `jobs.deliveries`. Stored results that are being sent count as well.
    pub(super) delivery_shares: Arc<ClientShares>,
    /// True if the first mesh was computed, false if it failed; unset before.
    pub(super) first_mesh: OnceLock<bool>,
    /// Health check of the store.
    pub(super) probe: Probe,
    /// Exporter of spans.
    pub(super) tracer: Tracer,
    /// Devices that were found at the start.
    pub(super) found: Vec<FoundDevice>,
    /// Body of `/v1/capabilities` without devices; with devices, which may fail, it is written for each request.
    pub(super) capabilities: Bytes,
}

impl App {
    /// Rejects a job that is invalid regardless of its input.
    pub(super) fn accepts(&self, job: &Job) -> Result<(), Problem> {
        let refused = |error| Failure::Job { error, diagnostics: Vec::new() };
        job.check(&self.config.limits.job()).map_err(|error| refused(error).into())
    }

    /// Returns the namespace of a group of keys. Without keys all clients share the common one.
    pub(super) fn namespace(&self, group: &str) -> Namespace {
        if self.access.has_keys() { Namespace::of_group(&self.secret, group) } else { Namespace::default() }
    }

    /// Returns the structures that are kept in memory.
    pub(super) fn structures(&self) -> Arc<Structures> {
        Arc::clone(&self.pool.settings().structures)
    }

    /// Runs `work`, which reads a structure, on a blocking thread. Waits for a permit first; `jobs.deadline_ms` limits
    /// both together. If the request ends earlier, the work is cancelled; permit and memory are released when it has
    /// stopped.
    pub(super) async fn read<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Control<'_>) -> T + Send + 'static,
    ) -> Result<T, Failure> {
        let limit = Duration::from_millis(self.config.jobs.deadline_ms);
        let end = Instant::now() + limit;
        let late = |_elapsed| Failure::Deadline { limit };
        let panicked = |message: String| Failure::Panicked { message };
        let permit = timeout_at(end, Arc::clone(&self.readers).acquire_owned()).await.map_err(late)?;
        let permit = permit.map_err(|closed| panicked(closed.to_string()))?;
        let stop = CancelOnDrop(CancelToken::default());
        let reading = tokio::task::spawn_blocking({
            let (cancel, lease) = (stop.0.clone(), self.pool.settings().budget.lease());
            move || {
                let control =
                    Control { cancel, deadline: Some(end.into_std()), memory: Arc::new(lease), ..Control::default() };
                let value = work(&control);
                drop((control, permit));
                value
            }
        });
        timeout_at(end, reading).await.map_err(late)?.map_err(|error| panicked(error.to_string()))
    }

    /// Takes a place for one request for a mesh.
    pub(super) fn delivery(&self, client: Client) -> Result<Delivery, Problem> {
        let permit = Arc::clone(&self.deliveries).try_acquire_owned().map_err(|_full| {
            let limit = self.config.jobs.deliveries;
            Problem::new(
                Kind::TooManyDeliveries,
                format!("{limit} meshes are being computed or sent, which is the limit"),
            )
            .with("limit", limit)
            .retry_after(self.pool.estimated_wait())
        })?;
        Ok(Delivery { _permit: permit, _share: self.delivery_shares.take(client.0)? })
    }
}

/// Place of a request in `jobs.deliveries`, and in the share of its client.
pub(super) struct Delivery {
    _permit: OwnedSemaphorePermit,
    _share: Place,
}

/// State as handlers extract it.
pub(super) type Shared = Arc<App>;
