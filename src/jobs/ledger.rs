//! Jobs that were promised: on record before anybody is told of them, and taken up again after a restart.
//!
//! The store is the truth. Accepting means: input kept, record kept, only then an answer. Meshing twice is harmless, as
//! results are named by their contents; so a crash anywhere costs time and never a job.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, mpsc};
use std::time::Duration;

use bytes::Bytes;
use metrics::counter;
use serde_json::Value;
use tokio::sync::watch;

use super::patience::insist;
use super::promise::{Promise, Runner};
use super::record::{JobId, Record, Requester, Status, now_ms};
use super::{Claim, ContentKey, EndError, Pool, PromiseError, Task, Ticket};
use crate::formats::Format;
use crate::store::{Digest, Folder, Name, Pin, Secret, Store, StoreError};
use crate::telemetry::JOBS_RECOVERED;

/// Ended jobs that are kept in mind; older ones are read from the store.
const MOST_ENDED: usize = 10_000;

/// Sizes of a ledger.
#[derive(Debug, Clone, Copy)]
pub struct LedgerSettings {
    /// Time that a promised job has, waiting included.
    pub allowed: Duration,
    /// Times that a job is begun at most.
    pub attempts: u32,
    /// Bytes of a result at most.
    pub output_bytes: u64,
    /// Time for which what the store does not take is held and offered again.
    pub patience: Duration,
}

/// What a job is made of.
#[derive(Debug)]
pub struct Order {
    /// The task.
    pub task: Task,
    /// Its parameters as they were given.
    pub parameters: Vec<(String, String)>,
    /// The mesh format.
    pub format: Format,
    /// The key under which the client may send it again.
    pub idempotency: Option<String>,
}

/// What everybody may know of a job.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Its record.
    pub record: Record,
    /// The stage that runs.
    pub stage: Option<&'static str>,
    /// How much is done, from 0 to 1.
    pub fraction: f64,
    /// Rises with every change.
    pub version: u64,
    /// What is told of it, written by the first who tells it, for all who do.
    pub written: Arc<OnceLock<String>>,
}

impl View {
    /// Something has changed.
    pub(super) fn changed(&mut self) {
        self.version += 1;
        self.written = Arc::default();
    }
}

/// Writes an ending for clients.
pub type Describe = fn(&EndError) -> Value;

/// The jobs that were promised.
#[derive(Clone)]
pub struct Ledger(pub(super) Arc<Inner>);

pub(super) struct Inner {
    pub(super) store: Store,
    pub(super) pool: Arc<Pool>,
    pub(super) settings: LedgerSettings,
    pub(super) describe: Describe,
    /// Turns idempotency keys into ids.
    secret: Secret,
    promises: Mutex<HashMap<JobId, Arc<Promise>>>,
    /// Jobs that are seen through at this moment.
    pub(super) open: watch::Sender<usize>,
}

impl Inner {
    fn lock(&self) -> MutexGuard<'_, HashMap<JobId, Arc<Promise>>> {
        self.promises.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps what an unfinished job needs from being tidied away.
    fn pin(&self, id: &JobId, input: &Digest) -> Result<[Pin; 2], StoreError> {
        Ok([self.store.pin(&Name::input(input)), self.store.pin(&Name::job(id.as_str())?)])
    }

    /// Writes a record down.
    pub(super) async fn keep(&self, record: &Record) -> Result<(), StoreError> {
        let bytes = serde_json::to_vec(record).unwrap_or_default();
        self.store.put(&Name::job(record.id.as_str())?, Bytes::from(bytes)).await
    }

    /// Writes down how a promise stands. Those who do so for one promise take turns: what is written last is what was so
    /// last, and a job that was dismissed while it began does not come back with the next start.
    pub(super) async fn keep_up(&self, promise: &Promise) -> Result<(), StoreError> {
        let _turn = promise.writing.lock().await;
        self.keep(&promise.record()).await
    }

    /// Keeps a promise in mind, unless there is one with this id; then that one counts.
    fn enter(&self, id: &JobId, promise: &Arc<Promise>) -> Arc<Promise> {
        let mut promises = self.lock();
        let entered = Arc::clone(promises.entry(id.clone()).or_insert_with(|| Arc::clone(promise)));
        if promises.len() > MOST_ENDED + MOST_ENDED / 10 {
            let mut ended: Vec<_> = promises.values().filter_map(|p| p.ended()).collect();
            ended.sort_unstable();
            for (_, id) in ended.iter().take(promises.len().saturating_sub(MOST_ENDED)) {
                promises.remove(id);
            }
        }
        entered
    }
}

impl Ledger {
    /// A ledger over `store`, whose jobs run on `pool`. `secret` is that of the store.
    #[must_use]
    pub(crate) fn new(
        store: Store,
        pool: Arc<Pool>,
        settings: LedgerSettings,
        secret: Secret,
        describe: Describe,
    ) -> Self {
        Self(Arc::new(Inner {
            store,
            pool,
            settings,
            describe,
            secret,
            promises: Mutex::default(),
            open: watch::channel(0).0,
        }))
    }

