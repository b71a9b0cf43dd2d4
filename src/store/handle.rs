//! Store of atomic, durable objects by name.

use std::collections::hash_map::DefaultHasher;
use std::fmt;
use std::future::Future;
use std::hash::{Hash as _, Hasher as _};
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicUsize;
use std::sync::{Arc, PoisonError};
use std::time::SystemTime;

use bytes::Bytes;
use metrics::counter;
use quick_cache::sync::Cache;
use tokio::sync::Mutex as AsyncMutex;

use super::backend::Backend;
use super::clock::Clock;
use super::error::StoreError;
use super::eviction::SpaceReservation;
use super::index::{Index, Seen};
use super::memory::Memory;
use super::name::{Folder, Name};
use super::object::{ByteStream, Meta, Pin, Stored, Usage};
use super::secret::Secret;
use super::{results, stream};
use crate::config::StoreConfig;
use crate::sync::{Handle, Mutex, MutexGuard};
use crate::telemetry::CACHE_REQUESTS;

/// Number of locks for writing and removing. Names share them by hash.
const WRITE_LOCKS: usize = 64;

/// Object store in a folder or on S3. Clones share one store.
///
/// Writes and removals are atomic. Futures may be dropped at any time: a started operation is completed or undone.
#[derive(Clone)]
pub struct Store(pub(super) Arc<StoreState>);

pub(super) struct StoreState {
    pub(super) backend: Backend,
    pub(super) config: StoreConfig,
    /// True if other nodes write to the store and remove from it.
    pub(super) is_shared: bool,
    index: Mutex<Index>,
    pub(super) memory: Memory,
    /// Results that this process has written or checked, as they were then.
    pub(super) intact: Cache<Name, Meta>,
    write_locks: [AsyncMutex<()>; WRITE_LOCKS],
    /// Serializes evictions, so that two do not remove twice as much. The value is the time of the last search for
    /// staged files.
    pub(super) last_cleanup: AsyncMutex<SystemTime>,
    pub(super) clock: Clock,
    /// Number of job records in quarantine at the last count.
    pub(super) quarantined: AtomicUsize,
    pub(super) runtime: Handle,
}

impl fmt::Debug for Store {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Store").field(&self.0.backend.location()).finish()
    }
}

impl Store {
    /// Opens the configured store, by default the folder `store` in `data_dir`. Tests it, removes leftovers of crashed
    /// processes, and indexes its objects. Must be called on the runtime that runs the operations of the store.
    ///
    /// # Errors
    /// Returns [`StoreError::Open`] if it cannot be written and read.
    pub async fn open(config: &StoreConfig, data_dir: &Path) -> Result<Self, StoreError> {
        Self::open_for(config, data_dir, false).await
    }

    /// Opens a store over `backend`; see [`open`](Self::open).
    pub(super) async fn open_backend(
        backend: Backend,
        config: &StoreConfig,
        is_shared: bool,
    ) -> Result<Self, StoreError> {
        backend.check_start().await.map_err(|e| backend.open_error(&e))?;
        let clock = Clock::start();
        let now = clock.now();
        // Not fatal: credentials may permit uploads without permitting their listing.
        let cleared = match backend.clear_stale(now).await {
            Ok(cleared) => cleared,
            Err(error) => {
                tracing::warn!(%error, "leftovers of crashed processes were not removed from the store");
                0
            }
        };
        let mut index = Index::default();
        index.keeps_inputs = is_shared;
        for folder in Folder::ALL {
            for (name, meta) in backend.list(folder).await.map_err(|e| backend.open_error(&e))? {
                index.commit(&name, meta.size, meta.modified);
            }
            index.update_metrics(folder);
        }
        let [inputs, jobs, results] = Folder::ALL.map(|folder| index.usage(folder).objects);
        tracing::info!(location = backend.location(), inputs, jobs, results, cleared, "store opened");
        let store = Self(Arc::new(StoreState {
            backend,
            is_shared,
            index: Mutex::new(index),
            memory: Memory::new(config.memory_bytes, config.memory_object_bytes),
            intact: Cache::new(results::INTACT_RESULTS),
            write_locks: [const { AsyncMutex::const_new(()) }; WRITE_LOCKS],
            last_cleanup: AsyncMutex::new(now),
            clock,
            quarantined: AtomicUsize::new(0),
            runtime: Handle::current(),
            config: config.clone(),
        }));
        store.count_quarantined().await.map_err(|e| store.0.backend.open_error(&e))?;
        Ok(store)
    }

    /// Stores `bytes` under `name`, replacing any existing object. The object is durable on return.
    ///
    /// # Errors
    /// Returns a [`StoreError`]. An existing object is unchanged then, unless it was evicted.
    pub async fn put(&self, name: &Name, bytes: Bytes) -> Result<(), StoreError> {
        self.write(name, bytes, false).await.map(|_| ())
    }

