//! One promised job from its acceptance to its end, and whoever watches it.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use metrics::gauge;
use tokio::sync::{Notify, watch};
use tracing::Instrument as _;

use super::flight::Progress;
use super::ledger::{Ledger, View};
use super::patience::{self, insist};
use super::rank::{Client, Rank};
use super::record::{JobId, Record, Status, now_ms};
use super::results::{self, SaveError};
use super::{ContentKey, EndError, Failure, Finished, Lease, Refusal, Task, Ticket};
use crate::formats::Format;
use crate::pipeline::{JobError, params};
use crate::store::{Digest, Pin};
use crate::surface::SurfaceError;
use crate::telemetry::{JOBS_OPEN, SpanKind, TraceSpan, Tracer};

/// How often a running job's progress is looked at.
const TICK: Duration = Duration::from_millis(100);
/// Between two attempts to get a place in the queue, or memory.
const PAUSE: Duration = Duration::from_millis(500);

/// A promised job.
pub(super) struct Promise {
    view: watch::Sender<View>,
    progress: Mutex<Option<Arc<Progress>>>,
    dismissed: Notify,
    /// Held while the record is written.
    pub(super) writing: tokio::sync::Mutex<()>,
}

impl Promise {
    pub(super) fn new(record: Record) -> Self {
        let fraction = if record.status == Status::Successful { 1.0 } else { 0.0 };
        let (view, _) = watch::channel(View { record, stage: None, fraction, version: 1, written: Arc::default() });
        Self { view, progress: Mutex::default(), dismissed: Notify::new(), writing: tokio::sync::Mutex::default() }
    }

    pub(super) fn id(&self) -> JobId {
        self.view.borrow().record.id.clone()
    }

    pub(super) fn record(&self) -> Record {
        self.view.borrow().record.clone()
    }

    pub(super) fn view(&self) -> View {
        self.view.borrow().clone()
    }

    pub(super) fn subscribe(&self) -> watch::Receiver<View> {
        self.view.subscribe()
    }

    /// When it ended, and its id; none if it has not.
    pub(super) fn ended(&self) -> Option<(u64, JobId)> {
        let view = self.view.borrow();
        view.record.finished_ms.map(|ms| (ms, view.record.id.clone()))
    }

    /// The work begins. False if the job was dismissed meanwhile: then it stays so.
    pub(super) fn begin(&self) -> bool {
        self.view.send_if_modified(|view| {
            if view.record.status.is_final() {
                return false;
            }
            view.record.attempts += 1;
            view.record.status = Status::Running;
            view.record.started_ms = Some(now_ms());
            view.changed();
            true
        })
    }

    /// The work is left for the next start: the attempt, if there was one, does not count. True if that changed the record.
    fn leave(&self, tried: u32) -> bool {
        self.view.send_if_modified(|view| {
            if view.record.status.is_final() || view.record.attempts == tried && view.record.started_ms.is_none() {
                return false;
            }
            view.record.attempts = tried;
            view.record.status = Status::Accepted;
            view.record.started_ms = None;
            view.stage = None;
            view.changed();
            true
        })
    }

    /// The job ends, unless it has. True if it did.
    pub(super) fn end(&self, status: Status, and: impl FnOnce(&mut Record)) -> bool {
        self.view.send_if_modified(|view| {
            if view.record.status.is_final() {
                return false;
            }
            view.record.status = status;
            view.record.finished_ms = Some(now_ms());
            and(&mut view.record);
            view.stage = None;
            view.changed();
            if status == Status::Successful {
                view.fraction = 1.0;
            }
            true
        })
    }

    /// Tells the runner that nobody wants the result any more.
    pub(super) fn dismiss(&self) {
        self.dismissed.notify_one();
    }

    fn follow(&self, progress: &Arc<Progress>) {
        *self.progress.lock().unwrap_or_else(PoisonError::into_inner) = Some(Arc::clone(progress));
    }

    /// Publishes how far the work is, if it is further.
    fn look(&self) {
        let progress = self.progress.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let Some((stage, fraction)) = progress.and_then(|progress| progress.now()) else { return };
        self.tell(stage, fraction);
    }