    /// Promises a job: when this returns, it survives the process. `ticket` is that of a job that waits or runs already.
    ///
    /// # Errors
    /// [`PromiseError`]; then nothing was promised.
    pub async fn promise(&self, order: Order, ticket: Option<Ticket>) -> Result<View, PromiseError> {
        let inner = &self.0;
        let client = order.task.rank.client.number();
        let id = match &order.idempotency {
            Some(key) => JobId::of_key(&inner.secret, client, key),
            None => JobId::random().map_err(PromiseError::Random)?,
        };
        let record = Record {
            id: id.clone(),
            input: order.task.digest.to_string(),
            parameters: order.parameters,
            format: order.format.extension().to_owned(),
            client,
            urgency: order.task.rank.urgency,
            status: Status::Accepted,
            attempts: u32::from(ticket.is_some()),
            created_ms: now_ms(),
            started_ms: None,
            finished_ms: None,
            result: None,
            problem: None,
            requester: Requester::of(&order.task.parent),
        };
        if order.idempotency.is_some()
            && let Some(view) = self.view(&id).await?
        {
            return if record.asks_as(&view.record) { Ok(view) } else { Err(PromiseError::OtherRequest) };
        }
        if ticket.is_none()
            && let Some(key) = self.made(&order.task, order.format).await?
        {
            let ended = Some(now_ms());
            let made = Record { status: Status::Successful, result: Some(key), finished_ms: ended, ..record };
            inner.keep(&made).await?;
            let promise = Arc::new(Promise::new(made));
            return Ok(inner.enter(&id, &promise).view());
        }
        // A place in the queue first: what is on record without one would be a promise that cannot be kept soon.
        let promise = Arc::new(Promise::new(record));
        let (input, digest) = (order.task.input.clone(), order.task.digest);
        let pin = inner.pin(&id, &digest)?;
        let (recorded, kept) = mpsc::sync_channel(1);
        let ticket = if let Some(ticket) = ticket {
            ticket
        } else {
            let claim = self.claim(&promise, Some(kept));
            let task = Task { id: Some(id.clone()), ..order.task };
            let ticket = inner.pool.submit(task, inner.settings.allowed, Some(claim))?;
            if ticket.came_late() {
                promise.begin();
            }
            ticket
        };
        inner.store.put_new(&Name::input(&digest), input).await?;
        let record = serde_json::to_vec(&promise.record()).unwrap_or_default();
        let name = Name::job(id.as_str()).map_err(StoreError::from)?;
        if !inner.store.put_new(&name, Bytes::from(record)).await?
            && let Some(view) = self.view(&id).await?
        {
            // The key came twice at once: the other request was promised first.
            return if promise.record().asks_as(&view.record) { Ok(view) } else { Err(PromiseError::OtherRequest) };
        }
        // A worker that waits for it goes on; there is none where the work runs already.
        _ = recorded.send(());
        let entered = inner.enter(&id, &promise);
        let view = entered.view();
        // Otherwise somebody has asked for it since it is on record, and it was taken up: in the same flight.
        if Arc::ptr_eq(&entered, &promise) {
            self.spawn(Runner { promise, ticket: Some(ticket), pin, digest, tried: 0 });
        }
        Ok(view)
    }

    /// The key of a task's result, if it was made before. A check is made anew.
    pub(super) async fn made(&self, task: &Task, format: Format) -> Result<Option<String>, StoreError> {
        let key = ContentKey::new(&task.digest, &task.job, format, &self.0.pool.maker(&task.job));
        let there = !task.strict && self.0.store.head(&key.name(format.extension())?).await?.is_some();
        Ok(there.then(|| key.to_string()))
    }

    /// What is said of a job, and whatever follows; none if there is no such job.
    ///
    /// # Errors
    /// That of the store.
    pub async fn watch(&self, id: &JobId) -> Result<Option<watch::Receiver<View>>, StoreError> {
        if let Some(promise) = self.0.lock().get(id) {
            return Ok(Some(promise.subscribe()));
        }
        let Some(stored) = self.0.store.get(&Name::job(id.as_str())?).await? else { return Ok(None) };
        // A record that cannot be read is none: nothing of ours writes one.
        let Ok(record) = serde_json::from_slice::<Record>(&stored.bytes) else { return Ok(None) };
        if record.status.is_final() {
            return Ok(Some(Promise::new(record).subscribe()));
        }
        // Somebody asks before it was taken up again.
        Ok(Some(self.take_up(record).await?.subscribe()))
    }

    /// What is said of a job now.
    ///
    /// # Errors
    /// That of the store.
    pub async fn view(&self, id: &JobId) -> Result<Option<View>, StoreError> {
        Ok(self.watch(id).await?.map(|seen| seen.borrow().clone()))
    }

