//! Run of a durable job, from its claim to its end or to its return to the queue.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::OwnedSemaphorePermit;
use tracing::Instrument as _;

use super::broker::{Claim, Dispatch, JobEvent, WorkLock};
use super::coalesced_job::work_key;
use super::durable_job::DurableJob;
use super::job_store::JobStore;
use super::record::JobRecord;
use super::records::LoadError;
use super::results::{self, SaveError};
use super::retry::{self, retry};
use super::runs::RunResult;
use super::{ContentKey, EndError, Failure, Finished, Refusal, Ticket};
use crate::pipeline::JobError;
use crate::store::{Digest, Pin, StoreError};
use crate::surface::{OutOfMemory, SurfaceError};
use crate::sync::{Handle, sleep};
use crate::telemetry::{SpanKind, TraceSpan};

/// Interval at which the progress of a running job is published. Its worker only stores fractions, so the number of
/// listeners does not slow it down.
const TICK: Duration = Duration::from_millis(100);
/// Pause between two attempts to get memory for an input.
const PAUSE: Duration = Duration::from_millis(500);
/// Time after which a job whose work another node does is claimed again.
const LOCKED_DELAY: Duration = Duration::from_millis(500);
/// Upper limit of the pause after an attempt that lacked memory. Each attempt repeats the work.
const MAX_MEMORY_PAUSE: Duration = Duration::from_mins(1);

/// State of the task that runs a durable job.
pub(super) struct Runner {
    /// The job, which this runner owns.
    pub(super) job: Arc<DurableJob>,
    /// SHA-256 of the input.
    pub(super) digest: Digest,
    /// Ticket of queued or running work; `None` for a claimed job.
    pub(super) ticket: Option<Ticket>,
    /// Claim of the job; `None` for a job whose work had begun before its acceptance.
    pub(super) claim: Option<Claim>,
    /// Permit of the job for a worker. A job that joins the work of another one needs none.
    pub(super) slot: Option<OwnedSemaphorePermit>,
}

/// Ticket of submitted work, and its lock unless another job has it.
type Work = (Ticket, Option<WorkLock>);

/// End of the run of a job.
enum RunEnd {
    /// The job has ended.
    Done {
        /// False if the store has rejected the record of the end.
        recorded: bool,
    },
    /// Another worker has claimed the job.
    Superseded,
    /// The job returns to the queue.
    Return {
        /// Time after which the job can be claimed.
        delay: Duration,
        /// False if the store has rejected the record, in which the attempt still counts.
        recorded: bool,
    },
}

/// Result of one attempt to run a job.
enum Attempt {
    /// The job has ended: key of the result with its pin, or the error.
    Ended(Result<(String, Pin), EndError>),
    /// The work needed more memory than was left.
    OutOfMemory(OutOfMemory),
    /// The store fails; it is retried with growing pauses.
    StoreFailed,
    /// Another node does the same work; its result will be found.
    Locked,
    /// The service stops; another process runs the job.
    Stopped,
}

/// Returns the pause after an attempt that lacked memory, of which there were `earlier` before.
fn memory_pause(earlier: u32) -> Duration {
    (retry::FIRST_PAUSE * (1 << earlier.min(16))).min(MAX_MEMORY_PAUSE)
}

/// Ownership of a job, until it is dropped.
struct Ownership(Arc<DurableJob>);

impl Drop for Ownership {
    fn drop(&mut self) {
        self.0.release();
    }
}

impl JobStore {
    /// Runs a job in a task of its own, traced under the request that created it.
    pub(super) fn spawn(&self, runner: Runner) {
        let record = runner.job.record();
        let log = record.requester.parent(&self.0.pool.settings().tracer).log_span(Some(record.id.as_str()));
        let (ownership, run, jobs) = (Ownership(Arc::clone(&runner.job)), self.count_run(), self.clone());
        let work = async move {
            let result = runner.run(&jobs).await;
            drop(ownership);
            run.end(result);
        };
        Handle::current().spawn(work.instrument(log));
    }
}

