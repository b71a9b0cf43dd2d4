//! Disk space for the indexes of tilesets whose atoms do not fit into memory.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock, Weak};

use super::{Client, Structures};
use crate::memory_budget::{Budget, Reclaim};
use crate::structure::StructureError;
use crate::structure::stream::ScratchFile;

/// Folder for temporary files, within a limit of their size.
#[derive(Debug)]
pub(crate) struct ScratchSpace {
    folder: PathBuf,
    budget: Budget,
    /// Cache that owns the files.
    cache: OnceLock<Weak<Structures>>,
}

impl ScratchSpace {
    /// Allows temporary files of together `limit` bytes in a folder. A client whose files take more than the fraction
    /// `share` leaves as much to others.
    pub(crate) fn new(folder: &Path, limit: u64, share: f64) -> Arc<Self> {
        let (folder, budget, cache) = (folder.to_owned(), Budget::of_disk(limit, share), OnceLock::new());
        let space = Arc::new(Self { folder, budget, cache });
        let owner: Arc<dyn Reclaim> = Arc::<Self>::clone(&space);
        space.budget.reclaim_from(Arc::downgrade(&owner));
        space
    }

    /// Returns the budget of the disk space.
    #[cfg(test)]
    pub(super) const fn budget(&self) -> &Budget {
        &self.budget
    }

    /// Sets the cache whose tilesets are evicted when the limit is reached.
    pub(super) fn evict_from(&self, cache: Weak<Structures>) {
        self.cache.get_or_init(|| cache);
    }

    /// Creates a file. It has no name, so that the system removes it when it is closed, also after a crash.
    ///
    /// # Errors
    /// Returns [`StructureError::Scratch`].
    pub(super) fn file(&self) -> Result<ScratchFile, StructureError> {
        self.charged_file(&self.budget)
    }

    /// Creates a file that counts towards the share of a client.
    ///
    /// # Errors
    /// Returns [`StructureError::Scratch`].
    pub(super) fn client_file(&self, client: Client) -> Result<ScratchFile, StructureError> {
        self.charged_file(&self.budget.for_client(client.0))
    }

    fn charged_file(&self, budget: &Budget) -> Result<ScratchFile, StructureError> {
        let file = tempfile::tempfile_in(&self.folder);
        let file = file.map_err(|error| StructureError::Scratch { reason: error.to_string() })?;
        Ok(ScratchFile { file, meter: Arc::new(budget.reservation()) })
    }
}

impl Reclaim for ScratchSpace {
    /// Removes the least recently used index that no request uses.
    fn reclaim(&self, _bytes: u64) -> bool {
        self.cache.get().and_then(Weak::upgrade).is_some_and(|cache| cache.evict_streamed())
    }
}
