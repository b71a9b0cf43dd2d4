//! Gate in front of the readers of structures: permits, shares of clients, and early refusal of requests that would
//! wait too long.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout_at;

use crate::client_shares::{ClientShares, SharePermit};

/// Weight of the newest read in the mean duration.
const NEWEST: f64 = 0.2;
/// Number of mean deviations above the mean within which nearly all reads end, as for timeouts of TCP (RFC 6298).
const DEVIATIONS: f64 = 4.0;

/// Durations of reads, s.
#[derive(Debug, Clone, Copy, Default)]
struct ReadTimes {
    /// Mean; 0 before the first read.
    mean: f64,
    /// Mean deviation from it.
    deviation: f64,
}

impl ReadTimes {
    /// Estimates the time within which a read ends.
    fn longest(self) -> Duration {
        Duration::try_from_secs_f64(self.mean + DEVIATIONS * self.deviation).unwrap_or(Duration::MAX)
    }

    /// Learns from a read that took `seconds`, or was cancelled after that time.
    fn learn(&mut self, seconds: f64) {
        if self.mean == 0.0 {
            (self.mean, self.deviation) = (seconds, seconds / 2.0);
            return;
        }
        let miss = seconds - self.mean;
        self.deviation += NEWEST * (miss.abs() - self.deviation);
        self.mean += NEWEST * miss;
    }
}

/// Requests at the gate.
#[derive(Debug, Default)]
struct GateState {
    waiting: usize,
    /// Starts of the reads in progress.
    reading: Vec<Instant>,
    /// Durations of the reads that have ended.
    ended: ReadTimes,
}

impl GateState {
    /// Estimates the time of `n` reads one after another.
    fn rounds(&self, n: f64) -> Duration {
        Duration::try_from_secs_f64(n * self.times().mean).unwrap_or(Duration::MAX)
    }

    /// Returns true if a request that waits for `wait` would probably begin after `begin_by` or end after `end`.
    fn is_late(&self, wait: Duration, begin_by: Instant, end: Instant) -> bool {
        let now = Instant::now();
        wait > begin_by.saturating_duration_since(now)
            || wait.saturating_add(self.times().longest()) > end.saturating_duration_since(now)
    }

    /// Returns the durations of reads at this moment: a read in progress that takes longer than the mean counts as if
    /// it had just ended. Otherwise a burst of requests would wait before the first read has shown how long they take.
    fn times(&self) -> ReadTimes {
        let mut times = self.ended;
        for seconds in self.reading.iter().map(|begun| begun.elapsed().as_secs_f64()) {
            if seconds > times.mean {
                times.learn(seconds);
            }
        }
        times
    }
}

/// No reader is free in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Busy {
    /// Estimated time until a reader is free.
    pub wait: Duration,
}

/// Readers of structures outside of jobs. Clones share them.
#[derive(Debug, Clone)]
pub struct Readers {
    permits: Arc<Semaphore>,
    shares: Arc<ClientShares>,
    state: Arc<Mutex<GateState>>,
    number: usize,
}

impl Readers {
    /// Creates `number` readers, of which a client may hold the fraction `share`.
    pub(crate) fn new(number: usize, share: f64) -> Self {
        let (permits, shares) = (Arc::new(Semaphore::new(number)), ClientShares::new(number, share));
        Self { permits, shares, state: Arc::default(), number }
    }

    fn lock(&self) -> MutexGuard<'_, GateState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Estimates the time until a request that arrives now is read.
    fn estimated_wait(&self, state: &GateState) -> Duration {
        if state.waiting + state.reading.len() < self.number {
            return Duration::ZERO;
        }
        state.rounds((state.waiting + state.reading.len().min(self.number)) as f64 / self.number as f64)
    }

    fn busy(&self) -> Busy {
        Busy { wait: self.estimated_wait(&self.lock()) }
    }

