//! Memory budget of all requests, in bytes: uploads, archive entries, jobs from reading to the mesh, meshes that are
//! not yet sent, the buffers of connections, and structures that are kept for further requests.

use std::fmt::Debug;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};

use bytes::{Bytes, BytesMut};
use metrics::gauge;

use crate::surface::{MemoryMeter, OutOfMemory};
use crate::telemetry::{MEMORY_HELD, MEMORY_USED, SCRATCH_BYTES};

/// Owner of memory that it can free when the budget is exceeded.
pub(crate) trait Reclaim: Debug + Send + Sync {
    /// Frees at least `bytes` if possible. Returns true if it freed some.
    fn reclaim(&self, bytes: u64) -> bool;
}

/// Memory budget in bytes. Clones share one budget.
#[derive(Debug, Clone)]
pub struct Budget {
    limit: u64,
    held: Arc<AtomicU64>,
    /// Budget of which this one is a part.
    whole: Option<Arc<Self>>,
    reclaim: Arc<OnceLock<Weak<dyn Reclaim>>>,
    gauges: Gauges,
}

/// Names of the metrics of a budget.
#[derive(Debug, Clone, Copy)]
struct Gauges {
    /// Bytes in use.
    used: &'static str,
    /// Bytes that requests reserve.
    held: Option<&'static str>,
}

impl Budget {
    /// Creates a budget of `limit` bytes.
    #[must_use]
    pub fn new(limit: u64) -> Self {
        let gauges = Gauges { used: MEMORY_USED, held: Some(MEMORY_HELD) };
        Self { limit, held: Arc::default(), reclaim: Arc::default(), whole: None, gauges }
    }

    /// Creates a budget of `limit` bytes of temporary files.
    #[must_use]
    pub fn of_disk(limit: u64) -> Self {
        Self { gauges: Gauges { used: SCRATCH_BYTES, held: None }, ..Self::new(limit) }
    }

    /// Creates a budget of `limit` bytes that is a part of this one: its reservations count in both.
    #[must_use]
    pub fn part(&self, limit: u64) -> Self {
        Self { whole: Some(Arc::new(self.clone())), ..Self::new(limit) }
    }

    /// Adds `bytes` regardless of the limit.
    fn add(&self, bytes: u64) {
        self.held.fetch_add(bytes, Ordering::Relaxed);
        match &self.whole {
            Some(whole) => whole.add(bytes),
            None => publish(self.gauges.used, bytes, 1.0),
        }
    }

    /// Returns the used part, bytes.
    #[cfg(test)]
    pub(crate) fn used(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    fn subtract(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
        match &self.whole {
            Some(whole) => whole.subtract(bytes),
            None => publish(self.gauges.used, bytes, -1.0),
        }
    }

    /// Creates a budget without a limit.
    #[must_use]
    pub fn unlimited() -> Self {
        Self::new(u64::MAX)
    }

    /// Sets the owner that is requested to free memory before a reservation is rejected. Only the first call has an
    /// effect.
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
        let Some(whole) = &self.whole else {
            publish(self.gauges.used, bytes, 1.0);
            return Ok(());
        };
        let taken = whole.take(bytes);
        if taken.is_err() {
            self.held.fetch_sub(bytes, Ordering::Relaxed);
        }
        taken
    }

    /// Takes `bytes` regardless of the limit until the result is dropped, for buffers that are bounded elsewhere.
    /// [`MEMORY_USED`] counts them, [`MEMORY_HELD`] does not.
    #[must_use]
    pub fn buffers(&self, bytes: u64) -> Buffers {
        self.add(bytes);
        Buffers { budget: self.clone(), bytes }
    }

    /// Changes the gauge of the bytes that requests reserve.
    fn publish_held(&self, bytes: u64, sign: f64) {
        if let Some(gauge) = self.gauges.held {
            publish(gauge, bytes, sign);
        }
    }

