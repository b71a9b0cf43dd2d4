//! Quota usage of clients, in bounded memory.
//!
//! A fixed window begins with the client's first request, which the `RateLimit` fields can describe exactly. Up to
//! twice the quota can be used around the end of a window; the limit of concurrent requests and fair scheduling bound
//! the effect. Rejected requests are not counted, so retries do not prolong a rejection.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::account::{Account, Quota, QuotaExceeded, QuotaUsage};

/// Minimum time between two searches for ended windows while the table is full.
const SWEEP_PAUSE: Duration = Duration::from_secs(1);

/// Usage of one client in its current window.
#[derive(Debug, Clone, Copy)]
struct Window {
    start: Instant,
    length: Duration,
    requests: u64,
    work: Duration,
    running: u64,
}

impl Window {
    fn new(length: Duration, now: Instant) -> Self {
        Self { start: now, length, requests: 0, work: Duration::ZERO, running: 0 }
    }

    fn is_over(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.start) >= self.length
    }

    /// Begins a new window if this one is over.
    fn roll(&mut self, now: Instant) {
        if self.is_over(now) {
            *self = Self { running: self.running, ..Self::new(self.length, now) };
        }
    }

    fn left(&self, now: Instant) -> Duration {
        self.length.saturating_sub(now.saturating_duration_since(self.start))
    }

    fn usage(&self, now: Instant) -> QuotaUsage {
        QuotaUsage { requests: self.requests, work: self.work, running: self.running, left: self.left(now) }
    }

    fn exceeded(&self, quota: &Quota, now: Instant) -> Option<QuotaExceeded> {
        let full = |limit: Option<u64>, used: u64| limit.filter(|limit| used >= *limit);
        if let Some(limit) = full(quota.concurrent, self.running) {
            // A running request may end at any time.
            return Some(QuotaExceeded { policy: "concurrency", limit, wait: Duration::from_secs(1) });
        }
        let limit = full(quota.requests, self.requests)?;
        Some(QuotaExceeded { policy: "requests", limit, wait: self.left(now) })
    }
}

/// Counter of an account.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Counter {
    Key(u64),
    Address(u64),
    /// Shared counter of the addresses beyond the capacity.
    Others,
}

#[derive(Debug, Default)]
struct QuotaTable {
    keys: HashMap<u64, Window>,
    addresses: HashMap<u64, Window>,
    others: Option<Window>,
    /// Earliest time of the next search for ended windows.
    sweep_at: Option<Instant>,
}

impl QuotaTable {
    /// Returns the current window of an account, a new one if necessary.
    fn of(&mut self, account: &Account, capacity: usize, now: Instant) -> (Counter, &mut Window) {
        let (length, client) = (account.quota.window(), account.client);
        let new = || Window::new(length, now);
        let (counter, window) = if account.is_key {
            (Counter::Key(client), self.keys.entry(client).or_insert_with(new))
        } else if self.counts_alone(client, capacity, now) {
            (Counter::Address(client), self.addresses.entry(client).or_insert_with(new))
        } else {
            (Counter::Others, self.others.get_or_insert_with(new))
        };
        // The key file may have changed the length.
        window.length = length;
        window.roll(now);
        (counter, window)
    }

    /// Returns true if the address has its own counter. Removes ended windows if the table is full.
    fn counts_alone(&mut self, client: u64, capacity: usize, now: Instant) -> bool {
        if self.addresses.contains_key(&client) || self.addresses.len() < capacity {
            return true;
        }
        if self.sweep_at.is_some_and(|at| now < at) {
            return false;
        }
        self.addresses.retain(|_, window| window.running > 0 || !window.is_over(now));
        self.sweep_at = Some(now + SWEEP_PAUSE);
        self.addresses.len() < capacity
    }

    fn window(&mut self, counter: Counter) -> Option<&mut Window> {
        match counter {
            Counter::Key(client) => self.keys.get_mut(&client),
            Counter::Address(client) => self.addresses.get_mut(&client),
            Counter::Others => self.others.as_mut(),
        }
    }
}

