//! State of the service that the handlers share.

use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use axum::http::HeaderMap;
use bytes::Bytes;
use quick_cache::sync::Cache;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout_at};

use super::problem::Problem;
use super::problem_types::ProblemType;
use super::stop::Stop;
use super::store_health::StoreHealth;
use crate::access::Access;
use crate::archive::Archive;
use crate::client_shares::{ClientShares, SharePermit};
use crate::config::Config;
use crate::jobs::{Budget, Client, ContentKey, Failure, JobStore, Pool, Structures};
use crate::pipeline::Job;
use crate::reader_line::ReaderLine;
use crate::single_flight::SingleFlight;
use crate::store::{Namespace, Secret, Store};
use crate::surface::{CancelToken, Control, FoundDevice, MemoryMeter as _};
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
    /// Requests that wait for one of `readers`.
    pub(super) reader_line: Arc<ReaderLine>,
    /// Shares of the clients in `readers`.
    pub(super) reader_shares: Arc<ClientShares>,
    /// Permits of `jobs.concurrent_saves`.
    pub(super) save_permits: Arc<Semaphore>,
    /// Held while a save starts, so that its permit and its entry in `saves` appear together.
    pub(super) save_start: Mutex<()>,
    /// Results that are being stored.
    pub(super) saves: SingleFlight<ContentKey, ()>,
    /// Phase of the shutdown, which ends long responses.
    pub(super) stopping: watch::Receiver<Stop>,
    /// Permits of `jobs.deliveries`.
    pub(super) deliveries: Arc<Semaphore>,
    /// Shares of the clients in `jobs.deliveries`. Stored results that are being sent count as well.
    pub(super) delivery_shares: Arc<ClientShares>,
    /// True if the first mesh was computed, false if it failed; unset before.
    pub(super) first_mesh: OnceLock<bool>,
    /// Health check of the store.
    pub(super) store_health: StoreHealth,
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
        job.check(&self.config.limits.job()).map_err(refused)?;
        Ok(self.pool.settings().budget.reservation().check(job.picture.map_or(0, |picture| picture.bytes()))?)
    }

    /// Returns the namespace of a group of keys. Without keys all clients share the common one.
    pub(super) fn namespace(&self, group: &str) -> Namespace {
        if self.access.has_keys() { Namespace::from_group(&self.secret, group) } else { Namespace::default() }
    }

    /// Returns the structures that are kept in memory.
    pub(super) fn structures(&self) -> Arc<Structures> {
        Arc::clone(&self.pool.settings().structures)
    }

    /// Runs `work`, which reads a structure, on a blocking thread. Waits for the share of the client and for a permit
    /// first, at most for half of `jobs.deadline_ms`, which limits all together. A request that would probably wait
    /// longer is refused at once. If the request ends earlier, the work is cancelled; permits,
    /// memory and `held` are released when it has stopped.
    pub(super) async fn read<T: Send + 'static>(
        &self,
        client: Client,
        held: impl Send + 'static,
        work: impl FnOnce(&Control<'_>) -> T + Send + 'static,
    ) -> Result<T, Failure> {
        let limit = Duration::from_millis(self.config.jobs.deadline_ms);
        let end = Instant::now() + limit;
        let late = |_elapsed| Failure::Deadline { limit };
        let panicked = |message: String| Failure::Panicked { message };
        let waited = || Failure::Waited { limit, wait: self.reader_line.estimated_wait() };
        let waiting = self.reader_line.enter(limit / 2).ok_or_else(waited)?;
        let begin_by = Instant::now() + limit / 2;
        // In this order, a client that waits for its share takes no permit of others.
        let share = self.reader_shares.wait(client.0, begin_by).await.map_err(|_full| waited())?;
        let permit = timeout_at(begin_by, Arc::clone(&self.readers).acquire_owned()).await;
        let permit = permit.map_err(|_elapsed| waited())?.map_err(|closed| panicked(closed.to_string()))?;
        let reading_time = waiting.begin();
        let stop = CancelOnDrop(CancelToken::default());
        let (cancel, reservation) = (stop.0.clone(), self.pool.settings().budget.reservation());
        let reading = spawn_holding((held, permit, share, reading_time), move || {
            let control =
                Control { cancel, deadline: Some(end.into_std()), memory: Arc::new(reservation), ..Control::default() };
            work(&control)
        });
        timeout_at(end, reading).await.map_err(late)?.map_err(|error| panicked(error.to_string()))
    }

    /// Takes a delivery slot for a request for a mesh.
    pub(super) fn delivery(&self, client: Client) -> Result<Delivery, Problem> {
        let permit = Arc::clone(&self.deliveries).try_acquire_owned().map_err(|_full| {
            let limit = self.config.jobs.deliveries;
            Problem::new(
                ProblemType::TooManyDeliveries,
                format!("{limit} meshes are being computed or sent, which is the limit"),
            )
            .with("limit", limit)
            .retry_after(self.pool.estimated_wait())
        })?;
        Ok(Delivery { _permit: permit, _share: self.delivery_shares.take(client.0)? })
    }
}

/// Runs `work` on a blocking thread. The thread drops `held` after the work, even if the caller has stopped waiting.
fn spawn_holding<T: Send + 'static>(
    held: impl Send + 'static,
    work: impl FnOnce() -> T + Send + 'static,
) -> JoinHandle<T> {
    tokio::task::spawn_blocking(move || {
        let value = work();
        drop(held);
        value
    })
}

/// Delivery slot: slot of a request in `jobs.deliveries`, and in the share of its client.
pub(super) struct Delivery {
    _permit: OwnedSemaphorePermit,
    _share: SharePermit,
}

/// State as handlers extract it.
pub(super) type Shared = Arc<App>;

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 1)]
    async fn a_request_that_ends_early_releases_nothing_before_its_work_has_stopped() {
        let (go, wait) = mpsc::sync_channel::<()>(1);
        let permits = Arc::new(Semaphore::new(1));
        let held = Arc::clone(&permits).acquire_owned().await.unwrap();
        let reading = spawn_holding(held, move || wait.recv().is_ok());
        assert!(tokio::time::timeout(Duration::from_millis(50), reading).await.is_err(), "the request has left");
        assert_eq!(permits.available_permits(), 0);
        go.send(()).unwrap();
        drop(tokio::time::timeout(Duration::from_mins(1), permits.acquire()).await.unwrap().unwrap());
    }
}
