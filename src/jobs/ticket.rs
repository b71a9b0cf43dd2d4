//! The right to a job's outcome. Whoever drops it has lost interest; work that nobody is interested in is cancelled.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::flight::Progress;
use super::queue::{Place, Queue};
use super::{Failure, Outcome};
use crate::telemetry::TraceSpan;

/// An accepted job.
#[must_use = "dropping the ticket cancels the job"]
pub struct Ticket {
    pub(super) queue: Arc<Queue>,
    pub(super) place: Place,
    pub(super) deadline: Instant,
    pub(super) allowed: Duration,
}

impl Ticket {
    /// Waits for the outcome, until the deadline at most. Cancel safe: dropping the future loses nothing.
    ///
    /// # Errors
    /// Any [`Failure`].
    pub async fn wait(&mut self) -> Outcome {
        match tokio::time::timeout_at(self.deadline.into(), &mut self.place.outcome).await {
            Err(_elapsed) => Err(Failure::Deadline { limit: self.allowed }),
            Ok(Ok(outcome)) => outcome,
            Ok(Err(_dropped)) => Err(Failure::Stopped),
        }
    }

    /// The same right, with `allowed` time from now.
    pub fn with_time(mut self, allowed: Duration) -> Self {
        (self.deadline, self.allowed) = (Instant::now() + allowed, allowed);
        self
    }

    /// How far the job is.
    #[must_use]
    pub fn progress(&self) -> &Arc<Progress> {
        &self.place.progress
    }

    /// The span of the work.
    #[must_use]
    pub fn span(&self) -> &TraceSpan {
        &self.place.span
    }

    /// Whether the work ran already when this ticket was given out: then its claim is not called.
    #[must_use]
    pub fn came_late(&self) -> bool {
        self.place.begun
    }

    /// Whether the same work was in the house already.
    #[must_use]
    pub fn is_shared(&self) -> bool {
        self.place.shared
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.queue.forget(self.place.flight, self.place.waiter);
    }
}