    /// Stores `bytes` under `name` unless an object exists, and returns true if it was stored. The object is durable on
    /// return.
    ///
    /// # Errors
    /// Returns a [`StoreError`]. Nothing has changed then.
    pub async fn put_new(&self, name: &Name, bytes: Bytes) -> Result<bool, StoreError> {
        let Some(meta) = self.head(name).await? else { return self.write(name, bytes, true).await };
        self.touch(name, self.now());
        self.renew(name, meta, bytes).await?;
        Ok(false)
    }

    /// Reads all bytes of an object. Results in memory need no disk access and no other thread. For large objects, use
    /// [`read`](Self::read).
    ///
    /// # Errors
    /// Returns a [`StoreError`]. A missing object is `None`, not an error, since objects may be removed at any time.
    pub async fn get(&self, name: &Name) -> Result<Option<Stored>, StoreError> {
        if let Some(stored) = self.get_from_memory(name) {
            return Ok(Some(stored));
        }
        let Some(seen) = self.begin_read(name) else { return Ok(None) };
        let read = self.0.backend.get_whole(name).await?;
        self.end_read(name, seen, read.as_ref().map(|stored| stored.meta));
        let copy = read.as_ref().and_then(|stored| self.0.memory.copy(name, &stored.bytes));
        let index = self.index();
        if let Some(stored) = &read
            && index.is_current(name, seen)
        {
            self.0.memory.put(name, copy, stored.meta);
        }
        Ok(read)
    }

    /// Streams an object, or a range of it whose end may exceed the size. Use it for content-addressed objects: each
    /// piece is read on demand. The object is pinned until the stream is dropped.
    ///
    /// # Errors
    /// Returns [`StoreError::Range`] if the range is empty or begins after the end, or another [`StoreError`]. The
    /// stream fails if the object is deleted during the read.
    pub async fn read(&self, name: &Name, range: Option<Range<u64>>) -> Result<Option<(Meta, ByteStream)>, StoreError> {
        let pin = self.pin(name);
        let known = self.get_from_memory(name).map(|stored| stored.meta);
        if known.is_none() && !self.0.backend.is_local() {
            return self.read_remote(name, range).await;
        }
        let meta = if let Some(meta) = known {
            meta
        } else {
            let Some(seen) = self.begin_read(name) else { return Ok(None) };
            let meta = self.0.backend.head(name).await?;
            self.end_read(name, seen, meta);
            let Some(meta) = meta else { return Ok(None) };
            meta
        };
        let range = range.map(|range| stream::within(range, meta.size)).transpose()?.unwrap_or(0..meta.size);
        Ok(Some((meta, stream::pieces(pin, meta, range))))
    }

    /// Reads from S3; see [`read`](Self::read). Makes one request for all pieces.
    async fn read_remote(
        &self,
        name: &Name,
        range: Option<Range<u64>>,
    ) -> Result<Option<(Meta, ByteStream)>, StoreError> {
        let Some(seen) = self.begin_read(name) else { return Ok(None) };
        let range = match range {
            Some(range) => {
                let Some(meta) = self.0.backend.head(name).await? else {
                    self.end_read(name, seen, None);
                    return Ok(None);
                };
                Some(stream::within(range, meta.size)?)
            }
            None => None,
        };
        let read = self.0.backend.get(name, range).await?;
        self.end_read(name, seen, read.as_ref().map(|read| Meta::from(&read.meta)));
        Ok(read.map(|read| (Meta::from(&read.meta), stream::remote(self.clone(), name.clone(), read))))
    }

