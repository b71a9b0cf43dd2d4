//! State of the service that the handlers share.

use std::sync::{Arc, Mutex, OnceLock};

use axum::http::HeaderMap;
use bytes::Bytes;
use quick_cache::sync::Cache;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::problem::Problem;
use super::problem_types::ProblemType;
use super::stop::Stop;
use super::store_health::StoreHealth;
use crate::access::Access;
use crate::archive::Archive;
use crate::client_shares::{ClientShares, SharePermit};
use crate::config::Config;
use crate::jobs::{Budget, Client, ContentKey, Failure, JobStore, Lane, Pool, Structures};
use crate::pipeline::Options;
use crate::readers::Readers;
use crate::single_flight::SingleFlight;
use crate::store::{Namespace, Secret, Store};
use crate::surface::{FoundDevice, MemoryMeter as _};
use crate::telemetry::Tracer;

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
    /// Readers of structures outside of jobs: one per worker.
    pub(super) readers: Readers,
    /// Permits to store results of synchronous requests.
    pub(super) save_permits: Arc<Semaphore>,
    /// Held while a save starts, so that its permit and its entry in `saves` appear together.
    pub(super) save_start: Mutex<()>,
    /// Results that are being stored.
    pub(super) saves: SingleFlight<ContentKey, ()>,
    /// Phase of the shutdown, which ends long responses.
    pub(super) stopping: watch::Receiver<Stop>,
    /// Permits for requests for meshes.
    pub(super) deliveries: Arc<Semaphore>,
    /// Shares of the clients in these permits. Stored results that are being sent count as well.
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
    /// Rejects options that are invalid regardless of the input.
    pub(super) fn check_options(&self, options: &Options) -> Result<(), Problem> {
        options.check(&self.config.limits.job()).map_err(Failure::from)?;
        Ok(self.pool.settings().budget.reservation().check(options.picture.map_or(0, |picture| picture.bytes()))?)
    }

    /// Returns the namespace of a group of keys. Without keys all clients share the common one.
    pub(super) fn namespace(&self, group: &str) -> Namespace {
        if self.access.has_keys() { Namespace::from_group(&self.secret, group) } else { Namespace::default() }
    }

    /// Returns the structures that are kept in memory.
    pub(super) fn structures(&self) -> Arc<Structures> {
        Arc::clone(&self.pool.settings().structures)
    }

    /// Returns the memory budget for the requests of a client.
    pub(super) fn memory(&self, client: Client) -> Budget {
        self.pool.settings().budget.for_client(client.0)
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
            .retry_after(self.pool.estimated_wait(Lane::Short))
        })?;
        Ok(Delivery { _permit: permit, _share: self.delivery_shares.take(client.0)? })
    }
}

/// Delivery slot: permit of a request for a mesh, and its slot in the share of its client.
pub(super) struct Delivery {
    _permit: OwnedSemaphorePermit,
    _share: SharePermit,
}

/// State as handlers extract it.
pub(super) type Shared = Arc<App>;
