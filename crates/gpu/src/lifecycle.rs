//! Lifecycle of devices and their threads: start, rebuilds, hangs, cool-down and end.

use std::ops::Range;
use std::sync::PoisonError;
use std::time::{Duration, Instant};

use super::device_queue::{DeviceQueue, DeviceState, DeviceThread, down_reasons, reject};
use super::running_batch::RunningBatch;
use super::scheduler::Scheduler;

/// Maximum cool-down, as a multiple of the first one.
pub(super) const MAX_COOL_DOWN: u32 = 64;

impl Scheduler {
    /// Registers the current thread of device `n`, which is about to start.
    pub(super) fn begin_thread(&self, n: usize) -> DeviceThread {
        let queue = &mut self.lock().queues[n];
        queue.has_thread = true;
        DeviceThread { device: n, generation: queue.generation }
    }

    /// Records that a thread begins to build its executor, and starts to watch it for a hang.
    pub(super) fn begin_build(&self, thread: DeviceThread) {
        if let Some(queue) = self.lock().queue_of(thread) {
            queue.running = Some(RunningBatch::build(Instant::now()));
        }
    }

    /// Records that a thread ends.
    pub(super) fn end_thread(&self, thread: DeviceThread) {
        if let Some(queue) = self.lock().queue_of(thread) {
            queue.has_thread = false;
        }
        self.changed.notify_all();
    }

    /// Waits until all threads have ended, at most for `time`.
    pub(super) fn wait_until_ended(&self, time: Duration) {
        let end = Instant::now().checked_add(time);
        let mut state = self.lock();
        while state.queues.iter().any(|queue| queue.has_thread) {
            let Some(left) = time_left(end) else { return };
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Returns true if a thread has ended and was not replaced.
    pub(super) fn has_ended(&self, thread: DeviceThread) -> bool {
        self.lock().queue_of(thread).is_some_and(|queue| !queue.has_thread)
    }

    /// Marks a device as up.
    pub(super) fn mark_up(&self, thread: DeviceThread) {
        if let Some(queue) = self.lock().queue_of(thread) {
            queue.counters.rebuilds += u64::from(matches!(queue.state, DeviceState::Down(_)));
            queue.state = DeviceState::Up;
        }
        self.changed.notify_all();
    }

    /// Marks a device as down and rejects its waiting jobs, unless the thread was replaced.
    pub(super) fn mark_down(&self, thread: DeviceThread, why: &str) {
        let left = self.lock().queue_of(thread).map(|queue| queue.mark_down(why));
        self.changed.notify_all();
        self.added[thread.device].notify_all();
        reject(left.unwrap_or_default(), why);
    }

    /// Marks device `n` as down and rejects its waiting jobs.
    pub(super) fn give_up(&self, n: usize, why: &str) {
        let generation = self.lock().queues[n].generation;
        self.mark_down(DeviceThread { device: n, generation }, why);
    }

    /// Marks those of `devices` as down whose batches have hung, and fails their jobs. Returns their indices.
    pub(super) fn take_hung(&self, devices: Range<usize>, hang_timeout: Duration) -> Vec<usize> {
        let mut hung = Vec::new();
        {
            let mut state = self.lock();
            if state.closed {
                return Vec::new();
            }
            let now = Instant::now();
            for n in devices {
                hung.extend(state.queues[n].take_hung(hang_timeout, now).map(|taken| (n, taken)));
            }
        }
        if !hung.is_empty() {
            self.changed.notify_all();
        }
        let mut devices = Vec::with_capacity(hung.len());
        for (n, (running, left, error)) in hung {
            running.fail(&error);
            reject(left, &error.to_string());
            devices.push(n);
        }
        devices
    }

    /// Waits for the cool-down of a device that is down, and doubles the next one. Returns false if the scheduler is
    /// closed or the thread was replaced.
    pub(super) fn cool_down(&self, thread: DeviceThread) -> bool {
        let maximum = self.settings.cool_down.saturating_mul(MAX_COOL_DOWN);
        let time = self.lock().queue_of(thread).map(|queue| {
            queue.running = None;
            let time = queue.cool_down;
            queue.cool_down = time.saturating_mul(2).min(maximum);
            time
        });
        time.is_some_and(|time| self.pause(thread.device, time))
    }

    /// Counts a rebuild of a device. Returns false, without counting, after `max` consecutive rebuilds.
    pub(super) fn count_rebuild(&self, thread: DeviceThread, max: usize) -> bool {
        self.lock().queue_of(thread).is_some_and(|queue| {
            let allowed = queue.consecutive_rebuilds < max;
            queue.consecutive_rebuilds += usize::from(allowed);
            queue.counters.rebuilds += u64::from(allowed);
            allowed
        })
    }

    /// Number of rebuilds of a device since it last finished a job.
    pub(super) fn consecutive_rebuilds(&self, thread: DeviceThread) -> usize {
        self.lock().queue_of(thread).map_or(0, |queue| queue.consecutive_rebuilds)
    }

    /// Waits until every device is up or down, at most for `time`. Returns false if the time was too short.
    pub(super) fn wait_until_started(&self, time: Duration) -> bool {
        let is_starting = |queue: &DeviceQueue| matches!(queue.state, DeviceState::Starting);
        let state = self.lock();
        if !state.queues.iter().any(is_starting) {
            return true;
        }
        let state = self.changed.wait_timeout(state, time).unwrap_or_else(PoisonError::into_inner).0;
        !state.queues.iter().any(is_starting)
    }

    /// Returns true if a device is up.
    pub(super) fn is_any_up(&self) -> bool {
        self.lock().queues.iter().any(|queue| matches!(queue.state, DeviceState::Up))
    }

    /// Waits for `time`. Returns false if the scheduler is closed.
    pub(super) fn pause(&self, n: usize, time: Duration) -> bool {
        let end = Instant::now().checked_add(time);
        let mut state = self.lock();
        while !state.closed {
            let Some(left) = time_left(end) else { return true };
            state = self.added[n].wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        false
    }

    /// Reasons of all devices that are down.
    pub(super) fn down_reasons(&self) -> String {
        down_reasons(&self.lock().queues)
    }
}

/// Returns the time until `end`, or `None` once it has passed. An `end` of `None` never passes: the clock cannot
/// represent it.
fn time_left(end: Option<Instant>) -> Option<Duration> {
    match end {
        Some(end) => end.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()),
        None => Some(Duration::MAX),
    }
}
