//! Uploaded structure files. Their digest is checked whenever they are read, because a damaged file would also spoil
//! the results that are computed from it. Reading takes longer than hashing, about 0.6 ns per byte.

use bytes::Bytes;
use futures_util::TryStreamExt as _;

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;
use super::{ByteStream, Digest, Meta, Namespace};
use crate::sync::spawn_blocking;

impl Store {
    /// Reads an uploaded structure file. A damaged one goes into quarantine, so that another upload can replace it.
    ///
    /// # Errors
    /// Returns [`StoreError::Damaged`] for a damaged file, or another [`StoreError`].
    pub(crate) async fn input(&self, digest: &Digest, namespace: Namespace) -> Result<Option<Bytes>, StoreError> {
        let name = Name::input(digest).within(namespace);
        let Some(read) = self.get(&name).await? else { return Ok(None) };
        if has_digest(&read.bytes, digest).await {
            return Ok(Some(read.bytes));
        }
        drop(read);
        self.remove_damaged(&name, digest).await
    }

    /// Stores an uploaded structure file unless it is stored undamaged. Returns true if it was stored.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub(crate) async fn put_input(
        &self,
        digest: &Digest,
        namespace: Namespace,
        bytes: Bytes,
    ) -> Result<bool, StoreError> {
        let name = Name::input(digest).within(namespace);
        // S3 checks its objects itself.
        if self.0.backend.is_local()
            && let Some((meta, stream)) = self.read(&name, None).await?
        {
            if holds(meta, stream, &bytes).await? {
                return if self.0.is_shared { self.put_new(&name, bytes).await } else { Ok(false) };
            }
            match self.remove_damaged(&name, digest).await {
                Ok(_) | Err(StoreError::Damaged { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        self.put_new(&name, bytes).await
    }

    /// Moves a file into quarantine if it is still damaged, and returns it if another upload has replaced it.
    async fn remove_damaged(&self, name: &Name, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        let (store, name, digest) = (self.clone(), name.clone(), *digest);
        self.run_to_completion(async move {
            let _lock = store.write_lock(&name).lock().await;
            let Some(read) = store.0.backend.get_whole(&name).await? else { return Ok(None) };
            if has_digest(&read.bytes, &digest).await {
                return Ok(Some(read.bytes));
            }
            store.quarantine_damaged(&name).await?;
            Err(StoreError::Damaged { digest })
        })
        .await
    }
}

/// Compares an object with `bytes`, piece by piece.
async fn holds(meta: Meta, mut stream: ByteStream, bytes: &Bytes) -> Result<bool, StoreError> {
    if meta.size != bytes.len() as u64 {
        return Ok(false);
    }
    let mut at = 0;
    while let Some(piece) = stream.try_next().await? {
        if bytes.get(at..at + piece.len()) != Some(&piece[..]) {
            return Ok(false);
        }
        at += piece.len();
    }
    Ok(true)
}

/// Hashes `bytes` on a blocking thread and compares the result. The thread is missing only when the process ends, which
/// damages nothing.
async fn has_digest(bytes: &Bytes, digest: &Digest) -> bool {
    let bytes = bytes.clone();
    spawn_blocking(move || Digest::of(&bytes)).await.map_or(true, |found| found == *digest)
}
