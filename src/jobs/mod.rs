//! The worker pool: a bounded queue in front of one backend, with worker threads of its own, and durable jobs on top.
//!
//! A [`Task`] (structure bytes and a [`crate::pipeline::Job`]) goes in, a mesh with its report comes out. Deadlines,
//! cancellation and panics are handled here, so callers only wait for a [`Ticket`]. This module knows no HTTP and no
//! graphics API.
//!
//! `queue` holds `coalesced_job`s: identical requests share one. `job_store` keeps the records of `durable_job`s, which
//! survive the process.

mod coalesced_job;
mod cost;
mod devices;
mod durable_job;
mod error;
mod job_store;
mod key;
mod pool;
mod queue;
mod rank;
mod record;
mod results;
mod retry;
#[cfg(test)]
mod tests;
mod ticket;
mod worker;

pub use crate::memory_budget::{Budget, Exhausted, Lease};
pub use coalesced_job::{OnStart, Progress};
pub use error::{AcceptError, EndError, Failure, Refusal};
pub use job_store::{DescribeError, JobSpec, JobStore, JobStoreSettings, JobView};
pub use key::ContentKey;
pub use pool::{Meter, Pool, Settings};
pub use rank::{Client, DEFAULT_URGENCY, Rank};
pub use record::{BadJobId, JobId, Record, Requester, Status, now_ms, rfc3339};
pub use results::{REPORT, SaveError, save};
pub use ticket::Ticket;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;

use crate::pipeline::{Job, Product};
use crate::store::Digest;
use crate::structure::strict_validator::Diagnostic;
use crate::telemetry::SpanParent;

/// Work for the pool.
#[derive(Debug)]
pub struct Task {
    /// Structure file, compressed or not.
    pub input: Bytes,
    /// SHA-256 of `input`.
    pub digest: Digest,
    /// Run the strict parser as well, and reject a file in which it finds errors.
    pub strict: bool,
    /// Parameters of the mesh.
    pub job: Job,
    /// Client and priority.
    pub rank: Rank,
    /// Memory budget that `input` is charged to.
    pub lease: Option<Arc<Lease>>,
    /// Parent of the spans of the task.
    pub parent: SpanParent,
    /// Id of the durable job; `None` for an interactive request.
    pub id: Option<JobId>,
}

/// Result of a job.
#[derive(Debug)]
pub struct Finished {
    /// Mesh and report.
    pub product: Product,
    /// Findings of the strict parser if the task was strict.
    pub diagnostics: Option<Vec<Diagnostic>>,
    /// SHA-256 of the input.
    pub digest: Digest,
    /// Time in the queue.
    pub waited: Duration,
    /// Memory budget that the mesh is charged to, until this is dropped.
    pub lease: Lease,
}

/// Outcome of a job.
pub type Outcome = Result<Arc<Finished>, Failure>;
