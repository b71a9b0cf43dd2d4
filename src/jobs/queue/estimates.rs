//! Estimates and metrics of the queue.

use std::time::{Duration, Instant};

use metrics::gauge;

use super::{Queue, QueueState};
use crate::jobs::coalesced_job::CoalescedJob;
use crate::jobs::rank::Lane;
use crate::telemetry::{QUEUE_AGE, QUEUE_DEPTH, QUEUE_WAIT};

impl Queue {
    /// Estimates the queueing time of a job of a lane that is accepted now.
    pub(in crate::jobs) fn estimated_wait(&self, lane: Lane) -> Duration {
        self.wait(&self.lock(), lane, Instant::now())
    }

    /// Returns true if a job waits for a worker.
    pub(in crate::jobs) fn has_waiting(&self) -> bool {
        self.lock().waiting().next().is_some()
    }

    /// Estimates the duration of a job of `units` work, s.
    pub(in crate::jobs) fn expected(&self, units: f64) -> f64 {
        self.lock().rate.seconds(units)
    }

    /// Estimates the remaining work of all jobs of a lane, divided by the number of its workers.
    pub(super) fn wait(&self, state: &QueueState, lane: Lane, now: Instant) -> Duration {
        if state.len(lane) < self.workers {
            return Duration::ZERO;
        }
        let left = |job: &CoalescedJob| {
            let spent = job.begun.map_or(0.0, |begun| now.saturating_duration_since(begun).as_secs_f64());
            let cost = state.rate.seconds(job.units);
            // A job that takes longer than expected may still run for a while.
            (cost - spent).max(0.1 * cost)
        };
        let ahead: f64 = state.jobs.iter().filter(|job| job.lane == lane).map(left).sum();
        Duration::try_from_secs_f64(ahead / self.workers as f64).unwrap_or(Duration::MAX)
    }

    /// Updates the metrics of the queue: the age of queued jobs grows without any event.
    pub(in crate::jobs) fn refresh(&self) {
        self.publish(&mut self.lock());
    }

    #[expect(clippy::cast_precision_loss, reason = "gauges are floats, counts of jobs are small")]
    pub(super) fn publish(&self, state: &mut QueueState) {
        let now = Instant::now();
        let waiting = state.waiting().count();
        let oldest = state.waiting().map(|job| now.saturating_duration_since(job.accepted)).max().unwrap_or_default();
        // Incremented by the difference, so that several pools in one process add up.
        gauge!(QUEUE_DEPTH).increment(waiting as f64 - state.published as f64);
        state.published = waiting;
        gauge!(QUEUE_AGE).set(oldest.as_secs_f64());
        let wait = self.wait(state, Lane::Short, now).max(self.wait(state, Lane::Long, now));
        gauge!(QUEUE_WAIT).set(wait.as_secs_f64());
    }
}
