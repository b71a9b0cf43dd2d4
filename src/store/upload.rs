//! Writing of objects, large ones in parts. An object becomes visible with its last part, or not at all.

use bytes::Bytes;
use object_store::{ObjectStoreExt as _, WriteMultipart};

use super::error::StoreError;
use super::eviction::SpaceReservation;
use super::handle::Store;
use super::name::{Folder, Name};

/// Concurrent parts. Hides the latency of a connection and bounds the memory.
const PARTS: usize = 3;

/// Multipart upload in progress.
#[derive(Debug)]
pub(super) struct ObjectUpload {
    store: Store,
    name: Name,
    parts: WriteMultipart,
}

impl ObjectUpload {
    /// Starts an upload. The backend of a folder creates the staged file on the calling thread.
    pub(super) async fn begin(store: &Store, name: &Name) -> Result<Self, StoreError> {
        let backend = &store.0.backend;
        backend.check_folder().await?;
        let begun = backend.timed(backend.objects().put_multipart(&name.path())).await;
        let begun = begun.map_err(backend.fail_at("put", name))?;
        let parts = WriteMultipart::new_with_chunk_size(begun, backend.part_size());
        Ok(Self { store: store.clone(), name: name.clone(), parts })
    }

    /// Uploads the next bytes. Waits while [`PARTS`] parts are in progress.
    pub(super) async fn push(&mut self, bytes: Bytes) -> Result<(), StoreError> {
        let backend = &self.store.0.backend;
        let sent = backend.timed(self.parts.wait_for_capacity(PARTS)).await;
        sent.map_err(backend.fail_at("put", &self.name))?;
        self.parts.put(bytes);
        Ok(())
    }

    /// Makes the object visible and durable.
    pub(super) async fn finish(self) -> Result<(), StoreError> {
        let backend = &self.store.0.backend;
        let finished = backend.timed(self.parts.finish()).await;
        finished.map(|_| ()).map_err(backend.fail_at("put", &self.name))
    }

    /// Aborts the upload and removes its parts, as far as possible.
    pub(super) async fn abort(self) {
        let backend = &self.store.0.backend;
        if let Err(error) = backend.timed(self.parts.abort()).await {
            let error = backend.fail_at("abort", &self.name)(error);
            tracing::warn!(%error, "an unfinished object was not removed; it will be removed when it is one hour old");
        }
    }
}

impl Store {
    /// Writes an object; with `new`, only if none exists. Returns true if it was written. If the disk is full, evicts
    /// objects and tries once more.
    pub(super) async fn write(&self, name: &Name, bytes: Bytes, new: bool) -> Result<bool, StoreError> {
        let (store, name) = (self.clone(), name.clone());
        self.run_to_completion(async move {
            let size = bytes.len() as u64;
            let mut reservation = store.empty_reservation(&name);
            reservation.grow(size).await?;
            match store.write_reserved(&name, &bytes, new, &mut reservation).await {
                Err(StoreError::NoSpace { .. }) if store.evict_for(size).await => {
                    store.write_reserved(&name, &bytes, new, &mut reservation).await
                }
                done => done,
            }
        })
        .await
    }

    async fn write_reserved(
        &self,
        name: &Name,
        bytes: &Bytes,
        new: bool,
        reservation: &mut SpaceReservation,
    ) -> Result<bool, StoreError> {
        let _lock = self.write_lock(name).lock().await;
        let backend = &self.0.backend;
        // Content-addressed objects are equal anyway; only job records need an atomic check.
        let create = new && name.folder() == Folder::Jobs;
        if new && !create && backend.head(name).await?.is_some() {
            return Ok(false);
        }
        if create || backend.is_local() || bytes.len() <= backend.part_size() {
            if !backend.put(name, bytes.clone(), create).await? {
                return Ok(false);
            }
        } else {
            put_in_parts(self, name, bytes.clone()).await?;
        }
        self.commit(name, bytes.len() as u64, Some(bytes), reservation);
        Ok(true)
    }
}

/// Uploads an object in parts. S3 requires parts from 5 GiB on; they are also faster for much smaller objects.
async fn put_in_parts(store: &Store, name: &Name, mut bytes: Bytes) -> Result<(), StoreError> {
    let mut upload = ObjectUpload::begin(store, name).await?;
    while !bytes.is_empty() {
        let next = bytes.split_to(store.0.backend.part_size().min(bytes.len()));
        if let Err(error) = upload.push(next).await {
            upload.abort().await;
            return Err(error);
        }
    }
    upload.finish().await
}
