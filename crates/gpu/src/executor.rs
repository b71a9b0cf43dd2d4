//! Interface between the device pool and the code that runs jobs on one device.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use super::error::GpuError;
use super::job::{GpuJob, JobResult};
use super::partition_handle::PartitionHandle;

/// Returns the large job that the pool will run after the current one, if there is one.
pub type NextJob = Box<dyn Fn() -> Option<GpuJob> + Send>;

/// Runs jobs on one device.
pub trait Executor: Send {
    /// Runs `jobs` in as few submissions as possible. Returns one result per job, in order.
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<JobResult>;

    /// Runs one partition of a job that several devices share. The mesh has the vertices and triangles of the
    /// partition; its triangles refer to vertices by their index in the whole mesh. Partitions exchange counts through
    /// `partition`.
    ///
    /// # Errors
    /// Those of [`Self::run`]; [`GpuError::Failed`] if the executor supports whole jobs only.
    fn run_partition(&mut self, job: &GpuJob, partition: &PartitionHandle) -> JobResult {
        let _ = (job, partition);
        Err(GpuError::Failed("the executor does not support partitions".to_owned()))
    }

    /// Counter of submissions so far. A device on which it does not change for too long is considered hung.
    fn submission_counter(&self) -> Arc<AtomicU64> {
        Arc::default()
    }

    /// Sets the source of the next job. The executor may start that job while it waits for the results of the current
    /// one, but the pool may still run another job first.
    fn set_next_job(&mut self, next: NextJob) {
        drop(next);
    }

    /// Allocates up to `bytes` of readback buffers. The pool calls it before the first job. If memory runs out, keeps
    /// the buffers allocated so far.
    fn reserve_memory(&mut self, bytes: u64) {
        let _ = bytes;
    }

    /// Frees large buffers that are kept for the next job. The pool calls it once the device has been idle for a while.
    fn release_idle_memory(&mut self) {}

    /// Bytes of device memory that the executor holds, in use and pooled.
    fn held_bytes(&self) -> u64;
}
