//! The right to a job's outcome. Whoever drops it has lost interest, and the job is cancelled.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::queue::Queue;
use super::{Failure, Outcome};
use crate::pipeline::JobError;
use crate::surface::{CancelToken, SurfaceError};

/// An accepted job.
#[must_use = "dropping the ticket cancels the job"]
pub struct Ticket {
    pub(super) id: u64,
    pub(super) queue: Arc<Queue>,
    pub(super) cancel: CancelToken,
    pub(super) outcome: oneshot::Receiver<Outcome>,
    pub(super) deadline: Instant,
    pub(super) allowed: Duration,
}

impl Ticket {
    /// Waits for the outcome, until the deadline at most.
    ///
    /// # Errors
    /// Any [`Failure`].
    pub async fn wait(mut self) -> Outcome {
        match tokio::time::timeout_at(self.deadline.into(), &mut self.outcome).await {
            // Dropping `self` on return takes the job out of the queue or stops it.
            Err(_elapsed) => Err(Failure::Deadline { limit: self.allowed }),
            // A worker or a device may look at the clock a moment before this timer does.
            Ok(Ok(Err(Failure::Job { error: JobError::Surface(SurfaceError::Deadline), .. }))) => {
                Err(Failure::Deadline { limit: self.allowed })
            }
            Ok(Err(_dropped)) if Instant::now() >= self.deadline => Err(Failure::Deadline { limit: self.allowed }),
            Ok(Ok(outcome)) => outcome,
            Ok(Err(_dropped)) => Err(Failure::Stopped),
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.cancel.cancel();
        self.queue.forget(self.id);
    }
}
