//! Multipart upload of large objects. An object becomes visible with its last part, or not at all.

use bytes::Bytes;
use object_store::{ObjectStoreExt as _, WriteMultipart};
use tokio::runtime::Handle;
use tokio::task::spawn_blocking;

use super::backend::Backend;
use super::error::StoreError;
use super::name::Name;

/// Concurrent parts. Hides the latency of a connection and bounds the memory.
const PARTS: usize = 3;

/// Multipart upload in progress.
pub(super) struct Upload<'a> {
    backend: &'a Backend,
    name: &'a Name,
    parts: WriteMultipart,
}

impl<'a> Upload<'a> {
    /// Starts an upload.
    pub(super) async fn begin(backend: &'a Backend, name: &'a Name) -> Result<Self, StoreError> {
        let (objects, path) = (backend.objects().clone(), name.path());
        // The backend of a folder creates the staged file on the calling thread.
        let begun = if backend.is_local() {
            let runtime = Handle::current();
            let begin = move || runtime.block_on(async { objects.put_multipart(&path).await });
            spawn_blocking(begin).await.unwrap_or_else(|e| Err(e.into()))
        } else {
            objects.put_multipart(&path).await
        };
        let begun = begun.map_err(|e| backend.fail("put", &name.to_string(), &e))?;
        Ok(Self { backend, name, parts: WriteMultipart::new_with_chunk_size(begun, backend.part()) })
    }

    /// Uploads the next bytes. Waits while [`PARTS`] parts are in progress.
    pub(super) async fn push(&mut self, bytes: Bytes) -> Result<(), StoreError> {
        let sent = self.parts.wait_for_capacity(PARTS).await;
        sent.map_err(|e| self.backend.fail("put", &self.name.to_string(), &e))?;
        self.parts.put(bytes);
        Ok(())
    }

    /// Makes the object visible and durable.
    pub(super) async fn finish(self) -> Result<(), StoreError> {
        let finished = self.parts.finish().await;
        finished.map(|_| ()).map_err(|e| self.backend.fail("put", &self.name.to_string(), &e))
    }

    /// Aborts the upload and removes its parts, as far as possible.
    pub(super) async fn abort(self) {
        if let Err(error) = self.parts.abort().await {
            let error = self.backend.fail("abort", &self.name.to_string(), &error);
            tracing::warn!(%error, "an unfinished object was not removed; it will be removed when it is one hour old");
        }
    }
}

/// Writes an object; see [`Backend::put`]. Uploads large objects to S3 in parts, which S3 requires from 5 GiB on and
/// which is faster for much smaller ones.
pub(super) async fn put(backend: &Backend, name: &Name, mut bytes: Bytes, new: bool) -> Result<bool, StoreError> {
    let part = backend.part();
    if backend.is_local() || new || bytes.len() <= part {
        return backend.put(name, bytes, new).await;
    }
    let mut upload = Upload::begin(backend, name).await?;
    while !bytes.is_empty() {
        let next = bytes.split_to(part.min(bytes.len()));
        if let Err(error) = upload.push(next).await {
            upload.abort().await;
            return Err(error);
        }
    }
    upload.finish().await.map(|()| true)
}