    /// Cancels a job, if it has not ended. What is said of it then; none if there is no such job.
    ///
    /// # Errors
    /// That of the store; the job is cancelled nevertheless.
    pub async fn dismiss(&self, id: &JobId) -> Result<Option<View>, StoreError> {
        let promise = self.0.lock().get(id).cloned();
        let Some(promise) = promise else { return self.view(id).await };
        if promise.end(Status::Dismissed, |_| {}) {
            promise.dismiss();
            self.0.keep_up(&promise).await?;
        }
        Ok(Some(promise.view()))
    }

    /// Takes up what earlier processes left undone. The number of jobs.
    ///
    /// # Errors
    /// That of the store, where the records cannot be listed.
    pub async fn recover(&self) -> Result<usize, StoreError> {
        let mut open = Vec::new();
        for (name, _) in self.0.store.list(Folder::Jobs).await? {
            let Some(stored) = self.0.store.get(&name).await? else { continue };
            match serde_json::from_slice::<Record>(&stored.bytes) {
                Ok(record) if !record.status.is_final() => open.push(record),
                Ok(_) => {}
                Err(error) => tracing::warn!(name = %name, %error, "a job's record cannot be read"),
            }
        }
        // In the order in which they were promised.
        open.sort_by_key(|record| (record.created_ms, record.id.clone()));
        let before = self.0.lock().len();
        for record in open {
            self.take_up(record).await?;
        }
        Ok(self.0.lock().len() - before)
    }

    /// Takes up a job from its record, unless that has been done.
    async fn take_up(&self, record: Record) -> Result<Arc<Promise>, StoreError> {
        let (id, input, tried) = (record.id.clone(), record.input.parse::<Digest>(), record.attempts);
        let fresh = Arc::new(Promise::new(record));
        let known = self.0.lock().get(&id).cloned();
        if let Some(known) = known {
            return Ok(known);
        }
        let Ok(digest) = input else {
            self.finish(&fresh, Err(EndError::Lost { why: "its input has no name".to_owned() })).await;
            return Ok(fresh);
        };
        let pin = self.0.pin(&id, &digest)?;
        let promise = self.0.enter(&id, &fresh);
        if Arc::ptr_eq(&promise, &fresh) {
            counter!(JOBS_RECOVERED).increment(1);
            self.spawn(Runner { promise: fresh, ticket: None, pin, digest, tried });
        }
        Ok(promise)
    }

    /// What the worker does before it begins: the attempt is on record by then, so that a job that ends the process is
    /// found out. It waits until the job itself is.
    pub(super) fn claim(&self, promise: &Arc<Promise>, kept: Option<mpsc::Receiver<()>>) -> Claim {
        let (ledger, promise) = (self.clone(), Arc::clone(promise));
        let runtime = tokio::runtime::Handle::current();
        Box::new(move || {
            // The sender is gone without a word if the job could not be recorded; it is cancelled then.
            if kept.is_some_and(|kept| kept.recv().is_err()) {
                return;
            }
            if promise.begin()
                && let Err(error) = runtime.block_on(ledger.0.keep_up(&promise))
            {
                tracing::error!(job_id = %promise.id(), %error, "a job's attempt cannot be recorded");
            }
        })
    }

    /// Writes an ending down. The ending of a job that was dismissed meanwhile is none.
    pub(super) async fn finish(&self, promise: &Promise, ending: Result<String, EndError>) {
        let changed = match ending {
            Ok(key) => {
                let changed = promise.end(Status::Successful, |record| record.result = Some(key));
                // Nobody's request ends now, so no other line tells of it.
                if changed {
                    tracing::info!(job_id = %promise.id(), "a job is done");
                }
                changed
            }
            Err(error) => {
                tracing::info!(job_id = %promise.id(), %error, "a job failed");
                let problem = (self.0.describe)(&error);
                promise.end(Status::Failed, |record| record.problem = Some(problem))
            }
        };
        if !changed {
            return;
        }
        let id = promise.id();
        let keep = || self.0.keep_up(promise);
        // Without the record a restart would do the job again: a waste, but nothing is lost.
        if let Err(error) = insist(&id, self.0.settings.patience, StoreError::is_transient, keep).await {
            tracing::error!(job_id = %promise.id(), %error, "a job's ending cannot be recorded");
        }
    }

    /// A task as it is on record.
    ///
    /// # Errors
    /// That of the store, which may pass; within it, why the task cannot be had any more, in words.
    pub(super) async fn task(
        &self,
        record: &Record,
        digest: Digest,
    ) -> Result<Result<(Task, Format), String>, StoreError> {
        let stored = self.0.store.get(&Name::input(&digest)).await?;
        let Some(input) = stored.map(|stored| stored.bytes) else { return Ok(Err("its input is gone".to_owned())) };
        let mut lease = self.0.pool.budget().lease();
        lease.force(input.len() as u64);
        Ok(super::promise::task(record, digest, input, lease, self.0.pool.tracer()))
    }
}
