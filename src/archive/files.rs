//! Entries in local files: those of the folder, and the copies on disk. Reading takes a permit and a part of the memory
//! budget, both before a file is read. The thread that reads holds the permit and the bytes hold the memory, so that a
//! client that disconnects releases neither too early.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::Instant;

use super::disk::{Disk, Found};
use super::error::FetchError;
use crate::config::Config;
use crate::memory_budget::Budget;
use crate::readers::{Busy, Readers};
use crate::store::{Digest, Hasher};
use crate::structure::{Archive as Folder, ArchiveError, EntryId, Stamp};

/// Folder and copies.
#[derive(Debug)]
pub(super) struct Files {
    folder: Folder,
    disk: Disk,
    memory: Budget,
    pub(super) readers: Readers,
    timeout: Duration,
}

impl Files {
    /// Creates the files of a configuration. Bytes that are read are charged to `memory` until they are dropped.
    pub(super) fn new(config: &Config, memory: Budget) -> Self {
        let (archive, inflated) = (&config.archive, config.limits.inflated_bytes);
        Self {
            folder: Folder::new(config.archive_dir()).with_max_bytes(inflated),
            disk: Disk::new(config.archive_cache_dir(), archive.cache_bytes),
            memory,
            readers: Readers::new(config.jobs.workers, config.server.client_share),
            timeout: Duration::from_millis(archive.timeout_ms),
        }
    }

    /// Returns the stamp of the file in the folder.
    pub(super) async fn stamp(self: &Arc<Self>, id: &EntryId) -> Result<Option<Stamp>, FetchError> {
        let (files, wanted) = (Arc::clone(self), id.clone());
        blocking(move || files.folder.stamp(&wanted)).await?.map_err(local)
    }

    /// Reads the file in the folder. Uses the digest of `known` if its stamp is that of the file.
    pub(super) async fn read(
        self: &Arc<Self>,
        id: &EntryId,
        known: Option<(Stamp, Digest)>,
        deadline: Instant,
    ) -> Result<Option<(Bytes, Digest, Stamp)>, FetchError> {
        let (files, wanted) = (Arc::clone(self), id.clone());
        let read = move || -> Result<_, FetchError> {
            let Some(mut opened) = files.folder.open(&wanted).map_err(local)? else { return Ok(None) };
            let reservation = files.memory.reservation();
            reservation.grow(opened.stamp.bytes()).map_err(|error| FetchError::Memory { id: wanted, error })?;
            let bytes = opened.read_all().map_err(local)?;
            let known = known.filter(|(stamp, _)| *stamp == opened.stamp);
            let digest = known.map_or_else(|| Digest::of(&bytes), |(_, digest)| digest);
            Ok(Some((reservation.attach(bytes), digest, opened.stamp)))
        };
        self.with_permit(id, deadline, read).await.flatten()
    }

    /// Computes the digest of the file in the folder, part by part.
    pub(super) async fn digest(self: &Arc<Self>, id: &EntryId) -> Result<Option<(Digest, Stamp)>, FetchError> {
        let (files, wanted) = (Arc::clone(self), id.clone());
        let read = move || -> Result<_, FetchError> {
            let Some(mut opened) = files.folder.open(&wanted).map_err(local)? else { return Ok(None) };
            let mut hasher = Hasher::default();
            opened.read_in_parts(|part| hasher.update(part)).map_err(local)?;
            Ok(Some((hasher.digest(), opened.stamp)))
        };
        self.with_permit(id, Instant::now() + self.timeout, read).await.flatten()
    }

    /// Loads the copy on disk.
    pub(super) async fn copy(
        self: &Arc<Self>,
        id: &EntryId,
        deadline: Instant,
    ) -> Result<std::io::Result<Found>, FetchError> {
        let (files, wanted) = (Arc::clone(self), id.clone());
        self.with_permit(id, deadline, move || files.disk.load(&wanted, files.memory.reservation())).await
    }

    /// Changes a copy on disk.
    pub(super) async fn change<T: Send + 'static>(
        self: &Arc<Self>,
        act: impl FnOnce(&Disk) -> T + Send + 'static,
    ) -> Result<T, FetchError> {
        let files = Arc::clone(self);
        blocking(move || act(&files.disk)).await
    }

    /// Runs blocking `work` on its own thread, with a permit that it keeps to its end. Waits for the permit at most for
    /// half of the time for an entry.
    async fn with_permit<T: Send + 'static>(
        &self,
        id: &EntryId,
        deadline: Instant,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, FetchError> {
        let limit = self.timeout / 2;
        let busy = |Busy { wait }| FetchError::Busy { id: id.clone(), limit, wait };
        let begin_by = deadline.min(Instant::now() + limit);
        let reading = self.readers.wait(None, begin_by.into_std(), deadline.into_std()).await.map_err(busy)?;
        blocking(move || {
            let value = work();
            drop(reading);
            value
        })
        .await
    }
}

fn local(error: ArchiveError) -> FetchError {
    FetchError::Local(Arc::new(error))
}

/// Runs blocking `work` on its own thread.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, FetchError> {
    let ended = tokio::task::spawn_blocking(work).await;
    ended.map_err(|_panicked_or_stopped| FetchError::Internal("reading ended without a result"))
}