    /// Waits for a reader, at most until `begin_by`, and for the share of `client` if there is one. The read must end
    /// by `end`. Cancel safe.
    ///
    /// # Errors
    /// Returns [`Busy`] at once if other requests wait, of the client or with their shares, and this one would probably
    /// wait longer, or end later; after the wait if the read would probably end later.
    pub async fn wait(&self, client: Option<u64>, begin_by: Instant, end: Instant) -> Result<Reading, Busy> {
        let end_of_wait = tokio::time::Instant::from_std(begin_by);
        let load = client.map_or(0.0, |client| self.shares.load(client));
        let after_own = Busy { wait: self.lock().rounds(load) };
        if load > 1.0 && self.lock().is_late(after_own.wait, begin_by, end) {
            return Err(after_own);
        }
        // In this order, requests that wait for the share of their client neither take a permit nor count for others.
        let share = match client {
            Some(client) => Some(self.shares.wait(client, end_of_wait).await.map_err(|_full| after_own)?),
            None => None,
        };
        let waiting = self.enter(load >= 1.0, begin_by, end)?;
        // The semaphore is never closed.
        let permit = timeout_at(end_of_wait, Arc::clone(&self.permits).acquire_owned()).await.ok().and_then(Result::ok);
        let permit = permit.ok_or_else(|| self.busy())?;
        waiting.begin(end, permit, share)
    }

    /// Counts a request that waits for a permit, and may have waited for the share of its client.
    fn enter(&self, has_waited: bool, begin_by: Instant, end: Instant) -> Result<Waiting, Busy> {
        let mut state = self.lock();
        let wait = self.estimated_wait(&state);
        if state.waiting > 0 && state.is_late(wait, begin_by, end) {
            return Err(Busy { wait });
        }
        let had_to_wait = has_waited || state.waiting + state.reading.len() >= self.number;
        state.waiting += 1;
        Ok(Waiting { readers: self.clone(), had_to_wait })
    }
}

/// Request that waits for a reader. Dropping it ends the wait.
struct Waiting {
    readers: Readers,
    /// True if no reader was free for it when it came.
    had_to_wait: bool,
}

impl Waiting {
    /// Ends the wait and begins the read, unless it would probably end after `end`. A request that found a free reader
    /// always tries: the estimate may be wrong, and only reads correct it.
    fn begin(self, end: Instant, permit: OwnedSemaphorePermit, share: Option<SharePermit>) -> Result<Reading, Busy> {
        let (mut state, begun) = (self.readers.lock(), Instant::now());
        let is_late = state.times().longest() > end.saturating_duration_since(begun);
        if self.had_to_wait && !state.reading.is_empty() && is_late {
            return Err(Busy { wait: self.readers.estimated_wait(&state) });
        }
        state.reading.push(begun);
        drop(state);
        Ok(Reading { readers: self.readers.clone(), begun, _permit: permit, _share: share })
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.readers.lock().waiting -= 1;
    }
}

/// Read in progress. Dropping it frees the reader and adds its duration to the estimates.
#[derive(Debug)]
pub struct Reading {
    readers: Readers,
    begun: Instant,
    _permit: OwnedSemaphorePermit,
    _share: Option<SharePermit>,
}

