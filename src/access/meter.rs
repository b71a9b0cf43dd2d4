//! What clients have used of their quotas, in memory that does not grow with their number.
//!
//! A client's window begins with its first request and is followed by a new one at its end: that is what the `RateLimit`
//! fields can say exactly. Twice the quota can be used around a border; requests at once and fair shares bound what that
//! does. What is refused for a quota does not count, so that trying again does not push the end away.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::account::{Account, Exceeded, Quota, Standing};

/// Between two looks for windows that are over, while there is no room.
const SWEEP_PAUSE: Duration = Duration::from_secs(1);

/// One client's window.
#[derive(Debug, Clone, Copy)]
struct Used {
    start: Instant,
    window: Duration,
    requests: u64,
    work: Duration,
    running: u64,
}

impl Used {
    fn new(window: Duration, now: Instant) -> Self {
        Self { start: now, window, requests: 0, work: Duration::ZERO, running: 0 }
    }

    fn is_over(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.start) >= self.window
    }

    /// Begins a new window if this one is over.
    fn roll(&mut self, now: Instant) {
        if self.is_over(now) {
            *self = Self { running: self.running, ..Self::new(self.window, now) };
        }
    }

    fn left(&self, now: Instant) -> Duration {
        self.window.saturating_sub(now.saturating_duration_since(self.start))
    }

    fn standing(&self, now: Instant) -> Standing {
        Standing { requests: self.requests, work: self.work, running: self.running, left: self.left(now) }
    }

    fn exceeded(&self, quota: &Quota, now: Instant) -> Option<Exceeded> {
        let full = |limit: Option<u64>, used: u64| limit.filter(|limit| used >= *limit);
        if let Some(limit) = full(quota.concurrent, self.running) {
            // Requests end at any time.
            return Some(Exceeded { policy: "concurrency", limit, wait: Duration::from_secs(1) });
        }
        let limit = full(quota.requests, self.requests)?;
        Some(Exceeded { policy: "requests", limit, wait: self.left(now) })
    }
}

/// Where an account is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Key(u64),
    Address(u64),
    /// Among the addresses for which there was no room.
    Others,
}

#[derive(Debug, Default)]
struct State {
    keys: HashMap<u64, Used>,
    addresses: HashMap<u64, Used>,
    others: Option<Used>,
    /// When looking for windows that are over is worth it again.
    sweep_at: Option<Instant>,
}

impl State {
    /// The window of an account, begun if there is none.
    fn of(&mut self, account: &Account, capacity: usize, now: Instant) -> (Place, &mut Used) {
        let (window, client) = (account.quota.window(), account.client);
        let new = || Used::new(window, now);
        let (place, used) = if account.is_key {
            (Place::Key(client), self.keys.entry(client).or_insert_with(new))
        } else if self.has_room(client, capacity, now) {
            (Place::Address(client), self.addresses.entry(client).or_insert_with(new))
        } else {
            (Place::Others, self.others.get_or_insert_with(new))
        };
        // A key's window may have got another length since.
        used.window = window;
        used.roll(now);
        (place, used)
    }

    /// Whether this address is counted for itself; makes room where windows are over.
    fn has_room(&mut self, client: u64, capacity: usize, now: Instant) -> bool {
        if self.addresses.contains_key(&client) || self.addresses.len() < capacity {
            return true;
        }
        if self.sweep_at.is_some_and(|at| now < at) {
            return false;
        }
        self.addresses.retain(|_, used| used.running > 0 || !used.is_over(now));
        self.sweep_at = Some(now + SWEEP_PAUSE);
        self.addresses.len() < capacity
    }

    fn at(&mut self, place: Place) -> Option<&mut Used> {
        match place {
            Place::Key(client) => self.keys.get_mut(&client),
            Place::Address(client) => self.addresses.get_mut(&client),
            Place::Others => self.others.as_mut(),
        }
    }
}

/// What clients have used.
#[derive(Debug)]
pub struct Meter {
    state: Mutex<State>,
    capacity: usize,
}

