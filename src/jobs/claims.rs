//! Dispatch and claims of jobs, and the state of jobs that run in other processes.

use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt as _;
use tokio::sync::OwnedSemaphorePermit;

use super::broker::{Claim, Dispatch, JobEvent};
use super::durable_job::DurableJob;
use super::job_store::JobStore;
use super::rank::Lane;
use super::record::{JobRecord, Status};
use super::retry;
use super::runner::Runner;
use super::runs::RunResult;
use super::{EndError, Refusal, Task};
use crate::store::{Digest, StoreError};
use crate::sync::{Handle, sleep};

/// Interval at which the record of a followed job is read. Events arrive sooner, but may be lost.
const POLL: Duration = Duration::from_secs(5);
/// Number of such intervals without any watcher after which a job is not followed any more.
const MAX_UNWATCHED: usize = 6;
/// Time after which a job that runs in this process already may be claimed again.
const DUPLICATE: Duration = Duration::from_secs(5);
/// Time after which a job of another release may be claimed again: short, because a node of that release may be idle.
const OTHER_RELEASE: Duration = Duration::from_secs(5);

impl JobStore {
    /// Returns how often the broker may have lost jobs, which [`Self::reconcile`] dispatches again.
    pub(crate) fn broker_losses(&self) -> usize {
        self.0.broker.losses()
    }

    /// Returns the reason for which no job can be dispatched or claimed now, if there is one.
    pub(crate) fn broker_down(&self) -> Option<String> {
        self.0.broker.down()
    }

    /// Dispatches an accepted job. If that fails, [`Self::reconcile`] dispatches it later.
    pub(super) async fn dispatch(&self, dispatch: &Dispatch) {
        if let Err(error) = self.0.broker.dispatch(dispatch).await {
            tracing::warn!(job_id = %dispatch.id, %error, "a job is dispatched later");
        }
    }

    /// Returns the refusal of a task when the queue of jobs is full.
    pub(super) fn queue_full(&self, task: &Task) -> Refusal {
        let (waiting, limit, pool) = (self.0.broker.queued(), self.0.broker.limit(), &self.0.pool);
        // As if the jobs ahead took as long as this one.
        let ahead = pool.expected(&task.input, &task.options) * waiting as f64 / pool.settings().workers as f64;
        let wait = pool.estimated_wait(Lane::Batch) + Duration::try_from_secs_f64(ahead).unwrap_or(Duration::MAX);
        Refusal::QueueFull { waiting, limit, wait }
    }

    /// Starts to claim and run jobs.
    pub(crate) fn start_claiming(&self) {
        Handle::current().spawn(self.clone().claim_jobs());
    }

    async fn claim_jobs(self) {
        let has_gpu = !self.0.pool.backend().devices().is_empty();
        loop {
            let next = async {
                // The semaphore is never closed.
                let slot = Arc::clone(&self.0.slots).acquire_owned().await.ok()?;
                Some((self.0.broker.claim(has_gpu).await, slot))
            };
            let claimed = tokio::select! {
                biased;
                () = self.0.runs.finishing() => None,
                claimed = next => claimed,
            };
            let Some((claim, slot)) = claimed else { return };
            let (jobs, run) = (self.clone(), self.count_run());
            Handle::current().spawn(async move { run.end(jobs.run_claimed(claim, slot).await) });
        }
    }

    /// Starts the run of a claimed job unless it has ended or runs in this process already. Returns the result of the
    /// claim, unless the run has its own.
    async fn run_claimed(&self, claim: Claim, slot: OwnedSemaphorePermit) -> Option<RunResult> {
        let record = tokio::select! {
            biased;
            record = self.record_of(&claim) => record,
            () = self.0.runs.returning() => {
                claim.release(Duration::ZERO);
                return Some(RunResult::Returned);
            }
        };
        let record = match record {
            Ok(Some(record)) => record,
            Ok(None) => {
                claim.done().await;
                return None;
            }
            Err(FromOtherRelease) => {
                claim.release(OTHER_RELEASE);
                return None;
            }
        };
        let job = self.insert_open(record.clone());
        if job.ended().is_some() {
            // Its end could not be written before.
            return Some(match self.0.write_job(&job).await {
                Ok(()) => {
                    claim.done().await;
                    RunResult::Finished
                }
                Err(error) => {
                    tracing::error!(job_id = %job.id(), %error, "cannot record the end of a job");
                    claim.release(DUPLICATE);
                    RunResult::Unrecorded
                }
            });
        }
        if !self.0.try_own(&job) {
            claim.release(DUPLICATE);
            return None;
        }
        job.adopt(record.clone());
        match self.0.track(&record) {
            Ok(digest) => {
                self.spawn(Runner { job, digest, ticket: None, claim: Some(claim), slot: Some(slot) });
                None
            }
            Err(error) => {
                let recorded = self.finish(&job, Err(error)).await;
                job.release();
                claim.done().await;
                Some(if recorded { RunResult::Finished } else { RunResult::Unrecorded })
            }
        }
    }

