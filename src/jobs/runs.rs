//! Runs of jobs in this process, and their orderly stop: no more jobs are claimed, claimed ones are finished, and those
//! that are not finished in time return to the queue.

use tokio::sync::watch;

use super::durable_job::DurableJob;
use super::job_store::JobStore;

/// Phase of the stop. Later phases include the restrictions of earlier ones.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
enum Phase {
    /// Jobs are claimed and run.
    #[default]
    Serve,
    /// No job is claimed; claimed ones are finished.
    Finish,
    /// Unfinished jobs return to the queue.
    Return,
}

/// End of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RunResult {
    /// The end of the job is on record.
    Finished,
    /// The job has returned to the queue.
    Returned,
    /// The store has rejected the record of the end or of the return.
    Unrecorded,
}

/// Numbers of asynchronous jobs by their state after a stop.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct StoppedJobs {
    /// Jobs that have ended since the stop began.
    pub(crate) finished: usize,
    /// Jobs that have returned to the queue, without a counted attempt.
    pub(crate) returned: usize,
    /// Jobs whose end or return is not on record. Their attempts count.
    pub(crate) unrecorded: usize,
}

/// Numbers of runs.
#[derive(Debug, Default)]
struct RunCounts {
    /// Claims and runners.
    running: usize,
    /// Runs that ended during the stop.
    stopped: StoppedJobs,
}

/// Runs of a job store.
#[derive(Debug, Default)]
pub(super) struct Runs {
    counts: watch::Sender<RunCounts>,
    phase: watch::Sender<Phase>,
}

impl Runs {
    /// Waits until no more jobs are claimed.
    pub(super) async fn finishing(&self) {
        self.reached(Phase::Finish).await;
    }

    /// Waits until unfinished jobs return to the queue.
    pub(super) async fn returning(&self) {
        self.reached(Phase::Return).await;
    }

    /// Returns true once unfinished jobs return to the queue.
    fn are_returning(&self) -> bool {
        *self.phase.borrow() == Phase::Return
    }

    async fn reached(&self, phase: Phase) {
        // The sender is in `self`.
        drop(self.phase.subscribe().wait_for(|now| *now >= phase).await);
    }
}

/// Claim or runner of a job. It is counted until it is dropped.
pub(super) struct RunGuard {
    jobs: JobStore,
    result: Option<RunResult>,
}

impl RunGuard {
    /// Ends the run. `result` is its result, unless another claim or runner has taken over.
    pub(super) fn end(mut self, result: Option<RunResult>) {
        self.result = result;
    }
}

impl Drop for RunGuard {
    fn drop(&mut self) {
        let runs = &self.jobs.0.runs;
        let stops = *runs.phase.borrow() > Phase::Serve;
        runs.counts.send_modify(|RunCounts { running, stopped }| {
            *running -= 1;
            match self.result.filter(|_| stops) {
                Some(RunResult::Finished) => stopped.finished += 1,
                Some(RunResult::Returned) => stopped.returned += 1,
                Some(RunResult::Unrecorded) => stopped.unrecorded += 1,
                None => {}
            }
        });
    }
}

impl JobStore {
    /// Counts a claim or a runner.
    pub(super) fn count_run(&self) -> RunGuard {
        self.0.runs.counts.send_modify(|counts| counts.running += 1);
        RunGuard { jobs: self.clone(), result: None }
    }

    /// Counts and records an attempt, unless the job has ended or returns to the queue.
    pub(super) async fn begin(&self, job: &DurableJob) {
        if job.begin(|| !self.0.runs.are_returning())
            && let Err(error) = self.0.write_job(job).await
        {
            tracing::error!(job_id = %job.id(), %error, "cannot record an attempt to run a job");
        }
    }

    /// Claims no more jobs.
    pub(crate) fn stop_claiming(&self) {
        self.0.runs.phase.send_replace(Phase::Finish);
    }

    /// Returns all unfinished jobs to the queue. Their attempts do not count, and other processes can claim them at
    /// once.
    pub(crate) fn return_jobs(&self) {
        self.0.runs.phase.send_replace(Phase::Return);
    }

    /// Waits until no job of this process runs any more: each has ended or is left to another process, its record is
    /// written, and the broker is told. The pool must be drained.
    pub(crate) async fn all_recorded(&self) {
        drop(self.0.runs.counts.subscribe().wait_for(|counts| counts.running == 0).await);
        self.0.broker.flush().await;
    }

    /// Returns the numbers of jobs that ended or returned since the stop began. Jobs that still run count as
    /// unrecorded.
    pub(crate) fn stopped_jobs(&self) -> StoppedJobs {
        let counts = self.0.runs.counts.borrow();
        StoppedJobs { unrecorded: counts.stopped.unrecorded + counts.running, ..counts.stopped }
    }
}
