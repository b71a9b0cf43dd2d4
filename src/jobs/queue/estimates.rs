//! Estimates and metrics of the queue.

use std::time::{Duration, Instant};

use metrics::gauge;

use super::{Queue, QueueState};
use crate::jobs::coalesced_job::CoalescedJob;
use crate::jobs::cost::WorkRate;
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

    /// Returns true if a queued request would probably miss its `deadline` even if it began now. One that is alone in
    /// its lane does begin now.
    pub(in crate::jobs) fn would_be_late(&self, id: u64, deadline: Instant) -> bool {
        let (state, now) = (self.lock(), Instant::now());
        let Some(job) = state.find(id).map(|at| &state.jobs[at]) else { return false };
        let left = deadline.saturating_duration_since(now);
        state.len(job.lane) > 1 && Self::expected_now(&state, job.lane, job.units, now) > left
    }

    /// Estimates the duration of a job of `units` work in a lane at this moment.
    pub(super) fn expected_now(state: &QueueState, lane: Lane, units: f64, now: Instant) -> Duration {
        Duration::try_from_secs_f64(Self::rate_now(state, lane, now).seconds(units)).unwrap_or(Duration::MAX)
    }

    /// Returns the rate of a lane at this moment: a running job that takes longer than expected counts as if it had
    /// just ended. Otherwise a burst of jobs would be accepted before the first one has shown how long they take.
    fn rate_now(state: &QueueState, lane: Lane, now: Instant) -> WorkRate {
        let mut rate = state.rate;
        for job in state.jobs.iter().filter(|job| job.lane == lane && !job.is_tile) {
            let spent = job.spent(now).as_secs_f64();
            if spent > rate.seconds(job.units) {
                rate.learn(job.units, spent);
            }
        }
        rate
    }

    /// Estimates the remaining work of all jobs of a lane, divided by the number of its workers.
    pub(super) fn wait(&self, state: &QueueState, lane: Lane, now: Instant) -> Duration {
        if state.len(lane) < self.workers {
            return Duration::ZERO;
        }
        let rate = Self::rate_now(state, lane, now);
        let left = |job: &CoalescedJob| {
            let cost = rate.seconds(job.units);
            // A job that takes longer than expected may still run for a while.
            (cost - job.spent(now).as_secs_f64()).max(0.1 * cost)
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
