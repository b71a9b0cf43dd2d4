//! Batch that a device runs, watched for a hang: no submission for longer than a limit.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::error::GpuError;
use super::job::JobResult;
use super::partition_handle::PartitionHandle;
use super::queued_job::QueuedJob;
use crate::sync::mpsc::SyncSender;

/// Maximum time of a submission on a slow device, as a multiple of the estimated time of its batch.
const MAX_SLOWDOWN: f64 = 100.0;

/// Batch that a device runs.
pub(super) struct RunningBatch {
    replies: Vec<SyncSender<JobResult>>,
    /// Partition that the batch consists of, if it does.
    partition: Option<PartitionHandle>,
    bricks: u64,
    /// Submissions of the executor.
    submissions: Arc<AtomicU64>,
    /// Number of submissions at the last change that was seen, and its time.
    seen: (u64, Instant),
}

impl RunningBatch {
    /// Starts to watch a batch that begins at `now` on an executor that counts `submissions`.
    pub(super) fn new(batch: &[QueuedJob], submissions: Arc<AtomicU64>, now: Instant) -> Self {
        let seen = (submissions.load(Ordering::Relaxed), now);
        let partition = batch.iter().find_map(|queued| queued.partition.clone());
        let replies = batch.iter().map(|queued| queued.reply.clone()).collect();
        Self { replies, partition, bricks: batch.iter().map(QueuedJob::bricks).sum(), submissions, seen }
    }

    /// Number of jobs.
    pub(super) fn len(&self) -> usize {
        self.replies.len()
    }

    /// Number of bricks of all jobs.
    pub(super) const fn bricks(&self) -> u64 {
        self.bricks
    }

    /// Returns the time limit of a submission: at least `minimum`, and more for a large batch on a slow device, whose
    /// shortest time per brick so far is `fastest`, s.
    pub(super) fn limit(&self, minimum: Duration, fastest: Option<f64>) -> Duration {
        let estimate = fastest.map_or(0.0, |per_brick| per_brick * self.bricks as f64);
        Duration::try_from_secs_f64(MAX_SLOWDOWN * estimate).map_or(Duration::MAX, |limit| limit.max(minimum))
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

    fn batch(bricks: u64) -> RunningBatch {
        let mut batch = RunningBatch::new(&[], Arc::default(), Instant::now());
        batch.bricks = bricks;
        batch
    }

    #[test]
    fn slow_devices_have_more_time_for_large_batches() {
        let limit = |bricks, fastest| batch(bricks).limit(Duration::from_secs(10), fastest);
        assert_eq!(limit(1 << 40, None), Duration::from_secs(10), "nothing is known about the device");
        assert_eq!(limit(50_000, Some(1e-7)), Duration::from_secs(10));
        assert_eq!(limit(50_000, Some(1e-4)), Duration::from_secs(500));
        assert_eq!(limit(u64::MAX, Some(1e9)), Duration::MAX);
    }

    #[test]
    fn each_submission_has_the_whole_limit() {
        let (mut batch, limit) = (batch(1), Duration::from_secs(10));
        let begun = batch.seen.1;
        let at = |s: u64| begun + Duration::from_secs(s);
        assert!(!batch.has_hung(limit, at(10)));
        batch.submissions.fetch_add(1, Ordering::Relaxed);
        assert!(!batch.has_hung(limit, at(12)));
        assert!(!batch.has_hung(limit, at(22)));
        assert!(batch.has_hung(limit, at(23)));
    }
}
