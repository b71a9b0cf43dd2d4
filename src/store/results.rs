//! Check of stored results. A result is compared with its digest before its first use in a process, and again whenever
//! its file has changed since.

use super::digest::{Digest, Hasher};
use super::error::StoreError;
use super::handle::Store;
use super::name::Name;
use super::object::Meta;
use crate::sync::spawn_blocking;

/// Number of results that are known to be intact, in a few megabytes. Others are checked again.
pub(super) const INTACT_RESULTS: usize = 16_384;
/// Bytes that are read and hashed at once.
const PIECE: u64 = 1 << 20;

impl Store {
    /// Returns all bytes of a small object. Does not count as a use or a look-up.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub(crate) async fn peek(&self, name: &Name) -> Result<Option<bytes::Bytes>, StoreError> {
        if let Some(stored) = self.0.memory.get(name) {
            return Ok(Some(stored.bytes));
        }
        Ok(self.0.backend.get_whole(name).await?.map(|stored| stored.bytes))
    }

    /// Records that this process has written a result.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub(crate) async fn set_intact(&self, name: &Name) -> Result<(), StoreError> {
        if let Some(meta) = self.0.backend.head(name).await? {
            self.0.intact.insert(name.clone(), meta);
        }
        Ok(())
    }

    /// Returns true if the result that `meta` describes was written or checked by this process. Reads no file.
    pub(crate) fn is_known_intact(&self, name: &Name, meta: Meta) -> bool {
        // S3 checks its objects itself. This process wrote the objects in memory.
        !self.0.backend.is_local()
            || self.0.intact.get(name) == Some(meta)
            || self.0.memory.get(name).is_some_and(|stored| stored.meta == meta)
    }

    /// Returns true if a result exists and has this size and digest. A damaged one goes into quarantine, so that it is
    /// computed again. The file is read at most once unless it changes.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub(crate) async fn is_intact(&self, name: &Name, size: u64, digest: &Digest) -> Result<bool, StoreError> {
        let Some(meta) = self.head(name).await? else { return Ok(false) };
        if self.is_known_intact(name, meta) {
            return Ok(true);
        }
        let (store, name, digest) = (self.clone(), name.clone(), *digest);
        self.run_to_completion(async move {
            // Concurrent requests wait for one check.
            let _lock = store.write_lock(&name).lock().await;
            let Some(meta) = store.0.backend.head(&name).await? else { return Ok(false) };
            if store.is_known_intact(&name, meta) {
                return Ok(true);
            }
            if meta.size == size && store.has_digest(&name, size, &digest).await? {
                store.0.intact.insert(name, meta);
                return Ok(true);
            }
            store.quarantine_damaged(&name).await?;
            Ok(false)
        })
        .await
    }

    /// Hashes an object of `size` bytes piece by piece on blocking threads, and compares the digest.
    async fn has_digest(&self, name: &Name, size: u64, digest: &Digest) -> Result<bool, StoreError> {
        let mut hasher = Hasher::default();
        let mut at = 0;
        while at < size {
            let end = size.min(at + PIECE);
            let piece = self.0.backend.piece(name, at..end).await?;
            let hashed = spawn_blocking(move || {
                hasher.update(&piece);
                hasher
            });
            hasher = hashed.await.map_err(|error| self.0.backend.fail("task", "", &error))?;
            at = end;
        }
        Ok(hasher.digest() == *digest)
    }
}
