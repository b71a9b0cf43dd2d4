//! Memory budget of all requests, in bytes: uploads, archive entries, meshes that are not yet sent, and the buffers of
//! connections.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use metrics::gauge;
use thiserror::Error;

use crate::telemetry::MEMORY_HELD;

/// Error of an exhausted budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("{held} of {limit} bytes of memory for uploads and meshes are in use")]
pub struct Exhausted {
    /// Size of the budget, bytes.
    pub limit: u64,
    /// Used part of the budget, bytes.
    pub held: u64,
}

/// Memory budget in bytes. Clones share one budget.
#[derive(Debug, Clone)]
pub struct Budget {
    limit: u64,
    held: Arc<AtomicU64>,
}

impl Budget {
    /// Creates a budget of `limit` bytes.
    #[must_use]
    pub fn new(limit: u64) -> Self {
        Self { limit, held: Arc::default() }
    }

    /// Creates a budget without a limit.
    #[must_use]
    pub fn unlimited() -> Self {
        Self::new(u64::MAX)
    }

    /// Checks that at most the limit is in use.
    ///
    /// # Errors
    /// [`Exhausted`].
    pub fn check(&self) -> Result<(), Exhausted> {
        let held = self.held.load(Ordering::Relaxed);
        if held > self.limit { Err(Exhausted { limit: self.limit, held }) } else { Ok(()) }
    }

    /// Takes `bytes` regardless of the limit until the result is dropped, for buffers that are bounded elsewhere. The
    /// metric of the budget does not count them.
    #[must_use]
    pub fn buffers(&self, bytes: u64) -> Buffers {
        self.held.fetch_add(bytes, Ordering::Relaxed);
        Buffers { budget: self.clone(), bytes }
    }

    /// Creates a lease of 0 bytes.
    #[must_use]
    pub fn lease(&self) -> Lease {
        Lease { budget: self.clone(), bytes: 0 }
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
        self.budget.held.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Bytes taken from a budget. Dropping the lease returns them.
#[derive(Debug)]
pub struct Lease {
    budget: Budget,
    bytes: u64,
}

impl Lease {
    /// Adds `bytes` to the lease. A failure changes nothing.
    ///
    /// # Errors
    /// [`Exhausted`].
    pub fn grow(&mut self, bytes: u64) -> Result<(), Exhausted> {
        let Budget { limit, held } = &self.budget;
        held.try_update(Ordering::Relaxed, Ordering::Relaxed, |now| now.checked_add(bytes).filter(|sum| sum <= limit))
            .map_err(|held| Exhausted { limit: *limit, held })?;
        self.bytes += bytes;
        publish(bytes, 1.0);
        Ok(())
    }

    /// Adds `bytes` regardless of the limit, for memory that is allocated already.
    pub fn force(&mut self, bytes: u64) {
        self.budget.held.fetch_add(bytes, Ordering::Relaxed);
        self.bytes += bytes;
        publish(bytes, 1.0);
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

impl Drop for Lease {
    fn drop(&mut self) {
        self.budget.held.fetch_sub(self.bytes, Ordering::Relaxed);
        publish(self.bytes, -1.0);
    }
}

/// Changes the gauge by a difference, so that several budgets in one process add up.
#[expect(clippy::cast_precision_loss, reason = "gauges are floats; exact up to 8 PiB")]
fn publish(bytes: u64, sign: f64) {
    gauge!(MEMORY_HELD).increment(sign * bytes as f64);
}

#[cfg(test)]
mod tests {
    use super::Budget;

    #[test]
    fn leases_add_up_and_come_back() {
        let budget = Budget::new(100);
        let (mut a, mut b) = (budget.lease(), budget.lease());
        a.grow(60).unwrap();
        assert_eq!(b.grow(41).unwrap_err().held, 60);
        b.grow(40).unwrap();
        b.force(10);
        assert_eq!(budget.check().unwrap_err().held, 110);
        drop(b);
        budget.check().unwrap();
        drop(a);
        budget.lease().grow(100).unwrap();
    }

    #[test]
    fn attached_bytes_hold_their_lease_to_the_last_reference() {
        let budget = Budget::new(10);
        let mut lease = budget.lease();
        lease.force(11);
        let mut bytes = lease.attach(vec![7; 11]);
        let tail = bytes.split_off(10);
        drop(bytes);
        assert_eq!((&tail[..], budget.check().unwrap_err().held), (&[7][..], 11));
        drop(tail);
        budget.check().unwrap();
    }
}
