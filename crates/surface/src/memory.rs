//! Accounting of memory. The core adds memory to a meter before it allocates; the meter's owner defines the limit.

use std::fmt::Debug;
use std::hash::Hash;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rustc_hash::FxHashMap;
use thiserror::Error;

/// Error of memory that is not available.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum OutOfMemory {
    /// The budget is used up.
    #[error("{held} of {limit} bytes of memory are in use and {needed} more are needed")]
    Budget {
        /// Requested bytes.
        needed: u64,
        /// Used part of the budget, bytes.
        held: u64,
        /// Size of the budget, bytes.
        limit: u64,
    },
    /// Other work of the client holds more than its share of the budget, and other clients would get too little.
    #[error(
        "this client holds {held} bytes of memory; with {needed} more, less than a share of {limit} bytes would be left \
         for others"
    )]
    Share {
        /// Requested bytes.
        needed: u64,
        /// Bytes that the client holds.
        held: u64,
        /// Share of a client, bytes.
        limit: u64,
    },
    /// The work needs more than the whole budget, so it cannot succeed later either.
    #[error("the request needs at least {needed} bytes of memory at once and the limit is {limit}")]
    Limit {
        /// Bytes that the work needs at once, a lower bound.
        needed: u64,
        /// Size of the budget, bytes.
        limit: u64,
    },
    /// The operating system refused an allocation.
    #[error("the system has no {needed} bytes of memory left")]
    System {
        /// Requested bytes.
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

    /// Returns the size of the whole budget and the part of it that this work holds, bytes.
    fn budget(&self) -> Option<[u64; 2]> {
        None
    }

    /// Checks that `bytes` more would fit if no other work used memory.
    ///
    /// # Errors
    /// [`OutOfMemory::Limit`].
    fn check(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let Some([limit, held]) = self.budget() else { return Ok(()) };
        let needed = held.saturating_add(bytes);
        if needed <= limit { Ok(()) } else { Err(OutOfMemory::Limit { needed, limit }) }
    }

    /// Notes that the work holds `bytes` until its end that another meter counts.
    fn also_held(&self, bytes: u64) {
        let _ = bytes;
    }
}

/// Meter without a limit.
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

    /// Keeps the bytes in the meter, whose owner subtracts them.
    pub fn keep(&self) {
        self.bytes.store(0, Ordering::Relaxed);
    }

    /// Reserves capacity for `n` more rows. If they do not fit, at least doubles the capacity. Adds the memory before
    /// it allocates; the old memory counts until the rows are moved.
    ///
    /// # Errors
    /// [`OutOfMemory`].
    pub fn reserve_rows<T>(&self, rows: &mut Vec<T>, n: usize) -> Result<(), OutOfMemory> {
        let old = rows.capacity();
        if rows.len() + n <= old {
            return Ok(());
        }
        let bytes = |capacity: usize| (capacity * size_of::<T>()) as u64;
        let new = (rows.len() + n).max(2 * old).max(4);
        self.grow(bytes(new))?;
        rows.reserve_exact(new - rows.len());
        self.shrink(bytes(old));
        Ok(())
    }

    /// Reserves capacity for `n` more entries of a table, as [`Self::reserve_rows`] does for rows.
    ///
    /// # Errors
    /// [`OutOfMemory`].
    pub fn reserve_entries<K: Eq + Hash, V>(&self, table: &mut FxHashMap<K, V>, n: usize) -> Result<(), OutOfMemory> {
        let old = table.capacity();
        if table.len() + n <= old {
            return Ok(());
        }
        // At most seven of eight buckets are used. Each bucket takes one byte besides its entry.
        let bytes = |capacity: usize| match capacity {
            0 => 0,
            _ => ((capacity * 8 / 7).next_power_of_two() * (size_of::<(K, V)>() + 1)) as u64,
        };
        self.grow(bytes((table.len() + n).max(old + 1)))?;
        table.reserve(n);
        self.shrink(bytes(old));
        Ok(())
    }
}

/// A reservation is a meter itself. Dropping it subtracts everything that was added to it.
impl MemoryMeter for Reservation {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.meter.grow(bytes)?;
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        let held = self.bytes.fetch_sub(bytes, Ordering::Relaxed);
        debug_assert!(held >= bytes, "{bytes} of {held} bytes are subtracted");
        self.meter.shrink(bytes);
    }

    fn budget(&self) -> Option<[u64; 2]> {
        self.meter.budget()
    }

    fn check(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.meter.check(bytes)
    }

    fn also_held(&self, bytes: u64) {
        self.meter.also_held(bytes);
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.meter.shrink(*self.bytes.get_mut());
    }
}
