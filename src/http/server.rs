//! The server: binds its listeners, warms up the backend, serves, and shuts down.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use futures_util::FutureExt as _;
use quick_cache::sync::Cache;
use thiserror::Error;
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;

use super::problem::Problem;
use super::state::{App, Shared};
use super::stop::{self, Stop};
use super::store_health::StoreHealth;
use super::wind_down::{Stopped, wind_down};
use super::{accept, capabilities, key_reload, metrics, router};
use crate::access::{Access, AccessError, Sites};
use crate::archive::Archive;
use crate::client_shares::ClientShares;
use crate::config::{Config, JOBS_PER_DEVICE, Role};
use crate::jobs::{
    Broker, Client, EndError, JobStore, MemoryBroker, NatsBroker, Pool, ScratchSpace, Settings, Structures,
};
use crate::memory_budget::Budget;
use crate::pipeline::SelectedBackend;
use crate::single_flight::SingleFlight;
use crate::store::{Digest, FolderLock, LockError, Secret, Store, StoreError, derive};
use crate::telemetry::{self, Recorder, TelemetryError, Traces};

/// Interval of metrics upkeep.
const UPKEEP: Duration = Duration::from_secs(5);

/// Interval at which the state of the broker is read.
const BROKER_CHECK: Duration = Duration::from_secs(1);
/// Interval at which jobs that the broker has lost are dispatched again.
const RECONCILE: Duration = Duration::from_mins(1);
/// Pause after a failed attempt to read the records of jobs.
const RETRY: Duration = Duration::from_secs(1);

/// Number of results whose headers are cached, about 2 KB each.
const CACHED_HEADERS: usize = 1024;

/// Error of a server that cannot start.
#[derive(Debug, Error)]
pub enum ServeError {
    /// An address cannot be listened on.
    #[error("cannot listen on {addr} ({key}): {error}")]
    Listen {
        /// Configuration key of the address.
        key: &'static str,
        /// Address.
        addr: SocketAddr,
        /// Error of the operating system.
        error: io::Error,
    },
    /// A worker thread cannot be started.
    #[error("cannot start the worker threads: {0}")]
    Workers(io::Error),
    /// Keys, signatures or quotas cannot be set up.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// The data folder is in use or cannot be locked.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// The address or the credentials of the broker are malformed.
    #[error("cannot use the broker (broker.url): {0}")]
    Broker(String),
    /// The store cannot be opened.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Metrics cannot be set up.
    #[error(transparent)]
    Telemetry(#[from] TelemetryError),
}

/// A server with bound listeners and running workers.
pub struct Server {
    app: Shared,
    listener: TcpListener,
    addr: SocketAddr,
    /// Listener of `/metrics` with its address.
    metrics_listener: Option<(TcpListener, SocketAddr)>,
    stop: watch::Sender<Stop>,
    traces: Traces,
    /// Lock of the data folder.
    data: FolderLock,
}

async fn listen(key: &'static str, addr: SocketAddr) -> Result<(TcpListener, SocketAddr), ServeError> {
    let failed = |error| ServeError::Listen { key, addr, error };
    let listener = TcpListener::bind(addr).await.map_err(failed)?;
    let bound = listener.local_addr().map_err(failed)?;
    Ok((listener, bound))
}

impl Server {
    /// Binds the listeners, locks the data folder, opens the store and starts the workers. Must be called on the
    /// runtime that [`Self::run`] runs on.
    ///
    /// # Errors
    /// [`ServeError`].
    pub async fn bind(config: Config, selected: SelectedBackend) -> Result<Self, ServeError> {
        let SelectedBackend { backend, reason, renderer, devices: found, .. } = selected;
        let access = Arc::new(Access::open(&config)?);
        if access.sites.lacks_origins() {
            tracing::warn!("pages of other origins are rejected: set access.cors_origins to their origins, or to none");
        }
        let (listener, addr) = listen("server.listen", config.server.listen).await?;
        let metrics_listener = match config.server.metrics_listen {
            Some(addr) => Some(listen("server.metrics_listen", addr).await?),
            None => None,
        };
        let data = FolderLock::acquire(&config.server.data_dir, addr)?;
        // Before any metric is recorded. Without a listener none is.
        if metrics_listener.is_some() {
            telemetry::recorder()?;
        }
        let traces = Traces::start(&config.telemetry)?;
        let budget = accept::budget(config.limits.memory_bytes, config.server.client_share);
        let scratch_bytes = config.limits.scratch_bytes;
        let scratch = (scratch_bytes > 0)
            .then(|| ScratchSpace::new(&config.server.data_dir, scratch_bytes, config.server.client_share));
        let settings = Settings {
            workers: config.jobs.workers.max(JOBS_PER_DEVICE * backend.devices().len()),
            queue: config.jobs.queue,
            limits: config.limits.job(),
            structures: Structures::new(config.limits.structure_cache_bytes, &budget, scratch),
            budget,
            renderer,
            meter: Some(Arc::new({
                let access = Arc::clone(&access);
                move |client: Client, time| access.meter.spent(client.0, time, Instant::now())
            })),
            tracer: traces.tracer(),
        };
        let store = Store::open_for(&config.store, &config.server.data_dir, config.broker.url.is_some()).await?;
        let secret = store.secret().await?;
        let pool = Arc::new(Pool::start(settings, backend, reason).map_err(ServeError::Workers)?);
        let job_store = open_jobs(&config, &store, &pool, secret).await?;
        ::metrics::gauge!(telemetry::MEMORY_LIMIT).set(config.limits.memory_bytes as f64);
        let archive = Archive::new(&config, pool.settings().budget.clone());
        let capabilities = capabilities::document(&config, &pool, &found);
        let deliveries = Arc::new(Semaphore::new(config.jobs.deliveries));
        let uploads = pool.settings().budget.part(config.limits.memory_bytes / 2);
        let readers = archive.readers();
        let delivery_shares = ClientShares::new(config.jobs.deliveries, config.server.client_share);
        let save_permits = Arc::new(Semaphore::new(config.jobs.concurrent_saves));
        let (stop, stopping) = watch::channel(Stop::Serve);
        let app = Arc::new(App {
            config,
            access,
            pool,
            archive,
            store,
            job_store,
            secret,
            result_headers: Cache::new(CACHED_HEADERS),
            uploads,
            readers,
            save_permits,
            save_start: Mutex::new(()),
            saves: SingleFlight::default(),
            stopping,
            deliveries,
            delivery_shares,
            first_mesh: OnceLock::new(),
            store_health: StoreHealth::new(),
            tracer: traces.tracer(),
            found,
            capabilities,
        });
        Ok(Self { app, listener, addr, metrics_listener, stop, traces, data })
    }

