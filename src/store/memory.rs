//! In-memory cache of small results.

use bytes::Bytes;
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use super::name::{Folder, Name};
use super::object::{Meta, Stored};

/// Memory of an entry besides its data, bytes.
const OVERHEAD: u64 = 256;

#[derive(Clone)]
struct Weight;

impl Weighter<Name, Stored> for Weight {
    fn weight(&self, _name: &Name, stored: &Stored) -> u64 {
        stored.bytes.len() as u64 + OVERHEAD
    }
}

/// Bounded cache of results.
pub(super) struct Memory {
    cache: Cache<Name, Stored, Weight>,
    largest: u64,
}

impl Memory {
    /// Creates a cache of `bytes`, for objects of at most `largest` bytes.
    pub(super) fn new(bytes: u64, largest: u64) -> Self {
        // The expected number of entries determines the number of shards. Few, large shards hold the largest object.
        let items = usize::try_from(bytes / largest.max(1)).unwrap_or(usize::MAX).clamp(1, 1 << 16);
        Self { cache: Cache::with_weighter(items, bytes, Weight), largest }
    }

    pub(super) fn get(&self, name: &Name) -> Option<Stored> {
        self.cache.get(name)
    }

    /// Returns a copy of an object to cache; `None` if it is no result or too large. The bytes of a writer or a request
    /// may be a small part of a buffer of a megabyte, which they would keep.
    pub(super) fn copy(&self, name: &Name, bytes: &Bytes) -> Option<Bytes> {
        let is_cached = name.folder() == Folder::Results && bytes.len() as u64 <= self.largest;
        is_cached.then(|| Bytes::copy_from_slice(bytes))
    }

    /// Caches the [copy](Self::copy) of an object, or drops an existing entry.
    pub(super) fn put(&self, name: &Name, copy: Option<Bytes>, meta: Meta) {
        match copy {
            Some(bytes) => self.cache.insert(name.clone(), Stored { bytes, meta }),
            None => self.remove(name),
        }
    }

    pub(super) fn remove(&self, name: &Name) {
        let _gone = self.cache.remove(name);
    }

    /// Returns the cached bytes.
    pub(super) fn held(&self) -> u64 {
        self.cache.weight()
    }
}
