//! Quarantine of job records that cannot be read and of damaged structure files. Only an operator removes them.

use std::io;
use std::sync::atomic::Ordering;

use futures_util::TryStreamExt as _;
use metrics::gauge;
use object_store::path::Path;
use object_store::{Error, ObjectMeta, ObjectStoreExt as _};

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;
use crate::telemetry::{RECORDS_QUARANTINED, shorten};

/// Folder of the quarantine, beside those of the objects.
pub(super) const QUARANTINE: &str = "quarantine";

fn quarantine_path(name: &Name) -> Path {
    Path::from_iter([QUARANTINE, name.path().filename().unwrap_or_default()])
}

/// Returns true for a job record. A damaged structure file needs no operator: another upload replaces it.
fn is_record(object: &ObjectMeta) -> bool {
    object.location.extension() == Some("json")
}

impl Store {
    /// Moves a job record into quarantine. Succeeds if it does not exist any more.
    pub(crate) async fn quarantine(&self, name: &Name) -> Result<(), StoreError> {
        let (store, name) = (self.clone(), name.clone());
        let moved = async move {
            let _lock = store.write_lock(&name).lock().await;
            store.move_to_quarantine(&name).await
        };
        self.run_to_completion(moved).await
    }

    /// Moves a file whose digest differs into quarantine, under the lock of its name.
    pub(super) async fn quarantine_damaged(&self, name: &Name) -> Result<(), StoreError> {
        let differs = io::Error::other("the digest differs");
        let error = self.0.backend.fail("verify", &shorten(&name.to_string()), &differs);
        tracing::error!(%error, "a stored file is damaged; moving it into quarantine");
        self.0.memory.remove(name);
        self.move_to_quarantine(name).await
    }

    /// Moves an object into quarantine, under the lock of its name.
    async fn move_to_quarantine(&self, name: &Name) -> Result<(), StoreError> {
        let backend = &self.0.backend;
        match backend.timed(backend.objects().rename(&name.path(), &quarantine_path(name))).await {
            Ok(()) | Err(Error::NotFound { .. }) => {}
            Err(error) => return Err(backend.fail_at("quarantine", name)(error)),
        }
        self.index().forget(name);
        self.count_quarantined().await.map(drop)
    }

    /// Returns true if the record of this name is in quarantine.
    pub(crate) async fn is_quarantined(&self, name: &Name) -> Result<bool, StoreError> {
        let backend = &self.0.backend;
        match backend.timed(backend.objects().head(&quarantine_path(name))).await {
            Ok(_) => Ok(true),
            Err(Error::NotFound { .. }) => Ok(false),
            Err(error) => Err(backend.fail_at("quarantine", name)(error)),
        }
    }

    /// Returns the number of records in quarantine.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub async fn quarantined(&self) -> Result<usize, StoreError> {
        // Without records, no request to the disk or the service is needed.
        if self.0.quarantined.load(Ordering::Relaxed) == 0 { Ok(0) } else { self.count_quarantined().await }
    }

    /// Counts the job records in quarantine, which an operator may have removed.
    pub(super) async fn count_quarantined(&self) -> Result<usize, StoreError> {
        let backend = &self.0.backend;
        let listed = backend.objects().list(Some(&Path::from(QUARANTINE)));
        let count =
            backend.timed(listed.try_fold(0, |n, object| std::future::ready(Ok(n + usize::from(is_record(&object))))));
        let count = count.await.map_err(|error| backend.fail("quarantine", QUARANTINE, &error))?;
        self.0.quarantined.store(count, Ordering::Relaxed);
        gauge!(RECORDS_QUARANTINED).set(count as f64);
        Ok(count)
    }
}