impl Drop for Reading {
    fn drop(&mut self) {
        let mut state = self.readers.lock();
        let at = state.reading.iter().position(|begun| *begun == self.begun);
        at.map(|at| state.reading.swap_remove(at));
        state.ended.learn(self.begun.elapsed().as_secs_f64());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(seconds: f64) -> Instant {
        Instant::now() + Duration::from_secs_f64(seconds)
    }

    /// Takes a free reader.
    async fn read(readers: &Readers) -> Reading {
        readers.wait(None, after(1.0), after(1.0)).await.unwrap()
    }

    #[tokio::test]
    async fn requests_that_would_wait_too_long_are_refused_at_once() {
        let readers = Readers::new(2, 1.0);
        readers.lock().ended.learn(60.0);
        assert_eq!(readers.busy().wait, Duration::ZERO, "both readers are free");
        let reading = (read(&readers).await, read(&readers).await);
        assert_eq!(readers.busy().wait, Duration::from_mins(1));
        // One request may always wait, because the mean may be wrong.
        let waiting = readers.enter(false, after(50.0), after(1e4)).unwrap();
        assert!(
            readers.enter(false, after(50.0), after(1e4)).is_err()
                && readers.enter(false, after(100.0), after(1e4)).is_ok()
        );
        assert!(readers.enter(false, after(100.0), after(200.0)).is_err(), "it would end too late");
        drop((reading, waiting));
        assert!(readers.busy().wait.is_zero() && readers.enter(false, after(50.0), after(50.0)).is_ok());
    }

    #[tokio::test]
    async fn reads_that_would_end_too_late_do_not_begin() {
        let readers = Readers::new(2, 1.0);
        for seconds in [9.0, 11.0, 9.0, 11.0] {
            readers.lock().ended.learn(seconds);
        }
        let longest = readers.lock().times().longest().as_secs_f64();
        assert!(longest > 15.0 && longest < 30.0, "{longest}");
        // A free reader tries it, because the estimate may be wrong.
        let (first, second) = (read(&readers).await, read(&readers).await);
        let begin = async |seconds: f64, free: Vec<Reading>| {
            let waiting = readers.enter(false, after(seconds), after(1e4)).unwrap();
            drop(free);
            let permit = Arc::clone(&readers.permits).acquire_owned().await.unwrap();
            readers.lock().ended = ReadTimes { mean: 10.0, deviation: 2.0 };
            waiting.begin(after(seconds), permit, None)
        };
        assert!(begin(12.0, vec![first]).await.is_err());
        let third = begin(30.0, Vec::new()).await.unwrap();
        assert!(begin(12.0, vec![second, third]).await.is_ok(), "no other read slows it down");
    }

    #[tokio::test]
    async fn reads_in_progress_that_take_long_count() {
        let readers = Readers::new(1, 1.0);
        readers.lock().ended.learn(1.0);
        let reading = read(&readers).await;
        assert_eq!(readers.busy().wait, Duration::from_secs(1));
        readers.lock().reading = vec![Instant::now().checked_sub(Duration::from_secs(11)).unwrap()];
        assert!(readers.busy().wait >= Duration::from_secs(3));
        drop(reading);
    }

    #[tokio::test]
    async fn a_client_waits_for_its_share_without_a_permit() {
        let readers = Readers::new(2, 0.5);
        let first = readers.wait(Some(1), after(1.0), after(1.0)).await.unwrap();
        let second = readers.wait(Some(1), after(0.05), after(1e4));
        let (second, other) = tokio::join!(second, readers.wait(Some(2), after(1.0), after(1.0)));
        assert!(second.is_err() && other.is_ok());
        drop(first);
        assert!(readers.wait(Some(1), after(1.0), after(1.0)).await.is_ok());
    }

    #[tokio::test]
    async fn requests_that_wait_for_the_share_of_their_client_delay_no_other_client() {
        let readers = Readers::new(2, 0.5);
        readers.lock().ended.learn(10.0);
        let _reading = readers.wait(Some(1), after(30.0), after(60.0)).await.unwrap();
        let mut waiting = Vec::new();
        for _ in 0..2 {
            let readers = readers.clone();
            waiting.push(tokio::spawn(async move { readers.wait(Some(1), after(30.0), after(60.0)).await }));
            tokio::task::yield_now().await;
        }
        // Three requests of 10 s are ahead of the next one of this client, and none of others.
        assert!(readers.wait(Some(1), after(30.0), after(60.0)).await.is_err_and(|busy| busy.wait.as_secs() == 30));
        assert!(readers.wait(Some(2), after(30.0), after(60.0)).await.is_ok());
        waiting.iter().for_each(tokio::task::JoinHandle::abort);
    }
}