impl Meter {
    /// One that counts `capacity` addresses one by one; those beyond share one quota. Keys are counted beside them.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        Self { state: Mutex::default(), capacity }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code under the lock can panic half way through a change, so a poisoned state is a sound one.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts a request, until what comes back is dropped.
    ///
    /// # Errors
    /// [`Exceeded`], for which nothing is counted.
    pub fn admit(self: &Arc<Self>, account: &Account, now: Instant) -> Result<Running, Exceeded> {
        let mut state = self.lock();
        let (place, used) = state.of(account, self.capacity, now);
        if let Some(exceeded) = used.exceeded(&account.quota, now) {
            return Err(exceeded);
        }
        used.requests += 1;
        used.running += 1;
        drop(state);
        Ok(Running { meter: Arc::clone(self), place })
    }

    /// Whether a job may be begun for this account: whether it has work left in this window.
    ///
    /// # Errors
    /// [`Exceeded`].
    pub fn admit_work(&self, account: &Account, now: Instant) -> Result<(), Exceeded> {
        let Some(limit) = account.quota.work_s else { return Ok(()) };
        let mut state = self.lock();
        let (_, used) = state.of(account, self.capacity, now);
        if used.work < Duration::from_secs(limit) {
            return Ok(());
        }
        Err(Exceeded { policy: "work", limit, wait: used.left(now) })
    }

    /// Workers have spent `time` on a job of this client. Those who are not counted for themselves are counted among the
    /// others; where there are none, nobody's quota depends on it.
    pub fn spent(&self, client: u64, time: Duration, now: Instant) {
        let mut state = self.lock();
        let State { keys, addresses, others, .. } = &mut *state;
        let used = keys.get_mut(&client).or_else(|| addresses.get_mut(&client)).or(others.as_mut());
        if let Some(used) = used {
            used.roll(now);
            used.work += time;
        }
    }

    /// How an account stands.
    #[must_use]
    pub fn standing(&self, account: &Account, now: Instant) -> Standing {
        self.lock().of(account, self.capacity, now).1.standing(now)
    }

    /// Forgets keys whose windows are over: called when there are other keys, so that keys that are gone do not stay.
    pub fn forget_keys(&self, now: Instant) {
        self.lock().keys.retain(|_, used| used.running > 0 || !used.is_over(now));
    }

    /// Clients that are counted one by one.
    #[must_use]
    pub fn clients(&self) -> usize {
        let state = self.lock();
        state.keys.len() + state.addresses.len()
    }
}

