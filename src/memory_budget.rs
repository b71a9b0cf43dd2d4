//! Memory budget of all requests, in bytes: uploads, archive entries, jobs from reading to the mesh, meshes that are
//! not yet sent, the buffers of connections, and structures that are kept for further requests.

mod shares;

use std::fmt::Debug;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock, Weak};

use bytes::{Bytes, BytesMut};
use metrics::gauge;

use self::shares::{Holdings, MemoryShares};
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
    /// Memory that each request needs besides its reservations, bytes.
    per_request: u64,
    held: Arc<AtomicU64>,
    shares: Arc<MemoryShares>,
    /// Client whose reservations these are; `None` for memory that belongs to none.
    holdings: Option<Arc<Holdings>>,
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
        let (shares, held, reclaim) = (MemoryShares::new(1.0), Arc::default(), Arc::default());
        Self { limit, per_request: 0, held, shares, holdings: None, reclaim, whole: None, gauges }
    }

    /// Creates the budget of a service, of `limit` bytes: each request takes `per_request` bytes besides its
    /// reservations, and a client whose requests hold more than the fraction `share`, besides one of them, leaves as
    /// much to others.
    #[must_use]
    pub fn for_service(limit: u64, per_request: u64, share: f64) -> Self {
        Self { per_request, shares: MemoryShares::new(share), ..Self::new(limit) }
    }

    /// Creates a budget of `limit` bytes of temporary files, with the `share` of a client.
    #[must_use]
    pub fn of_disk(limit: u64, share: f64) -> Self {
        Self {
            shares: MemoryShares::new(share),
            gauges: Gauges { used: SCRATCH_BYTES, held: None },
            ..Self::new(limit)
        }
    }

    /// Creates a budget of `limit` bytes that is a part of this one: its reservations count in both.
    #[must_use]
    pub fn part(&self, limit: u64) -> Self {
        let shares = MemoryShares::new(self.shares.share);
        Self { whole: Some(Arc::new(self.clone())), shares, ..Self::new(limit) }
    }

    /// Returns the budget for a client: its reservations count towards its share as well.
    #[must_use]
    pub fn for_client(&self, client: u64) -> Self {
        let whole = self.whole.as_ref().map(|whole| Arc::new(whole.for_client(client)));
        Self { holdings: Some(self.shares.of(client)), whole, ..self.clone() }
    }

    /// Checks that a client whose other work holds more than its share leaves as much to others after it has taken
    /// `bytes`. `own` are the bytes of the work that takes them.
    fn check_share(&self, bytes: u64, own: u64) -> Result<(), OutOfMemory> {
        let Some(holdings) = &self.holdings else { return Ok(()) };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction of a size")]
        #[expect(clippy::cast_precision_loss, reason = "a share needs no exact bytes")]
        let share = (self.limit as f64 * self.shares.share) as u64;
        let held = holdings.bytes.load(Ordering::Relaxed);
        let missing = || {
            let taken = self.held.load(Ordering::Relaxed).saturating_add(bytes);
            taken.saturating_sub(self.limit.saturating_sub(share))
        };
        if held.saturating_sub(own) <= share || missing() == 0 || (self.free(missing()) && missing() == 0) {
            return Ok(());
        }
        Err(OutOfMemory::Share { needed: bytes, held, limit: share })
    }

    /// Checks that work of `bytes` fits if there is no other work.
    fn check_alone(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let needed = bytes.saturating_add(self.per_request);
        if needed > self.limit {
            return Err(OutOfMemory::Limit { needed, limit: self.limit });
        }
        self.whole.as_ref().map_or(Ok(()), |whole| whole.check_alone(bytes))
    }

    /// Adds `bytes` regardless of the limit.
    fn add(&self, bytes: u64) {
        self.held.fetch_add(bytes, Ordering::Relaxed);
        self.holdings.iter().for_each(|of_client| _ = of_client.bytes.fetch_add(bytes, Ordering::Relaxed));
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
        self.holdings.iter().for_each(|of_client| _ = of_client.bytes.fetch_sub(bytes, Ordering::Relaxed));
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

    /// Has memory freed that nobody uses, at least `bytes` if possible. Returns true if some was freed.
    fn free(&self, bytes: u64) -> bool {
        self.reclaim.get().and_then(Weak::upgrade).is_some_and(|owner| owner.reclaim(bytes))
    }

    /// Checks that at most the limit is in use.
    ///
    /// # Errors
    /// [`OutOfMemory::Budget`].
    pub fn check(&self) -> Result<(), OutOfMemory> {
        self.take(0, 0)
    }

    /// Takes `bytes` for work that holds `own` bytes, within the limit and the share of the client. A failure changes
    /// nothing.
    fn take(&self, bytes: u64, own: u64) -> Result<(), OutOfMemory> {
        self.check_share(bytes, own)?;
        let limit = self.limit;
        let take = |held: u64| held.checked_add(bytes).filter(|sum| *sum <= limit);
        let mut reclaimed = true;
        while let Err(held) = self.held.try_update(Ordering::Relaxed, Ordering::Relaxed, take) {
            // Another thread may have freed memory even if this one could not.
            if !reclaimed {
                return Err(OutOfMemory::Budget { needed: bytes, held, limit });
            }
            let missing = held.saturating_add(bytes).saturating_sub(limit);
            reclaimed = self.free(missing);
        }
        match &self.whole {
            Some(whole) => whole.take(bytes, own).inspect_err(|_| {
                self.held.fetch_sub(bytes, Ordering::Relaxed);
            })?,
            None => publish(self.gauges.used, bytes, 1.0),
        }
        self.holdings.iter().for_each(|of_client| _ = of_client.bytes.fetch_add(bytes, Ordering::Relaxed));
        Ok(())
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
    /// [`OutOfMemory::Limit`] if the work alone exceeds the budget, else [`OutOfMemory::Share`] or
    /// [`OutOfMemory::Budget`].
    pub fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let own = self.work_bytes();
        self.budget.take(bytes, own).map_err(|error| self.check(bytes).err().unwrap_or(error))?;
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

    /// Returns the bytes that the work of this reservation holds, here and elsewhere.
    fn work_bytes(&self) -> u64 {
        self.bytes().saturating_add(self.elsewhere.load(Ordering::Relaxed))
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
        debug_assert!(self.budget.holdings.is_none(), "memory that no request uses belongs to no client");
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
        Some([self.budget.limit, self.work_bytes()])
    }

    fn check(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.budget.check_alone(self.work_bytes().saturating_add(bytes))
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
        assert_eq!(held(own.grow(50).unwrap_err()), 70);
        assert_eq!(own.check(51), Err(OutOfMemory::Limit { needed: 101, limit: 100 }));
        drop(other);
        own.grow(50).unwrap();
    }

    #[test]
    fn work_counts_with_what_each_request_needs_besides() {
        let budget = Budget::for_service(100, 30, 1.0);
        let (connection, own) = (budget.buffers(30), budget.reservation());
        own.grow(70).unwrap();
        // The service is idle otherwise, so the request would never fit.
        assert_eq!(own.grow(1), Err(OutOfMemory::Limit { needed: 101, limit: 100 }));
        let other = budget.buffers(30);
        own.shrink(40);
        assert_eq!(held(own.grow(11).unwrap_err()), 90);
        // In a part, the limit of the whole counts as well.
        drop((connection, other, own));
        let of_part = budget.part(80).reservation();
        assert_eq!(of_part.check(80), Err(OutOfMemory::Limit { needed: 110, limit: 100 }));
        assert_eq!((of_part.check(70), of_part.check(81).is_err()), (Ok(()), true));
    }

    #[test]
    fn a_client_with_more_than_its_share_leaves_one_to_others() {
        let budget = Budget::for_service(100, 0, 0.25);
        let [first, second] = [1, 2].map(|client| budget.for_client(client));
        // One request may take everything.
        let (alone, input) = (first.reservation(), first.reservation());
        input.grow(10).unwrap();
        alone.also_held(10);
        alone.grow(90).unwrap();
        drop((alone, input));
        // Beside others that hold its share, it may as well.
        let (large, small) = (first.reservation(), first.reservation());
        small.grow(25).unwrap();
        large.grow(75).unwrap();
        drop((large, small));
        let requests = [(); 4].map(|()| first.reservation());
        let taken = requests.iter().map(|request| request.grow(25)).collect::<Vec<_>>();
        let refused = Err(OutOfMemory::Share { needed: 25, held: 75, limit: 25 });
        assert_eq!(taken, [Ok(()), Ok(()), Ok(()), refused]);
        // Memory of no client is not limited by shares, and counts.
        let kept = budget.reservation();
        let other = second.reservation();
        other.grow(20).unwrap();
        kept.grow(5).unwrap();
        assert_eq!(held(other.grow(1).unwrap_err()), 100);
        drop((requests, kept, first));
        other.grow(80).unwrap();
        assert_eq!(budget.shares.clients().len(), 1, "clients without memory are forgotten");
        drop((other, second));
        assert!(budget.shares.clients().is_empty());
        // Control: without shares, a client takes everything.
        let budget = Budget::new(100).for_client(1);
        let requests = [(); 4].map(|()| budget.reservation());
        let taken: u64 = requests.iter().map(|request| request.grow(25).map_or(0, |()| 25)).sum();
        assert_eq!(taken, 100);
    }

    #[test]
    fn a_part_has_shares_of_its_own() {
        let budget = Budget::for_service(100, 0, 0.25);
        let part = budget.part(40);
        let first = part.for_client(1);
        let requests = [(); 4].map(|()| first.reservation());
        let taken = requests.iter().filter(|request| request.grow(10).is_ok()).count();
        assert_eq!(taken, 3);
        part.for_client(2).reservation().grow(10).unwrap();
        drop(requests);
        assert_eq!((part.used(), budget.used()), (0, 0));
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
