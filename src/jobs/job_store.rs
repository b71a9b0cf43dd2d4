//! Durable jobs: the record is in the store before the client gets its id, and unfinished jobs are resumed after
//! a restart.
//!
//! A job is accepted in four steps: store the input and its map, store the record, dispatch the job, answer. From the
//! second step on it is durable: unfinished jobs that no broker holds are dispatched again. Results are named by their
//! contents, so computing one twice is harmless; a crash costs time and never loses a job.

use std::borrow::Cow;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use quick_cache::sync::Cache;
use serde_json::Value;
use tokio::sync::{Semaphore, watch};
use tracing::Instrument as _;

use super::broker::{Broker, Dispatch};
use super::durable_job::DurableJob;
use super::job_map::JobMap;
use super::listing;
use super::rank::Client;
use super::record::{JobId, JobRecord, Requester, Status, now_ms};
use super::records::existing;
use super::runner::Runner;
use super::runs::Runs;
use super::{AcceptError, ContentKey, EndError, OnStart, Pool, SaveError, Task, Ticket, UploadedMap, results};
use crate::config::JobsConfig;
use crate::pipeline::suits_gpu;
use crate::single_flight::SingleFlight;
use crate::store::{Namespace, Pin, Secret, Store, StoreError};
use crate::sync::{Handle, timeout};

/// Maximum time that the acceptance of a job whose result is stored waits for its end to be recorded.
const STORED_WAIT: Duration = Duration::from_secs(5);
/// Number of records of begun and ended jobs that are written concurrently, so that others find a free thread.
const CONCURRENT_WRITES: usize = 64;
/// Number of ended jobs of batches whose states are kept: about 2 MB, for several large batches.
const KNOWN_ENDS: usize = 20_000;

/// Request for a durable job.
#[derive(Debug)]
pub(crate) struct JobSpec {
    /// The task.
    pub(crate) task: Task,
    /// Structure file of the task.
    pub(crate) file: Bytes,
    /// Map of the task.
    pub(crate) map: Option<UploadedMap>,
    /// Parameters as the client wrote them.
    pub(crate) parameters: Vec<(String, String)>,
    /// Idempotency key of the request.
    pub(crate) idempotency_key: Option<String>,
    /// Batch of the job.
    pub(crate) batch: Option<JobId>,
}

/// State of a job that its watchers see.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct JobView {
    /// Record of the job.
    pub(crate) record: JobRecord,
    /// Running stage.
    pub(crate) stage: Option<Cow<'static, str>>,
    /// Finished fraction, from 0 to 1.
    pub(crate) fraction: f64,
    /// Number of this state: the time of the change, ms since 1970. Grows with every change, even across restarts.
    pub(crate) version: u64,
    /// Record of an end that was decided but is not written yet. The end is visible once it is on record, or
    /// after the store has rejected the record for [`JobStoreState::retry_time`].
    pub(super) end: Option<Box<JobRecord>>,
}

/// Converts the error of a failed job into the document that clients get.
pub(crate) type DescribeError = fn(&EndError) -> Value;

/// Durable jobs. Clones share one state.
#[derive(Clone)]
pub(crate) struct JobStore(pub(super) Arc<JobStoreState>);

pub(super) struct JobStoreState {
    pub(super) store: Store,
    pub(super) pool: Arc<Pool>,
    pub(super) broker: Arc<dyn Broker>,
    pub(super) config: JobsConfig,
    /// Maximum size of a result, bytes.
    pub(super) output_bytes: u64,
    pub(super) describe: DescribeError,
    /// Secret that derives job ids from idempotency keys.
    pub(super) secret: Secret,
    /// Final states of jobs of batches, so that the state of a batch reads each record once.
    pub(super) ends: Cache<JobId, Status>,
    /// Jobs that this process knows of.
    jobs: Mutex<JobMap>,
    /// Namespaces of jobs that were listed.
    pub(super) namespaces: Cache<JobId, Namespace>,
    /// Permits to read a record for a list or a batch.
    pub(super) record_reads: Semaphore,
    /// True once the records of earlier processes were read.
    pub(super) records_read: watch::Sender<bool>,
    /// Permits to write the record of a begun or ended job.
    pub(super) writes: Semaphore,
    /// Permits to claim a job, one per worker.
    pub(super) slots: Arc<Semaphore>,
    /// Results that are being stored: jobs that shared work store its result once.
    pub(super) saves: SingleFlight<ContentKey, Result<(), SaveError>>,
    /// Claims and runners of jobs.
    pub(super) runs: Runs,
}

impl JobStoreState {
    /// Returns the maximum time from the acceptance of a job to its result.
    pub(super) fn allowed(&self) -> Duration {
        Duration::from_millis(self.config.batch_deadline_ms)
    }

    /// Returns the time for which a rejected write is retried.
    pub(super) fn retry_time(&self) -> Duration {
        Duration::from_millis(self.config.save_retry_ms)
    }

