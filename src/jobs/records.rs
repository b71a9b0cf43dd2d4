//! Records of durable jobs in the store.
//!
//! The record of an open job is `ID.json`. At its end, the record `ID.ended.json` is written, then the other one is
//! removed, so that one of them exists at any time. If both exist, the job has ended. The end of a job is thus known
//! from the name, and a start reads the records of open jobs only. The record of an end is never replaced.
//!
//! A damaged record goes into quarantine. A record of another release stays as it is: a node of that release runs the
//! job.

use std::time::Duration;

use bytes::Bytes;
use futures_util::{StreamExt as _, stream};
use metrics::counter;
use serde::de::DeserializeOwned;

use super::broker::{Dispatch, JobEvent};
use super::durable_job::DurableJob;
use super::job_store::{JobStore, JobStoreState};
use super::rank::{Client, Rank};
use super::record::{BadRecord, JobId, JobRecord, decode};
use super::retry::retry;
use super::{AcceptError, Input, JobView, Task};
use crate::store::{Name, Pin, RecordReservation, StoreError};
use crate::sync::timeout;
use crate::telemetry::{JOBS_RECOVERED, shorten};

/// Concurrent reads of records.
const CONCURRENT_READS: usize = 64;

impl JobStoreState {
    /// Protects the inputs (structure and map), the record and the batch of an unfinished job from eviction.
    pub(super) fn pins(&self, record: &JobRecord) -> Vec<Pin> {
        let inputs = [record.input].into_iter().chain(record.map);
        let inputs = inputs.map(|input| Name::input(&input).within(record.namespace));
        let batch = record.batch.iter().filter_map(|batch| Name::batch(batch.as_str()).ok());
        Name::job(record.id.as_str()).into_iter().chain(batch).chain(inputs).map(|name| self.store.pin(&name)).collect()
    }

    /// Adds an unfinished job; see [`JobMap::open`](super::job_map::JobMap::open). An error in `dispatch` is the reason
    /// why another release must run the job.
    pub(super) fn open(&self, id: JobId, dispatch: Result<Dispatch, String>, pins: Vec<Pin>) {
        if let Err(why) = &dispatch {
            tracing::warn!(job_id = %id, why, "a job is left to the release that wrote its record");
        }
        // Unpins after the end of the statement, without the lock.
        let _replaced = self.lock().open(id, dispatch.ok(), pins);
    }

    /// Removes a job from the unfinished ones.
    pub(super) fn close(&self, id: &JobId) {
        let _removed = self.lock().close(id);
    }

    /// Admits the record of a new job. At a cap, forgets ended jobs.
    pub(super) async fn admit(&self, id: &JobId) -> Result<RecordReservation, StoreError> {
        let (reservation, removed) = self.store.admit_record(&Name::job(id.as_str())?, &self.config).await?;
        for id in removed.iter().filter_map(|name| name.stem().parse().ok()) {
            self.lock().jobs.remove(&id);
            self.ends.remove(&id);
        }
        Ok(reservation)
    }

    /// Writes the latest record of a job, and makes its end visible. Writers of one job take turns, so the last write
    /// has the latest state, and a job that was dismissed while it started stays dismissed after a restart.
    pub(super) async fn write_job(&self, job: &DurableJob) -> Result<(), StoreError> {
        let _turn = job.writing.lock().await;
        // The semaphore is never closed.
        let _permit = self.writes.acquire().await;
        let record = job.record();
        if !record.status.is_final() {
            return self.store.put(&Name::job(record.id.as_str())?, record.to_bytes()).await;
        }
        let id = record.id.clone();
        job.publish_end(self.write_end(record).await?);
        self.close(&id);
        self.broker.publish(&id, JobEvent::Ended);
        Ok(())
    }

    /// Writes the latest record of a job, and repeats that while the store rejects it for now.
    pub(super) async fn write_job_until_stored(&self, job: &DurableJob) -> Result<(), StoreError> {
        retry(&job.id(), self.retry_time(), StoreError::is_temporary, || self.write_job(job)).await
    }

