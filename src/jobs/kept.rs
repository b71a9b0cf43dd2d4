//! Values of the cache of structures: structures, tilesets and their colours, each charged to the memory budget.

use std::any::Any;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Deref;
use std::sync::Arc;

use bytes::Bytes;

use super::MemoryReservation;
use crate::memory_budget::Buffers;
use crate::pipeline::tileset::{Tileset, TilesetColors};
use crate::pipeline::{Options, estimate_atoms, params};
use crate::store::{Digest, Namespace};
use crate::structure::Structure;

/// Namespace, and digest of a file or of a tileset. All other input of the reader is the same for the whole service,
/// except limits.
pub(crate) type CacheKey = (Namespace, Digest);

/// A structure or a tileset, and the memory that it is charged to.
#[derive(Debug)]
pub(super) struct Charged<T> {
    pub(super) value: T,
    /// Size of the structure file, bytes.
    pub(super) file_bytes: usize,
    /// Number of atoms as estimated from the file, so that estimates of work do not depend on its presence in memory.
    pub(super) atoms: f64,
    /// Memory of the value, bytes.
    pub(super) bytes: u64,
    /// Charge of the memory: the buffers of a value that is kept, else the reservation. The metric of the budget counts
    /// only the latter.
    pub(super) _charge: Result<Buffers, Arc<MemoryReservation>>,
}

/// A structure or a tileset that other requests may use as well. Clones share it.
#[derive(Debug)]
pub(crate) struct Shared<T>(pub(super) Arc<Charged<T>>);

/// A structure that other requests may use as well.
pub(crate) type SharedStructure = Shared<Structure>;
/// A prepared tileset that other requests may use as well.
pub(crate) type SharedTileset = Shared<Tileset<SharedStructure>>;
/// Colours of a tileset that other requests may use as well.
pub(crate) type SharedColors = Shared<TilesetColors>;

impl<T> Clone for Shared<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> Shared<T> {
    pub(super) fn bytes(&self) -> u64 {
        self.0.bytes
    }
}

impl<T> Deref for Shared<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0.value
    }
}

/// Structure of a task or a request.
#[derive(Debug, Clone)]
pub(crate) enum Input {
    /// Structure file, compressed or not.
    File(Bytes),
    /// Structure in memory, whose file need not be loaded.
    Kept(SharedStructure),
    /// Tileset with its atoms on disk, for jobs on its tiles.
    Tileset(SharedTileset),
}

impl Input {
    /// Returns the file; `None` if it was not loaded.
    pub(crate) fn file(&self) -> Option<&Bytes> {
        match self {
            Self::File(file) => Some(file),
            Self::Kept(_) | Self::Tileset(_) => None,
        }
    }

    /// Returns the size of the file, bytes.
    pub(crate) fn file_bytes(&self) -> usize {
        match self {
            Self::File(file) => file.len(),
            Self::Kept(kept) => kept.0.file_bytes,
            Self::Tileset(kept) => kept.0.file_bytes,
        }
    }

    /// Returns the number of atoms as estimated from the file.
    pub(crate) fn atoms(&self) -> f64 {
        match self {
            Self::File(file) => estimate_atoms(file),
            Self::Kept(kept) => kept.0.atoms,
            Self::Tileset(kept) => kept.0.atoms,
        }
    }
}

/// Value of the cache: a [`SharedStructure`], a [`SharedTileset`] or [`SharedColors`].
#[derive(Debug, Clone)]
pub(super) struct Kept {
    pub(super) bytes: u64,
    value: Arc<dyn Any + Send + Sync>,
}

impl<T: Send + Sync + 'static> From<Shared<T>> for Kept {
    fn from(shared: Shared<T>) -> Self {
        Self { bytes: shared.bytes(), value: shared.0 }
    }
}

impl Kept {
    /// Returns the value if it has this type.
    pub(super) fn get<T: Send + Sync + 'static>(&self) -> Option<Shared<T>> {
        Arc::clone(&self.value).downcast().ok().map(Shared)
    }

    /// Returns true for a tileset with its atoms on disk.
    pub(super) fn is_streamed(&self) -> bool {
        self.get().is_some_and(|tileset: SharedTileset| tileset.is_streamed())
    }

    /// Returns true if a request uses the value, or a cached tileset uses the structure.
    pub(super) fn is_used(&self) -> bool {
        Arc::strong_count(&self.value) > 1
    }
}

#[derive(Debug, Default)]
pub(super) struct CacheState {
    /// Values, each with the number of its last use.
    pub(super) kept: HashMap<CacheKey, (u64, Kept)>,
    /// Least recently used first.
    pub(super) by_use: BTreeMap<u64, CacheKey>,
    /// Number of uses.
    pub(super) uses: u64,
    /// Memory of all values, bytes.
    pub(super) bytes: u64,
    /// Values that a request is making.
    pub(super) making: HashSet<CacheKey>,
}

impl CacheState {
    /// Adds a value as the most recently used one.
    pub(super) fn insert(&mut self, key: CacheKey, value: Kept) {
        self.remove(&key);
        self.uses += 1;
        self.bytes += value.bytes;
        self.by_use.insert(self.uses, key);
        self.kept.insert(key, (self.uses, value));
    }

    pub(super) fn remove(&mut self, key: &CacheKey) -> Option<Kept> {
        let (used, value) = self.kept.remove(key)?;
        self.by_use.remove(&used);
        self.bytes -= value.bytes;
        Some(value)
    }

    /// Removes the least recently used value that `is_candidate` accepts, and returns it.
    pub(super) fn evict(&mut self, is_candidate: impl Fn(&Kept) -> bool) -> Option<Kept> {
        let accepted = |key: &&CacheKey| self.kept.get(*key).is_some_and(|(_, value)| is_candidate(value));
        let found = *self.by_use.values().find(accepted)?;
        self.remove(&found)
    }

    /// Finds a value, and makes it the most recently used one.
    pub(super) fn find(&mut self, key: &CacheKey) -> Option<Kept> {
        let found = self.remove(key)?;
        self.insert(*key, found.clone());
        Some(found)
    }
}

/// Returns the digests of a tileset: of its structure file and of the parameters that affect the index. The second one
/// is that of a tileset with its atoms on disk, whose index has the colours.
pub(super) fn tileset_digests(digest: &Digest, options: &Options) -> [Digest; 2] {
    let color = options.color.map(|coloring| coloring.canonical());
    let Options { compress, normals, .. } = Options::default();
    let mut options = Options { tile: None, color: None, compress, normals, ..options.clone() };
    options.params.atom_ids = false;
    let canonical = params::canonical(&options);
    let in_memory = Digest::of(format!("tileset\n{digest}\n{canonical}").as_bytes());
    [in_memory, Digest::of(format!("on disk\n{in_memory}\n{color:?}").as_bytes())]
}