impl Runner {
    /// Runs the job. Returns the result, unless another worker has claimed the job.
    async fn run(self, jobs: &JobStore) -> Option<RunResult> {
        let Self { job, digest, mut ticket, claim, mut slot } = self;
        let (mut pause, stop) = (Duration::ZERO, job.stop());
        let mut counted = job.record().attempts - u32::from(ticket.is_some());
        let end = loop {
            let attempt = async {
                if !pause.is_zero() {
                    sleep(pause).await;
                }
                attempt(jobs, &job, (&mut ticket, &mut slot), digest).await
            };
            // Dropping the attempt with its ticket stops the work.
            let attempt = tokio::select! {
                biased;
                attempt = attempt => attempt,
                () = stop.notified() => {
                    break if job.is_decided() { RunEnd::Done { recorded: true } } else { RunEnd::Superseded };
                }
                () = jobs.0.runs.returning() => Attempt::Stopped,
            };
            match attempt {
                Attempt::Ended(ending) => {
                    if ending.is_err() && jobs.is_superseded(&job).await {
                        tracing::warn!(job_id = %job.id(), "another worker runs a later attempt of a job that failed");
                        break RunEnd::Superseded;
                    }
                    break RunEnd::Done { recorded: jobs.finish(&job, ending).await };
                }
                Attempt::OutOfMemory(error) => {
                    let waits = job.record().memory_waits;
                    let waited: Duration = (0..waits).map(memory_pause).sum();
                    let never_fits = matches!(error, OutOfMemory::Limit { .. });
                    if never_fits || waited >= jobs.0.allowed() {
                        break RunEnd::Done { recorded: jobs.finish(&job, Err(EndError::Job(error.into()))).await };
                    }
                    tracing::info!(job_id = %job.id(), %error, "a job waits for memory");
                    break jobs.return_to_queue(&job, (counted, 1), memory_pause(waits)).await;
                }
                Attempt::StoreFailed => {
                    counted = job.record().attempts;
                    pause = (pause * 2).clamp(retry::FIRST_PAUSE, retry::MAX_PAUSE);
                }
                Attempt::Locked => break RunEnd::Return { delay: LOCKED_DELAY, recorded: true },
                Attempt::Stopped => break jobs.return_to_queue(&job, (counted, 0), Duration::ZERO).await,
            }
        };
        job.release();
        match (&end, claim) {
            (RunEnd::Done { .. }, Some(claim)) => claim.done().await,
            (RunEnd::Superseded, Some(claim)) => claim.abandon(),
            (RunEnd::Return { delay, .. }, Some(claim)) => claim.release(*delay),
            (RunEnd::Done { .. } | RunEnd::Superseded, None) => {}
            (RunEnd::Return { .. }, None) => jobs.dispatch(&Dispatch::of(&job.record())).await,
        }
        match end {
            RunEnd::Done { recorded: true } => Some(RunResult::Finished),
            RunEnd::Return { recorded: true, .. } => Some(RunResult::Returned),
            RunEnd::Done { .. } | RunEnd::Return { .. } => Some(RunResult::Unrecorded),
            RunEnd::Superseded => None,
        }
    }
}