    /// Returns the address of the service.
    #[must_use]
    pub fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Returns the address of `/metrics`, if it is served.
    #[must_use]
    pub fn metrics_addr(&self) -> Option<SocketAddr> {
        self.metrics_listener.as_ref().map(|(_, addr)| *addr)
    }

    /// Serves until `orders` requests a stop, then shuts down in the phases of [`Stop`]: `server.termination_notice_ms`
    /// for [`Stop::Notice`], `server.drain_timeout_ms` for [`Stop::Drain`], one second for cancelled work. A further
    /// order during the drain cuts it short. Must run on a tokio runtime with timers and several threads. Unfinished
    /// durable jobs return to the queue.
    ///
    /// # Errors
    /// [`ServeError`].
    pub async fn run(self, mut orders: watch::Receiver<Stop>) -> Result<Stopped, ServeError> {
        let (stop, stopped) = (self.stop, self.app.stopping.clone());
        let config = Arc::new(self.app.config.server.clone());
        // Dropping the set aborts its tasks.
        let mut background = JoinSet::new();
        background.spawn(key_reload::run(Arc::clone(&self.app.access)));
        let app = Arc::clone(&self.app);
        background.spawn_blocking(move || warm_up(&app));
        background.spawn(dispatch_jobs(self.app.job_store.clone(), self.app.config.server.role != Role::Api));
        background.spawn(sweep(Arc::clone(&self.app)));
        let (router, budget) = (router::router(&self.app), self.app.pool.settings().budget.clone());
        let serving = accept::serve(self.listener, router, Arc::clone(&config), budget, stopped.clone());
        let serving = tokio::spawn(serving);
        let mut recorder = None;
        if let Some((listener, address)) = self.metrics_listener {
            let process_recorder = telemetry::recorder()?;
            let router = metrics::router(process_recorder.clone(), Sites::for_metrics(&self.app.config, address));
            background.spawn(accept::serve(listener, router, config, Budget::unlimited(), stopped).map(drop));
            recorder = Some(process_recorder);
        }
        background.spawn(publish(Arc::clone(&self.app), recorder));
        stop::reached(&mut orders, Stop::Notice).await;
        let result = wind_down(&self.app, &stop, &mut orders, serving).await;
        drop(background);
        self.traces.shut_down().await;
        drop(self.data);
        Ok(result)
    }
}

/// Creates the job store. Reads no record of a job.
async fn open_jobs(config: &Config, store: &Store, pool: &Arc<Pool>, secret: Secret) -> Result<JobStore, ServeError> {
    let describe = |error: &EndError| Problem::from(error.clone()).record("");
    let (jobs, output_bytes) = (config.jobs.clone(), config.limits.output_bytes);
    let broker: Arc<dyn Broker> = match &config.broker.url {
        Some(url) => {
            // Identifies the store without revealing its secret.
            let id = Digest::of(&derive(&secret, "store")).to_string();
            Arc::new(NatsBroker::connect(&config.broker, url, &id).await.map_err(ServeError::Broker)?)
        }
        None => Arc::new(MemoryBroker::new(config.broker.queue)),
    };
    Ok(JobStore::new(store.clone(), Arc::clone(pool), broker, jobs, output_bytes, secret, describe))
}

/// Publishes the gauges that no event updates.
async fn publish(app: Shared, recorder: Option<Recorder>) {
    loop {
        tokio::time::sleep(UPKEEP).await;
        app.pool.publish();
        key_reload::publish_clients(&app.access);
        recorder.iter().for_each(Recorder::run_upkeep);
    }
}

/// Reads the records of unfinished jobs, claims jobs if `claims`, and dispatches jobs that the broker has lost, at
/// regular intervals.
async fn dispatch_jobs(jobs: JobStore, claims: bool) {
    // Also without the broker, because requests wait for the records.
    while !jobs.has_read_records() {
        match jobs.reconcile().await {
            Ok(0) => {}
            Ok(recovered) => tracing::info!(jobs = recovered, "dispatched jobs of an earlier process"),
            Err(error) => {
                tracing::warn!(%error, "the records of jobs were not read");
                tokio::time::sleep(RETRY).await;
            }
        }
    }
    if claims {
        jobs.start_claiming();
    }
    loop {
        while jobs.broker().down().is_some() {
            tokio::time::sleep(BROKER_CHECK).await;
        }
        let losses = jobs.broker().losses();
        let pause = match jobs.reconcile().await {
            Ok(0) => RECONCILE,
            Ok(dispatched) => {
                tracing::warn!(jobs = dispatched, "dispatched jobs that the broker did not have");
                RECONCILE
            }
            // The inputs of jobs whose records were not read are not protected.
            Err(error) => {
                tracing::warn!(%error, "the records of jobs were not read");
                RETRY
            }
        };
        let end = tokio::time::Instant::now() + pause;
        let may_lack_jobs = || jobs.broker().down().is_some() || jobs.broker().losses() != losses;
        while tokio::time::Instant::now() < end && !may_lack_jobs() {
            tokio::time::sleep(BROKER_CHECK).await;
        }
    }
}

/// Removes expired objects of the store at regular intervals, once the inputs of unfinished jobs are protected.
async fn sweep(app: Shared) {
    let interval = Duration::from_millis(app.config.store.sweep_ms);
    loop {
        tokio::time::sleep(interval).await;
        if app.job_store.has_read_records() {
            app.store.sweep(app.store.now()).await;
        }
    }
}

/// Computes a tiny first mesh on every device, or on the CPU without devices.
fn warm_up(app: &App) {
    let start = Instant::now();
    let backend = Arc::clone(app.pool.backend());
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| backend.warm_up()));
    app.pool.publish();
    let succeeded = match result {
        Ok(Ok(())) => {
            let ms = start.elapsed().as_secs_f64() * 1e3;
            let (device, reason) = (backend.describe(), app.pool.reason());
            tracing::info!(ms, backend = backend.name(), device, reason, "ready");
            true
        }
        Ok(Err(error)) => {
            tracing::error!(%error, backend = backend.name(), "the first mesh failed");
            false
        }
        Err(_payload) => {
            tracing::error!(backend = backend.name(), "the first mesh panicked");
            false
        }
    };
    app.first_mesh.get_or_init(|| succeeded);
}
