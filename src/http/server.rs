//! The server: binds its listeners, warms the backend up, serves until it is told to stop, drains.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime};

use quick_cache::sync::Cache;
use thiserror::Error;
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;

use super::guard::Bill;
use super::probe::Probe;
use super::problem::Problem;
use super::state::{App, Readiness, Shared, Warm};
use super::stop::{self, Stop};
use super::{accept, capabilities, metrics, pdb, renew, router};
use crate::access::{Access, AccessError};
use crate::archive::Archive;
use crate::config::Config;
use crate::jobs::{Budget, EndError, Ledger, LedgerSettings, Pool, Settings};
use crate::picture::Drawer;
use crate::store::{FolderLock, LockError, Store, StoreError};
use crate::surface::{Backend, FoundDevice};
use crate::telemetry::{self, TelemetryError, Traces};

/// How often the recorder tidies up its histograms.
const UPKEEP: std::time::Duration = std::time::Duration::from_secs(5);

/// Between two attempts to list the jobs of earlier processes.
const RECOVER_PAUSE: std::time::Duration = std::time::Duration::from_secs(5);
/// Results whose headers are kept at hand: a kilobyte each.
const HEADS: usize = 4096;

/// Time for jobs to notice that they were cancelled, and for that to be on record.
const CANCELLING: std::time::Duration = std::time::Duration::from_secs(1);