    fn tell(&self, stage: &'static str, fraction: f64) {
        self.view.send_if_modified(|view| {
            let waits = view.record.status == Status::Accepted;
            let further = view.stage != Some(stage) || fraction > view.fraction + 0.004;
            if view.record.status.is_final() || !(waits || further) {
                return false;
            }
            if waits {
                view.record.status = Status::Running;
                view.record.started_ms = Some(now_ms());
            }
            view.stage = Some(stage);
            view.fraction = view.fraction.max(fraction);
            view.changed();
            true
        });
    }
}

/// Sees a promised job through. `P` keeps its input in the store.
pub(super) struct Runner<P> {
    pub(super) promise: Arc<Promise>,
    /// The right to the outcome of work that waits or runs; none for a job from the records.
    pub(super) ticket: Option<Ticket>,
    pub(super) pin: P,
    pub(super) digest: Digest,
    /// Times that it was begun before this process took it up.
    pub(super) tried: u32,
}

impl Ledger {
    /// Sees a job through, beside everything else, in the name of the request that asked for it.
    pub(super) fn spawn(&self, runner: Runner<[Pin; 2]>) {
        let record = runner.promise.record();
        let log = record.requester.parent(self.0.pool.tracer()).log_span(Some(record.id.as_str()));
        gauge!(JOBS_OPEN).increment(1.0);
        self.0.open.send_modify(|open| *open += 1);
        let ledger = self.clone();
        let run = async move {
            runner.run(&ledger).await;
            gauge!(JOBS_OPEN).decrement(1.0);
            ledger.0.open.send_modify(|open| *open -= 1);
        };
        tokio::spawn(run.instrument(log));
    }

    /// Waits until every job that was taken up has ended, or is left, and that is on record. The pool must be drained.
    pub async fn settled(&self) {
        drop(self.0.open.subscribe().wait_for(|open| *open == 0).await);
    }
}

/// What became of one attempt.
enum Attempt {
    Ended(Result<String, EndError>),
    /// It can be tried again soon: nothing about the job stands against it.
    Again,
    /// The store does not do its part; it is asked less and less often.
    Silent,
    /// The service stops; the job stays on record, for the next start.
    Left,
}

impl<P> Runner<P> {
    pub(super) async fn run(self, ledger: &Ledger) {
        let Self { promise, mut ticket, pin, digest, tried } = self;
        let mut pause = patience::FIRST;
        loop {
            let attempt = attempt(ledger, &promise, &mut ticket, digest);
            let attempt = tokio::select! {
                attempt = attempt => attempt,
                // Dropping the ticket stops the work.
                () = promise.dismissed.notified() => break,
            };
            match attempt {
                Attempt::Ended(ending) => {
                    ledger.finish(&promise, ending).await;
                    break;
                }
                Attempt::Again => {
                    pause = patience::FIRST;
                    tokio::time::sleep(PAUSE).await;
                }
                Attempt::Silent => {
                    tokio::time::sleep(pause).await;
                    pause = (pause * 2).min(patience::LONGEST);
                }
                Attempt::Left => {
                    // Stopping a service is not the job's fault, however often it happens.
                    if promise.leave(tried)
                        && let Err(error) = ledger.0.keep_up(&promise).await
                    {
                        tracing::warn!(job_id = %promise.id(), %error, "a job that is left counts an attempt too many");
                    }
                    break;
                }
            }
        }
        drop(pin);
    }
}

async fn attempt(ledger: &Ledger, promise: &Arc<Promise>, ticket: &mut Option<Ticket>, digest: Digest) -> Attempt {
    let record = promise.record();
    let mut ticket = match ticket.take() {
        Some(ticket) => ticket,
        None => match submit(ledger, promise, &record, digest).await {
            Ok(ticket) => ticket,
            Err(attempt) => return attempt,
        },
    };
    promise.follow(ticket.progress());
    let outcome = loop {
        tokio::select! {
            outcome = ticket.wait() => break outcome,
            () = tokio::time::sleep(TICK) => promise.look(),
        }
    };
    match outcome {
        Ok(finished) => {
            promise.tell("encode", 0.95);
            match save(ledger, &record, finished).await {
                // The mesh is not held for ever. As long as it may be begun again, it is made anew once the store answers.
                Err(EndError::Save { error, .. })
                    if error.is_transient() && promise.record().attempts < ledger.0.settings.attempts =>
                {
                    tracing::warn!(job_id = %record.id, %error, "a result was given up; it is made again");
                    Attempt::Silent
                }
                ending => Attempt::Ended(ending),
            }
        }
        // Work that somebody waits for is cancelled by the end of the service alone.
        Err(Failure::Stopped | Failure::Job { error: JobError::Surface(SurfaceError::Cancelled), .. }) => Attempt::Left,
        Err(Failure::Memory(_)) => Attempt::Again,
        Err(failure) => Attempt::Ended(Err(failure.into())),
    }
}

