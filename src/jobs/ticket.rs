//! Handle of a job's outcome. A job is cancelled when its last ticket is dropped.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::coalesced_job::Progress;
use super::queue::{Admission, Queue};
use super::{Failure, Outcome};
use crate::telemetry::TraceSpan;

/// Handle of an accepted job.
#[must_use = "dropping the ticket cancels the job"]
pub struct Ticket {
    pub(super) queue: Arc<Queue>,
    pub(super) admission: Admission,
    pub(super) deadline: Instant,
    pub(super) allowed: Duration,
}

impl Ticket {
    /// Waits for the outcome, at most until the deadline. Cancel safe.
    ///
    /// # Errors
    /// Any [`Failure`].
    pub async fn wait(&mut self) -> Outcome {
        let Some(outcome) = &mut self.admission.outcome else { return Err(Failure::Stopped) };
        match tokio::time::timeout_at(self.deadline.into(), outcome.recv()).await {
            Err(_elapsed) => Err(Failure::Deadline { limit: self.allowed }),
            Ok(Some(outcome)) => outcome,
            Ok(None) => Err(Failure::Stopped),
        }
    }

    /// Progress of the job.
    #[must_use]
    pub fn progress(&self) -> &Arc<Progress> {
        &self.admission.progress
    }

    /// Span of the job.
    #[must_use]
    pub fn span(&self) -> &TraceSpan {
        &self.admission.span
    }

    /// Returns true if the job was already running when it was joined; its `on_start` callback is not called then.
    #[must_use]
    pub fn joined_running(&self) -> bool {
        self.admission.running
    }

    /// Returns true if the ticket joined a job that was queued or running.
    #[must_use]
    pub fn is_shared(&self) -> bool {
        self.admission.shared
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        drop(self.admission.outcome.take());
        self.queue.leave_job(self.admission.job);
    }
}