/// Meter of the quota usage of clients.
#[derive(Debug)]
pub(crate) struct QuotaMeter {
    state: Mutex<QuotaTable>,
    capacity: usize,
}

impl QuotaMeter {
    /// Creates a meter with separate counters for `capacity` addresses; further addresses share one. Keys always have
    /// their own.
    pub(crate) fn new(capacity: usize) -> Self {
        Self { state: Mutex::default(), capacity }
    }

    fn lock(&self) -> MutexGuard<'_, QuotaTable> {
        // No code under the lock panics during a change, so a poisoned state is consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts a request, which runs until the returned guard is dropped. Counts nothing if a quota is used up.
    pub(crate) fn admit(self: &Arc<Self>, account: &Account, now: Instant) -> Result<Running, QuotaExceeded> {
        let mut state = self.lock();
        let (counter, window) = state.of(account, self.capacity, now);
        if let Some(exceeded) = window.exceeded(&account.quota, now) {
            return Err(exceeded);
        }
        window.requests += 1;
        window.running += 1;
        drop(state);
        Ok(Running { meter: Arc::clone(self), counter })
    }

    /// Checks that the account has computing time left in this window.
    pub(crate) fn admit_work(&self, account: &Account, now: Instant) -> Result<(), QuotaExceeded> {
        let Some(limit) = account.quota.work_s else { return Ok(()) };
        let mut state = self.lock();
        let (_, window) = state.of(account, self.capacity, now);
        if window.work < Duration::from_secs(limit) {
            return Ok(());
        }
        Err(QuotaExceeded { policy: "work", limit, wait: window.left(now) })
    }

    /// Adds `time` of computing to the usage of `client`, or to the shared counter if the client has none.
    pub(crate) fn spent(&self, client: u64, time: Duration, now: Instant) {
        let mut state = self.lock();
        let QuotaTable { keys, addresses, others, .. } = &mut *state;
        let window = keys.get_mut(&client).or_else(|| addresses.get_mut(&client)).or(others.as_mut());
        if let Some(window) = window {
            window.roll(now);
            window.work += time;
        }
    }

    /// Returns the usage of an account.
    pub(crate) fn usage(&self, account: &Account, now: Instant) -> QuotaUsage {
        self.lock().of(account, self.capacity, now).1.usage(now)
    }

    /// Removes keys with ended windows. Called after a reload of the key file, so that removed keys do not accumulate.
    pub(crate) fn forget_keys(&self, now: Instant) {
        self.lock().keys.retain(|_, window| window.running > 0 || !window.is_over(now));
    }

    /// Returns the number of clients with their own counter.
    pub(crate) fn clients(&self) -> usize {
        let state = self.lock();
        state.keys.len() + state.addresses.len()
    }
}