/// Why the server cannot start.
#[derive(Debug, Error)]
pub enum ServeError {
    /// An address cannot be listened on.
    #[error("cannot listen on {addr} ({key}): {error}")]
    Listen {
        /// The key of the configuration that says the address.
        key: &'static str,
        /// The address.
        addr: SocketAddr,
        /// The system's words.
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
    /// What the service keeps cannot be kept.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Metrics cannot be set up.
    #[error(transparent)]
    Telemetry(#[from] TelemetryError),
}

/// What the service computes with, and why.
pub struct Chosen {
    /// The backend.
    pub backend: Arc<dyn Backend>,
    /// Why it was taken.
    pub reason: String,
    /// What draws pictures, and why.
    pub drawer: Drawer,
    /// Every device that was found, taken or not.
    pub devices: Vec<FoundDevice>,
}

/// A server whose listeners are bound and whose workers run.
pub struct Server {
    app: Shared,
    listener: TcpListener,
    metrics_listener: Option<TcpListener>,
    addr: SocketAddr,
    metrics_addr: Option<SocketAddr>,
    stop: watch::Sender<Stop>,
    traces: Traces,
    /// Held until the service has ended.
    data: FolderLock,
}

fn listen(key: &'static str, addr: SocketAddr) -> Result<(TcpListener, SocketAddr), ServeError> {
    let bind = || {
        let listener = TcpListener::bind(addr)?;
        listener.set_nonblocking(true)?;
        let bound = listener.local_addr()?;
        Ok((listener, bound))
    };
    bind().map_err(|error| ServeError::Listen { key, addr, error })
}

impl Server {
    /// Binds the listeners, locks the data folder, opens the store and starts the workers. Must be called on the
    /// runtime that [`Self::run`] is.
    ///
    /// # Errors
    /// [`ServeError`].
    pub async fn bind(config: Config, chosen: Chosen) -> Result<Self, ServeError> {
        let Chosen { backend, reason, drawer, devices: found } = chosen;
        let access = Arc::new(Access::open(&config)?);
        let (listener, addr) = listen("server.listen", config.server.listen)?;
        let metrics = config.server.metrics_listen.map(|addr| listen("server.metrics_listen", addr)).transpose()?;
        let (metrics_listener, metrics_addr) = metrics.unzip();
        let data = FolderLock::acquire(&config.server.data_dir, addr)?;
        // Before anything is counted; what nobody can read is not.
        if metrics_listener.is_some() {
            telemetry::recorder()?;
        }
        let traces = Traces::start(&config.telemetry)?;
        let settings = Settings {
            workers: config.jobs.workers.max(config.devices.jobs * backend.devices().len()),
            queue: config.jobs.queue,
            patience: config.jobs.patience(),
            limits: config.limits.job(),
            budget: Budget::new(config.limits.memory_bytes),
            drawer,
            meter: Some(Arc::new(Bill(Arc::clone(&access)))),
            tracer: traces.tracer(),
        };
        let store = Store::open(&config.store, &config.server.data_dir).await?;
        let secret = store.secret().await?;
        let pool = Arc::new(Pool::start(settings, backend, reason).map_err(ServeError::Workers)?);
        let promises = LedgerSettings {
            allowed: config.jobs.batch_deadline(),
            attempts: config.jobs.attempts,
            output_bytes: config.limits.output_bytes,
            patience: config.jobs.store_patience(),
        };
        let describe = |error: &EndError| Problem::from(error.clone()).record();
        let ledger = Ledger::new(store.clone(), Arc::clone(&pool), promises, secret, describe);
        let archive = Archive::new(&config, Arc::new(pdb::Fetching(pool.budget().clone())));
        let capabilities = capabilities::document(&config, &pool, &found);
        let deliveries = Arc::new(Semaphore::new(config.jobs.deliveries));
        let readiness = Readiness::default();
        let keepers = Arc::new(Semaphore::new(config.jobs.keepers));
        let (stop, stopping) = watch::channel(Stop::Serve);
        let app = Arc::new(App {
            config,
            access,
            pool,
            archive,
            store,
            ledger,
            heads: Cache::new(HEADS),
            keepers,
            keeping: Mutex::default(),
            stopping,
            deliveries,
            readiness,
            probe: Probe::new(),
            tracer: traces.tracer(),
            found,
            capabilities,
        });
        Ok(Self { app, listener, metrics_listener, addr, metrics_addr, stop, traces, data })
    }

    /// Address of the service.
    #[must_use]
    pub fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Address of `/metrics`, if it is served.
    #[must_use]
    pub fn metrics_addr(&self) -> Option<SocketAddr> {
        self.metrics_addr
    }

    /// Serves until `orders` say otherwise, then ends step by step as [`Stop`] says: `server.notice_ms` for
    /// [`Stop::Notice`], `server.drain_timeout_ms` for [`Stop::Drain`], a second for what is cancelled. Whatever is ordered
    /// while it drains, once the notice is over by itself or by order, cuts it short. Must run on a tokio
    /// runtime with timers and several threads. True if every request was finished; promised jobs that were not are left
    /// for the next start.
    ///
    /// # Errors
    /// [`ServeError`].
    pub async fn run(self, mut orders: watch::Receiver<Stop>) -> Result<bool, ServeError> {
        let (stop, stopped) = (self.stop, self.app.stopping.clone());
        let config = Arc::new(self.app.config.server.clone());
        let renewing = tokio::spawn(renew::keys(Arc::clone(&self.app.access)));
        let warming = tokio::task::spawn_blocking({
            let app = Arc::clone(&self.app);
            move || warm_up(&app)
        });
        let recovering = tokio::spawn({
            let ledger = self.app.ledger.clone();
            async move { recover(&ledger).await }
        });
        let sweeping = tokio::spawn({
            let (store, every) = (self.app.store.clone(), self.app.config.store.sweep());
            async move {
                loop {
                    tokio::time::sleep(every).await;
                    store.sweep(SystemTime::now()).await;
                }
            }
        });
        let listener = tokio_listener("server.listen", self.addr, self.listener)?;
        let service = router::router(&self.app);
        let serving = tokio::spawn(accept::serve(listener, service, Arc::clone(&config), stopped.clone()));
        let metrics = match self.metrics_listener.zip(self.metrics_addr) {
            Some((listener, addr)) => {
                let listener = tokio_listener("server.metrics_listen", addr, listener)?;
                let router = metrics::router(telemetry::recorder()?);
                Some(tokio::spawn(accept::serve(listener, router, config, stopped)))
            }
            None => None,
        };
        let watched = Arc::clone(&self.app);
        let recorder = self.metrics_addr.map(|_| telemetry::recorder()).transpose()?;
        let upkeep = tokio::spawn(async move {
            loop {
                tokio::time::sleep(UPKEEP).await;
                watched.pool.publish();
                renew::tell(&watched.access);
                recorder.iter().for_each(telemetry::Recorder::run_upkeep);
            }
        });
        stop::reached(&mut orders, Stop::Notice).await;
        let requests = wind_down(&self.app, &stop, &mut orders, serving).await;
        for task in [upkeep, warming, recovering, sweeping, renewing] {
            task.abort();
        }
        if let Some(metrics) = metrics {
            metrics.abort();
        }
        self.traces.shut_down().await;
        drop(self.data);
        Ok(requests)
    }
}

/// Ends the service step by step, as far as `orders` say. True if every request was finished.
async fn wind_down(
    app: &Shared,
    stop: &watch::Sender<Stop>,
    orders: &mut watch::Receiver<Stop>,
    mut serving: JoinHandle<bool>,
) -> bool {
    app.readiness.end();
    let notice = app.config.server.notice();
    if orders.has_changed().is_ok() && *orders.borrow() == Stop::Notice && !notice.is_zero() {
        stop.send_replace(Stop::Notice);
        tracing::info!(notice_ms = notice.as_millis(), "not ready any more; everything is served for a while");
        drop(tokio::time::timeout(notice, stop::reached(orders, Stop::Drain)).await);
    }
    tracing::info!("stopping: what has begun is finished, nothing new is accepted");
    let end = tokio::time::Instant::now() + app.config.server.drain_timeout();
    // Whatever is ordered from now on is an order more.
    orders.borrow_and_update();
    app.pool.leave();
    stop.send_replace(Stop::Drain);
    let cut = async {
        tokio::select! {
            () = tokio::time::sleep_until(end) => {}
            () = stop::further(orders) => {}
        }
        stop.send_replace(Stop::Now);
    };
    tokio::pin!(cut);
    // Requests whose bodies are still under way may still submit their jobs; after the last one nothing can.
    let served = tokio::select! {
        served = &mut serving => Some(served),
        () = cut.as_mut() => None,
    };
    let (requests, jobs) = match served {
        Some(served) => (served.unwrap_or(false), app.pool.drain(cut).await),
        None => (serving.await.unwrap_or(false), app.pool.drain(std::future::ready(())).await),
    };
    // Endings of promised jobs go on record, and results that are on their way into the store arrive.
    let ends = async { tokio::join!(app.ledger.settled(), app.all_kept()) };
    let settled = tokio::time::timeout(CANCELLING, ends).await.is_ok();
    tracing::info!(requests, jobs, settled, "stopped");
    requests
}

fn tokio_listener(
    key: &'static str,
    addr: SocketAddr,
    listener: TcpListener,
) -> Result<tokio::net::TcpListener, ServeError> {
    tokio::net::TcpListener::from_std(listener).map_err(|error| ServeError::Listen { key, addr, error })
}

/// Takes up what earlier processes left undone; tries again while the store does not answer.
async fn recover(ledger: &Ledger) {
    loop {
        match ledger.recover().await {
            Ok(0) => return,
            Ok(jobs) => {
                tracing::info!(jobs, "jobs of an earlier process were taken up again");
                return;
            }
            Err(error) => tracing::error!(%error, "jobs of earlier processes cannot be listed"),
        }
        tokio::time::sleep(RECOVER_PAUSE).await;
    }
}

/// Computes a first, tiny mesh on every device, or on the processor where there is none.
fn warm_up(app: &App) {
    let start = Instant::now();
    let backend = Arc::clone(app.pool.backend());
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| backend.warm()));
    app.pool.publish();
    match result {
        Ok(Ok(())) => {
            let ms = start.elapsed().as_secs_f64() * 1e3;
            let (device, reason) = (backend.describe(), app.pool.reason());
            tracing::info!(ms, backend = backend.name(), device, reason, "ready");
            app.readiness.set(Warm::Yes);
        }
        Ok(Err(error)) => {
            tracing::error!(%error, backend = backend.name(), "the first mesh failed");
            app.readiness.set(Warm::Broken);
        }
        Err(_payload) => {
            tracing::error!(backend = backend.name(), "the first mesh panicked");
            app.readiness.set(Warm::Broken);
        }
    }
}
