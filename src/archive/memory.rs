//! The memory of what is being fetched. How much there may be is known to whoever owns the archive; here it is asked, byte by byte.

use std::fmt::Debug;

/// There is no more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoMemory {
    /// Bytes allowed.
    pub limit: u64,
    /// Bytes in use.
    pub held: u64,
}

/// Counts the memory of fetches.
pub trait Memory: Debug + Send + Sync {
    /// Begins to count one fetch.
    fn begin(&self) -> Box<dyn Share>;
}

/// The memory of one fetch; dropping it gives it back.
pub trait Share: Debug + Send {
    /// Takes `bytes` more.
    ///
    /// # Errors
    /// [`NoMemory`]; what was taken before is still held.
    fn grow(&mut self, bytes: u64) -> Result<(), NoMemory>;
}

/// Memory that nobody counts: only `archive.max_bytes` and `archive.concurrent` bound it.
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
