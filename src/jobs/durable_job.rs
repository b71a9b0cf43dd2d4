//! One durable job from its acceptance to its end, and the state that its watchers see.

use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::gauge;
use tokio::sync::{Notify, watch};
use tracing::Instrument as _;

use super::job_store::{JobStore, JobView};
use super::record::{JobId, JobRecord, Status, now_ms};
use super::records::LoadError;
use super::results::{self, SaveError};
use super::retry::{self, retry};
use super::{ContentKey, EndError, Failure, Finished, Refusal, Ticket};
use crate::pipeline::JobError;
use crate::store::{Digest, Pin, StoreError};
use crate::surface::{OutOfMemory, SurfaceError};
use crate::sync::{Handle, sleep};
use crate::telemetry::{JOBS_OPEN, SpanKind, TraceSpan};

/// Interval at which the progress of a running job is published.
const TICK: Duration = Duration::from_millis(100);
/// Pause between two attempts to get a queue slot or memory.
const PAUSE: Duration = Duration::from_millis(500);
/// Upper limit of the pause after an attempt that lacked memory. Each attempt repeats the work.
const MAX_MEMORY_PAUSE: Duration = Duration::from_mins(1);

/// A job whose record is in the store.
pub(super) struct DurableJob {
    pub(super) state: watch::Sender<JobView>,
    /// Signals the runner to stop the work.
    pub(super) dismissed: Notify,
    /// Held while the record is written.
    pub(super) writing: tokio::sync::Mutex<()>,
}

impl DurableJob {
    pub(super) fn new(record: JobRecord) -> Self {
        let fraction = if record.status == Status::Successful { 1.0 } else { 0.0 };
        // Later than every version of an earlier process, unless the job has ended.
        let version = record.finished_ms.unwrap_or_else(now_ms);
        let (state, _) = watch::channel(JobView { record, stage: None, fraction, version, end: None });
        Self { state, dismissed: Notify::new(), writing: tokio::sync::Mutex::default() }
    }

    pub(super) fn id(&self) -> JobId {
        self.state.borrow().record.id.clone()
    }

    /// Returns the latest record. It contains the end once that is decided, even if it is not visible yet.
    pub(super) fn record(&self) -> JobRecord {
        let view = self.state.borrow();
        view.end.as_deref().unwrap_or(&view.record).clone()
    }

    pub(super) fn view(&self) -> JobView {
        self.state.borrow().clone()
    }

    /// Returns the time of its end, ms since 1970, and its id; `None` if it has not ended.
    pub(super) fn ended(&self) -> Option<(u64, JobId)> {
        let view = self.state.borrow();
        view.record.finished_ms.map(|ms| (ms, view.record.id.clone()))
    }

    /// Calls `change` with the state and the present time unless the job has ended. If it returns true, the time
    /// becomes the version of the state, and watchers are notified. Returns the value of `change`, or false.
    fn update(&self, change: impl FnOnce(&mut JobView, u64) -> bool) -> bool {
        self.state.send_if_modified(|view| {
            let now = now_ms().max(view.version + 1);
            let is_open = !view.record.status.is_final() && view.end.is_none();
            let changed = is_open && change(view, now);
            if changed {
                view.version = now;
            }
            changed
        })
    }

    /// Marks the job as running and counts an attempt. Returns false if the job has ended, for example by a dismissal.
    pub(super) fn begin(&self) -> bool {
        self.update(|view, now| {
            view.record.attempts += 1;
            view.record.status = Status::Running;
            view.record.started_ms = Some(now);
            true
        })
    }

    /// Marks the job as accepted again, with `attempts` attempts. Returns true if that changed the record.
    fn return_to_queue(&self, attempts: u32) -> bool {
        self.update(|view, _| {
            if view.record.attempts == attempts && view.record.started_ms.is_none() {
                return false;
            }
            view.record.attempts = attempts;
            view.record.status = Status::Accepted;
            view.record.started_ms = None;
            view.stage = None;
            true
        })
    }

    /// Marks the job as accepted again, with `attempts` attempts, and writes the record. An attempt does not count if
    /// the service stopped it or if memory was short.
    async fn record_return_to_queue(&self, jobs: &JobStore, attempts: u32) {
        if self.return_to_queue(attempts)
            && let Err(error) = jobs.0.write_job(self).await
        {
            tracing::warn!(job_id = %self.id(), %error, "an interrupted attempt is counted");
        }
    }

