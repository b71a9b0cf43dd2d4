//! Reservations, eviction of the least recently used objects, and expiry.

use std::time::{Duration, SystemTime};

use futures_util::future::join_all;
use metrics::counter;

use super::error::StoreError;
use super::handle::Store;
use super::index::{EvictionCandidate, ReserveError};
use super::name::{Folder, Name};
use super::object::Usage;
use super::stale::STALE;
use crate::surface::{Exceeded, Limit};
use crate::telemetry::{STORE_REMOVED, shorten};

/// Attempts to free space. Other requests may use the candidates or take the freed space in between.
const ATTEMPTS: usize = 16;

/// Shortest time between two saved uses of an object.
const SAVE_USE: Duration = Duration::from_hours(1);

/// Result of a sweep.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Swept {
    /// Objects whose time to live expired.
    pub expired: u64,
    /// Objects evicted because the store was over its capacity.
    pub evicted: u64,
    /// Bytes of removed objects.
    pub bytes: u64,
    /// Abandoned unfinished objects that were removed.
    pub stale: u64,
    /// Objects that could not be removed. The errors are logged, and the next sweep retries.
    pub failed: u64,
}

/// Bytes reserved by a writer, until they are committed or released.
#[derive(Debug)]
pub(super) struct SpaceReservation {
    store: Store,
    bytes: u64,
    capped: bool,
}

impl SpaceReservation {
    /// Reserves more bytes, evicting objects if necessary.
    pub(super) async fn grow(&mut self, bytes: u64) -> Result<(), StoreError> {
        if self.capped {
            self.store.reserve(self.bytes, bytes).await?;
            self.bytes += bytes;
        }
        Ok(())
    }

    /// Returns the reserved bytes, which the caller releases.
    pub(super) fn take(&mut self) -> u64 {
        std::mem::take(&mut self.bytes)
    }
}

impl Drop for SpaceReservation {
    fn drop(&mut self) {
        self.store.index().release(self.bytes);
    }
}

impl Store {
    /// Removes expired objects, then the least recently used ones until the store is within its capacity, and about
    /// once an hour leftovers of crashed processes. Saves times of last use, at most once an hour for an object. The
    /// service calls it regularly.
    pub async fn sweep(&self, now: SystemTime) -> Swept {
        let mut swept = Swept::default();
        let mut cleared = self.0.last_cleanup.lock().await;
        if self.0.is_shared
            && let Err(error) = self.refresh().await
        {
            tracing::warn!(%error, "the store was not swept, because it cannot be listed");
            return swept;
        }
        let expired = self.index().expired(now, |folder| self.ttl(folder));
        (swept.expired, swept.bytes) = self.remove_all(&expired, "ttl", &mut swept.failed).await;
        // The capacity may have been lowered, or other processes may have written.
        let (excess, _) = self.index().excess(0, self.capacity());
        let (evicted, bytes) = self.remove_all(&excess, "cap", &mut swept.failed).await;
        (swept.evicted, swept.bytes) = (evicted, swept.bytes + bytes);
        let mut uses = self.index().unsaved_uses(SAVE_USE);
        for (_, used) in &mut uses {
            *used = self.0.clock.to_system(*used);
        }
        if let Err(error) = self.0.backend.save_uses(uses).await {
            tracing::warn!(%error, "times of last use were not saved");
        }
        if now.duration_since(*cleared).is_ok_and(|age| age >= STALE) {
            match self.0.backend.clear_stale(self.0.clock.to_system(now)).await {
                Ok(stale) => (swept.stale, *cleared) = (stale, now),
                Err(error) => tracing::warn!(%error, "leftovers of crashed processes were not removed from the store"),
            }
        }
        if swept != Swept::default() {
            let Swept { expired, evicted, bytes, stale, failed } = swept;
            tracing::info!(expired, evicted, bytes, stale, failed, "store swept");
        }
        swept
    }

    pub(super) fn ttl(&self, folder: Folder) -> Duration {
        match folder {
            Folder::Inputs => Duration::from_millis(self.0.config.input_ttl_ms),
            Folder::Jobs | Folder::Results => Duration::from_millis(self.0.config.result_ttl_ms),
        }
    }

    /// Returns the capacity for results and inputs.
    fn capacity(&self) -> Usage {
        Usage { bytes: self.0.config.max_bytes, objects: self.0.config.max_objects }
    }

