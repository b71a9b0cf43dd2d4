//! Dispatch of asynchronous jobs to workers, within a process or between the nodes of a cluster.
//!
//! The store is authoritative: a broker holds only ids, and a broker that loses them loses no job, since every node
//! dispatches unfinished jobs again ([`JobStore::reconcile`](super::JobStore::reconcile)). A job may therefore be
//! run twice; results are named by their contents, and the first end on record counts.
//!
//! Within a level of urgency, jobs run in the order of dispatch, whichever client sent them: shares of clients are
//! enforced when jobs are accepted.

mod memory;
mod nats;
mod order;
#[cfg(test)]
pub(crate) mod tests;

use std::borrow::Cow;
use std::fmt;
use std::time::Duration;

use futures_util::future::BoxFuture;
use futures_util::stream::BoxStream;
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub(crate) use memory::MemoryBroker;
pub(crate) use nats::NatsBroker;
pub use nats::check_broker;

use super::record::{JobId, JobRecord};
use crate::store::Digest;

/// Queue entry of a job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Dispatch {
    /// Id of the job.
    pub(crate) id: JobId,
    /// Urgency, from 0 (first) to 7 (last).
    pub(crate) urgency: u8,
    /// True for a job that workers with a GPU should run.
    pub(crate) suits_gpu: bool,
}

impl Dispatch {
    /// Returns the dispatch of the job of a record.
    pub(crate) fn of(record: &JobRecord) -> Self {
        let JobRecord { id, urgency, suits_gpu, .. } = record;
        Self { id: id.clone(), urgency: *urgency, suits_gpu: *suits_gpu }
    }
}

/// Progress of a running job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobProgress {
    /// Number of attempts.
    pub(crate) attempts: u32,
    /// Start of the attempt, ms since 1970.
    pub(crate) started_ms: Option<u64>,
    /// Name of the stage.
    pub(crate) stage: Cow<'static, str>,
    /// Finished fraction, from 0 to 1.
    pub(crate) fraction: f64,
}

/// News of a job, published by the node that runs or cancels it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum JobEvent {
    /// The job runs.
    Running(JobProgress),
    /// The end of the job is on record.
    Ended,
}

/// Error of a job that was not dispatched.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub(crate) enum DispatchError {
    /// The queue is full.
    #[error("the queue is full")]
    Full,
    /// The broker does not answer.
    #[error("{why}")]
    Unavailable { why: String },
}

/// Dispatches jobs to workers.
pub(crate) trait Broker: Send + Sync {
    /// Queues a job. Returns false if it is queued or claimed already.
    fn dispatch<'a>(&'a self, job: &'a Dispatch) -> BoxFuture<'a, Result<bool, DispatchError>>;

    /// Waits for a job and claims it. Within a level of urgency, jobs that suit a GPU come first if `prefers_gpu`, else
    /// the others. If the future is dropped, a job that it has claimed can be claimed again after its lease.
    fn claim(&self, prefers_gpu: bool) -> BoxFuture<'_, Claim>;

    /// Locks work that one node at a time does. `None` if another run has the lock. If the broker does not answer, the
    /// work is not locked: doing it twice costs time only.
    fn lock<'a>(&'a self, work: &'a Digest) -> BoxFuture<'a, Option<WorkLock>>;

    /// Publishes the state of a job to its followers. An event may be lost.
    fn publish(&self, id: &JobId, event: JobEvent);

    /// Returns the events of a job that are published from now on.
    fn events(&self, id: &JobId) -> BoxFuture<'_, BoxStream<'static, JobEvent>>;

    /// Waits until the ends of claims and locks are sent to the broker.
    fn flush(&self) -> BoxFuture<'_, ()>;

    /// Returns the number of queued jobs.
    fn queued(&self) -> usize;

    /// Returns the maximum number of queued jobs.
    fn limit(&self) -> usize;

    /// Returns how often the broker may have lost jobs.
    fn losses(&self) -> usize;

    /// Returns the reason for which no job can be dispatched or claimed now, if there is one.
    fn down(&self) -> Option<String>;
}

/// Lock of some work, until it is dropped.
#[must_use = "dropping the lock releases the work"]
pub(crate) struct WorkLock(Option<Box<dyn FnOnce() + Send + Sync>>);

impl WorkLock {
    /// Creates a lock that `release` ends.
    fn new(release: impl FnOnce() + Send + Sync + 'static) -> Self {
        Self(Some(Box::new(release)))
    }
}

impl Drop for WorkLock {
    fn drop(&mut self) {
        if let Some(release) = self.0.take() {
            release();
        }
    }
}

/// End of a claim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ClaimEnd {
    /// The job leaves the queue.
    Done,
    /// The job returns to the queue, and can be claimed again after this time.
    Release(Duration),
    /// Another worker has claimed the job meanwhile.
    Abandon,
}

/// Function that ends a claim. The caller may drop the returned future, except for [`ClaimEnd::Done`].
type EndClaim = Box<dyn FnOnce(ClaimEnd) -> BoxFuture<'static, ()> + Send + Sync>;

/// Claimed job. No other worker gets the job until the claim ends, or until its node has not extended it for a lease. A
/// claim that is dropped returns the job to the queue.
#[must_use = "dropping the claim returns the job to the queue"]
pub(crate) struct Claim {
    /// Id of the job.
    pub(crate) id: JobId,
    end: Option<EndClaim>,
}

impl fmt::Debug for Claim {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Claim").field("id", &self.id).finish_non_exhaustive()
    }
}

impl Claim {
    fn new(id: JobId, end: impl FnOnce(ClaimEnd) -> BoxFuture<'static, ()> + Send + Sync + 'static) -> Self {
        Self { id, end: Some(Box::new(end)) }
    }

    /// Ends the claim.
    pub(crate) async fn end(mut self, end: ClaimEnd) {
        if let Some(finish) = self.end.take() {
            finish(end).await;
        }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        if let Some(finish) = self.end.take() {
            drop(finish(ClaimEnd::Release(Duration::ZERO)));
        }
    }
}
