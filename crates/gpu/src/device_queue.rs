//! Queue of jobs for one device, with the device's state and counters.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use molmesh_surface::DeviceStatus;

use super::error::GpuError;
use super::queued_job::{LARGE_LOAD, QueuedJob};
use super::running_batch::RunningBatch;

/// Thread of a device. A thread that hangs is replaced by one of the next generation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct DeviceThread {
    /// Index of the device.
    pub(super) device: usize,
    pub(super) generation: u64,
}

/// Outcome of a run on a device.
pub(super) struct RunOutcome {
    /// Duration.
    pub(super) time: Duration,
    /// Bytes of device memory that the executor holds after the run.
    pub(super) held_bytes: u64,
    /// True if the device failed, so that its executor is discarded.
    pub(super) failed: bool,
    /// Reason why the device is given up; `None` if it stays up.
    pub(super) down: Option<String>,
}

/// State of a device.
pub(super) enum DeviceState {
    /// Its thread builds the executor for the first time.
    Starting,
    Up,
    Down(String),
}

/// Queue, state and counters of a device.
pub(super) struct DeviceQueue {
    pub(super) waiting: VecDeque<QueuedJob>,
    /// Jobs that run now; an empty batch while the device is built.
    pub(super) running: Option<RunningBatch>,
    /// Load of the jobs that wait or run.
    pub(super) load: u64,
    pub(super) state: DeviceState,
    /// Number of rebuilds since the last finished job.
    pub(super) consecutive_rebuilds: usize,
    /// Pause before the next attempt to use the device after it went down.
    pub(super) cool_down: Duration,
    /// Number of threads of this device that hung and were replaced.
    pub(super) generation: u64,
    /// True while the thread of this generation runs.
    pub(super) has_thread: bool,
    /// Shortest time per brick of any finished batch, s.
    pub(super) fastest: Option<f64>,
    /// Name and counters. [`Self::status`] adds the other fields.
    pub(super) counters: DeviceStatus,
}

impl DeviceQueue {
    /// Creates the queue of a device that is starting.
    pub(super) fn new(number: usize, name: String, limit: usize, cool_down: Duration) -> Self {
        Self {
            waiting: VecDeque::with_capacity(limit),
            running: None,
            load: 0,
            state: DeviceState::Starting,
            consecutive_rebuilds: 0,
            cool_down,
            generation: 0,
            has_thread: false,
            fastest: None,
            counters: DeviceStatus { number, name, ..DeviceStatus::default() },
        }
    }

    /// Returns true if the device is up and has less than a large job to do.
    pub(super) fn is_idle(&self) -> bool {
        matches!(self.state, DeviceState::Up) && self.load < LARGE_LOAD
    }

    /// Adds a job at the end.
    pub(super) fn push(&mut self, job: QueuedJob) {
        self.load += job.load();
        self.waiting.push_back(job);
    }

    /// Status of the device.
    pub(super) fn status(&self) -> DeviceStatus {
        DeviceStatus {
            down: match &self.state {
                DeviceState::Starting => Some("it is being built".to_owned()),
                DeviceState::Up => None,
                DeviceState::Down(why) => Some(why.clone()),
            },
            waiting: self.waiting.len() + self.running.as_ref().map_or(0, RunningBatch::len),
            ..self.counters.clone()
        }
    }

    /// Takes the device down if the batch that it runs has hung. Returns the batch, the waiting jobs and the error.
    pub(super) fn take_hung(
        &mut self,
        minimum: Duration,
        now: Instant,
    ) -> Option<(RunningBatch, VecDeque<QueuedJob>, GpuError)> {
        let fastest = self.fastest;
        let running = self.running.take_if(|running| running.has_hung(running.limit(minimum, fastest), now))?;
        let after = running.limit(minimum, fastest);
        let error = GpuError::Hung { after_ms: u64::try_from(after.as_millis()).unwrap_or(u64::MAX) };
        self.generation += 1;
        self.has_thread = false;
        self.counters.hung += 1;
        self.counters.failed += running.len() as u64;
        let left = self.mark_down(&error.to_string());
        self.load = 0;
        Some((running, left, error))
    }

    /// Marks the device as down, unless it is down already, and returns the waiting jobs.
    pub(super) fn mark_down(&mut self, why: &str) -> VecDeque<QueuedJob> {
        if !matches!(self.state, DeviceState::Down(_)) {
            self.state = DeviceState::Down(single_line(why));
        }
        self.counters.held_bytes = 0;
        let waiting = std::mem::take(&mut self.waiting);
        self.load -= waiting.iter().map(QueuedJob::load).sum::<u64>();
        waiting
    }
}

/// Reasons of all devices that are down.
pub(super) fn down_reasons(queues: &[DeviceQueue]) -> String {
    let why = |queue: &DeviceQueue| match &queue.state {
        DeviceState::Down(why) => Some(format!("{} {}: {why}", queue.counters.number, queue.counters.name)),
        DeviceState::Starting | DeviceState::Up => None,
    };
    queues.iter().filter_map(why).collect::<Vec<_>>().join("; ")
}

/// Joins the lines of a driver's message, because reasons appear in headers and on single lines.
pub(super) fn single_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Sends an error to the callers of jobs that their device will not run.
pub(super) fn reject(jobs: VecDeque<QueuedJob>, why: &str) {
    for job in jobs {
        job.reply(Err(GpuError::NoDevice(why.to_owned())));
    }
}
