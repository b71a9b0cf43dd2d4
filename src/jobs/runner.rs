//! Run of a durable job, from its claim to its end or to its return to the queue.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::OwnedSemaphorePermit;
use tracing::Instrument as _;

use super::broker::{ClaimEnd, Dispatch, JobEvent, JobProgress};
use super::coalesced_job::work_key;
use super::durable_job::{DurableJob, Ownership};
use super::job_store::JobStore;
use super::record::JobRecord;
use super::results::{self, SaveError};
use super::retry::{self, retry};
use super::runs::{Phase, RunEnd};
use super::{ContentKey, EndError, Failure, Finished, Input, Refusal, Task, Ticket};
use crate::pipeline::MapFile;
use crate::pipeline::params::Request;
use crate::store::{Digest, Name, Pin, StoreError};
use crate::surface::OutOfMemory;
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
    pub(super) jobs: JobStore,
    pub(super) owned: Ownership,
    /// Ticket of queued or running work; `None` for a claimed job.
    pub(super) ticket: Option<Ticket>,
    /// Permit of the job for a worker. A job that joins the work of another one needs none.
    pub(super) slot: Option<OwnedSemaphorePermit>,
}

/// Reason for which an attempt to run a job has no result.
enum NoResult {
    /// The job has failed.
    Failed(EndError),
    /// The work needed more memory than was left.
    OutOfMemory(OutOfMemory),
    /// There is no memory for the input now.
    InputWaits,
    /// The store fails; it is retried with growing pauses.
    StoreFailed { error: SaveError, message: &'static str },
    /// Another node does the same work; its result will be found.
    Locked,
    /// The service stops; another process runs the job.
    Stopped,
}

impl From<EndError> for NoResult {
    fn from(error: EndError) -> Self {
        Self::Failed(error)
    }
}

impl From<StoreError> for NoResult {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::Damaged { .. } => Self::Failed(EndError::Lost { why: error.to_string() }),
            error => Self::StoreFailed { error: error.into(), message: "a job waits for the store" },
        }
    }
}

impl From<OutOfMemory> for NoResult {
    fn from(error: OutOfMemory) -> Self {
        match error {
            OutOfMemory::Limit { .. } => Self::Failed(EndError::Job(error.into())),
            error => Self::OutOfMemory(error),
        }
    }
}

impl From<Refusal> for NoResult {
    /// The pool refuses a claimed job only while it stops.
    fn from(_: Refusal) -> Self {
        Self::Stopped
    }
}

/// Returns the pause after an attempt that lacked memory, of which there were `earlier` before.
fn memory_pause(earlier: u32) -> Duration {
    (retry::FIRST_PAUSE * (1 << earlier.min(16))).min(MAX_MEMORY_PAUSE)
}

impl Runner {
    /// Runs a job without a claim in a task of its own.
    pub(super) fn spawn(self) {
        let (run, jobs, job) = (self.jobs.count_run(), self.jobs.clone(), Arc::clone(&self.owned.job));
        let work = async move {
            let end = self.run().await;
            if let ClaimEnd::Release(_) = end.claim {
                jobs.dispatch(&Dispatch::of(&job.record())).await;
            }
            run.end(end);
        };
        Handle::current().spawn(work.in_current_span());
    }

    /// Runs the job, traced under the request that created it.
    pub(super) async fn run(self) -> RunEnd {
        let record = self.owned.job.record();
        let log = record.requester.parent(&self.jobs.0.pool.settings().tracer).log_span(Some(record.id.as_str()));
        self.run_attempts(record.attempts).instrument(log).await
    }

