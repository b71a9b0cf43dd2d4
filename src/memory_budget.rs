//! Memory budget of all requests, in bytes: uploads, archive entries, jobs from reading to the mesh, meshes that are
//! not yet sent, the buffers of connections, and structures that are kept for further requests.

use std::fmt::Debug;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};

use bytes::Bytes;
use metrics::gauge;

use crate::surface::{MemoryMeter, OutOfMemory};
use crate::telemetry::MEMORY_HELD;

/// Owner of memory that it gives back when the budget is short.
pub(crate) trait Reclaim: Debug + Send + Sync {
    /// Frees at least `bytes` if possible. Returns true if it freed some.
    fn reclaim(&self, bytes: u64) -> bool;
}

/// Memory budget in bytes. Clones share one budget.
#[derive(Debug, Clone)]
pub struct Budget {
    limit: u64,
    held: Arc<AtomicU64>,
    /// Budget that this one is a part of.
    whole: Option<Arc<Self>>,
    reclaim: Arc<OnceLock<Weak<dyn Reclaim>>>,
}

impl Budget {
    /// Creates a budget of `limit` bytes.
    #[must_use]
    pub fn new(limit: u64) -> Self {
        Self { limit, held: Arc::default(), reclaim: Arc::default(), whole: None }
    }

    /// Creates a budget of at most `limit` bytes of this one: its leases count in both.
    #[must_use]
    pub fn part(&self, limit: u64) -> Self {
        Self { whole: Some(Arc::new(self.clone())), ..Self::new(limit) }
    }

    /// Adds `bytes` regardless of the limit.
    fn add(&self, bytes: u64) {
        self.held.fetch_add(bytes, Ordering::Relaxed);
        self.whole.iter().for_each(|whole| whole.add(bytes));
    }

    fn subtract(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
        self.whole.iter().for_each(|whole| whole.subtract(bytes));
    }

    /// Creates a budget without a limit.
    #[must_use]
    pub fn unlimited() -> Self {
        Self::new(u64::MAX)
    }

    /// Sets the owner that is asked for memory before anything is rejected. Only the first call has an effect.
    pub(crate) fn reclaim_from(&self, owner: Weak<dyn Reclaim>) {
        self.reclaim.get_or_init(|| owner);
    }

    /// Checks that at most the limit is in use.
    ///
    /// # Errors
    /// [`OutOfMemory::Budget`].
    pub fn check(&self) -> Result<(), OutOfMemory> {
        self.take(0)
    }

    /// Takes `bytes`, within the limit. A failure changes nothing.
    fn take(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let limit = self.limit;
        let take = |held: u64| held.checked_add(bytes).filter(|sum| *sum <= limit);
        let mut reclaimed = true;
        while let Err(held) = self.held.try_update(Ordering::Relaxed, Ordering::Relaxed, take) {
            // Another thread may have freed memory even if this one could not.
            if !reclaimed {
                return Err(OutOfMemory::Budget { needed: bytes, held, limit });
            }
            let missing = held.saturating_add(bytes).saturating_sub(limit);
            reclaimed = self.reclaim.get().and_then(Weak::upgrade).is_some_and(|owner| owner.reclaim(missing));
        }
        if let Some(Err(error)) = self.whole.as_ref().map(|whole| whole.take(bytes)) {
            self.held.fetch_sub(bytes, Ordering::Relaxed);
            return Err(error);
        }
        Ok(())
    }

    /// Takes `bytes` regardless of the limit until the result is dropped, for buffers that are bounded elsewhere. The
    /// metric of the budget does not count them.
    #[must_use]
    pub fn buffers(&self, bytes: u64) -> Buffers {
        self.add(bytes);
        Buffers { budget: self.clone(), bytes }
    }

    /// Creates a lease of 0 bytes.
    #[must_use]
    pub fn lease(&self) -> Lease {
        Lease { budget: self.clone(), bytes: AtomicU64::new(0) }
    }
}

/// Buffers that are charged to a budget.
#[derive(Debug)]
pub struct Buffers {
    budget: Budget,
    bytes: u64,
}

impl Drop for Buffers {
    fn drop(&mut self) {
        self.budget.subtract(self.bytes);
    }
}

/// Bytes taken from a budget. Dropping the lease returns them.
#[derive(Debug)]
pub struct Lease {
    budget: Budget,
    bytes: AtomicU64,
}

