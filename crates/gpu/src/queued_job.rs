//! Job in the queue of a device.

use molmesh_sync::mpsc::SyncSender;

use super::job::{GpuJob, JobResult};
use super::partition_handle::PartitionHandle;

/// Load of a large job or of a partition, in units of a small job.
pub(super) const LARGE_LOAD: u64 = 16;

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

    /// Returns true if the job is large, whole and tried for the first time.
    pub(super) fn is_alone(&self) -> bool {
        !self.retry && self.partition.is_none() && !self.job.prepared.is_small()
    }

    /// Number of bricks of the job or of the partition.
    pub(super) fn bricks(&self) -> u64 {
        match &self.partition {
            Some(handle) => u64::from(handle.partition().bricks.end - handle.partition().bricks.start),
            None => self.job.prepared.plan.bricks.len() as u64,
        }
    }

    /// Load that the job adds to its device, in units of a small job.
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use molmesh_surface::backend::one_atom;
    use molmesh_surface::{
        CancelToken, Control, GridStats, Mesh, MeshOutput, SurfaceError, SurfaceLimits, SurfaceParams,
    };
    use molmesh_sync::mpsc::sync_channel;

    use super::*;
    use crate::error::GpuError;
    use crate::job::{Finished, Prepared};
    use crate::plan::Partition;
    use crate::sheets::SheetBlocks;

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
