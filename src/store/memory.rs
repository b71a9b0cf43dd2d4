//! Small results, kept in memory: an answer that everybody asks for costs no disk and no other thread.

use bytes::Bytes;
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use super::name::{Folder, Name};
use super::object::Meta;

/// What an entry takes beside its bytes: its name, its place in the cache.
const OVERHEAD: u64 = 256;

#[derive(Clone)]
struct Weight;

impl Weighter<Name, (Meta, Bytes)> for Weight {
    fn weight(&self, _name: &Name, (_, bytes): &(Meta, Bytes)) -> u64 {
        bytes.len() as u64 + OVERHEAD
    }
}

/// The memory tier.
pub(super) struct Memory {
    cache: Cache<Name, (Meta, Bytes), Weight>,
    largest: u64,
}

impl Memory {
    /// At most `bytes` in all, in objects of at most `largest` bytes.
    pub(super) fn new(bytes: u64, largest: u64) -> Self {
        // The cache divides itself into shards by the number of entries expected; few large entries make few shards,
        // so that the largest object fits into one.
        let items = usize::try_from(bytes / largest.max(1)).unwrap_or(usize::MAX).clamp(1, 1 << 16);
        Self { cache: Cache::with_weighter(items, bytes, Weight), largest }
    }

    fn takes(&self, name: &Name, bytes: u64) -> bool {
        name.folder() == Folder::Results && bytes <= self.largest
    }

    pub(super) fn get(&self, name: &Name) -> Option<(Meta, Bytes)> {
        self.cache.get(name)
    }

    /// Keeps a result if it is small enough; what was kept under the name is gone in any case.
    pub(super) fn put(&self, name: &Name, meta: Meta, bytes: &Bytes) {
        if self.takes(name, bytes.len() as u64) {
            self.cache.insert(name.clone(), (meta, bytes.clone()));
        } else {
            self.remove(name);
        }
    }

    pub(super) fn remove(&self, name: &Name) {
        let _gone = self.cache.remove(name);
    }

    /// Bytes held.
    pub(super) fn held(&self) -> u64 {
        self.cache.weight()
    }
}
