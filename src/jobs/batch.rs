//! Batches: lists of durable jobs with one record. A batch runs nothing itself, so its state is that of its jobs.
//!
//! The jobs are accepted first, with ids that follow from that of the batch, then the record is stored. A request that
//! is repeated after a crash in between finds the jobs that exist and adds the others. The record counts as that of an
//! ended job, and is pinned while a job of the batch is open.

use futures_util::stream::{self, StreamExt as _};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::durable_job::DurableJob;
use super::job_store::JobStore;
use super::record::{JobId, Status, encode};
use super::{AcceptError, Client, JobView};
use crate::store::{Digest, Name, Namespace, RecordReservation, StoreError};

/// Maximum size of the record of a batch, bytes: ten thousand files with names of usual length, some of them rejected.
pub(crate) const MAX_RECORD_BYTES: usize = 4 << 20;
/// Number of jobs that are cancelled concurrently.
const CONCURRENT_DISMISSALS: usize = 8;

/// File of a batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct BatchFile {
    /// Name in the archive, or PDB id. Names are unique, apart from those of refused entries.
    pub(crate) name: String,
    /// SHA-256 of the file; `None` if it was refused.
    pub(crate) input: Option<Digest>,
    /// Problem document of a refused file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) problem: Option<Value>,
    /// Jobs, one for each format of the batch; none if the file was refused.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) jobs: Vec<JobId>,
}

/// Stored description of a batch, which never changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct BatchRecord {
    /// Id of the batch.
    pub(crate) id: JobId,
    /// Namespace of the batch and its jobs.
    #[serde(default, skip_serializing_if = "Namespace::is_common")]
    pub(crate) namespace: Namespace,
    /// Time of acceptance, ms since 1970.
    pub(crate) created_ms: u64,
    /// Names and values of the parameters, as the client wrote them.
    pub(crate) parameters: Vec<(String, String)>,
    /// Files in the order of the request.
    pub(crate) files: Vec<BatchFile>,
}

impl BatchRecord {
    /// Returns the size of the stored record.
    pub(crate) fn encoded_bytes(&self) -> usize {
        encode(self).len()
    }

    /// Returns true if both records describe the same request. The archive may have another file of an entry now, or
    /// none.
    pub(crate) fn is_same_request(&self, other: &Self) -> bool {
        let same = |own: &BatchFile, other: &BatchFile| {
            let differs = own.input.zip(other.input).is_some_and(|(own, other)| own != other);
            own.name == other.name && !differs
        };
        self.parameters == other.parameters
            && self.files.len() == other.files.len()
            && self.files.iter().zip(&other.files).all(|(own, other)| same(own, other))
    }
}

/// Room for further jobs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Room {
    /// Number of queued jobs.
    pub(crate) queued: usize,
    /// Maximum number of queued jobs.
    pub(crate) queue: usize,
    /// Maximum number of jobs in one batch.
    pub(crate) jobs: usize,
}

impl JobStore {
    /// Returns the id of a new batch, or of the batch with this idempotency key.
    pub(crate) fn batch_id(
        &self,
        client: Client,
        namespace: Namespace,
        key: Option<&str>,
    ) -> Result<JobId, AcceptError> {
        match key {
            // A key has no tab, so the id is not that of a job.
            Some(key) => Ok(JobId::from_key(&self.0.secret, namespace, client.0, &format!("batch\t{key}"))),
            None => JobId::random(&self.0.secret, client.0).map_err(AcceptError::Random),
        }
    }

    /// Returns the room for a batch.
    pub(crate) fn room(&self) -> Room {
        let (broker, config) = (&self.0.broker, &self.0.config);
        // The record of the batch counts as well.
        let records = config.records_per_client.min(config.records).saturating_sub(1);
        Room { queued: broker.queued(), queue: broker.limit(), jobs: records.min(broker.limit()) }
    }

    /// Admits the record of a new batch. At a cap, forgets ended jobs.
    pub(crate) async fn admit_batch(&self, id: &JobId) -> Result<RecordReservation, StoreError> {
        self.0.admit(id).await
    }

    /// Stores the record of a batch that was `admitted` unless there is one with its id, and returns the stored one.
    pub(crate) async fn put_batch(
        &self,
        record: BatchRecord,
        admitted: RecordReservation,
    ) -> Result<BatchRecord, StoreError> {
        let name = Name::batch(record.id.as_str())?;
        let is_new = self.0.store.put_new(&name, encode(&record)).await?;
        drop(admitted);
        if is_new {
            return Ok(record);
        }
        Ok(self.0.read_document(&name).await?.unwrap_or(record))
    }

    /// Returns the record of a batch; `None` if the namespace has no such batch.
    pub(crate) async fn batch(&self, id: &JobId, namespace: Namespace) -> Result<Option<BatchRecord>, StoreError> {
        let record: Option<BatchRecord> = self.0.read_document(&Name::batch(id.as_str())?).await?;
        Ok(record.filter(|record| record.namespace == namespace))
    }

    /// Returns the present state of a job; `None` if the namespace has no such job. The job does not stay in memory, as
    /// it does after [`view`](Self::view).
    pub(crate) async fn view_once(&self, id: &JobId, namespace: Namespace) -> Result<Option<JobView>, StoreError> {
        if let Some(view) = self.known(id, namespace, |job| job.view()) {
            return Ok(Some(view));
        }
        // The semaphore is never closed.
        let _permit = self.0.record_reads.acquire().await;
        let record = self.0.read(id).await?.filter(|record| record.namespace == namespace);
        Ok(record.map(|record| DurableJob::new(record).view()))
    }

    /// Returns the status of a job of a batch; `None` if its record was removed, which ends the job as well. Reads each
    /// record of an ended job once.
    pub(crate) async fn status(&self, id: &JobId, namespace: Namespace) -> Result<Option<Status>, StoreError> {
        if let Some(status) = self.known(id, namespace, |job| job.state.borrow().record.status) {
            return Ok(Some(status));
        }
        if let Some(status) = self.0.ends.get(id) {
            // The state of a batch is a use of its jobs.
            self.0.store.touch(&Name::ended_job(id.as_str())?, self.0.store.now());
            return Ok(Some(status));
        }
        let status = match self.view_once(id, namespace).await {
            // A damaged record ends the job as well.
            Err(StoreError::Quarantined { .. }) => None,
            view => view?.map(|view| view.record.status),
        };
        if let Some(status) = status.filter(|status| status.is_final()) {
            self.0.ends.insert(id.clone(), status);
        }
        Ok(status)
    }

    /// Cancels the jobs of a batch that have not ended, the last ones first, so that no worker begins one meanwhile.
    /// After the error of one job, the others are cancelled as well.
    pub(crate) async fn dismiss_batch(&self, record: &BatchRecord) -> Result<(), StoreError> {
        let ids: Vec<JobId> = record.files.iter().flat_map(|file| file.jobs.iter().cloned()).rev().collect();
        let dismiss = |id: JobId| async move {
            match self.status(&id, record.namespace).await? {
                Some(status) if !status.is_final() => self.dismiss(&id, record.namespace).await.map(drop),
                _ => Ok(()),
            }
        };
        let ended = stream::iter(ids).map(dismiss).buffered(CONCURRENT_DISMISSALS);
        ended.fold(Ok(()), async |all, one| all.and(one)).await
    }
}