    async fn run_attempts(mut self, attempts: u32) -> RunEnd {
        let (jobs, job, stop) = (self.jobs.clone(), Arc::clone(&self.owned.job), Arc::clone(&self.owned.stop));
        let (mut pause, mut store_pause) = (Duration::ZERO, Duration::ZERO);
        let mut counted = attempts - u32::from(self.ticket.is_some());
        loop {
            let attempt = async {
                if !pause.is_zero() {
                    sleep(pause).await;
                }
                self.attempt().await
            };
            // Dropping the attempt with its ticket stops the work.
            let attempt = tokio::select! {
                biased;
                attempt = attempt => attempt,
                () = stop.notified() => {
                    let is_decided = job.is_decided();
                    return if is_decided { RunEnd::done(true) } else { RunEnd::without_record(ClaimEnd::Abandon) };
                }
                () = jobs.0.runs.reached(Phase::Return) => Err(NoResult::Stopped),
            };
            let ending = match attempt {
                Ok(result) => Ok(result),
                Err(NoResult::Failed(error)) => Err(error),
                Err(NoResult::OutOfMemory(error)) => {
                    let waited: Duration = (0..job.record().memory_waits).map(memory_pause).sum();
                    if waited < jobs.0.allowed() {
                        tracing::info!(job_id = %job.id(), %error, "a job waits for memory");
                        return jobs.return_to_queue(&job, counted, true).await;
                    }
                    Err(EndError::Job(error.into()))
                }
                Err(NoResult::InputWaits) => {
                    pause = PAUSE;
                    continue;
                }
                Err(NoResult::StoreFailed { error, message }) => {
                    tracing::warn!(job_id = %job.id(), %error, "{message}");
                    counted = job.record().attempts;
                    store_pause = (store_pause * 2).clamp(retry::FIRST_PAUSE, retry::MAX_PAUSE);
                    pause = store_pause;
                    continue;
                }
                Err(NoResult::Locked) => return RunEnd::returned(LOCKED_DELAY, true),
                Err(NoResult::Stopped) => return jobs.return_to_queue(&job, counted, false).await,
            };
            if ending.is_err() && jobs.is_superseded(&job).await {
                tracing::warn!(job_id = %job.id(), "another worker runs a later attempt of a job that failed");
                return RunEnd::without_record(ClaimEnd::Abandon);
            }
            return RunEnd::done(jobs.finish(&job, ending).await);
        }
    }

    /// Returns the key of the stored result, with its pin.
    async fn attempt(&mut self) -> Result<(String, Pin), NoResult> {
        let (jobs, job) = (&self.jobs, &self.owned.job);
        let (record, pool, broker) = (job.record(), &jobs.0.pool, &jobs.0.broker);
        let task = jobs.task_of(&record).map_err(|why| EndError::Lost { why })?;
        let (request, work) = (task.request.clone(), work_key(&task));
        // Held until the result is stored.
        let (mut ticket, _lock) = if let Some(mut ticket) = self.ticket.take() {
            ticket.is_durable = true;
            // Other nodes may find the record and dispatch the job.
            (ticket, broker.lock(&work).await)
        } else {
            let mut on_start = Some(jobs.on_start(job));
            let (ticket, lock) = if let Some(ticket) = pool.join(&task, jobs.0.allowed(), &mut on_start)? {
                (ticket, None)
            } else {
                let lock = broker.lock(&work).await;
                // Another job with the same work may have stored its result. So may an earlier process that ended
                // before it updated the record.
                if let Some(stored) = jobs.stored_result(&task).await? {
                    return Ok(stored);
                }
                let lock = lock.ok_or(NoResult::Locked)?;
                // Without the lock, the last attempt may still run on another node.
                if record.attempts >= jobs.0.config.attempts {
                    return Err(EndError::Poison { attempts: record.attempts }.into());
                }
                let task = jobs.load_input(task, record.map).await?;
                (pool.submit(task, jobs.0.allowed(), on_start)?, Some(lock))
            };
            if ticket.joined_running {
                jobs.begin(job).await;
            }
            (ticket, lock)
        };
        if ticket.is_shared {
            drop(self.slot.take());
        }
        let outcome = loop {
            tokio::select! {
                outcome = ticket.wait() => break outcome,
                () = sleep(TICK) => {
                    if let Some((stage, fraction)) = ticket.progress.now() {
                        jobs.publish_progress(job, stage, fraction);
                    }
                }
            }
        };
        let finished = match outcome {
            Ok(finished) => finished,
            // Work with a ticket is cancelled only when the service stops.
            Err(failure) if failure == Failure::Stopped || failure.is_cancelled() => return Err(NoResult::Stopped),
            Err(Failure::Memory(error)) => return Err(error.into()),
            Err(failure) => return Err(EndError::from(failure).into()),
        };
        jobs.publish_progress(job, "encode", 0.95);
        let saved = save(jobs, &record, &request, finished).await;
        saved.map_err(|error| match error {
            // The mesh is not held for ever. It is computed again while attempts are left.
            EndError::Save { error, .. } if error.is_temporary() && job.record().attempts < jobs.0.config.attempts => {
                NoResult::StoreFailed { error, message: "a result was not stored; computing it again" }
            }
            error => error.into(),
        })
    }
}

