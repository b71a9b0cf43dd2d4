//! Store that several nodes use at the same time. Other nodes write and remove objects without notice to the index.
//!
//! The index is updated from a list of the store before anything is removed. Inputs are not evicted for space, because
//! another node may be about to read them, and their age is that of their last write.

use std::path::Path;
use std::time::Duration;

use bytes::Bytes;

use super::backend::Backend;
use super::error::StoreError;
use super::handle::Store;
use super::index::{EvictionCandidate, Index};
use super::name::{Folder, Name};
use super::object::Meta;
use crate::config::StoreConfig;

/// Number of objects that are updated or listed in the index under one lock.
const REFRESHED: usize = 1000;
/// Upper limit of the steps of file times.
const CLOCK_STEP: Duration = Duration::from_secs(2);

impl Store {
    /// Opens a store, which other nodes use at the same time if `is_shared`; see [`open`](Self::open).
    pub(crate) async fn open_for(config: &StoreConfig, data_dir: &Path, is_shared: bool) -> Result<Self, StoreError> {
        Self::open_backend(Backend::open(config, data_dir).await?, config, is_shared).await
    }

    /// Returns the names of all job records, without those of batches, in name order.
    pub(crate) async fn job_records(&self) -> Result<Vec<Name>, StoreError> {
        if !self.0.is_shared {
            let (mut names, mut last) = (Vec::new(), Name::before(Folder::Jobs));
            loop {
                // The record of an end directly precedes that of the open job: a job that ends meanwhile is not missed.
                let some = self.index().names_after(&last, REFRESHED);
                let Some(end) = some.last() else { return Ok(names) };
                last = end.clone();
                names.extend(some.into_iter().filter(|name| !name.is_batch()));
            }
        }
        let listed = self.list(Folder::Jobs).await?.into_iter().map(|(name, _)| name);
        Ok(listed.filter(|name| !name.is_batch()).collect())
    }

    /// Writes an input again if half of its time to live has passed since its last write: other nodes know its last use
    /// from that.
    pub(super) async fn renew(&self, name: &Name, meta: Meta, bytes: Bytes) -> Result<(), StoreError> {
        let age = self.now().duration_since(self.0.clock.to_clock(meta.modified)).unwrap_or_default();
        if self.0.is_shared && name.folder() == Folder::Inputs && age >= self.ttl(Folder::Inputs) / 2 {
            self.write(name, bytes, false).await?;
        }
        Ok(())
    }

    /// Updates the index with what other nodes have written and removed.
    pub(super) async fn refresh(&self) -> Result<(), StoreError> {
        for folder in Folder::ALL {
            let before = self.index().names(folder);
            let listed = self.list(folder).await?;
            for name in before {
                if listed.binary_search_by(|(listed, _)| listed.cmp(&name)).is_err() {
                    let mut index = self.index();
                    self.forget(&mut index, &name);
                }
            }
            for some in listed.chunks(REFRESHED) {
                let mut index = self.index();
                for (name, meta) in some {
                    let used = self.0.clock.to_clock(meta.modified);
                    if let Some(seen) = index.begin_read(name) {
                        index.adopt(name, seen, meta.size, used);
                        index.touch(name, used);
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns true if another node has written an object of a candidate since the candidate was last used.
    pub(super) async fn was_written(&self, candidate: &EvictionCandidate) -> Result<bool, StoreError> {
        for (name, used) in candidate.uses() {
            if let Some(meta) = self.0.backend.head(name).await?
                && self.0.clock.to_clock(meta.modified) > used + CLOCK_STEP
            {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Removes an object from index and caches.
    pub(super) fn forget(&self, index: &mut Index, name: &Name) {
        index.forget(name);
        self.0.memory.remove(name);
        self.0.intact.remove(name);
    }
}
