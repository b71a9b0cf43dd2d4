//! Room for what comes, at the cost of what was not used for longest.

use std::time::{Duration, SystemTime};

use metrics::counter;

use super::error::StoreError;
use super::handle::Store;
use super::index::{NoRoom, Victim};
use super::name::{Folder, Name};
use super::stale::STALE;
use crate::telemetry::STORE_REMOVED;

/// Attempts to make room, where others use what was about to go or take the room that was made.
const ATTEMPTS: usize = 16;

/// What a sweep did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Swept {
    /// Objects removed because their time was up.
    pub expired: u64,
    /// Objects removed because everything together was too large.
    pub evicted: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Unfinished objects of crashed processes that were removed.
    pub stale: u64,
    /// Objects that could not be removed; they are tried again next time. The errors are in the log.
    pub failed: u64,
}

/// Bytes promised to a writer, until they are committed or given up.
pub(super) struct Room {
    store: Store,
    bytes: u64,
    capped: bool,
}

impl Room {
    /// Promises more bytes.
    pub(super) async fn grow(&mut self, bytes: u64) -> Result<(), StoreError> {
        if self.capped {
            self.store.reserve(self.bytes, bytes).await?;
            self.bytes += bytes;
        }
        Ok(())
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.store.index().release(self.bytes);
    }
}

impl Store {
    /// Removes what has been kept for long enough at `now`, then the least recently used until everything fits, and
    /// about once an hour what crashed processes left. To be called regularly, by whoever owns the service.
    pub async fn sweep(&self, now: SystemTime) -> Swept {
        let mut swept = Swept::default();
        let mut cleared = self.0.tidying.lock().await;
        let expired = self.index().expired(now, |folder| self.ttl(folder));
        (swept.expired, swept.bytes) = self.remove_all(&expired, "ttl", &mut swept.failed).await;
        // The cap may have been lowered, or others may have written.
        let (excess, _) = self.index().excess(0, self.0.config.max_bytes);
        let (evicted, bytes) = self.remove_all(&excess, "cap", &mut swept.failed).await;
        (swept.evicted, swept.bytes) = (evicted, swept.bytes + bytes);
        if now.duration_since(*cleared).is_ok_and(|age| age >= STALE) {
            match self.0.backend.clear_stale(now).await {
                Ok(stale) => (swept.stale, *cleared) = (stale, now),
                Err(error) => tracing::warn!(%error, "what crashed processes left in the store was not removed"),
            }
        }
        if swept != Swept::default() {
            let Swept { expired, evicted, bytes, stale, failed } = swept;
            tracing::info!(expired, evicted, bytes, stale, failed, "store swept");
        }
        swept
    }

    fn ttl(&self, folder: Folder) -> Duration {
        match folder {
            Folder::Inputs => self.0.config.input_ttl(),
            Folder::Jobs => self.0.config.job_ttl(),
            Folder::Results => self.0.config.result_ttl(),
        }
    }

    /// Promises room for an object, and makes it where there is none.
    pub(super) async fn room_for(&self, name: &Name, bytes: u64) -> Result<Room, StoreError> {
        let mut room = Room { store: self.clone(), bytes: 0, capped: name.folder().is_capped() };
        room.grow(bytes).await?;
        Ok(room)
    }

    /// Promises `more` bytes to whoever has `had`.
    async fn reserve(&self, had: u64, more: u64) -> Result<(), StoreError> {
        let max_bytes = self.0.config.max_bytes;
        let bytes = had.saturating_add(more);
        if bytes > max_bytes {
            return Err(StoreError::TooLarge { bytes, max_bytes });
        }
        if self.index().reserve(more, max_bytes).is_ok() {
            return Ok(());
        }
        let _one_at_a_time = self.0.tidying.lock().await;
        let mut held = max_bytes;
        for _ in 0..ATTEMPTS {
            let outcome = self.index().reserve(more, max_bytes);
            match outcome {
                Ok(()) => return Ok(()),
                Err(NoRoom::Held(by_others)) => return Err(StoreError::Full { bytes, held: by_others, max_bytes }),
                Err(NoRoom::Remove(victims)) => {
                    let mut failed = 0;
                    let (_, freed) = self.remove_all(&victims, "cap", &mut failed).await;
                    held = held.saturating_sub(freed);
                    if failed > 0 && freed == 0 {
                        break;
                    }
                }
            }
        }
        Err(StoreError::Full { bytes, held, max_bytes })
    }

    /// Removes what may still go. Returns how many objects and bytes went; `failed` counts those that did not let go.
    async fn remove_all(&self, victims: &[Victim], reason: &'static str, failed: &mut u64) -> (u64, u64) {
        let (mut objects, mut bytes) = (0, 0);
        for victim in victims {
            match self.remove_victim(victim.clone()).await {
                Ok(true) => (objects, bytes) = (objects + 1, bytes + victim.bytes),
                Ok(false) => {}
                Err(error) => {
                    *failed += 1;
                    tracing::warn!(%error, name = %victim.name, "an object could not be removed");
                }
            }
        }
        counter!(STORE_REMOVED, "reason" => reason).increment(objects);
        (objects, bytes)
    }

    async fn remove_victim(&self, victim: Victim) -> Result<bool, StoreError> {
        let store = self.clone();
        self.finished(async move {
            let _lock = store.stripe(&victim.name).lock().await;
            let goes = store.index().begin_removal(&victim);
            if goes {
                store.remove(&victim.name).await?;
            }
            Ok(goes)
        })
        .await
    }
}
