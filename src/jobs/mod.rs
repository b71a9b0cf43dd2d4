//! The worker pool: a bounded queue in front of one backend, on threads of its own.
//!
//! Structure bytes and a [`crate::pipeline::Job`] go in; a mesh with its report comes out. Deadlines, cancellation
//! and panics are dealt with here, so that whoever submits only waits. It knows no HTTP and no graphics API.

mod budget;
mod cost;
mod devices;
mod error;
mod flight;
mod key;
mod ledger;
mod patience;
mod pool;
mod promise;
mod queue;
mod rank;
mod record;
mod results;
mod returns;
#[cfg(test)]
mod tests;
mod ticket;
mod worker;

pub use budget::{Budget, Exhausted, Lease};
pub use error::{EndError, Failure, PromiseError, Refusal};
pub use flight::{Claim, Progress};
pub use key::ContentKey;
pub use ledger::{Describe, Ledger, LedgerSettings, Order, View};
pub use pool::{Meter, Pool, Settings};
pub use rank::{Client, Rank, USUAL_URGENCY};
pub use record::{BadJobId, JobId, Record, Requester, Status, now_ms, rfc3339};
pub use results::{REPORT, SaveError, save};
pub use ticket::Ticket;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;

use crate::pipeline::{Job, Product};
use crate::store::Digest;
use crate::structure::referee::Diagnostic;
use crate::telemetry::SpanParent;

/// One job to run.
#[derive(Debug)]
pub struct Task {
    /// The structure file as it came, compressed or not.
    pub input: Bytes,
    /// Its digest.
    pub digest: Digest,
    /// Ask the referee, and refuse a file in which it finds errors.
    pub strict: bool,
    /// What to make of it.
    pub job: Job,
    /// Whose job it is, and how it stands to others.
    pub rank: Rank,
    /// Memory that the input is charged to, given back with it.
    pub lease: Option<Arc<Lease>>,
    /// Who asked for it.
    pub parent: SpanParent,
    /// The id of the job that was promised; none if somebody waits.
    pub id: Option<JobId>,
}

/// A finished job.
#[derive(Debug)]
pub struct Finished {
    /// Mesh and report.
    pub product: Product,
    /// What the referee said, if it was asked.
    pub diagnostics: Option<Vec<Diagnostic>>,
    /// Digest of the input.
    pub digest: Digest,
    /// Time in the queue.
    pub waited: Duration,
    /// Memory that the mesh is charged to, given back when this is dropped.
    pub lease: Lease,
}

/// What a job comes to.
pub type Outcome = Result<Arc<Finished>, Failure>;
