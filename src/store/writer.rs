//! Writer of objects for blocking threads.

use std::io;

use bytes::{Bytes, BytesMut};

use super::digest::{Digest, Hasher};
use super::error::StoreError;
use super::eviction::SpaceReservation;
use super::handle::Store;
use super::name::Name;
use super::upload::ObjectUpload;

/// Blocking writer of an object; see [`Store::writer`].
///
/// The object becomes visible with [`finish`](Self::finish). Dropping the writer earlier leaves nothing behind. At most
/// four parts are in memory: the one being filled and those being uploaded.
#[derive(Debug)]
pub struct Writer {
    store: Store,
    name: Name,
    reservation: SpaceReservation,
    filling: BytesMut,
    hasher: Hasher,
    /// True if a small object is cached in memory.
    is_cached: bool,
    /// Upload in parts, from the first full part on.
    upload: Option<ObjectUpload>,
    /// Total size of the uploaded parts, bytes.
    uploaded: u64,
    failed: bool,
}

impl Store {
    /// Starts an object that a blocking thread writes. Space is reserved as the object grows.
    ///
    /// The calls of the writer block, so they must not be made on the async runtime.
    #[must_use]
    pub fn writer(&self, name: &Name) -> Writer {
        Writer {
            store: self.clone(),
            name: name.clone(),
            reservation: self.empty_reservation(name),
            filling: BytesMut::new(),
            hasher: Hasher::default(),
            is_cached: true,
            upload: None,
            uploaded: 0,
            failed: false,
        }
    }
}

impl Writer {
    /// Leaves the object out of the cache in memory unless `is_cached`.
    #[must_use]
    pub(crate) fn cached(mut self, is_cached: bool) -> Self {
        self.is_cached = is_cached;
        self
    }

    /// Makes the object visible. It is durable on return. Returns its size, bytes, and its digest.
    ///
    /// # Errors
    /// Returns a [`StoreError`]. The object is not visible then.
    pub fn finish(mut self) -> Result<(u64, Digest), StoreError> {
        let runtime = self.store.0.runtime.clone();
        let size = runtime.block_on(self.complete())?;
        Ok((size, std::mem::take(&mut self.hasher).digest()))
    }

    async fn complete(&mut self) -> Result<u64, StoreError> {
        let last = self.filling.split().freeze();
        if self.failed {
            return Err(StoreError::WriterFailed);
        }
        if self.upload.is_some() {
            self.push(last.clone()).await?;
        } else {
            self.reservation.grow(last.len() as u64).await?;
        }
        let _lock = self.store.write_lock(&self.name).lock().await;
        if let Some(upload) = self.upload.take() {
            upload.finish().await?;
            self.store.commit(&self.name, self.uploaded, None, &mut self.reservation);
            return Ok(self.uploaded);
        }
        // An object of one part needs no multipart upload, and may be cached.
        let size = last.len() as u64;
        self.store.0.backend.put(&self.name, last.clone(), false).await?;
        self.store.commit(&self.name, size, self.is_cached.then_some(&last), &mut self.reservation);
        Ok(size)
    }

    /// Uploads a part. Aborts the upload if that fails.
    async fn push(&mut self, part: Bytes) -> Result<(), StoreError> {
        let pushed = self.try_push(part).await;
        if pushed.is_err() {
            self.failed = true;
            if let Some(upload) = self.upload.take() {
                upload.abort().await;
            }
        }
        pushed
    }

    async fn try_push(&mut self, part: Bytes) -> Result<(), StoreError> {
        self.reservation.grow(part.len() as u64).await?;
        self.uploaded += part.len() as u64;
        let upload = match &mut self.upload {
            Some(upload) => upload,
            none => none.insert(ObjectUpload::begin(&self.store, &self.name).await?),
        };
        upload.push(part).await
    }
}

impl io::Write for Writer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.failed {
            return Err(StoreError::WriterFailed.into());
        }
        let part = self.store.0.backend.part_size();
        if self.filling.capacity() == 0 {
            self.filling.reserve(part);
        }
        let taken = bytes.len().min(part - self.filling.len());
        self.filling.extend_from_slice(&bytes[..taken]);
        self.hasher.update(&bytes[..taken]);
        if self.filling.len() == part {
            let full = std::mem::take(&mut self.filling).freeze();
            let runtime = self.store.0.runtime.clone();
            runtime.block_on(self.push(full))?;
        }
        Ok(taken)
    }

    /// Does nothing: only [`Writer::finish`] makes the object visible.
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        if let Some(upload) = self.upload.take() {
            self.store.0.runtime.spawn(upload.abort());
        }
    }
}