    /// Reads the record of a claimed job; `None` if no such job is open. Waits while the store fails.
    async fn record_of(&self, claim: &Claim) -> Result<Option<JobRecord>, FromOtherRelease> {
        let mut pause = retry::FIRST_PAUSE;
        loop {
            match self.0.read(&claim.id).await {
                Ok(Some(record)) if record.status.is_final() => return Ok(None),
                Ok(Some(record)) if record.request().is_err() => return Err(FromOtherRelease),
                Ok(record) => return Ok(record),
                Err(StoreError::Quarantined { .. }) => return Ok(None),
                Err(StoreError::OtherRelease { .. }) => return Err(FromOtherRelease),
                Err(error) => tracing::warn!(job_id = %claim.id, %error, "a claimed job waits for the store"),
            }
            sleep(pause).await;
            pause = (pause * 2).min(retry::MAX_PAUSE);
        }
    }

    /// Adds an unfinished job to the map, unless it is there, and returns the job in the map.
    pub(super) fn insert_open(&self, record: JobRecord) -> Arc<DurableJob> {
        let (id, fresh) = (record.id.clone(), Arc::new(DurableJob::new(record)));
        let job = self.0.insert(&id, &fresh);
        if Arc::ptr_eq(&job, &fresh) {
            Handle::current().spawn(self.clone().follow(fresh));
        }
        job
    }

    /// Updates the state of a job until it has ended or has no watcher any more: the job may run, or be dismissed, in
    /// another process.
    async fn follow(self, job: Arc<DurableJob>) {
        let id = job.id();
        let mut events = self.0.broker.events(&id).await;
        let mut ended = job.state.subscribe();
        let mut unwatched = 0;
        // The job may have ended since its record was read.
        let mut stale = true;
        loop {
            if stale && self.refresh(&job).await {
                return;
            }
            stale = tokio::select! {
                Some(event) = events.next() => match event {
                    JobEvent::Ended => true,
                    JobEvent::Running { attempts, .. } if job.is_owned() => {
                        // An attempt that returned to the queue does not count any more.
                        let own = job.record();
                        if own.status == Status::Running && attempts > own.attempts {
                            tracing::warn!(job_id = %id, "another worker runs a later attempt of a job");
                            job.stop().notify_one();
                        }
                        false
                    }
                    JobEvent::Running { attempts, started_ms, stage, fraction } => {
                        job.publish_stage((attempts, started_ms), stage, fraction);
                        false
                    }
                },
                _ = ended.wait_for(|view| view.record.status.is_final()) => return,
                () = sleep(POLL) => {
                    unwatched = if is_unused(&job) { unwatched + 1 } else { 0 };
                    true
                }
            };
            let mut map = self.0.lock();
            if unwatched > MAX_UNWATCHED && is_unused(&job) {
                map.jobs.remove(&id);
                return;
            }
        }
    }

    /// Reads the record of a job that may have changed in another process. Returns true if the job has ended or is
    /// gone.
    pub(super) async fn refresh(&self, job: &Arc<DurableJob>) -> bool {
        let id = job.id();
        match self.0.read(&id).await {
            Ok(Some(record)) if record.status.is_final() => {
                job.publish_end(record);
                self.0.open.remove(&id);
                if job.is_owned() {
                    job.stop().notify_one();
                    // Removes the open record, which the runner may have written after the end of the job.
                    if let Err(error) = self.0.write_job(job).await {
                        tracing::debug!(job_id = %id, %error, "the open record of an ended job is removed later");
                    }
                }
                true
            }
            Ok(Some(record)) => {
                if !job.is_owned() {
                    job.adopt(record);
                }
                false
            }
            Ok(None) => {
                self.0.lock().jobs.remove(&id);
                true
            }
            Err(StoreError::OtherRelease { .. }) => {
                // A node of that release has taken the job over.
                self.0.lock().jobs.remove(&id);
                job.stop().notify_one();
                true
            }
            Err(error) => {
                tracing::debug!(job_id = %id, %error, "the record of a followed job was not read");
                false
            }
        }
    }
}

/// Error of a claimed job whose record another release wrote, or whose parameters this release does not know.
struct FromOtherRelease;

/// Returns true if only the task that follows a job uses it.
fn is_unused(job: &DurableJob) -> bool {
    job.state.receiver_count() <= 1 && !job.is_owned()
}

/// Returns the digest of the input of a record.
pub(super) fn input_of(record: &JobRecord) -> Result<(Digest, Option<Digest>), EndError> {
    let map = record.map.as_deref().map(str::parse::<Digest>).transpose();
    match (record.input.parse::<Digest>(), map) {
        (Ok(input), Ok(map)) => Ok((input, map)),
        _ => Err(EndError::Lost { why: "its input or its map has no valid digest".to_owned() }),
    }
}