    /// Reads a range of the object that `meta` describes. Copies from memory, so that the result does not keep the
    /// whole object alive.
    pub(super) async fn piece(&self, name: &Name, meta: Meta, range: Range<u64>) -> Result<Bytes, StoreError> {
        if let Some(Stored { bytes, .. }) = self.0.memory.get(name).filter(|stored| stored.meta.size == meta.size) {
            let at = |offset: u64| usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len());
            return Ok(Bytes::copy_from_slice(&bytes[at(range.start)..at(range.end)]));
        }
        self.0.backend.piece(name, range).await
    }

    /// Returns the metadata of an object. Does not count as a use.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub async fn head(&self, name: &Name) -> Result<Option<Meta>, StoreError> {
        let Some(seen) = self.index().begin_read(name) else { return Ok(None) };
        let meta = self.0.backend.head(name).await?;
        self.reconcile(name, seen, meta);
        Ok(meta)
    }

    /// Removes an object, even if it is pinned. Succeeds if it does not exist.
    ///
    /// # Errors
    /// Returns a [`StoreError`]. The object still exists then.
    pub async fn delete(&self, name: &Name) -> Result<(), StoreError> {
        let (store, name) = (self.clone(), name.clone());
        self.run_to_completion(async move {
            let _lock = store.write_lock(&name).lock().await;
            store.index().mark_removed(&name);
            store.remove(&name).await
        })
        .await
    }

    /// Lists the objects of a folder in name order, as the disk or the service reports them.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub async fn list(&self, folder: Folder) -> Result<Vec<(Name, Meta)>, StoreError> {
        self.0.backend.list(folder).await
    }

    /// Returns the time for [`touch`](Self::touch) and [`sweep`](Self::sweep). It does not follow jumps of the system
    /// clock.
    #[must_use]
    pub fn now(&self) -> SystemTime {
        self.0.clock.now()
    }

    /// Records a use of an object at time `at`, which restarts its time to live. A mesh and its report are used
    /// together.
    pub fn touch(&self, name: &Name, at: SystemTime) {
        self.index().touch(name, at);
    }

    /// Protects an object from eviction and expiry until the pin is dropped, a mesh together with its report. The
    /// object need not exist yet. [`delete`](Self::delete) ignores pins.
    pub fn pin(&self, name: &Name) -> Pin {
        self.index().pin(name);
        Pin { store: self.clone(), name: name.clone() }
    }

    /// Tests the store: writes, reads and removes a small object.
    ///
    /// # Errors
    /// Returns a [`StoreError`].
    pub async fn check(&self) -> Result<(), StoreError> {
        self.0.backend.check().await
    }

    /// Returns the secret of the store, from which unguessable ids are derived. Creates it on first use.
    ///
    /// # Errors
    /// Returns [`StoreError::Open`] if it cannot be read or created.
    pub(crate) async fn secret(&self) -> Result<Secret, StoreError> {
        self.0.backend.secret().await
    }

    /// Returns the number and total size of the objects in a folder.
    #[must_use]
    pub fn usage(&self, folder: Folder) -> Usage {
        self.index().usage(folder)
    }

    /// Returns the bytes of results in memory.
    #[must_use]
    pub fn memory_held(&self) -> u64 {
        self.0.memory.held()
    }

    /// Returns the location, for messages.
    #[must_use]
    pub fn location(&self) -> &str {
        self.0.backend.location()
    }

    pub(super) fn index(&self) -> MutexGuard<'_, Index> {
        self.0.index.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the lock for writing and removing an object, which its group shares.
    pub(super) fn write_lock(&self, name: &Name) -> &AsyncMutex<()> {
        let mut hasher = DefaultHasher::new();
        name.group().hash(&mut hasher);
        let ix = usize::try_from(hasher.finish() % WRITE_LOCKS as u64).unwrap_or_default();
        &self.0.write_locks[ix]
    }

    /// Indexes an object that was just written under the lock of its name, and ends its reservation in the same step,
    /// so that it never counts twice. Caches small results in memory.
    pub(super) fn commit(&self, name: &Name, size: u64, bytes: Option<&Bytes>, reservation: &mut SpaceReservation) {
        let (used, modified) = (self.now(), SystemTime::now());
        let copy = bytes.and_then(|bytes| self.0.memory.copy(name, bytes));
        let mut index = self.index();
        index.commit(name, size, used);
        index.release(reservation.take());
        self.0.memory.put(name, copy, Meta { size, modified });
    }

    /// Removes an object that the index has marked as being removed, under the lock of its name.
    pub(super) async fn remove(&self, name: &Name) -> Result<(), StoreError> {
        self.0.memory.remove(name);
        self.0.intact.remove(name);
        let removed = self.0.backend.delete(name).await;
        self.index().end_removal(name, removed.is_ok());
        removed
    }

    /// Runs an operation to its end, even if the caller stops waiting.
    pub(super) async fn run_to_completion<T: Send + 'static>(
        &self,
        work: impl Future<Output = Result<T, StoreError>> + Send + 'static,
    ) -> Result<T, StoreError> {
        let done = self.0.runtime.spawn(work).await;
        done.unwrap_or_else(|e| Err(self.0.backend.fail("task", "", &e)))
    }

    /// Returns a result from memory.
    fn get_from_memory(&self, name: &Name) -> Option<Stored> {
        if name.folder() != Folder::Results {
            return None;
        }
        let found = self.0.memory.get(name);
        count("memory", found.is_some());
        if found.is_some() {
            self.touch(name, self.now());
        }
        found
    }

    /// Starts a read and records the use.
    fn begin_read(&self, name: &Name) -> Option<Seen> {
        let seen = self.index().begin_read(name);
        if seen.is_none() && name.folder() == Folder::Results {
            count("store", false);
        }
        seen
    }

    /// Ends a read.
    fn end_read(&self, name: &Name, seen: Seen, meta: Option<Meta>) {
        if name.folder() == Folder::Results {
            count("store", meta.is_some());
        }
        self.reconcile(name, seen, meta);
        if meta.is_some() {
            self.touch(name, self.now());
        }
    }

    /// Updates the index with the result of a read, because other processes may write to the store and remove from it.
    fn reconcile(&self, name: &Name, seen: Seen, meta: Option<Meta>) {
        let mut index = self.index();
        match meta {
            Some(meta) => index.adopt(name, seen, meta.size, self.0.clock.to_clock(meta.modified)),
            None if index.is_current(name, seen) => self.forget(&mut index, name),
            None => {}
        }
    }
}

/// Counts a lookup of a result.
fn count(tier: &'static str, hit: bool) {
    counter!(CACHE_REQUESTS, "tier" => tier, "result" => if hit { "hit" } else { "miss" }).increment(1);
}