    /// Returns the last digits of the ids of the jobs of a client.
    pub(super) fn owner_digits(&self, client: Client) -> String {
        JobId::owner_digits(&self.secret, client.0)
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, JobMap> {
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl JobStore {
    /// Creates an empty job store over `store`, whose jobs are dispatched by `broker` and run on `pool`. `secret` is
    /// the secret of the store.
    pub(crate) fn new(
        store: Store,
        pool: Arc<Pool>,
        broker: Arc<dyn Broker>,
        config: JobsConfig,
        output_bytes: u64,
        secret: Secret,
        describe: DescribeError,
    ) -> Self {
        let slots = Arc::new(Semaphore::new(pool.settings().workers));
        Self(Arc::new(JobStoreState {
            store,
            pool,
            broker,
            config,
            output_bytes,
            describe,
            secret,
            ends: Cache::new(KNOWN_ENDS),
            jobs: Mutex::default(),
            namespaces: Cache::new(listing::MAX_NAMESPACES),
            record_reads: Semaphore::new(listing::CONCURRENT_READS),
            records_read: watch::Sender::new(false),
            writes: Semaphore::new(CONCURRENT_WRITES),
            slots,
            saves: SingleFlight::default(),
            runs: Runs::default(),
        }))
    }

    /// Accepts a job. From then on the job survives the process. `ticket` belongs to work that is queued or running
    /// already.
    pub(crate) async fn accept(&self, spec: JobSpec, ticket: Option<Ticket>) -> Result<JobView, AcceptError> {
        let inner = &self.0;
        let (client, namespace) = (spec.task.rank.client.0, spec.task.namespace);
        let id = match &spec.idempotency_key {
            Some(key) => JobId::from_key(&inner.secret, namespace, client, key),
            None => JobId::random(&inner.secret, client).map_err(AcceptError::Random)?,
        };
        let record = JobRecord {
            id: id.clone(),
            namespace,
            input: spec.task.digest,
            map: spec.map.as_ref().map(|map| map.digest),
            parameters: spec.parameters,
            format: spec.task.request.format.name().to_owned(),
            client,
            batch: spec.batch,
            urgency: spec.task.rank.urgency,
            suits_gpu: suits_gpu(spec.task.input.atoms(), &spec.task.request.options),
            status: Status::Accepted,
            attempts: u32::from(ticket.is_some()),
            memory_waits: 0,
            created_ms: now_ms(),
            started_ms: None,
            finished_ms: None,
            result: None,
            problem: None,
            requester: Requester::of(&spec.task.parent),
        };
        if spec.idempotency_key.is_some()
            && let Some(view) = self.view(&id, namespace).await?
        {
            return existing(&record, view);
        }
        // Its pin keeps the result until the job has ended.
        let stored = match &ticket {
            Some(_) => None,
            None => self.stored_result(&spec.task).await?,
        };
        let is_dispatched = ticket.is_none() && stored.is_none();
        if let Some(why) = inner.broker.down().filter(|_| is_dispatched) {
            // Clients do not get the reason, which may contain an address.
            tracing::warn!(why, "a job was rejected, because it cannot be dispatched");
            return Err(AcceptError::BrokerDown);
        }
        if is_dispatched && inner.broker.queued() >= inner.broker.limit() {
            return Err(self.queue_full(&spec.task).into());
        }
        // Nothing of the job is evicted meanwhile.
        let pins = inner.pins(&record);
        let reservation = inner.admit(&id).await?;
        inner.store.put_input(&record.input, namespace, spec.file).await?;
        if let Some(map) = spec.map {
            inner.store.put_input(&map.digest, namespace, map.bytes).await?;
        }
        if !inner.write_new(&record).await?
            && let Some(view) = self.view(&id, namespace).await?
        {
            // A concurrent request with the same key stored its record first.
            return existing(&record, view);
        }
        drop(reservation);
        let dispatch = Dispatch::of(&record);
        inner.open(id.clone(), Ok(dispatch.clone()), pins);
        if is_dispatched {
            self.dispatch(&dispatch).await;
            let known = self.known(&id, namespace, |job| job.view());
            return Ok(known.unwrap_or_else(|| DurableJob::new(record).view()));
        }
        let job = self.insert_open(record);
        let owned = inner.lock().own(&job);
        // Otherwise the job was dispatched from its record and runs already.
        if let Some(owned) = owned {
            Runner { jobs: self.clone(), owned, ticket, slot: None }.spawn();
        }
        if stored.is_some() {
            // The client gets the end at once, unless the store fails.
            let mut watched = job.state.subscribe();
            drop(timeout(STORED_WAIT, watched.wait_for(|view| view.record.status.is_final())).await);
        }
        Ok(job.view())
    }

    /// Returns the key of a task's result, pinned, if it is stored. Strict tasks always run.
    pub(super) async fn stored_result(&self, task: &Task) -> Result<Option<(String, Pin)>, StoreError> {
        let Task { request, digest, namespace, .. } = task;
        let arithmetics = if request.strict { Vec::new() } else { self.0.pool.file_arithmetics(&request.options) };
        for arithmetic in arithmetics {
            let key = ContentKey::new(digest, request, &arithmetic, *namespace);
            let pin = self.0.store.pin(&key.name(request.format.name())?);
            if results::is_stored(&self.0.store, request.format, &key).await? {
                return Ok(Some((key.to_string(), pin)));
            }
        }
        Ok(None)
    }

    /// Calls `use_job` with a job in memory, if it is of the namespace, under the lock of the map. A job that is
    /// subscribed to there stays in memory.
    pub(super) fn known<T>(
        &self,
        id: &JobId,
        namespace: Namespace,
        use_job: impl FnOnce(&Arc<DurableJob>) -> T,
    ) -> Option<T> {
        self.0.lock().jobs.get(id).filter(|job| job.state.borrow().record.namespace == namespace).map(use_job)
    }

    /// Watches the state of a job; `None` if the namespace has no such job.
    pub(crate) async fn watch(
        &self,
        id: &JobId,
        namespace: Namespace,
    ) -> Result<Option<watch::Receiver<JobView>>, StoreError> {
        let watch_known = || self.known(id, namespace, |job| job.state.subscribe());
        if let Some(watched) = watch_known() {
            return Ok(Some(watched));
        }
        let record = self.0.read(id).await?.filter(|record| record.namespace == namespace);
        let Some(record) = record else { return Ok(None) };
        if let Some(watched) = watch_known() {
            // The job began during the read. Its end may be on record and not be visible to others yet.
            return Ok(Some(watched));
        }
        if record.status.is_final() {
            return Ok(Some(DurableJob::new(record).state.subscribe()));
        }
        Ok(Some(self.insert_open(record).state.subscribe()))
    }

    /// Returns the present state of a job; `None` if the namespace has no such job.
    pub(crate) async fn view(&self, id: &JobId, namespace: Namespace) -> Result<Option<JobView>, StoreError> {
        Ok(self.watch(id, namespace).await?.map(|watched| watched.borrow().clone()))
    }

    /// Cancels a job unless it has ended, and returns its final state; `None` if the namespace has no such job. The job
    /// is cancelled even if the store fails.
    pub(crate) async fn dismiss(&self, id: &JobId, namespace: Namespace) -> Result<Option<JobView>, StoreError> {
        if self.watch(id, namespace).await?.is_none() {
            return Ok(None);
        }
        let Some(job) = self.known(id, namespace, Arc::clone) else { return self.view(id, namespace).await };
        if job.end(Status::Dismissed, |_| {}) {
            job.stop();
            let (inner, ended) = (Arc::clone(&self.0), Arc::clone(&job));
            let write = async move {
                let written = inner.write_job(&ended).await;
                if written.is_err() {
                    ended.publish_end(ended.record());
                }
                written
            };
            // The write ends even if the client leaves.
            if let Ok(written) = Handle::current().spawn(write.in_current_span()).await {
                written?;
            }
        }
        // Another end may have been decided, but not be on record yet. The job holds the sender.
        drop(job.state.subscribe().wait_for(|view| view.record.status.is_final()).await);
        Ok(Some(job.view()))
    }

    /// Returns the work that records an attempt before the worker starts it, so that a job that crashes the process is
    /// detected.
    pub(super) fn on_start(&self, job: &Arc<DurableJob>) -> OnStart {
        let (jobs, job) = (self.clone(), Arc::clone(job));
        OnStart::new(async move { jobs.begin(&job).await })
    }

    /// Records the end of a job and makes it visible, unless it was dismissed meanwhile. Its result is pinned until
    /// then. Returns false if the store has rejected the record.
    pub(super) async fn finish(&self, job: &DurableJob, ending: Result<(String, Pin), EndError>) -> bool {
        let id = job.id();
        let changed = match &ending {
            Ok((key, _pin)) => {
                let changed = job.end(Status::Successful, |record| record.result = Some(key.clone()));
                if changed {
                    tracing::info!(job_id = %id, "a job finished");
                }
                changed
            }
            Err(error) => {
                tracing::info!(job_id = %id, %error, "a job failed");
                let problem = (self.0.describe)(error);
                job.end(Status::Failed, |record| record.problem = Some(problem))
            }
        };
        if !changed {
            return true;
        }
        let written = self.0.write_job_until_stored(job).await;
        // Without the record a restart runs the job again: wasted work, but nothing is lost.
        if let Err(error) = &written {
            tracing::error!(job_id = %id, %error, "cannot record the end of a job");
            job.publish_end(job.record());
        }
        written.is_ok()
    }
}
