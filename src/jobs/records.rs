//! Records of durable jobs in the store.
//!
//! The record of an open job is `ID.json`. At its end, the record `ID.ended.json` is written, then the other one is
//! removed, so that one of them exists at any time. If both exist, the job has ended. The end of a job is thus known
//! from the name, and a start reads the records of open jobs only. The record of an end is never replaced.
//!
//! A damaged record goes into quarantine. A record of another release stays as it is: a node of that release runs the
//! job.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::{StreamExt as _, stream};
use metrics::counter;
use thiserror::Error;

use super::broker::{Dispatch, JobEvent};
use super::claims::input_of;
use super::durable_job::DurableJob;
use super::job_store::{JobStore, JobStoreState};
use super::rank::{Client, Rank};
use super::record::{BadRecord, JobId, JobRecord};
use super::{AcceptError, EndError, Input, JobView, Task};
use crate::formats::Format;
use crate::pipeline::MapFile;
use crate::store::{BadDigest, Digest, Name, Namespace, Pin, RecordCaps, RecordReservation, StoreError};
use crate::surface::OutOfMemory;
use crate::sync::timeout;
use crate::telemetry::{JOBS_RECOVERED, shorten};

/// Concurrent reads of records.
const CONCURRENT_READS: usize = 64;

impl JobStoreState {
    /// Protects the inputs (structure and map) and the record of an unfinished job from eviction.
    pub(super) fn pins(
        &self,
        id: &JobId,
        inputs: impl IntoIterator<Item = Digest>,
        space: Namespace,
    ) -> Result<Vec<Pin>, StoreError> {
        let mut pins = vec![self.store.pin(&Name::job(id.as_str())?)];
        pins.extend(inputs.into_iter().map(|input| self.store.pin(&Name::input(&input).within(space))));
        Ok(pins)
    }

    /// Admits the record of a new job. At a cap, forgets ended jobs.
    pub(super) async fn admit(&self, id: &JobId) -> Result<RecordReservation, StoreError> {
        let caps = RecordCaps { total: self.config.records, per_client: self.config.records_per_client };
        let (reservation, removed) = self.store.admit_record(&Name::job(id.as_str())?, caps).await?;
        for id in removed.iter().filter_map(|name| name.stem().parse().ok()) {
            self.lock().jobs.remove(&id);
        }
        Ok(reservation)
    }