/// Guard of a running request.
#[derive(Debug)]
pub(crate) struct Running {
    meter: Arc<QuotaMeter>,
    counter: Counter,
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(window) = self.meter.lock().window(self.counter) {
            window.running = window.running.saturating_sub(1);
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
    fn the_request_quota_is_restored_in_the_next_window() {
        let (meter, start) = (Arc::new(QuotaMeter::new(10)), Instant::now());
        let me = account(1, true, &QUOTA);
        for n in 1..=3 {
            drop(meter.admit(&me, start + n * S).unwrap());
        }
        // The window began with the first request, at 1 s.
        let refused = meter.admit(&me, start + 4 * S).unwrap_err();
        assert_eq!(refused, QuotaExceeded { policy: "requests", limit: 3, wait: 7 * S });
        let usage = meter.usage(&me, start + 5 * S);
        assert_eq!(usage, QuotaUsage { requests: 3, work: Duration::ZERO, running: 0, left: 6 * S });
        assert!(meter.admit(&me, start + Duration::from_nanos(10_999_999_999)).is_err());
        drop(meter.admit(&me, start + 11 * S).unwrap());
        assert_eq!(meter.usage(&me, start + 11 * S).requests, 1, "rejected requests do not count");
        // Other clients are not affected.
        drop(meter.admit(&account(2, true, &QUOTA), start + 4 * S).unwrap());
    }

    #[test]
    fn concurrent_requests_are_counted_until_they_end() {
        let (meter, now) = (Arc::new(QuotaMeter::new(10)), Instant::now());
        let me = account(1, false, &QUOTA);
        let [first, second] = [meter.admit(&me, now).unwrap(), meter.admit(&me, now).unwrap()];
        let refused = meter.admit(&me, now).unwrap_err();
        assert_eq!((refused.policy, refused.limit, refused.wait), ("concurrency", 2, S));
        drop(first);
        // A new window still counts running requests.
        let later = now + 10 * S;
        let third = meter.admit(&me, later).unwrap();
        assert_eq!(meter.usage(&me, later).running, 2);
        assert!(meter.admit(&me, later).is_err());
        drop((second, third));
        assert_eq!(meter.usage(&me, later).running, 0);
    }

    #[test]
    fn computing_time_is_charged_when_a_job_ends() {
        let (meter, now) = (Arc::new(QuotaMeter::new(10)), Instant::now());
        let me = account(1, true, &QUOTA);
        meter.admit_work(&me, now).unwrap();
        meter.spent(1, Duration::from_millis(1999), now);
        meter.spent(7, 100 * S, now);
        meter.admit_work(&me, now + S).unwrap();
        meter.spent(1, Duration::from_millis(1), now + S);
        let refused = meter.admit_work(&me, now + S).unwrap_err();
        assert_eq!(refused, QuotaExceeded { policy: "work", limit: 2, wait: 9 * S });
        drop(meter.admit(&me, now + S).expect("requests without computing are admitted"));
        meter.admit_work(&me, now + 10 * S).unwrap();
        // A job that ends after the window counts in the next one.
        meter.spent(1, 2 * S, now + 20 * S);
        assert!(meter.admit_work(&me, now + 20 * S).is_err());
        let free = account(3, true, &Quota { window_s: 10, ..Quota::default() });
        meter.spent(3, 1000 * S, now);
        meter.admit_work(&free, now).unwrap();
    }

    #[test]
    fn memory_is_bounded_and_no_usage_is_forgotten() {
        let (meter, now) = (Arc::new(QuotaMeter::new(3)), Instant::now());
        let address = |n| account(n, false, &QUOTA);
        let use_up = |n, at| (0..3).for_each(|_| drop(meter.admit(&address(n), at).unwrap()));
        (0..3).for_each(|n| use_up(n, now));
        // Further addresses share one quota.
        use_up(100, now);
        assert!(meter.admit(&address(101), now).is_err());
        for n in 0..1000 {
            assert!(meter.admit(&address(n), now + S).is_err(), "{n}");
        }
        assert_eq!(meter.clients(), 3);
        // Keys have their own counters.
        drop(meter.admit(&account(5, true, &QUOTA), now).unwrap());
        meter.spent(100, 2 * S, now);
        assert_eq!(meter.admit_work(&address(102), now).unwrap_err().policy, "work");
        // Ended windows make space.
        use_up(101, now + 10 * S);
        use_up(102, now + 10 * S);
        assert_eq!(meter.clients(), 3, "two addresses and the key");
        meter.forget_keys(now + 10 * S);
        assert_eq!(meter.clients(), 2);
    }

    #[test]
    fn a_changed_quota_keeps_the_usage() {
        let (meter, now) = (Arc::new(QuotaMeter::new(1)), Instant::now());
        drop(meter.admit(&account(1, true, &QUOTA), now).unwrap());
        let more = Quota { requests: Some(5), window_s: 100, ..QUOTA };
        let usage = meter.usage(&account(1, true, &more), now + 20 * S);
        assert_eq!((usage.requests, usage.left), (1, 80 * S));
    }
}