    /// Returns a reservation of 0 bytes for an object.
    pub(super) fn empty_reservation(&self, name: &Name) -> SpaceReservation {
        SpaceReservation { store: self.clone(), bytes: 0, capped: name.folder().is_capped() }
    }

    /// Reserves `more` bytes for a writer that has reserved `had`.
    async fn reserve(&self, had: u64, more: u64) -> Result<(), StoreError> {
        let (cap, max_bytes) = (self.capacity(), self.0.config.max_bytes);
        let bytes = had.saturating_add(more);
        if bytes > max_bytes {
            let error = Exceeded { actual: Some(bytes), ..Exceeded::new(Limit::StoreBytes, max_bytes) };
            return Err(StoreError::TooLarge(error.into()));
        }
        if self.index().reserve(more, cap).is_ok() {
            return Ok(());
        }
        let _one_at_a_time = self.0.last_cleanup.lock().await;
        let mut held = max_bytes;
        for _ in 0..ATTEMPTS {
            let outcome = self.index().reserve(more, cap);
            match outcome {
                Ok(()) => return Ok(()),
                Err(ReserveError::Held(by_others)) => {
                    return Err(StoreError::Full { bytes, held: by_others, max_bytes });
                }
                Err(ReserveError::Remove(candidates)) => {
                    let mut failed = 0;
                    let (_, freed) = self.remove_all(&candidates, "cap", &mut failed).await;
                    held = held.saturating_sub(freed);
                    if failed > 0 && freed == 0 {
                        break;
                    }
                }
            }
        }
        Err(StoreError::Full { bytes, held, max_bytes })
    }

    /// Evicts the least recently used objects after the disk had no space for `bytes`: twice as many bytes, since other
    /// writers need space too. Evicts nothing if `bytes` would not fit even then. Returns true if that freed any.
    pub(crate) async fn evict_for(&self, bytes: u64) -> bool {
        let _one_at_a_time = self.0.last_cleanup.lock().await;
        let free = self.0.backend.free_bytes().await;
        let candidates = self.index().oldest(Usage { bytes: bytes.saturating_mul(2), objects: 0 });
        let evictable: u64 = candidates.iter().map(|candidate| candidate.bytes).sum();
        if free.is_some_and(|free| free.saturating_add(evictable) < bytes) {
            return false;
        }
        let (objects, freed) = self.remove_all(&candidates, "cap", &mut 0).await;
        tracing::warn!(objects, bytes = freed, "the disk is full; evicted objects");
        freed > 0
    }

    /// Returns true if an object of `bytes` fits into the capacity, and twice into the free space of the disk.
    pub(crate) async fn has_space(&self, bytes: u64) -> bool {
        let (_, missing) = self.index().excess(bytes, self.capacity());
        missing == 0 && self.0.backend.free_bytes().await.is_none_or(|free| free / 2 >= bytes)
    }

    /// Removes the candidates that are still unused. Returns the numbers of removed objects and bytes; adds failures to
    /// `failed`.
    async fn remove_all(&self, candidates: &[EvictionCandidate], reason: &'static str, failed: &mut u64) -> (u64, u64) {
        let (mut objects, mut bytes) = (0, 0);
        for candidate in candidates {
            match self.remove_candidate(candidate).await {
                Ok(true) => (objects, bytes) = (objects + candidate.names.len() as u64, bytes + candidate.bytes),
                Ok(false) => {}
                Err(error) => {
                    *failed += 1;
                    tracing::warn!(error = shorten(&error.to_string()), "an object could not be removed");
                }
            }
        }
        counter!(STORE_REMOVED, "reason" => reason).increment(objects);
        (objects, bytes)
    }

    /// Removes the objects of a candidate, unless they were used meanwhile. Returns true if they were removed.
    pub(super) async fn remove_candidate(&self, candidate: &EvictionCandidate) -> Result<bool, StoreError> {
        let (store, candidate) = (self.clone(), candidate.clone());
        self.run_to_completion(async move {
            let Some(first) = candidate.names.first() else { return Ok(false) };
            let _lock = store.write_lock(first).lock().await;
            if store.0.is_shared && store.was_written(&candidate).await? {
                return Ok(false);
            }
            let begun = store.index().begin_removal(&candidate);
            if begun {
                let removed = join_all(candidate.names.iter().map(|name| store.remove(name))).await;
                removed.into_iter().collect::<Result<(), _>>()?;
            }
            Ok(begun)
        })
        .await
    }
}
