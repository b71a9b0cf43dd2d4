//! Accounting of memory. The core asks a meter before it allocates, and does not know the budget behind it.

use std::fmt::Debug;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use thiserror::Error;

/// Error of memory that is not available now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum OutOfMemory {
    /// The budget is used up.
    #[error("{held} of {limit} bytes of memory are in use and {needed} more are needed")]
    Budget {
        /// Bytes asked for.
        needed: u64,
        /// Used part of the budget, bytes.
        held: u64,
        /// Size of the budget, bytes.
        limit: u64,
    },
    /// The operating system refused an allocation.
    #[error("the system has no {needed} bytes of memory left")]
    System {
        /// Bytes asked for.
        needed: u64,
    },
}

/// Counter of memory, called before memory is allocated and after it is freed.
pub trait MemoryMeter: Debug + Send + Sync {
    /// Adds `bytes`; changes nothing on failure.
    ///
    /// # Errors
    /// [`OutOfMemory`].
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory>;

    /// Subtracts `bytes` that were added before.
    fn shrink(&self, bytes: u64);
}

/// No limit.
impl MemoryMeter for () {
    fn grow(&self, _bytes: u64) -> Result<(), OutOfMemory> {
        Ok(())
    }

    fn shrink(&self, _bytes: u64) {}
}

/// Bytes added to a meter, until this is dropped.
#[derive(Debug)]
pub struct Reservation {
    meter: Arc<dyn MemoryMeter>,
    bytes: AtomicU64,
}

impl Reservation {
    /// Creates a reservation of 0 bytes.
    #[must_use]
    pub fn new(meter: &Arc<dyn MemoryMeter>) -> Self {
        Self { meter: Arc::clone(meter), bytes: AtomicU64::new(0) }
    }

    /// Leaves the bytes added to the meter, whose owner subtracts them.
    pub fn keep(&self) {
        self.bytes.store(0, Ordering::Relaxed);
    }
}

/// A reservation is a meter itself: what is added to it ends with it at the latest.
impl MemoryMeter for Reservation {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.meter.grow(bytes)?;
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.bytes.fetch_sub(bytes, Ordering::Relaxed);
        self.meter.shrink(bytes);
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.meter.shrink(*self.bytes.get_mut());
    }
}
