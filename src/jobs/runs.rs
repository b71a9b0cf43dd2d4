//! Runs of jobs in this process, and their orderly stop: no more jobs are claimed, claimed ones are finished, and those
//! that are not finished in time return to the queue.

use std::time::Duration;

use tokio::sync::watch;

use super::broker::ClaimEnd;
use super::durable_job::DurableJob;
use super::job_store::JobStore;

/// Phase of the stop. Later phases include the restrictions of earlier ones.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Phase {
    /// Jobs are claimed and run.
    #[default]
    Serve,
    /// No job is claimed; claimed ones are finished.
    Finish,
    /// Unfinished jobs return to the queue.
    Return,
}

/// End of a claim or a run of a job.
#[derive(Debug, Clone, Copy)]
pub(super) struct RunEnd {
    /// End of the claim: done if the job has ended, a release if it returns to the queue.
    pub(super) claim: ClaimEnd,
    /// False if the store has rejected the record of the end or of the return. `None` if this run made neither.
    recorded: Option<bool>,
}

impl RunEnd {
    /// Returns the end of a run whose job has ended.
    pub(super) const fn done(recorded: bool) -> Self {
        Self { claim: ClaimEnd::Done, recorded: Some(recorded) }
    }

    /// Returns the end of a run whose job returns to the queue and can be claimed again after `delay`.
    pub(super) const fn returned(delay: Duration, recorded: bool) -> Self {
        Self { claim: ClaimEnd::Release(delay), recorded: Some(recorded) }
    }

    /// Returns the end of a run that wrote no record: it was not necessary, or another one takes over.
    pub(super) const fn without_record(claim: ClaimEnd) -> Self {
        Self { claim, recorded: None }
    }
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
    /// Waits until the stop has reached a phase.
    pub(super) async fn reached(&self, phase: Phase) {
        // The sender is in `self`.
        drop(self.phase.subscribe().wait_for(|now| *now >= phase).await);
    }
}

/// Claim or runner of a job. It is counted until it is dropped.
pub(super) struct RunGuard {
    jobs: JobStore,
    end: Option<RunEnd>,
}

impl RunGuard {
    /// Ends the run.
    pub(super) fn end(mut self, end: RunEnd) {
        self.end = Some(end);
    }
}

impl Drop for RunGuard {
    fn drop(&mut self) {
        let runs = &self.jobs.0.runs;
        let stops = *runs.phase.borrow() > Phase::Serve;
        runs.counts.send_modify(|RunCounts { running, stopped }| {
            *running -= 1;
            match self.end.filter(|_| stops) {
                Some(RunEnd { claim: ClaimEnd::Done, recorded: Some(true) }) => stopped.finished += 1,
                Some(RunEnd { recorded: Some(true), .. }) => stopped.returned += 1,
                Some(RunEnd { recorded: Some(false), .. }) => stopped.unrecorded += 1,
                Some(RunEnd { recorded: None, .. }) | None => {}
            }
        });
    }
}

impl JobStore {
    /// Counts a claim or a runner.
    pub(super) fn count_run(&self) -> RunGuard {
        self.0.runs.counts.send_modify(|counts| counts.running += 1);
        RunGuard { jobs: self.clone(), end: None }
    }

    /// Counts and records an attempt, unless the job has ended or returns to the queue.
    pub(super) async fn begin(&self, job: &DurableJob) {
        if job.begin(|| *self.0.runs.phase.borrow() < Phase::Return)
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
