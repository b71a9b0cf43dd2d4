//! Memory accounting of fetches. The owner of the archive implements the limit.

use std::fmt::Debug;

/// Error: the memory limit is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoMemory {
    /// Memory limit, bytes.
    pub limit: u64,
    /// Memory in use, bytes.
    pub held: u64,
}

/// Memory accounting of all fetches.
pub trait Memory: Debug + Send + Sync {
    /// Starts the accounting of one fetch.
    fn begin(&self) -> Box<dyn Share>;
}

/// Memory of one fetch, released on drop.
pub trait Share: Debug + Send {
    /// Reserves `bytes` more.
    ///
    /// # Errors
    /// Returns [`NoMemory`] if the limit is reached; earlier reservations remain.
    fn grow(&mut self, bytes: u64) -> Result<(), NoMemory>;
}

/// Accounting without a limit: only `archive.max_bytes` and `archive.concurrent` bound the memory.
#[derive(Debug, Clone, Copy)]
pub struct Uncounted;

impl Memory for Uncounted {
    fn begin(&self) -> Box<dyn Share> {
        Box::new(Self)
    }
}

impl Share for Uncounted {
    fn grow(&mut self, _bytes: u64) -> Result<(), NoMemory> {
        Ok(())
    }
}
