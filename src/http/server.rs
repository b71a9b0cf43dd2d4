//! The server: binds its listeners, warms the backend up, serves until it is told to stop, drains.

use std::future::Future;
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime};

use quick_cache::sync::Cache;
use thiserror::Error;
use tokio::sync::{Semaphore, watch};

use super::problem::Problem;
use super::state::{App, Readiness, Ready, Shared};
use super::{accept, capabilities, metrics, router};
use crate::archive::Archive;
use crate::config::Config;
use crate::jobs::{Budget, EndError, Ledger, LedgerSettings, Pool, Settings};
use crate::store::{Store, StoreError};
use crate::surface::{Backend, FoundDevice};
use crate::telemetry::{self, Exporter, TelemetryError};

/// How often the recorder tidies up its histograms.
const UPKEEP: std::time::Duration = std::time::Duration::from_secs(5);

/// How often the store is tidied.
const SWEEP: std::time::Duration = std::time::Duration::from_mins(1);
/// Between two attempts to list the jobs of earlier processes.
const RECOVER_PAUSE: std::time::Duration = std::time::Duration::from_secs(5);
/// Results whose headers are kept at hand: a kilobyte each.
const HEADS: usize = 4096;

/// Time for a job to notice that it was cancelled.
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
    stop: watch::Sender<bool>,
    exporter: Option<Exporter>,
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
    /// Binds the listeners, opens the store and starts the workers. Must be called on the runtime that [`Self::run`] is.
    ///
    /// # Errors
    /// [`ServeError`].
    pub async fn bind(config: Config, chosen: Chosen) -> Result<Self, ServeError> {
        let Chosen { backend, reason, devices: found } = chosen;
        let (listener, addr) = listen("server.listen", config.server.listen)?;
        let metrics = config.server.metrics_listen.map(|addr| listen("server.metrics_listen", addr)).transpose()?;
        let (metrics_listener, metrics_addr) = metrics.unzip();
        // Before anything is counted; what nobody can read is not.
        if metrics_listener.is_some() {
            telemetry::recorder()?;
        }
        let (tracer, exporter) = Exporter::start(&config.telemetry);
        let settings = Settings {
            workers: config.jobs.workers.max(config.devices.jobs * backend.devices().len()),
            queue: config.jobs.queue,
            limits: config.limits.job(),
            budget: Budget::new(config.limits.memory_bytes),
            tracer: tracer.clone(),
        };
        let store = Store::open(&config.store, &config.server.data_dir).await?;
        let pool = Arc::new(Pool::start(settings, backend, reason).map_err(ServeError::Workers)?);
        let promises = LedgerSettings {
            allowed: config.jobs.batch_deadline(),
            attempts: config.jobs.attempts,
            output_bytes: config.limits.output_bytes,
        };
        let describe = |error: &EndError| Problem::from(error.clone()).record();
        let ledger = Ledger::new(store.clone(), Arc::clone(&pool), promises, describe);
        let archive = Archive::new(&config);
        let capabilities = capabilities::document(&config, &pool, &found);
        let deliveries = Arc::new(Semaphore::new(config.jobs.deliveries));
        let readiness = Readiness::default();
        let keepers = Arc::new(Semaphore::new(config.jobs.keepers));
        let (stop, stopping) = watch::channel(false);
        let app = Arc::new(App {
            config,
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
            tracer,
            found,
            capabilities,
        });
        Ok(Self { app, listener, metrics_listener, addr, metrics_addr, stop, exporter })
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

    /// Serves until `shutdown` is done, then lets running requests finish, for the drain timeout at most. Must run
    /// on a tokio runtime with timers and several threads. True if every request was finished.
    ///
    /// # Errors
    /// [`ServeError`].
    pub async fn run(self, shutdown: impl Future<Output = ()>) -> Result<bool, ServeError> {
        let (stop, stopped) = (self.stop, self.app.stopping.clone());
        let config = Arc::new(self.app.config.server.clone());
        let warming = tokio::task::spawn_blocking({
            let app = Arc::clone(&self.app);
            move || warm_up(&app)
        });
        let recovering = tokio::spawn({
            let ledger = self.app.ledger.clone();
            async move { recover(&ledger).await }
        });
        let sweeping = tokio::spawn({
            let store = self.app.store.clone();
            async move {
                loop {
                    tokio::time::sleep(SWEEP).await;
                    store.sweep(SystemTime::now()).await;
                }
            }
        });
        let listener = tokio_listener("server.listen", self.addr, self.listener)?;
        let service = router::router(Arc::clone(&self.app));
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
                recorder.iter().for_each(telemetry::Recorder::run_upkeep);
            }
        });
        shutdown.await;
        tracing::info!("stopping: running requests are finished, new ones are refused");
        self.app.readiness.set(Ready::ShuttingDown);
        let deadline = Instant::now() + self.app.config.server.drain_timeout();
        stop.send_replace(true);
        // Requests whose bodies are still under way may still submit their jobs; after the last one nothing can.
        let requests = serving.await.unwrap_or(false);
        let jobs = self.app.pool.drain(deadline.max(Instant::now() + CANCELLING)).await;
        for task in [upkeep, warming, recovering, sweeping] {
            task.abort();
        }
        if let Some(metrics) = metrics {
            metrics.abort();
        }
        if let Some(exporter) = self.exporter {
            exporter.finish().await;
        }
        let drained = jobs && requests;
        tracing::info!(drained, "stopped");
        Ok(drained)
    }
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
            app.readiness.set(Ready::Yes);
        }
        Ok(Err(error)) => {
            tracing::error!(%error, backend = backend.name(), "the first mesh failed");
            app.readiness.set(Ready::Broken);
        }
        Err(_payload) => {
            tracing::error!(backend = backend.name(), "the first mesh panicked");
            app.readiness.set(Ready::Broken);
        }
    }
}

/// Done on the first SIGTERM, or SIGINT (Ctrl-C).
pub async fn shutdown_signal() {
    let interrupt = async {
        if let Err(error) = tokio::signal::ctrl_c().await {
            tracing::warn!(%error, "cannot listen for Ctrl-C");
            std::future::pending::<()>().await;
        }
    };
    #[cfg(unix)]
    let terminate = async {
        match tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate()) {
            Ok(mut signal) => drop(signal.recv().await),
            Err(error) => {
                tracing::warn!(%error, "cannot listen for SIGTERM");
                std::future::pending::<()>().await;
            }
        }
    };
    #[cfg(not(unix))]
    let terminate = std::future::pending::<()>();
    tokio::select! {
        () = interrupt => {}
        () = terminate => {}
    }
}