impl Lease {
    /// Adds `bytes` to the lease. A failure changes nothing.
    ///
    /// # Errors
    /// [`OutOfMemory::Budget`].
    pub fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.budget.take(bytes)?;
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        publish(bytes, 1.0);
        Ok(())
    }

    /// Returns the size of the lease, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Adds `bytes` regardless of the limit, for memory that is allocated already.
    pub fn force(&self, bytes: u64) {
        self.budget.add(bytes);
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        publish(bytes, 1.0);
    }

    /// Subtracts `bytes` of freed memory.
    pub fn shrink(&self, bytes: u64) {
        self.budget.subtract(bytes);
        self.bytes.fetch_sub(bytes, Ordering::Relaxed);
        publish(bytes, -1.0);
    }

    /// Sets the lease to `bytes` regardless of the limit, for memory that remains of a finished job.
    pub fn set(&self, bytes: u64) {
        let before = self.bytes();
        self.force(bytes.saturating_sub(before));
        self.shrink(before.saturating_sub(bytes));
    }

    /// Converts the lease, for memory that no request uses. The lease then has 0 bytes.
    pub(crate) fn to_buffers(&self) -> Buffers {
        let bytes = self.bytes.swap(0, Ordering::Relaxed);
        publish(bytes, -1.0);
        Buffers { budget: self.budget.clone(), bytes }
    }

    /// Returns `memory` as bytes that hold this lease until the last reference to them is dropped.
    pub fn attach(self, memory: impl AsRef<[u8]> + Send + 'static) -> Bytes {
        Bytes::from_owner(Leased { memory, _lease: self })
    }
}

/// Memory together with its lease.
struct Leased<T> {
    memory: T,
    _lease: Lease,
}

impl<T: AsRef<[u8]>> AsRef<[u8]> for Leased<T> {
    fn as_ref(&self) -> &[u8] {
        self.memory.as_ref()
    }
}

impl MemoryMeter for Lease {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.grow(bytes)
    }

    fn shrink(&self, bytes: u64) {
        self.shrink(bytes);
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.shrink(self.bytes());
    }
}

/// Changes the gauge by a difference, so that several budgets in one process add up.
#[expect(clippy::cast_precision_loss, reason = "gauges are floats; exact up to 8 PiB")]
fn publish(bytes: u64, sign: f64) {
    gauge!(MEMORY_HELD).increment(sign * bytes as f64);
}

#[cfg(test)]
mod tests {
    use super::{Budget, OutOfMemory};

    fn held(error: OutOfMemory) -> u64 {
        let OutOfMemory::Budget { held, .. } = error else { return 0 };
        held
    }

    #[test]
    fn leases_add_up_and_come_back() {
        let budget = Budget::new(100);
        let (a, b) = (budget.lease(), budget.lease());
        a.grow(60).unwrap();
        assert_eq!(held(b.grow(41).unwrap_err()), 60);
        b.grow(40).unwrap();
        b.force(10);
        assert_eq!(held(budget.check().unwrap_err()), 110);
        b.set(45);
        assert_eq!(held(budget.check().unwrap_err()), 105);
        b.set(50);
        drop(b);
        budget.check().unwrap();
        drop(a);
        budget.lease().grow(100).unwrap();
    }

    #[test]
    fn a_part_is_limited_and_counts_in_the_whole() {
        let budget = Budget::new(100);
        let part = budget.part(50);
        let (of_part, of_whole) = (part.lease(), budget.lease());
        of_part.grow(50).unwrap();
        assert_eq!(held(of_part.grow(1).unwrap_err()), 50);
        assert_eq!(held(of_whole.grow(51).unwrap_err()), 50);
        of_part.shrink(20);
        of_whole.grow(60).unwrap();
        // A failure in the whole changes neither.
        assert_eq!(held(of_part.grow(20).unwrap_err()), 90);
        of_part.grow(10).unwrap();
        drop((of_part, of_whole));
        part.lease().grow(50).unwrap();
        budget.lease().grow(100).unwrap();
    }

    #[test]
    fn attached_bytes_hold_their_lease_to_the_last_reference() {
        let budget = Budget::new(10);
        let lease = budget.lease();
        lease.force(11);
        let mut bytes = lease.attach(vec![7; 11]);
        let tail = bytes.split_off(10);
        drop(bytes);
        assert_eq!((&tail[..], held(budget.check().unwrap_err())), (&[7][..], 11));
        drop(tail);
        budget.check().unwrap();
    }
}
