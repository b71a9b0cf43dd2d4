//! Queue of jobs for one device, with the device's state and counters.

use std::collections::VecDeque;
use std::time::Duration;

use super::error::GpuError;
use super::job::{GpuJob, JobResult};
use super::partition_handle::PartitionHandle;
use crate::surface::DeviceStatus;
use crate::sync::mpsc::SyncSender;

/// Load of a large job or of a partition, in small jobs.
const LARGE_LOAD: u64 = 16;

/// Job in a device's queue.
pub(super) struct QueuedJob {
    pub(super) id: u64,
    pub(super) job: GpuJob,
    /// Partition to run; `None` for the whole job.
    pub(super) partition: Option<PartitionHandle>,
    /// True if an earlier attempt failed, so that the job must not share a submission.
    pub(super) retry: bool,
    pub(super) reply: SyncSender<JobResult>,
}

impl QueuedJob {
    /// Returns true if the job may share a submission.
    pub(super) fn is_batchable(&self) -> bool {
        !self.retry && self.partition.is_none() && self.job.prepared.is_small()
    }

    /// Load that the job adds to its device, in small jobs.
    pub(super) fn load(&self) -> u64 {
        if self.partition.is_none() && self.job.prepared.is_small() { 1 } else { LARGE_LOAD }
    }

    /// Sends the result.
    pub(super) fn reply(mut self, result: JobResult) {
        if result.is_ok() {
            self.partition = None;
        }
        // The caller may have given up waiting.
        drop(self.reply.send(result));
    }
}

impl Drop for QueuedJob {
    /// Aborts the other partitions of the job unless this one succeeded.
    fn drop(&mut self) {
        if let Some(partition) = &self.partition {
            partition.abort();
        }
    }
}

/// Outcome of a run on a device.
pub(super) struct RunOutcome {
    /// Duration.
    pub(super) time: Duration,
    /// Bytes of device memory that are held now.
    pub(super) held_bytes: u64,
    /// True if the device failed, so that its executor is discarded.
    pub(super) failed: bool,
    /// Reason for which the device is given up.
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
    /// Number of jobs that run now.
    pub(super) running: usize,
    /// Load of the jobs that wait or run.
    pub(super) load: u64,
    pub(super) state: DeviceState,
    /// Number of rebuilds since the last finished job.
    pub(super) consecutive_rebuilds: usize,
    /// Name and counters. [`Self::status`] adds the other fields.
    pub(super) counters: DeviceStatus,
}

impl DeviceQueue {
    /// Creates the queue of a device that is starting.
    pub(super) fn new(number: usize, name: String, limit: usize) -> Self {
        Self {
            waiting: VecDeque::with_capacity(limit),
            running: 0,
            load: 0,
            state: DeviceState::Starting,
            consecutive_rebuilds: 0,
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
            waiting: self.waiting.len() + self.running,
            ..self.counters.clone()
        }
    }

    /// Marks the device as down, unless it is, and returns the waiting jobs.
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

/// Replies to jobs that their device will not run.
pub(super) fn reject(jobs: VecDeque<QueuedJob>, why: &str) {
    for job in jobs {
        job.reply(Err(GpuError::NoDevice(why.to_owned())));
    }
}

#[cfg(test)]
mod tests {
    use crate::sync::mpsc::sync_channel;
    use std::sync::Arc;

    use super::*;
    use crate::gpu::job::{Finished, Prepared};
    use crate::gpu::plan::Partition;
    use crate::gpu::sheets::SheetBlocks;
    use crate::surface::backend::one_atom;
    use crate::surface::{
        CancelToken, Control, GridStats, Mesh, MeshOutput, SurfaceError, SurfaceLimits, SurfaceParams,
    };

    /// Two partitions; the first is queued.
    fn queued() -> (QueuedJob, PartitionHandle) {
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        let prepared = Prepared::new(&one_atom().unwrap(), &params, &limits, &Control::default()).unwrap();
        let job = GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None };
        let mut handles = PartitionHandle::for_partitions(vec![Partition::default(); 2]);
        let (other, partition) = (handles.pop().unwrap(), handles.pop());
        (QueuedJob { id: 0, job, partition, retry: false, reply: sync_channel(1).0 }, other)
    }

    #[test]
    fn a_partition_that_does_not_succeed_aborts_the_others() {
        let cancelled = Err(GpuError::Surface(SurfaceError::Cancelled));
        let (job, other) = queued();
        assert_eq!(other.check(), Ok(()));
        drop(job);
        assert_eq!(other.check(), cancelled, "dropped without a result");
        let (job, other) = queued();
        job.reply(Err(SurfaceError::Deadline.into()));
        assert_eq!(other.check(), cancelled, "failed");
        let (job, other) = queued();
        job.reply(Ok(Finished {
            meshed: MeshOutput::new(Mesh::default(), GridStats::default()),
            stages: Vec::new(),
            sheets: SheetBlocks::default(),
        }));
        assert_eq!(other.check(), Ok(()), "succeeded");
    }
}
