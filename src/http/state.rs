//! What the handlers share.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use quick_cache::sync::Cache;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::kinds::Kind;
use super::probe::Probe;
use super::problem::Problem;
use super::results::Head;
use super::stop::Stop;
use crate::access::Access;
use crate::archive::Archive;
use crate::config::Config;
use crate::jobs::{ContentKey, Failure, Ledger, Pool};
use crate::pipeline::Job;
use crate::store::Store;
use crate::surface::FoundDevice;
use crate::telemetry::Tracer;

/// State of the service, behind one pointer.
pub(super) struct App {
    pub(super) config: Config,
    pub(super) access: Arc<Access>,
    pub(super) pool: Arc<Pool>,
    pub(super) archive: Archive,
    pub(super) store: Store,
    pub(super) ledger: Ledger,
    /// Headers of results that were asked for lately.
    pub(super) heads: Cache<ContentKey, Arc<Head>>,
    /// Places for results that are kept beside their answers: see `jobs.keepers`.
    pub(super) keepers: Arc<Semaphore>,
    /// Results that are being kept at this moment; their receivers hang up when it is over.
    pub(super) keeping: Mutex<HashMap<ContentKey, watch::Receiver<()>>>,
    /// How far the service's end has come: long answers end with it.
    pub(super) stopping: watch::Receiver<Stop>,
    /// Places for requests for meshes: see `jobs.deliveries`.
    pub(super) deliveries: Arc<Semaphore>,
    pub(super) readiness: Readiness,
    /// Whether the store works.
    pub(super) probe: Probe,
    /// Where spans go.
    pub(super) tracer: Tracer,
    /// The devices that were found when the service started.
    pub(super) found: Vec<FoundDevice>,
    /// The body of `/v1/capabilities`, which changes only where devices can fail: with devices it is written anew.
    pub(super) capabilities: Bytes,
}

impl App {
    /// Refuses what can be refused before anything is read.
    pub(super) fn accepts(&self, job: &Job) -> Result<(), Problem> {
        let refused = |error| Failure::Job { error, diagnostics: Vec::new() };
        job.check(&self.config.limits.job()).map_err(|error| refused(error).into())
    }

    /// A place for one request for a mesh.
    pub(super) fn delivery(&self) -> Result<OwnedSemaphorePermit, Problem> {
        Arc::clone(&self.deliveries).try_acquire_owned().map_err(|_full| {
            let limit = self.config.jobs.deliveries;
            Problem::new(Kind::TooManyDeliveries, format!("{limit} meshes are being made or sent, which is the limit"))
                .with("limit", limit)
                .retry_after(self.pool.estimated_wait())
        })
    }
}

/// What handlers extract.
pub(super) type Shared = Arc<App>;

/// Whether requests should come here, as far as the process itself knows.
#[derive(Debug, Default)]
pub(super) struct Readiness {
    warm: AtomicU8,
    ending: AtomicBool,
}

/// How the first mesh went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Warm {
    /// It is being computed.
    Warming = 0,
    Yes = 1,
    /// It could not be computed.
    Broken = 2,
}

impl Readiness {
    pub(super) fn warm(&self) -> Warm {
        match self.warm.load(Ordering::Relaxed) {
            0 => Warm::Warming,
            1 => Warm::Yes,
            _ => Warm::Broken,
        }
    }

    /// Notes how the first mesh went.
    pub(super) fn set(&self, warm: Warm) {
        self.warm.store(warm as u8, Ordering::Relaxed);
    }

    /// Whether the service has been told to stop.
    pub(super) fn is_ending(&self) -> bool {
        self.ending.load(Ordering::Relaxed)
    }

    /// The service has been told to stop. That is final.
    pub(super) fn end(&self) {
        self.ending.store(true, Ordering::Relaxed);
    }
}