    /// Writes the record of an end, unless an end is on record, and returns the record in the store.
    pub(super) async fn write_end(&self, record: JobRecord) -> Result<JobRecord, StoreError> {
        let (open, ended) = (Name::job(record.id.as_str())?, Name::ended_job(record.id.as_str())?);
        let end = if self.store.put_new(&ended, record.to_bytes()).await? {
            record
        } else {
            match self.read_document(&ended).await {
                // The job has ended; this release cannot show that end.
                Err(StoreError::OtherRelease { .. }) => record,
                read => read?.unwrap_or(record),
            }
        };
        self.store.delete(&open).await?;
        Ok(end)
    }

    /// Writes the record of a new, open job. Returns false if there is a job with its id, open or ended.
    pub(super) async fn write_new(&self, record: &JobRecord) -> Result<bool, StoreError> {
        let (open, ended) = (Name::job(record.id.as_str())?, Name::ended_job(record.id.as_str())?);
        if !self.store.put_new(&open, record.to_bytes()).await? {
            return Ok(false);
        }
        // A job with the same idempotency key may have been accepted and ended meanwhile.
        let is_new = self.store.head(&ended).await?.is_none();
        if !is_new {
            self.store.delete(&open).await?;
        }
        Ok(is_new)
    }

    /// Reads the record of a job.
    pub(super) async fn read(&self, id: &JobId) -> Result<Option<JobRecord>, StoreError> {
        // In this order, a job that ends meanwhile is not missed.
        let open = self.read_document(&Name::job(id.as_str())?).await;
        let ended = self.read_document(&Name::ended_job(id.as_str())?).await?;
        if ended.is_some() { Ok(ended) } else { open }
    }

    /// Reads the record of a job that was listed as open or ended. Does not count as a use.
    pub(super) async fn peek(&self, id: &JobId, is_ended: bool) -> Result<Option<JobRecord>, StoreError> {
        let (open, ended) = (Name::job(id.as_str())?, Name::ended_job(id.as_str())?);
        if !is_ended && let Some(record) = self.parse_document(&open, self.store.peek(&open).await?).await? {
            return Ok(Some(record));
        }
        self.parse_document(&ended, self.store.peek(&ended).await?).await
    }

    /// Reads the document of a job or a batch.
    pub(super) async fn read_document<T: DeserializeOwned>(&self, name: &Name) -> Result<Option<T>, StoreError> {
        let stored = self.store.get(name).await?;
        self.parse_document(name, stored.map(|stored| stored.bytes)).await
    }

    /// Parses a document that was read. A damaged one goes into quarantine.
    async fn parse_document<T: DeserializeOwned>(
        &self,
        name: &Name,
        bytes: Option<Bytes>,
    ) -> Result<Option<T>, StoreError> {
        match bytes.map(|bytes| decode(&bytes)) {
            Some(Ok(record)) => return Ok(Some(record)),
            Some(Err(BadRecord::OtherRelease(why))) => return Err(StoreError::OtherRelease { why }),
            Some(Err(error @ BadRecord::Damaged(_))) => {
                let short = shorten(&name.to_string());
                tracing::error!(name = short, %error, "the record of a job cannot be read; moving it into quarantine");
                self.store.quarantine(name).await?;
            }
            None if self.store.is_quarantined(name).await? => {}
            None => return Ok(None),
        }
        Err(StoreError::Quarantined { name: name.to_string() })
    }

    /// Returns the names of the records of open jobs that this process does not know yet. Removes those of jobs that
    /// have ended. Forgets jobs that are not on record any more.
    async fn unknown_records(&self) -> Result<Vec<Name>, StoreError> {
        let mut known = self.lock().open_ids();
        let records = self.store.job_records().await?;
        let (ends, others): (Vec<_>, Vec<_>) = records.into_iter().partition(Name::is_ended_job);
        let mut unfinished = Vec::new();
        for name in others {
            if ends.binary_search(&Name::ended_job(name.stem())?).is_ok() {
                // A crash has left it behind.
                self.store.delete(&name).await?;
            } else if name.stem().parse().is_ok_and(|id: JobId| !known.remove(&id)) {
                unfinished.push(name);
            }
        }
        for gone in &known {
            self.close(gone);
        }
        Ok(unfinished)
    }
}