async fn attempt(
    jobs: &JobStore,
    job: &Arc<DurableJob>,
    (ticket, slot): (&mut Option<Ticket>, &mut Option<OwnedSemaphorePermit>),
    digest: Digest,
) -> Attempt {
    let record = job.record();
    let (mut ticket, lock) = match ticket.take() {
        // Other nodes may find the record and dispatch the job.
        Some(mut ticket) => {
            ticket.is_durable = true;
            (ticket, jobs.lock_work(&record, digest).await)
        }
        None => match submit(jobs, job, &record, digest).await {
            Ok(submitted) => submitted,
            Err(attempt) => return attempt,
        },
    };
    if ticket.is_shared {
        drop(slot.take());
    }
    // Until the result is stored.
    let _lock = lock;
    let outcome = loop {
        tokio::select! {
            outcome = ticket.wait() => break outcome,
            () = sleep(TICK) => {
                if let Some((stage, fraction)) = ticket.progress.now() {
                    jobs.publish_stage(job, stage, fraction);
                }
            }
        }
    };
    match outcome {
        Ok(finished) => {
            jobs.publish_stage(job, "encode", 0.95);
            match save(jobs, &record, finished).await {
                // The mesh is not held for ever. It is computed again while attempts are left.
                Err(EndError::Save { error, .. })
                    if error.is_temporary() && job.record().attempts < jobs.0.config.attempts =>
                {
                    tracing::warn!(job_id = %record.id, %error, "a result was not stored; computing it again");
                    Attempt::StoreFailed
                }
                ending => Attempt::Ended(ending),
            }
        }
        // Work with a ticket is cancelled only when the service stops.
        Err(Failure::Stopped | Failure::Job { error: JobError::Surface(SurfaceError::Cancelled), .. }) => {
            Attempt::Stopped
        }
        Err(Failure::Memory(error)) => Attempt::OutOfMemory(error),
        Err(failure) => Attempt::Ended(Err(failure.into())),
    }
}

/// Submits a claimed job to the pool. Waits while memory for its input is short.
async fn submit(jobs: &JobStore, job: &Arc<DurableJob>, record: &JobRecord, digest: Digest) -> Result<Work, Attempt> {
    let (ticket, lock) = loop {
        if let Some(work) = join_or_load(jobs, job, record, digest).await? {
            break work;
        }
        sleep(PAUSE).await;
    };
    if ticket.joined_running {
        jobs.begin(job).await;
    }
    Ok((ticket, lock))
}

fn store_failed(record: &JobRecord, error: &StoreError) -> Attempt {
    tracing::warn!(job_id = %record.id, %error, "a job waits for the store");
    Attempt::StoreFailed
}

/// Joins an identical job. Otherwise submits the job with its input. `None` if memory for the input is short.
async fn join_or_load(
    jobs: &JobStore,
    job: &Arc<DurableJob>,
    record: &JobRecord,
    digest: Digest,
) -> Result<Option<Work>, Attempt> {
    let lost = |why| Attempt::Ended(Err(EndError::Lost { why }));
    // The pool refuses a claimed job only while it stops.
    let refused = |_: Refusal| Attempt::Stopped;
    let (mut task, format) = jobs.task_of(record, digest).map_err(lost)?;
    let (pool, mut on_start) = (&jobs.0.pool, Some(jobs.on_start(job)));
    if let Some(ticket) = pool.join(&task, jobs.0.allowed(), &mut on_start).map_err(refused)? {
        return Ok(Some((ticket, None)));
    }
    let lock = jobs.0.broker.lock(&work_key(&task)).await.ok_or(Attempt::Locked)?;
    // An earlier process may have ended between storing the result and updating the record.
    let stored = jobs.stored_result(&task, format).await.map_err(|error| store_failed(record, &error))?;
    if let Some(stored) = stored {
        return Err(Attempt::Ended(Ok(stored)));
    }
    // Without the lock, the last attempt may still run on another node.
    if record.attempts >= jobs.0.config.attempts {
        return Err(Attempt::Ended(Err(EndError::Poison { attempts: record.attempts })));
    }
    match jobs.load_input(&mut task).await {
        Ok(()) => {
            let ticket = pool.submit(task, jobs.0.allowed(), on_start).map_err(refused)?;
            Ok(Some((ticket, Some(lock))))
        }
        Err(error @ (LoadError::Removed | LoadError::Store(StoreError::Damaged { .. }))) => {
            Err(lost(error.to_string()))
        }
        Err(LoadError::Memory(error @ OutOfMemory::Limit { .. })) => {
            Err(Attempt::Ended(Err(EndError::Job(error.into()))))
        }
        Err(LoadError::Memory(_)) => Ok(None),
        Err(LoadError::Store(error)) => Err(store_failed(record, &error)),
    }
}