    /// Adds the job of an open record to the open jobs, with pins of its inputs. Returns the digest of its input.
    pub(super) fn track(&self, record: &JobRecord) -> Result<Digest, EndError> {
        let (input, map) = input_of(record)?;
        let pins = self.pins(&record.id, [input].into_iter().chain(map), record.namespace);
        let pins = pins.map_err(|error| EndError::Lost { why: error.to_string() })?;
        let request = record.request();
        if let Err(why) = &request {
            tracing::warn!(job_id = %record.id, why, "a job is left to the release that wrote its record");
        }
        self.open.insert(record.id.clone(), request.is_ok().then(|| Dispatch::of(record)), pins);
        Ok(input)
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
        self.open.remove(&id);
        self.broker.publish(&id, JobEvent::Ended);
        Ok(())
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

    /// Reads a document. A damaged one goes into quarantine.
    async fn read_document(&self, name: &Name) -> Result<Option<JobRecord>, StoreError> {
        match self.store.get(name).await?.map(|stored| JobRecord::from_bytes(&stored.bytes)) {
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

    /// Reads the records of open jobs that this process does not know yet, in the order of their acceptance. Removes
    /// those of jobs that have ended. Forgets jobs that are not on record any more.
    async fn read_unknown(&self) -> Result<UnknownJobs, StoreError> {
        let mut known = self.open.ids();
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
            self.open.remove(gone);
        }
        let read = |name: Name| async move { (self.read_document(&name).await, name) };
        let mut reads = stream::iter(unfinished).map(read).buffer_unordered(CONCURRENT_READS);
        let mut unknown = UnknownJobs { records: Vec::new(), error: None };
        while let Some((read, name)) = reads.next().await {
            match read {
                Ok(record) => unknown.records.extend(record),
                Err(StoreError::Quarantined { .. }) => {}
                Err(error @ StoreError::OtherRelease { .. }) => self.leave(&name, &error),
                Err(error) => unknown.error = Some(error),
            }
        }
        drop(reads);
        unknown.records.sort_by_key(|record| (record.created_ms, record.id.clone()));
        Ok(unknown)
    }

    /// Leaves an open job to the release that wrote its record.
    fn leave(&self, name: &Name, error: &StoreError) {
        if let Ok(id) = name.stem().parse::<JobId>() {
            tracing::warn!(job_id = %id, %error, "a job is left to the release that wrote its record");
            self.open.insert(id, None, vec![self.store.pin(name)]);
        }
    }
}

/// Records of open jobs that this process did not know.
struct UnknownJobs {
    /// In the order of acceptance.
    records: Vec<JobRecord>,
    /// Last error of a record that was not read. It does not delay the jobs of the others.
    error: Option<StoreError>,
}

/// Returns the job that has the idempotency key of `record`, if both requests are the same.
pub(super) fn existing(record: &JobRecord, view: JobView) -> Result<JobView, AcceptError> {
    if record.is_same_request(&view.record) { Ok(view) } else { Err(AcceptError::OtherRequest) }
}

/// Error of [`JobStore::load_input`].
#[derive(Debug, Error)]
pub(super) enum LoadError {
    /// The store has no such input.
    #[error("its input was removed")]
    Removed,
    #[error(transparent)]
    Memory(#[from] OutOfMemory),
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl JobStore {
    /// Returns the task of a record, without its input.
    pub(super) fn task_of(&self, record: &JobRecord, digest: Digest) -> Result<(Task, Format), String> {
        let request = record.request()?;
        let task = Task {
            input: Input::File(Bytes::new()),
            digest,
            namespace: record.namespace,
            strict: request.strict,
            options: request.options,
            rank: Rank { client: Client(record.client), batch: true, urgency: record.urgency },
            reservation: None,
            parent: record.requester.parent(&self.0.pool.settings().tracer),
            id: Some(record.id.clone()),
        };
        Ok((task, request.format))
    }

    /// Loads the input of a task and its map, charged to the memory budget before they are read.
    pub(super) async fn load_input(&self, task: &mut Task) -> Result<(), LoadError> {
        let reservation = self.0.pool.settings().budget.for_client(task.rank.client.0).reservation();
        let map: Option<Digest> = match &task.options.map {
            Some(map) => Some(map.digest().parse().map_err(|_bad: BadDigest| LoadError::Removed)?),
            None => None,
        };
        let load = async |digest: Digest| {
            let name = Name::input(&digest).within(task.namespace);
            reservation.grow(self.0.store.head(&name).await?.ok_or(LoadError::Removed)?.size)?;
            self.0.store.input(&digest, task.namespace).await?.ok_or(LoadError::Removed)
        };
        let file = load(task.digest).await?;
        let loaded = match map {
            Some(digest) => Some(MapFile::new(digest.to_string(), load(digest).await?)),
            None => None,
        };
        task.options.map = loaded;
        task.input = Input::File(file);
        task.reservation = Some(Arc::new(reservation));
        Ok(())
    }

    /// Dispatches the unfinished jobs that neither the broker nor this process has, such as those of an earlier
    /// process, and returns their number. After the error of a single record, the others were handled.
    pub(crate) async fn reconcile(&self) -> Result<usize, StoreError> {
        let inner = &self.0;
        let UnknownJobs { records, mut error } = inner.read_unknown().await?;
        // If no record was read, the store fails, and no input is protected yet.
        let is_any_read = !records.is_empty() || error.is_none();
        for record in records {
            if record.status.is_final() {
                if let Err(failed) = inner.write_end(record).await {
                    error = Some(failed);
                }
            } else if let Err(error) = inner.track(&record) {
                let job = self.insert_open(record);
                self.finish(&job, Err(error)).await;
            }
        }
        if is_any_read {
            inner.records_read.send_replace(true);
        }
        let mut dispatched = 0;
        if inner.broker.down().is_some() {
            return error.map_or(Ok(0), Err);
        }
        for dispatch in inner.open.all() {
            if inner.lock().jobs.get(&dispatch.id).is_some_and(|job| job.is_owned()) {
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
        self.0.open.other_release_count()
    }
}