/// A request that is under way, as long as this lives.
#[derive(Debug)]
pub struct Running {
    meter: Arc<Meter>,
    place: Place,
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(used) = self.meter.lock().at(self.place) {
            used.running = used.running.saturating_sub(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn account(client: u64, is_key: bool, quota: &Quota) -> Account {
        Account { client, is_key, quota: Arc::new(quota.clone()) }
    }

    const S: Duration = Duration::from_secs(1);
    const QUOTA: Quota = Quota { requests: Some(3), work_s: Some(2), concurrent: Some(2), window_s: 10 };

    #[test]
    fn requests_are_counted_and_come_back_with_the_next_window() {
        let (meter, start) = (Arc::new(Meter::new(10)), Instant::now());
        let me = account(1, true, &QUOTA);
        for n in 1..=3 {
            drop(meter.admit(&me, start + n * S).unwrap());
        }
        // The window began with the first request, at 1 s.
        let refused = meter.admit(&me, start + 4 * S).unwrap_err();
        assert_eq!(refused, Exceeded { policy: "requests", limit: 3, wait: 7 * S });
        let standing = meter.standing(&me, start + 5 * S);
        assert_eq!(standing, Standing { requests: 3, work: Duration::ZERO, running: 0, left: 6 * S });
        assert!(meter.admit(&me, start + Duration::from_nanos(10_999_999_999)).is_err());
        drop(meter.admit(&me, start + 11 * S).unwrap());
        assert_eq!(meter.standing(&me, start + 11 * S).requests, 1, "refusals do not count");
        // Nobody else pays for that.
        drop(meter.admit(&account(2, true, &QUOTA), start + 4 * S).unwrap());
    }

    #[test]
    fn requests_at_once_are_counted_until_they_end() {
        let (meter, now) = (Arc::new(Meter::new(10)), Instant::now());
        let me = account(1, false, &QUOTA);
        let [first, second] = [meter.admit(&me, now).unwrap(), meter.admit(&me, now).unwrap()];
        let refused = meter.admit(&me, now).unwrap_err();
        assert_eq!((refused.policy, refused.limit, refused.wait), ("concurrency", 2, S));
        drop(first);
        // A new window does not forget what is under way.
        let later = now + 10 * S;
        let third = meter.admit(&me, later).unwrap();
        assert_eq!(meter.standing(&me, later).running, 2);
        assert!(meter.admit(&me, later).is_err());
        drop((second, third));
        assert_eq!(meter.standing(&me, later).running, 0);
    }

    #[test]
    fn work_is_charged_when_it_is_done() {
        let (meter, now) = (Arc::new(Meter::new(10)), Instant::now());
        let me = account(1, true, &QUOTA);
        meter.admit_work(&me, now).unwrap();
        meter.spent(1, Duration::from_millis(1999), now);
        meter.spent(7, 100 * S, now);
        meter.admit_work(&me, now + S).unwrap();
        meter.spent(1, Duration::from_millis(1), now + S);
        let refused = meter.admit_work(&me, now + S).unwrap_err();
        assert_eq!(refused, Exceeded { policy: "work", limit: 2, wait: 9 * S });
        drop(meter.admit(&me, now + S).expect("what needs no work is still answered"));
        meter.admit_work(&me, now + 10 * S).unwrap();
        // A job that ends after the window counts in the next one.
        meter.spent(1, 2 * S, now + 20 * S);
        assert!(meter.admit_work(&me, now + 20 * S).is_err());
        let free = account(3, true, &Quota { window_s: 10, ..Quota::default() });
        meter.spent(3, 1000 * S, now);
        meter.admit_work(&free, now).unwrap();
    }

    #[test]
    fn memory_is_bounded_and_nobody_is_forgotten_for_it() {
        let (meter, now) = (Arc::new(Meter::new(3)), Instant::now());
        let address = |n| account(n, false, &QUOTA);
        let use_up = |n, at| (0..3).for_each(|_| drop(meter.admit(&address(n), at).unwrap()));
        (0..3).for_each(|n| use_up(n, now));
        // Those beyond share one quota.
        use_up(100, now);
        assert!(meter.admit(&address(101), now).is_err());
        for n in 0..1000 {
            assert!(meter.admit(&address(n), now + S).is_err(), "{n}");
        }
        assert_eq!(meter.clients(), 3);
        // Keys have a place of their own.
        drop(meter.admit(&account(5, true, &QUOTA), now).unwrap());
        meter.spent(100, 2 * S, now);
        assert_eq!(meter.admit_work(&address(102), now).unwrap_err().policy, "work");
        // When windows are over there is room again.
        use_up(101, now + 10 * S);
        use_up(102, now + 10 * S);
        assert_eq!(meter.clients(), 3, "two addresses and the key");
        meter.forget_keys(now + 10 * S);
        assert_eq!(meter.clients(), 2);
    }

    #[test]
    fn a_key_whose_quota_changes_is_counted_on() {
        let (meter, now) = (Arc::new(Meter::new(1)), Instant::now());
        drop(meter.admit(&account(1, true, &QUOTA), now).unwrap());
        let more = Quota { requests: Some(5), window_s: 100, ..QUOTA };
        let standing = meter.standing(&account(1, true, &more), now + 20 * S);
        assert_eq!((standing.requests, standing.left), (1, 80 * S));
    }
}
