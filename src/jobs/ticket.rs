//! Handle of a job's outcome. A job is cancelled when its last ticket is dropped.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::coalesced_job::Progress;
use super::queue::Queue;
use super::rank::Lane;
use super::{Failure, Outcome};
use crate::single_flight::ResultReceiver;
use crate::surface::OutOfMemory;
use crate::sync::timeout;
use crate::telemetry::TraceSpan;

/// Interval at which a queued job asks for a worker.
const QUEUED_TICK: Duration = Duration::from_millis(20);

/// Handle of an accepted job.
#[must_use = "dropping the ticket cancels the job"]
pub(crate) struct Ticket {
    pub(super) queue: Arc<Queue>,
    /// Number of the job in the queue.
    pub(super) job: u64,
    /// Lane in which the job was queued.
    pub(super) lane: Lane,
    /// `None` if the job is left for the next process.
    pub(super) outcome: Option<ResultReceiver<Outcome>>,
    pub(super) deadline: Instant,
    pub(super) allowed: Duration,
    pub(super) progress: Arc<Progress>,
    /// Span of the job.
    pub(crate) span: TraceSpan,
    /// True for an accepted asynchronous job, which may wait until its deadline. A request gives up as soon as it would
    /// probably miss it.
    pub(super) is_durable: bool,
    /// True if the task joined a queued or running job.
    pub(crate) is_shared: bool,
    /// True if the task joined a running job. The `on_start` callback of the task is not called then.
    pub(super) joined_running: bool,
}

impl Ticket {
    /// Waits for the outcome, at most until the deadline, or as long as the job can begin in time. Cancel safe.
    pub(crate) async fn wait(&mut self) -> Outcome {
        let Some(outcome) = &mut self.outcome else { return Err(Failure::Stopped) };
        let limit = self.allowed;
        loop {
            let (now, is_queued) = (Instant::now(), self.progress.now().is_none());
            let has_passed = now >= self.deadline;
            let gives_up = is_queued && !self.is_durable;
            if gives_up && (has_passed || self.queue.would_be_late(self.job, self.deadline)) {
                return Err(Failure::Waited { limit, wait: self.queue.estimated_wait(self.lane) });
            }
            if has_passed {
                return Err(Failure::Deadline { limit });
            }
            if is_queued && self.lane == Lane::Short {
                self.queue.make_room();
            }
            let tick = if is_queued { now + QUEUED_TICK } else { self.deadline };
            let end = tick.min(self.deadline);
            if let Ok(outcome) = timeout(end.saturating_duration_since(now), outcome.recv()).await {
                return match outcome.unwrap_or(Err(Failure::Stopped)) {
                    // The share is that of the client that sent the job first.
                    Err(Failure::Memory(OutOfMemory::Share { needed, .. })) if self.is_shared => {
                        Err(Failure::Memory(OutOfMemory::System { needed }))
                    }
                    outcome => outcome,
                };
            }
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        drop(self.outcome.take());
        self.queue.leave_job(self.job);
    }
}