/// Stores the result and returns its key, with its pin.
async fn save(
    jobs: &JobStore,
    record: &JobRecord,
    request: &Request,
    finished: Arc<Finished>,
) -> Result<(String, Pin), EndError> {
    let (report, format) = (&finished.product.report, request.format);
    let resolution = report.resolution;
    let key = ContentKey::new(&record.input, request, &report.file_arithmetic(), record.namespace);
    let parent = record.requester.parent(&jobs.0.pool.settings().tracer);
    let span = TraceSpan::start(&parent, "save", SpanKind::Internal, Instant::now());
    let failed = |error| EndError::Save { error, resolution };
    let pin = jobs.0.store.pin(&key.name(format.name()).map_err(|error| failed(error.into()))?);
    // The results of a batch are usually read once, in its archive, and would evict all others from the cache.
    let is_cached = record.batch.is_none();
    let start = || {
        let (store, finished, limit) = (jobs.0.store.clone(), Arc::clone(&finished), jobs.0.output_bytes);
        async move { results::save(&store, finished, format, &key, limit, is_cached).await.map(drop) }
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
    /// Loads the input of a task and its map, charged to the memory budget before they are read.
    async fn load_input(&self, mut task: Task, map: Option<Digest>) -> Result<Task, NoResult> {
        let reservation = self.0.pool.settings().budget.for_client(task.rank.client.0).reservation();
        let (store, namespace) = (&self.0.store, task.namespace);
        let removed = || EndError::Lost { why: "its input was removed".to_owned() };
        let load = async |digest: Digest| {
            let size = store.head(&Name::input(&digest).within(namespace)).await?.ok_or_else(removed)?.size;
            reservation.grow(size).map_err(|error| match error.into() {
                NoResult::OutOfMemory(_) => NoResult::InputWaits,
                error => error,
            })?;
            Ok::<_, NoResult>(store.input(&digest, namespace).await?.ok_or_else(removed)?)
        };
        task.input = Input::File(load(task.digest).await?);
        if let Some(digest) = map {
            task.request.options.map = Some(MapFile::new(digest.to_string(), load(digest).await?));
        }
        task.reservation = Some(Arc::new(reservation));
        Ok(task)
    }

    /// Publishes the stage and the finished fraction of a running job here and to other processes.
    fn publish_progress(&self, job: &DurableJob, stage: &'static str, fraction: f64) {
        let JobRecord { attempts, started_ms, .. } = job.record();
        let progress = JobProgress { attempts, started_ms, stage: Cow::Borrowed(stage), fraction };
        if job.publish_progress(&progress) {
            self.0.broker.publish(&job.id(), JobEvent::Running(progress));
        }
    }

    /// Marks a job as accepted again, with `attempts` attempts, and writes the record. An attempt does not count if the
    /// service stopped it or if memory was short. Each attempt that lacked memory delays the next claim. Does nothing
    /// if another worker has claimed the job already.
    async fn return_to_queue(&self, job: &DurableJob, attempts: u32, lacked_memory: bool) -> RunEnd {
        if self.is_superseded(job).await {
            return RunEnd::without_record(ClaimEnd::Abandon);
        }
        let delay = if lacked_memory { memory_pause(job.record().memory_waits) } else { Duration::ZERO };
        let is_changed = job.return_to_queue(attempts, lacked_memory);
        let written = if is_changed { self.0.write_job_until_stored(job).await } else { Ok(()) };
        if let Err(error) = &written {
            tracing::warn!(job_id = %job.id(), %error, "an interrupted attempt is counted");
        }
        RunEnd::returned(delay, written.is_ok())
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
}
