//! The worker pool: a bounded queue in front of one backend, with worker threads of its own, and durable jobs on top.
//!
//! The result of a [`Task`] (a structure and a [`Request`]) is a mesh with its report. Deadlines, cancellation and
//! panics are handled here, so callers only wait for a [`Ticket`]. This module knows no HTTP and no graphics API.
//!
//! `queue` holds `coalesced_job`s: identical requests share one. `job_store` keeps `durable_job`s, whose `records`
//! survive the process. A `batch` is a list of durable jobs.

mod batch;
mod broker;
mod claims;
mod coalesced_job;
mod cost;
mod devices;
mod durable_job;
mod error;
#[cfg(test)]
#[cfg(feature = "shuttle")]
mod interleavings;
mod job_map;
mod job_store;
mod kept;
mod key;
mod listing;
mod pool;
mod queue;
mod rank;
mod record;
mod records;
mod results;
mod retry;
mod runner;
mod runs;
mod scratch;
mod structures;
#[cfg(test)]
mod tests;
mod threads;
mod ticket;
mod worker;

pub(crate) use crate::memory_budget::{Budget, MemoryReservation};
pub(crate) use batch::{BatchFile, BatchRecord, MAX_RECORD_BYTES, Room};
pub use broker::check_broker;
pub(crate) use broker::{Broker, MemoryBroker, NatsBroker};
pub(crate) use coalesced_job::OnStart;
pub(crate) use error::{AcceptError, EndError, Failure, Refusal};
pub(crate) use job_store::{JobSpec, JobStore, JobView};
pub(crate) use kept::{CacheKey, Input, SharedStructure, SharedTileset};
pub(crate) use key::ContentKey;
pub(crate) use listing::{JobCursor, JobFilter, LISTED_BYTES, MAX_READS};
pub(crate) use pool::{Pool, Settings};
pub(crate) use rank::{Client, DEFAULT_URGENCY, Lane, Rank};
pub(crate) use record::{JobId, JobRecord, Status, now_ms, rfc3339};
pub(crate) use results::{REPORT, SaveError, document, is_stored, save};
pub(crate) use scratch::ScratchSpace;
pub(crate) use structures::Structures;
pub(crate) use ticket::Ticket;

use std::sync::Arc;

use bytes::Bytes;

use crate::pipeline::Product;
use crate::pipeline::params::Request;
use crate::store::{Digest, Namespace};
use crate::structure::strict_validator::Diagnostic;
use crate::telemetry::SpanParent;

/// Work for the pool.
#[derive(Debug)]
pub(crate) struct Task {
    /// Structure. A strict task needs its file.
    pub(crate) input: Input,
    /// SHA-256 of the structure file.
    pub(crate) digest: Digest,
    /// Namespace of input and result. Only tasks of one namespace share work.
    pub(crate) namespace: Namespace,
    /// Parameters and format. If `strict`, the strict validator also runs, and a file with errors is rejected.
    pub(crate) request: Request,
    /// Client and priority.
    pub(crate) rank: Rank,
    /// Memory budget that `input` is charged to.
    pub(crate) reservation: Option<Arc<MemoryReservation>>,
    /// Parent of the spans of the task.
    pub(crate) parent: SpanParent,
    /// Id of the durable job; `None` for an interactive request.
    pub(crate) id: Option<JobId>,
}

/// Map file of a request.
#[derive(Debug, Clone)]
pub(crate) struct UploadedMap {
    /// Content.
    pub(crate) bytes: Bytes,
    /// SHA-256 of `bytes`.
    pub(crate) digest: Digest,
}

/// Result of a job.
#[derive(Debug)]
pub(crate) struct Finished {
    /// Mesh and report.
    pub(crate) product: Product,
    /// Findings of the strict validator if the task was strict.
    pub(crate) diagnostics: Option<Vec<Diagnostic>>,
    /// Memory budget that the mesh is charged to, until this is dropped.
    #[expect(dead_code, reason = "holds the memory until it is dropped")]
    pub(crate) reservation: Arc<MemoryReservation>,
}

/// Outcome of a job.
pub(crate) type Outcome = Result<Arc<Finished>, Failure>;