    /// Creates a reservation of 0 bytes.
    #[must_use]
    pub fn reservation(&self) -> MemoryReservation {
        MemoryReservation { budget: self.clone(), bytes: AtomicU64::new(0), elsewhere: AtomicU64::new(0) }
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

/// Bytes taken from a budget. Dropping the reservation returns them.
#[derive(Debug)]
pub struct MemoryReservation {
    budget: Budget,
    bytes: AtomicU64,
    /// Bytes of the same work in other reservations.
    elsewhere: AtomicU64,
}

impl MemoryReservation {
    /// Adds `bytes` to the reservation. A failure changes nothing.
    ///
    /// # Errors
    /// [`OutOfMemory::Limit`] if the work alone exceeds the budget, else [`OutOfMemory::Budget`].
    pub fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.budget.take(bytes).map_err(|error| self.check(bytes).err().unwrap_or(error))?;
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        self.budget.publish_held(bytes, 1.0);
        Ok(())
    }

    /// Appends `data` to `buffer`, whose capacity this reservation contains. A full buffer grows to the `expected`
    /// length, or to twice its length if that is unknown (0) or too small. It grows to at most 8 times the received
    /// data, because a client may announce more than it sends. Both buffers count while the data is copied.
    ///
    /// # Errors
    /// [`OutOfMemory::Budget`].
    pub(crate) fn extend(&self, buffer: &mut BytesMut, data: &[u8], expected: u64) -> Result<(), OutOfMemory> {
        let (old, length) = (buffer.capacity(), buffer.len() + data.len());
        if length > old {
            let expected = usize::try_from(expected).unwrap_or(usize::MAX);
            let new = if expected < length { 2 * length } else { expected.min(8 * length) };
            self.grow(new as u64)?;
            let mut grown = BytesMut::with_capacity(new);
            grown.extend_from_slice(buffer);
            *buffer = grown;
            self.shrink(old as u64);
        }
        buffer.extend_from_slice(data);
        Ok(())
    }

    /// Returns the size of the reservation, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Adds `bytes` regardless of the limit, for memory that is allocated already.
    pub fn force(&self, bytes: u64) {
        self.budget.add(bytes);
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        self.budget.publish_held(bytes, 1.0);
    }

    /// Subtracts `bytes` of freed memory.
    pub fn shrink(&self, bytes: u64) {
        self.budget.subtract(bytes);
        let held = self.bytes.fetch_sub(bytes, Ordering::Relaxed);
        debug_assert!(held >= bytes, "{bytes} of {held} bytes are subtracted");
        self.budget.publish_held(bytes, -1.0);
    }

    /// Sets the reservation to `bytes` regardless of the limit, for memory that remains of a finished job.
    pub fn set(&self, bytes: u64) {
        let before = self.bytes();
        self.force(bytes.saturating_sub(before));
        self.shrink(before.saturating_sub(bytes));
    }

    /// Converts the reservation, for memory that no request uses. The reservation then has 0 bytes.
    pub(crate) fn to_buffers(&self) -> Buffers {
        let bytes = self.bytes.swap(0, Ordering::Relaxed);
        self.budget.publish_held(bytes, -1.0);
        Buffers { budget: self.budget.clone(), bytes }
    }

    /// Returns `memory` as bytes that hold this reservation until the last reference to them is dropped.
    pub fn attach(self, memory: impl AsRef<[u8]> + Send + 'static) -> Bytes {
        Bytes::from_owner(Reserved { memory, _reservation: self })
    }
}

/// Memory together with its reservation.
struct Reserved<T> {
    memory: T,
    _reservation: MemoryReservation,
}

impl<T: AsRef<[u8]>> AsRef<[u8]> for Reserved<T> {
    fn as_ref(&self) -> &[u8] {
        self.memory.as_ref()
    }
}

impl MemoryMeter for MemoryReservation {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.grow(bytes)
    }

    fn shrink(&self, bytes: u64) {
        self.shrink(bytes);
    }

    fn budget(&self) -> Option<[u64; 2]> {
        Some([self.budget.limit, self.bytes().saturating_add(self.elsewhere.load(Ordering::Relaxed))])
    }

    fn also_held(&self, bytes: u64) {
        self.elsewhere.fetch_add(bytes, Ordering::Relaxed);
    }
}

impl Drop for MemoryReservation {
    fn drop(&mut self) {
        self.shrink(self.bytes());
    }
}

/// Changes the gauge by a difference, so that several budgets in one process add up.
#[expect(clippy::cast_precision_loss, reason = "gauges are floats; exact up to 8 PiB")]
fn publish(gauge: &'static str, bytes: u64, sign: f64) {
    gauge!(gauge).increment(sign * bytes as f64);
}