/// Returns the job that has the idempotency key of `record`, if both requests are the same.
pub(super) fn existing(record: &JobRecord, view: JobView) -> Result<JobView, AcceptError> {
    if record.is_same_request(&view.record) { Ok(view) } else { Err(AcceptError::OtherRequest) }
}

impl JobStore {
    /// Returns the task of a record, without its input.
    pub(super) fn task_of(&self, record: &JobRecord) -> Result<Task, String> {
        Ok(Task {
            input: Input::File(Bytes::new()),
            digest: record.input,
            namespace: record.namespace,
            request: record.request()?,
            rank: Rank { client: Client(record.client), batch: true, urgency: record.urgency },
            reservation: None,
            parent: record.requester.parent(&self.0.pool.settings().tracer),
            id: Some(record.id.clone()),
        })
    }

    /// Dispatches the unfinished jobs that neither the broker nor this process has, such as those of an earlier
    /// process, and returns their number. After the error of a single record, the others were handled.
    pub(crate) async fn reconcile(&self) -> Result<usize, StoreError> {
        let inner = &self.0;
        let read = |name: Name| async move { (inner.read_document::<JobRecord>(&name).await, name) };
        let mut reads = stream::iter(inner.unknown_records().await?).map(read).buffer_unordered(CONCURRENT_READS);
        let (mut records, mut error) = (Vec::new(), None);
        while let Some((read, name)) = reads.next().await {
            match read {
                Ok(record) => records.extend(record),
                Err(StoreError::Quarantined { .. }) => {}
                Err(other @ StoreError::OtherRelease { .. }) => {
                    if let Ok(id) = name.stem().parse() {
                        inner.open(id, Err(other.to_string()), vec![inner.store.pin(&name)]);
                    }
                }
                // It does not delay the jobs of the other records.
                Err(failed) => error = Some(failed),
            }
        }
        drop(reads);
        // In the order of acceptance.
        records.sort_by_key(|record| (record.created_ms, record.id.clone()));
        // If no record was read, the store fails, and no input is protected yet.
        let is_any_read = !records.is_empty() || error.is_none();
        for record in records {
            if record.status.is_final() {
                if let Err(failed) = inner.write_end(record).await {
                    error = Some(failed);
                }
            } else {
                let dispatch = record.request().map(|_| Dispatch::of(&record));
                inner.open(record.id.clone(), dispatch, inner.pins(&record));
            }
        }
        if is_any_read {
            inner.records_read.send_replace(true);
        }
        let mut dispatched = 0;
        if inner.broker.down().is_some() {
            return error.map_or(Ok(0), Err);
        }
        let dispatches = inner.lock().dispatches();
        for dispatch in dispatches {
            if inner.lock().is_owned(&dispatch.id) {
                continue;
            }
            match inner.broker.dispatch(&dispatch).await {
                Ok(true) => dispatched += 1,
                Ok(false) => {}
                Err(error) => {
                    tracing::warn!(%error, "some jobs are dispatched later");
                    break;
                }
            }
        }
        counter!(JOBS_RECOVERED).increment(dispatched as u64);
        error.map_or(Ok(dispatched), Err)
    }

    /// Waits for at most `limit` until the records of earlier processes were read. Returns true if they were.
    pub(crate) async fn records_read(&self, limit: Duration) -> bool {
        timeout(limit, self.0.records_read.subscribe().wait_for(|read| *read)).await.is_ok()
    }

    /// Returns true once the records of earlier processes were read.
    pub(crate) fn has_read_records(&self) -> bool {
        *self.0.records_read.borrow()
    }

    /// Returns the number of unfinished jobs of other releases, which this process leaves alone.
    pub(crate) fn other_release_count(&self) -> usize {
        self.0.lock().other_release_count()
    }
}
