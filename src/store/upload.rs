//! Large objects, part by part. They appear with the last one, or not at all.

use bytes::Bytes;
use object_store::{ObjectStoreExt as _, WriteMultipart};
use tokio::runtime::Handle;
use tokio::task::spawn_blocking;

use super::backend::Backend;
use super::error::StoreError;
use super::name::Name;

/// Parts that are on their way at once: they fill a line with some latency, and bound what waits in memory.
const PARTS: usize = 3;

/// An object that is being written.
pub(super) struct Upload<'a> {
    backend: &'a Backend,
    name: &'a Name,
    parts: WriteMultipart,
}

impl<'a> Upload<'a> {
    /// Begins one.
    pub(super) async fn begin(backend: &'a Backend, name: &'a Name) -> Result<Self, StoreError> {
        let (objects, path) = (backend.objects().clone(), name.path());
        // A folder's backend makes the staged file right here, and not on another thread.
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

    /// Takes the next bytes, and waits while too much is on its way.
    pub(super) async fn push(&mut self, bytes: Bytes) -> Result<(), StoreError> {
        let sent = self.parts.wait_for_capacity(PARTS).await;
        sent.map_err(|e| self.backend.fail("put", &self.name.to_string(), &e))?;
        self.parts.put(bytes);
        Ok(())
    }

    /// Makes the object appear, durably.
    pub(super) async fn finish(self) -> Result<(), StoreError> {
        let finished = self.parts.finish().await;
        finished.map(|_| ()).map_err(|e| self.backend.fail("put", &self.name.to_string(), &e))
    }

    /// Leaves nothing behind, as far as the backend lets us.
    pub(super) async fn abort(self) {
        if let Err(error) = self.parts.abort().await {
            let error = self.backend.fail("abort", &self.name.to_string(), &error);
            tracing::warn!(%error, "an unfinished object was left behind; it is removed when it is an hour old");
        }
    }
}

/// Writes a whole object; see [`Backend::put`]. A large one goes to S3 in parts, which the service asks for from 5 GiB
/// on and which is faster long before.
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
