//! Dispatch and claims of jobs, and the state of jobs that run in other processes.

use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt as _;
use tokio::sync::OwnedSemaphorePermit;

use super::broker::{Broker, Claim, ClaimEnd, Dispatch, JobEvent};
use super::durable_job::DurableJob;
use super::job_store::JobStore;
use super::rank::Lane;
use super::record::{JobRecord, Status};
use super::retry;
use super::runner::Runner;
use super::runs::{Phase, RunEnd};
use super::{Refusal, Task};
use crate::store::StoreError;
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
    /// Returns the broker. [`Self::reconcile`] dispatches again the jobs that the broker has lost.
    pub(crate) fn broker(&self) -> &dyn Broker {
        self.0.broker.as_ref()
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
        let expected = pool.expected(&task.input, &task.request.options).as_secs_f64();
        let ahead = Duration::try_from_secs_f64(expected * waiting as f64 / pool.settings().workers as f64);
        let wait = pool.estimated_wait(Lane::Batch).saturating_add(ahead.unwrap_or(Duration::MAX));
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
                () = self.0.runs.reached(Phase::Finish) => None,
                claimed = next => claimed,
            };
            let Some((claim, slot)) = claimed else { return };
            let (jobs, run) = (self.clone(), self.count_run());
            Handle::current().spawn(async move {
                let end = jobs.run_claimed(&claim, slot).await;
                claim.end(end.claim).await;
                run.end(end);
            });
        }
    }

    /// Runs a claimed job unless it has ended or runs in this process already.
    async fn run_claimed(&self, claim: &Claim, slot: OwnedSemaphorePermit) -> RunEnd {
        let record = tokio::select! {
            biased;
            record = self.record_of(claim) => match record {
                Ok(record) => record,
                Err(end) => return RunEnd::without_record(end),
            },
            () = self.0.runs.reached(Phase::Return) => return RunEnd::returned(Duration::ZERO, true),
        };
        let job = self.insert_open(record.clone());
        if job.ended().is_some() {
            // Its end could not be written before.
            let Err(error) = self.0.write_job(&job).await else { return RunEnd::done(true) };
            tracing::error!(job_id = %job.id(), %error, "cannot record the end of a job");
            return RunEnd::returned(DUPLICATE, false);
        }
        let owned = self.0.lock().own(&job);
        let Some(owned) = owned else { return RunEnd::without_record(ClaimEnd::Release(DUPLICATE)) };
        self.0.open(record.id.clone(), Ok(Dispatch::of(&record)), self.0.pins(&record));
        job.adopt(record);
        Runner { jobs: self.clone(), owned, ticket: None, slot: Some(slot) }.run().await
    }

    /// Reads the record of a claimed job. Returns the end of the claim as an error if the job has ended, is not on
    /// record or belongs to another release. Waits while the store fails.
    async fn record_of(&self, claim: &Claim) -> Result<JobRecord, ClaimEnd> {
        let mut pause = retry::FIRST_PAUSE;
        loop {
            match self.0.read(&claim.id).await {
                Ok(Some(record)) if record.status.is_final() => return Err(ClaimEnd::Done),
                Ok(Some(record)) if record.request().is_err() => return Err(ClaimEnd::Release(OTHER_RELEASE)),
                Ok(record) => return record.ok_or(ClaimEnd::Done),
                Err(StoreError::Quarantined { .. }) => return Err(ClaimEnd::Done),
                Err(StoreError::OtherRelease { .. }) => return Err(ClaimEnd::Release(OTHER_RELEASE)),
                Err(error) => tracing::warn!(job_id = %claim.id, %error, "a claimed job waits for the store"),
            }
            sleep(pause).await;
            pause = (pause * 2).min(retry::MAX_PAUSE);
        }
    }

    /// Adds an unfinished job to the map, unless it is there, and returns the job in the map.
    pub(super) fn insert_open(&self, record: JobRecord) -> Arc<DurableJob> {
        let fresh = Arc::new(DurableJob::new(record));
        let job = self.0.lock().insert(&fresh);
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
                    JobEvent::Running(progress) if job.is_owned() => {
                        // An attempt that returned to the queue does not count any more.
                        let own = job.record();
                        if own.status == Status::Running && progress.attempts > own.attempts {
                            tracing::warn!(job_id = %id, "another worker runs a later attempt of a job");
                            job.stop();
                        }
                        false
                    }
                    JobEvent::Running(progress) => {
                        job.publish_progress(&progress);
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
                self.0.close(&id);
                if job.is_owned() {
                    job.stop();
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
                job.stop();
                true
            }
            Err(error) => {
                tracing::debug!(job_id = %id, %error, "the record of a followed job was not read");
                false
            }
        }
    }
}

/// Returns true if only the task that follows a job uses it.
fn is_unused(job: &DurableJob) -> bool {
    job.state.receiver_count() <= 1 && !job.is_owned()
}