    /// Decides the end of the job: sets `status` and applies `change` to the record. Returns false if the end was
    /// decided before. [`Self::publish_end`] makes it visible.
    pub(super) fn end(&self, status: Status, change: impl FnOnce(&mut JobRecord)) -> bool {
        let mut decided = false;
        self.update(|view, now| {
            let mut record = view.record.clone();
            record.status = status;
            record.finished_ms = Some(now);
            change(&mut record);
            view.end = Some(Box::new(record));
            decided = true;
            false
        });
        decided
    }

    /// Makes a decided end visible.
    pub(super) fn publish_end(&self) {
        self.state.send_if_modified(|view| {
            let Some(record) = view.end.take() else { return false };
            view.version = record.finished_ms.unwrap_or(view.version + 1);
            view.stage = None;
            if record.status == Status::Successful {
                view.fraction = 1.0;
            }
            view.record = *record;
            true
        });
    }

    /// Publishes the stage and the finished fraction of the running work if they have advanced.
    fn publish_stage(&self, stage: &'static str, fraction: f64) {
        self.update(|view, now| {
            let waits = view.record.status == Status::Accepted;
            if !waits && view.stage == Some(stage) && fraction <= view.fraction + 0.004 {
                return false;
            }
            if waits {
                view.record.status = Status::Running;
                view.record.started_ms = Some(now);
            }
            view.stage = Some(stage);
            view.fraction = view.fraction.max(fraction);
            true
        });
    }
}

/// State of the task that runs a durable job to its end.
pub(super) struct Runner {
    pub(super) job: Arc<DurableJob>,
    /// Ticket of queued or running work; `None` for a job from the records.
    pub(super) ticket: Option<Ticket>,
    /// Keeps input, map and record in the store.
    pub(super) pin: Vec<Pin>,
    pub(super) digest: Digest,
    /// Number of attempts by earlier processes.
    pub(super) earlier_attempts: u32,
}

impl JobStore {
    /// Runs a job in a task of its own, traced under the request that created it.
    pub(super) fn spawn(&self, runner: Runner) {
        let record = runner.job.record();
        let log = record.requester.parent(&self.0.pool.settings().tracer).log_span(Some(record.id.as_str()));
        gauge!(JOBS_OPEN).increment(1.0);
        self.0.open.send_modify(|open| *open += 1);
        let jobs = self.clone();
        let run = async move {
            runner.run(&jobs).await;
            gauge!(JOBS_OPEN).decrement(1.0);
            jobs.0.open.send_modify(|open| *open -= 1);
        };
        Handle::current().spawn(run.instrument(log));
    }

    /// Waits until every job has ended or is left to the next process, and its record is written. The pool must be
    /// drained.
    pub(crate) async fn all_recorded(&self) {
        drop(self.0.open.subscribe().wait_for(|open| *open == 0).await);
    }
}

/// Result of one attempt to run a job.
enum Attempt {
    /// The job has ended: key of the result with its pin, or the error.
    Ended(Result<(String, Pin), EndError>),
    /// The queue is full, or memory for the input is short.
    Retry,
    /// The work needed more memory than was left.
    OutOfMemory(OutOfMemory),
    /// The store fails; it is retried with growing pauses.
    StoreFailed,
    /// The service stops; the next process runs the job.
    Left,
}

impl Runner {
    pub(super) async fn run(self, jobs: &JobStore) {
        let Self { job, mut ticket, pin, digest, earlier_attempts } = self;
        let (begun, mut pause, mut counted) = (Instant::now(), retry::FIRST_PAUSE, earlier_attempts);
        loop {
            let attempt = attempt(jobs, &job, &mut ticket, digest);
            let attempt = tokio::select! {
                attempt = attempt => attempt,
                // Dropping the ticket stops the work.
                () = job.dismissed.notified() => break,
            };
            match attempt {
                Attempt::Ended(ending) => {
                    jobs.finish(&job, ending).await;
                    break;
                }
                Attempt::Retry => {
                    pause = retry::FIRST_PAUSE;
                    sleep(PAUSE).await;
                }
                Attempt::OutOfMemory(error) => {
                    let never_fits = matches!(error, OutOfMemory::Limit { .. });
                    if never_fits || begun.elapsed() >= jobs.0.allowed() {
                        jobs.finish(&job, Err(EndError::Job(error.into()))).await;
                        break;
                    }
                    tracing::info!(job_id = %job.id(), %error, "a job waits for memory");
                    job.record_return_to_queue(jobs, counted).await;
                    sleep(pause).await;
                    pause = (pause * 2).min(MAX_MEMORY_PAUSE);
                }
                Attempt::StoreFailed => {
                    counted = job.record().attempts;
                    sleep(pause).await;
                    pause = (pause * 2).min(retry::MAX_PAUSE);
                }
                Attempt::Left => {
                    job.record_return_to_queue(jobs, counted).await;
                    break;
                }
            }
        }
        drop(pin);
    }
}

