//! What the handlers share.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use quick_cache::sync::Cache;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::kinds::Kind;
use super::problem::Problem;
use super::results::Head;
use crate::archive::Archive;
use crate::config::Config;
use crate::jobs::{ContentKey, Ledger, Pool};
use crate::store::Store;
use crate::surface::FoundDevice;
use crate::telemetry::Tracer;

/// State of the service, behind one pointer.
pub(super) struct App {
    pub(super) config: Config,
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
    /// Turns true when the service ends: long answers end with it.
    pub(super) stopping: watch::Receiver<bool>,
    /// Places for requests for meshes: see `jobs.deliveries`.
    pub(super) deliveries: Arc<Semaphore>,
    pub(super) readiness: Readiness,
    /// Where spans go.
    pub(super) tracer: Tracer,
    /// The devices that were found when the service started.
    pub(super) found: Vec<FoundDevice>,
    /// The body of `/v1/capabilities`, which changes only where devices can fail: with devices it is written anew.
    pub(super) capabilities: Bytes,
}

impl App {
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

/// Whether requests should come here.
#[derive(Debug, Default)]
pub(super) struct Readiness(AtomicU8);

/// The answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Ready {
    /// The first mesh is being computed.
    Warming = 0,
    Yes = 1,
    /// The first mesh could not be computed.
    Broken = 2,
    ShuttingDown = 3,
}

impl Readiness {
    pub(super) fn get(&self) -> Ready {
        match self.0.load(Ordering::Relaxed) {
            0 => Ready::Warming,
            1 => Ready::Yes,
            2 => Ready::Broken,
            _ => Ready::ShuttingDown,
        }
    }

    /// Takes the new value unless the service is shutting down, which is final.
    pub(super) fn set(&self, ready: Ready) {
        self.0.fetch_max(ready as u8, Ordering::Relaxed);
    }
}
