//! Moves of jobs from the short lane to the long one.

use std::time::{Duration, Instant};

use super::Queue;
use crate::jobs::rank::Lane;
use crate::jobs::{OnStart, Task};
use crate::surface::CancelToken;

/// Time after which a job of the short lane gives its worker to one that waits.
const SHORT_LIMIT: Duration = Duration::from_millis(if cfg!(feature = "shuttle") { 0 } else { 100 });

impl Queue {
    /// Frees a worker of the short lane if a job waits for one: cancels the job that began last, of those that run for
    /// longer than the lane allows. [`Self::restart`] starts it again in the long lane, if that has a free slot.
    pub(in crate::jobs) fn make_room(&self) {
        let mut state = self.lock();
        let is_wanted = state.waiting_in(Lane::Short).next().is_some() && !state.jobs.iter().any(|job| job.is_moving);
        if state.closed || !is_wanted || state.len(Lane::Long) >= self.limit + self.workers {
            return;
        }
        let now = Instant::now();
        let is_late = |begun: Instant| now.saturating_duration_since(begun) > SHORT_LIMIT;
        let running = state.jobs.iter_mut().filter(|job| job.lane == Lane::Short && job.begun.is_some_and(is_late));
        // It has the least work to repeat.
        if let Some(job) = running.max_by_key(|job| job.begun) {
            job.is_moving = true;
            job.cancel.cancel();
        }
    }

    /// Queues a job again, in the long lane, if [`Self::make_room`] has cancelled it. `on_start` is the work that its
    /// worker has not waited for yet.
    ///
    /// # Errors
    /// Returns the task of a job that is not queued again.
    #[expect(clippy::result_large_err, reason = "gives the task back, once per job")]
    pub(in crate::jobs) fn restart(&self, id: u64, task: Task, on_start: Vec<OnStart>) -> Result<(), Task> {
        let mut state = self.lock();
        let Some(at) = state.find(id) else { return Err(task) };
        let job = &mut state.jobs[at];
        if !std::mem::take(&mut job.is_moving) || job.is_abandoned() {
            return Err(task);
        }
        job.task = Some(task);
        job.on_start.extend(on_start);
        (job.begun, job.cancel) = (None, CancelToken::default());
        job.progress.restart();
        state.enqueue(at, Lane::Long);
        self.publish(&mut state);
        Ok(())
    }
}