#[cfg(test)]
mod tests {
    use super::{Budget, BytesMut, MemoryMeter as _, OutOfMemory};

    fn held(error: OutOfMemory) -> u64 {
        let OutOfMemory::Budget { held, .. } = error else { return 0 };
        held
    }

    #[test]
    fn reservations_add_up_and_are_released() {
        let budget = Budget::new(100);
        let (a, b) = (budget.reservation(), budget.reservation());
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
        budget.reservation().grow(100).unwrap();
    }

    #[test]
    fn a_part_is_limited_and_counts_in_the_whole() {
        let budget = Budget::new(100);
        let part = budget.part(50);
        let (of_part, of_whole) = (part.reservation(), budget.reservation());
        of_part.grow(50).unwrap();
        assert_eq!(held(part.reservation().grow(1).unwrap_err()), 50);
        // Alone, the reservation of all of the part cannot grow at any time.
        assert_eq!(of_part.grow(1), Err(OutOfMemory::Limit { needed: 51, limit: 50 }));
        assert_eq!(held(of_whole.grow(51).unwrap_err()), 50);
        of_part.shrink(20);
        of_whole.grow(60).unwrap();
        // A failure in the whole changes neither.
        assert_eq!(held(of_part.grow(20).unwrap_err()), 90);
        of_part.grow(10).unwrap();
        drop((of_part, of_whole));
        part.reservation().grow(50).unwrap();
        budget.reservation().grow(100).unwrap();
    }

    #[test]
    fn growing_buffers_are_charged_by_capacity() {
        let budget = Budget::new(1000);
        let (reservation, mut buffer) = (budget.reservation(), BytesMut::new());
        // An announced length is trusted for eight times what arrived.
        for (sent, expected, capacity) in [(10, 900, 80), (70, 900, 80), (1, 900, 648), (600, 900, 900)] {
            if buffer.len() + sent <= 600 {
                reservation.extend(&mut buffer, &vec![7; sent], expected).unwrap();
                assert_eq!((buffer.capacity() as u64, reservation.bytes()), (capacity, capacity));
            } else {
                // Both buffers do not fit while one moves, and nothing changes.
                let refused = reservation.extend(&mut buffer, &vec![7; sent], expected);
                assert_eq!(refused, Err(OutOfMemory::Limit { needed: 1548, limit: 1000 }));
            }
        }
        assert_eq!((buffer.len(), reservation.bytes()), (81, 648));
        let (reservation, mut buffer) = (Budget::new(100).reservation(), BytesMut::new());
        reservation.extend(&mut buffer, &[7; 5], 0).unwrap();
        assert_eq!((buffer.capacity(), reservation.bytes()), (10, 10));
        reservation.extend(&mut buffer, &[7; 6], 3).unwrap();
        assert_eq!((buffer.capacity(), &buffer[..], reservation.bytes()), (22, &[7; 11][..], 22));
    }

    #[test]
    fn work_that_exceeds_the_budget_alone_is_told_from_work_that_has_to_wait() {
        let budget = Budget::new(100);
        let (other, own) = (budget.reservation(), budget.reservation());
        other.grow(50).unwrap();
        own.grow(20).unwrap();
        assert_eq!(held(own.grow(80).unwrap_err()), 70);
        assert_eq!(own.grow(81), Err(OutOfMemory::Limit { needed: 101, limit: 100 }));
        // Its input is in another reservation.
        own.also_held(30);
        assert_eq!((own.available(), held(own.grow(50).unwrap_err())), (50, 70));
        assert_eq!(own.check(51), Err(OutOfMemory::Limit { needed: 101, limit: 100 }));
        drop(other);
        own.grow(50).unwrap();
    }

    #[test]
    fn attached_bytes_hold_their_reservation_until_the_last_reference_is_dropped() {
        let budget = Budget::new(10);
        let reservation = budget.reservation();
        reservation.force(11);
        let mut bytes = reservation.attach(vec![7; 11]);
        let tail = bytes.split_off(10);
        drop(bytes);
        assert_eq!((&tail[..], held(budget.check().unwrap_err())), (&[7][..], 11));
        drop(tail);
        budget.check().unwrap();
    }
}