/// Puts a job from the records into the queue.
async fn submit(ledger: &Ledger, promise: &Arc<Promise>, record: &Record, digest: Digest) -> Result<Ticket, Attempt> {
    let settings = &ledger.0.settings;
    if record.attempts >= settings.attempts {
        return Err(Attempt::Ended(Err(EndError::Poison { attempts: record.attempts })));
    }
    let lost = |why| Attempt::Ended(Err(EndError::Lost { why }));
    // A store that does not answer now is no reason to give a promise up.
    let silent = |error| {
        tracing::warn!(job_id = %record.id, %error, "a job waits for the store");
        Attempt::Silent
    };
    let (task, format) = ledger.task(record, digest).await.map_err(silent)?.map_err(lost)?;
    // An earlier process may have ended between the result and its record.
    if let Some(key) = ledger.made(&task, format).await.map_err(silent)? {
        return Err(Attempt::Ended(Ok(key)));
    }
    let claim = ledger.claim(promise, None);
    let ticket = ledger.0.pool.submit(task, settings.allowed, Some(claim)).map_err(|refusal| match refusal {
        Refusal::Draining => Attempt::Left,
        // It was accepted once: it waits until there is room.
        Refusal::QueueFull { .. } | Refusal::TooLate { .. } => Attempt::Again,
    })?;
    if ticket.came_late() && promise.begin() {
        ledger.0.keep_up(promise).await.map_err(silent)?;
    }
    Ok(ticket)
}

/// Keeps the result. Its key comes back.
async fn save(ledger: &Ledger, record: &Record, finished: Arc<Finished>) -> Result<String, EndError> {
    let lost = |why| EndError::Lost { why };
    let (job, format) = read(record).map_err(lost)?;
    let report = &finished.product.report;
    let (resolution, digest) = (report.resolution, finished.digest);
    let key = ContentKey::new(&digest, &job, format, &report.maker());
    let (store, settings) = (&ledger.0.store, &ledger.0.settings);
    let parent = record.requester.parent(ledger.0.pool.tracer());
    let span = TraceSpan::start(&parent, "keep", SpanKind::Internal, Instant::now());
    let keep = || results::save(store, Arc::clone(&finished), format, &key, settings.output_bytes);
    insist(&record.id, settings.patience, SaveError::is_transient, keep)
        .await
        .map_err(|error| EndError::Save { error, resolution })?;
    span.end();
    Ok(key.to_string())
}

/// The job and the format of a record.
fn read(record: &Record) -> Result<(crate::pipeline::Job, Format), String> {
    let mut request = params::parse(record.parameters.iter().map(|(n, v)| (n, v))).map_err(|e| e.to_string())?;
    let format = record.format.parse().map_err(|_bad| format!("its format `{}` is unknown", record.format))?;
    params::settle(&mut request.job, format).map_err(|e| e.to_string())?;
    Ok((request.job, format))
}

/// The task of a record, with its input.
pub(super) fn task(
    record: &Record,
    digest: Digest,
    input: Bytes,
    lease: Lease,
    tracer: &Tracer,
) -> Result<(Task, Format), String> {
    let (job, format) = read(record)?;
    let rank = Rank { client: Client::numbered(record.client), batch: true, urgency: record.urgency };
    let strict = record.parameters.iter().any(|(name, _)| name == "check");
    let (parent, id) = (record.requester.parent(tracer), Some(record.id.clone()));
    Ok((Task { input, digest, strict, job, rank, lease: Some(Arc::new(lease)), parent, id }, format))
}