async fn attempt(jobs: &JobStore, job: &Arc<DurableJob>, ticket: &mut Option<Ticket>, digest: Digest) -> Attempt {
    let record = job.record();
    let mut ticket = match ticket.take() {
        Some(ticket) => ticket,
        None => match submit(jobs, job, &record, digest).await {
            Ok(ticket) => ticket,
            Err(attempt) => return attempt,
        },
    };
    let outcome = loop {
        tokio::select! {
            outcome = ticket.wait() => break outcome,
            () = sleep(TICK) => {
                if let Some((stage, fraction)) = ticket.progress.now() {
                    job.publish_stage(stage, fraction);
                }
            }
        }
    };
    match outcome {
        Ok(finished) => {
            job.publish_stage("encode", 0.95);
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
        Err(Failure::Stopped | Failure::Job { error: JobError::Surface(SurfaceError::Cancelled), .. }) => Attempt::Left,
        Err(Failure::Memory(error)) => Attempt::OutOfMemory(error),
        Err(Failure::Waited { limit, .. }) => Attempt::Ended(Err(Failure::Deadline { limit }.into())),
        Err(failure) => Attempt::Ended(Err(failure.into())),
    }
}

/// Submits a job from its record to the queue. Holds a permit of `loads` while the queue is full or memory is short, so
/// that few jobs retry at the same time.
async fn submit(jobs: &JobStore, job: &Arc<DurableJob>, record: &JobRecord, digest: Digest) -> Result<Ticket, Attempt> {
    if record.attempts >= jobs.0.config.attempts {
        return Err(Attempt::Ended(Err(EndError::Poison { attempts: record.attempts })));
    }
    // The semaphore is never closed.
    let permit = jobs.0.loads.acquire().await;
    let ticket = loop {
        match join_or_load(jobs, job, record, digest).await {
            Err(Attempt::Retry) => sleep(PAUSE).await,
            submitted => break submitted?,
        }
    };
    drop(permit);
    if ticket.joined_running && job.begin() {
        jobs.0.write_job(job).await.map_err(|error| store_failed(record, &error))?;
    }
    Ok(ticket)
}

fn store_failed(record: &JobRecord, error: &StoreError) -> Attempt {
    tracing::warn!(job_id = %record.id, %error, "a job waits for the store");
    Attempt::StoreFailed
}

/// Joins an identical job. Otherwise submits the job with its input, if the queue has a free slot and there is memory.
async fn join_or_load(
    jobs: &JobStore,
    job: &Arc<DurableJob>,
    record: &JobRecord,
    digest: Digest,
) -> Result<Ticket, Attempt> {
    let lost = |why| Attempt::Ended(Err(EndError::Lost { why }));
    let refused = |refusal| match refusal {
        Refusal::Draining => Attempt::Left,
        // An accepted job waits until the queue has a free slot.
        Refusal::QueueFull { .. } | Refusal::TooLate { .. } => Attempt::Retry,
    };
    let (mut task, format) = jobs.task_of(record, digest).map_err(lost)?;
    let (pool, mut on_start) = (&jobs.0.pool, Some(jobs.on_start(job, None)));
    if let Some(ticket) = pool.join(&task, jobs.0.allowed(), &mut on_start).map_err(refused)? {
        return Ok(ticket);
    }
    // An earlier process may have ended between storing the result and updating the record.
    let stored = jobs.stored_result(&task, format).await.map_err(|error| store_failed(record, &error))?;
    if let Some(stored) = stored {
        return Err(Attempt::Ended(Ok(stored)));
    }
    jobs.load_input(&mut task).await.map_err(|error| match error {
        LoadError::Removed | LoadError::Store(StoreError::Damaged { .. }) => lost(error.to_string()),
        LoadError::Memory(error @ OutOfMemory::Limit { .. }) => Attempt::Ended(Err(EndError::Job(error.into()))),
        LoadError::Memory(_) => Attempt::Retry,
        LoadError::Store(error) => store_failed(record, &error),
    })?;
    pool.submit(task, jobs.0.allowed(), on_start).map_err(refused)
}

/// Stores the result and returns its key, with its pin.
async fn save(jobs: &JobStore, record: &JobRecord, finished: Arc<Finished>) -> Result<(String, Pin), EndError> {
    let lost = |why| EndError::Lost { why };
    let (request, format) = record.request().map_err(lost)?;
    let report = &finished.product.report;
    let (resolution, digest) = (report.resolution, finished.digest);
    let key = ContentKey::new(&digest, &request.job, format, &report.file_arithmetic(), record.namespace);
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
