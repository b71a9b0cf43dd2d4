//! Batch that a device runs, or build of its executor, watched for a hang: no submission for longer than a limit.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use molmesh_sync::mpsc::SyncSender;

use super::error::GpuError;
use super::hang_limit;
use super::job::JobResult;
use super::partition_handle::PartitionHandle;
use super::queued_job::QueuedJob;

/// Batch that a device runs, or build of its executor.
pub(super) struct RunningBatch {
    is_build: bool,
    /// True if a job of the batch has failed before.
    pub(super) is_retry: bool,
    replies: Vec<SyncSender<JobResult>>,
    /// Partition, if the batch consists of one.
    partition: Option<PartitionHandle>,
    /// Number of bricks of all jobs.
    pub(super) bricks: u64,
    /// Submissions of the executor.
    submissions: Arc<AtomicU64>,
    /// Number of submissions, and the time at which it was first seen.
    seen: (u64, Instant),
}

impl RunningBatch {
    /// Starts to watch a batch that begins at `now` on an executor that counts `submissions`.
    pub(super) fn new(batch: &[QueuedJob], submissions: Arc<AtomicU64>, now: Instant) -> Self {
        let seen = (submissions.load(Ordering::Relaxed), now);
        let partition = batch.iter().find_map(|queued| queued.partition.clone());
        let replies = batch.iter().map(|queued| queued.reply.clone()).collect();
        let bricks = batch.iter().map(QueuedJob::bricks).sum();
        let is_retry = batch.iter().any(|queued| queued.retry);
        Self { is_build: false, is_retry, replies, partition, bricks, submissions, seen }
    }

    /// Creates the record of a build that begins at `now`.
    pub(super) fn build(now: Instant) -> Self {
        Self { is_build: true, ..Self::new(&[], Arc::default(), now) }
    }

    /// Number of jobs.
    pub(super) fn len(&self) -> usize {
        self.replies.len()
    }

    /// Returns the time limit of a submission, or of the build. For `minimum` and `fastest`, see
    /// [`hang_limit::of_submission`].
    pub(super) fn limit(&self, minimum: Duration, fastest: Option<f64>) -> Duration {
        if self.is_build {
            hang_limit::of_build(minimum)
        } else {
            hang_limit::of_submission(minimum, self.bricks, fastest)
        }
    }

    /// Returns true if no submission was made for longer than `limit`. A partition that waits for others never hangs.
    pub(super) fn has_hung(&mut self, limit: Duration, now: Instant) -> bool {
        let submissions = self.submissions.load(Ordering::Relaxed);
        if submissions != self.seen.0 || self.partition.as_ref().is_some_and(PartitionHandle::is_waiting) {
            self.seen = (submissions, now);
        }
        now.saturating_duration_since(self.seen.1) > limit
    }

    /// Sends an error to the callers of all jobs and aborts the other partitions of the job.
    pub(super) fn fail(self, error: &GpuError) {
        if let Some(partition) = &self.partition {
            partition.abort();
        }
        for reply in self.replies {
            // The caller may have given up waiting. No other result was sent.
            drop(reply.send(Err(error.clone())));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_submission_has_the_whole_limit() {
        let (mut batch, limit) = (RunningBatch::new(&[], Arc::default(), Instant::now()), Duration::from_secs(10));
        let begun = batch.seen.1;
        let at = |s: u64| begun + Duration::from_secs(s);
        assert!(!batch.has_hung(limit, at(10)));
        batch.submissions.fetch_add(1, Ordering::Relaxed);
        assert!(!batch.has_hung(limit, at(12)));
        assert!(!batch.has_hung(limit, at(22)));
        assert!(batch.has_hung(limit, at(23)));
    }
}