/// Stores the result and returns its key, with its pin.
async fn save(jobs: &JobStore, record: &JobRecord, finished: Arc<Finished>) -> Result<(String, Pin), EndError> {
    let lost = |why| EndError::Lost { why };
    let request = record.request().map_err(lost)?;
    let format = request.format;
    let report = &finished.product.report;
    let (resolution, digest) = (report.resolution, finished.digest);
    let key = ContentKey::new(&digest, &request.options, format, &report.file_arithmetic(), record.namespace);
    let parent = record.requester.parent(&jobs.0.pool.settings().tracer);
    let span = TraceSpan::start(&parent, "save", SpanKind::Internal, Instant::now());
    let failed = |error| EndError::Save { error, resolution };
    let pin = jobs.0.store.pin(&key.name(format.name()).map_err(|error| failed(error.into()))?);
    let start = || {
        let (store, finished, limit) = (jobs.0.store.clone(), Arc::clone(&finished), jobs.0.output_bytes);
        async move { results::save(&store, finished, format, &key, limit).await.map(drop) }
    };
    let save = async || {
        let saved = jobs.0.saves.run(&key, start).recv().await;
        saved.unwrap_or_else(|| Err(SaveError::Other("the encoder panicked".to_owned())))
    };
    retry(&record.id, jobs.0.retry_time(), SaveError::is_temporary, save).await.map_err(failed)?;
    span.end();
    Ok((key.to_string(), pin))
}

impl JobStore {
    /// Publishes the stage and the finished fraction of a running job here and to other processes.
    fn publish_stage(&self, job: &DurableJob, stage: &'static str, fraction: f64) {
        let JobRecord { attempts, started_ms, .. } = job.record();
        if job.publish_stage((attempts, started_ms), Cow::Borrowed(stage), fraction) {
            let event = JobEvent::Running { attempts, started_ms, stage: Cow::Borrowed(stage), fraction };
            self.0.broker.publish(&job.id(), event);
        }
    }

    /// Marks a job as accepted again, with `attempts` attempts and `memory_waits` more that lacked memory, and writes
    /// the record. An attempt does not count if the service stopped it or if memory was short. The job can be claimed
    /// again after `delay`, unless another worker has claimed it already.
    async fn return_to_queue(&self, job: &DurableJob, (attempts, memory_waits): (u32, u32), delay: Duration) -> RunEnd {
        if self.is_superseded(job).await {
            return RunEnd::Superseded;
        }
        let mut written = Ok(());
        if job.return_to_queue(attempts, memory_waits) {
            let write = || self.0.write_job(job);
            written = retry(&job.id(), self.0.retry_time(), StoreError::is_temporary, write).await;
        }
        if let Err(error) = &written {
            tracing::warn!(job_id = %job.id(), %error, "an interrupted attempt is counted");
        }
        RunEnd::Return { delay, recorded: written.is_ok() }
    }

    /// Returns true if another process has begun a later attempt of a job, because the claim of this one had expired.
    /// Its release may be another one.
    pub(super) async fn is_superseded(&self, job: &DurableJob) -> bool {
        let own = job.record();
        match self.0.read(&own.id).await {
            Ok(stored) => stored.is_some_and(|stored| stored.attempts > own.attempts),
            Err(error) => matches!(error, StoreError::OtherRelease { .. }),
        }
    }

    /// Locks the work of a job that runs already. `None` if another node does the same work.
    async fn lock_work(&self, record: &JobRecord, digest: Digest) -> Option<WorkLock> {
        let (task, _) = self.task_of(record, digest).ok()?;
        self.0.broker.lock(&work_key(&task)).await
    }
}
