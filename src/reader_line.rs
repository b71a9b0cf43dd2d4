//! Requests that wait for a reader, and the estimate of their waiting time.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Weight of the newest read in the mean duration.
const NEWEST: f64 = 0.2;
/// Number of mean deviations above the mean within which nearly all reads end, as for timeouts of TCP (RFC 6298).
const DEVIATIONS: f64 = 4.0;

/// Requests at a [`ReaderLine`].
#[derive(Debug, Default)]
struct LineState {
    waiting: u32,
    reading: u32,
    /// Mean duration of a read, s; 0 before the first one.
    mean: f64,
    /// Mean deviation from it, s.
    deviation: f64,
}

impl LineState {
    /// Estimates the time until one of `readers` reads a request that arrives now.
    fn wait(&self, readers: u32) -> Duration {
        if self.waiting + self.reading < readers {
            return Duration::ZERO;
        }
        let rounds = f64::from(self.waiting + self.reading.min(readers)) / f64::from(readers);
        Duration::try_from_secs_f64(rounds * self.mean).unwrap_or(Duration::MAX)
    }

    /// Estimates the time within which a read ends.
    fn longest(&self) -> Duration {
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

/// Counts of requests that wait for one of the readers of structures or are read, with the durations of reads.
#[derive(Debug)]
pub(crate) struct ReaderLine {
    readers: u32,
    state: Mutex<LineState>,
}

impl ReaderLine {
    /// Creates the line in front of `readers` readers.
    pub(crate) fn new(readers: usize) -> Arc<Self> {
        Arc::new(Self { readers: u32::try_from(readers.max(1)).unwrap_or(u32::MAX), state: Mutex::default() })
    }

    fn lock(&self) -> MutexGuard<'_, LineState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Estimates the time until a request that arrives now is read.
    pub(crate) fn estimated_wait(&self) -> Duration {
        self.lock().wait(self.readers)
    }

    /// Counts a request that waits. `None` if others wait and it would probably wait longer than `max_wait`, or end
    /// after twice that time.
    pub(crate) fn enter(self: &Arc<Self>, max_wait: Duration) -> Option<Waiting> {
        let mut state = self.lock();
        let wait = state.wait(self.readers);
        let is_late = wait > max_wait || wait.saturating_add(state.longest()) > max_wait.saturating_mul(2);
        if state.waiting > 0 && is_late {
            return None;
        }
        let had_to_wait = state.waiting + state.reading >= self.readers;
        state.waiting += 1;
        Some(Waiting { line: Arc::clone(self), had_to_wait })
    }
}

/// Request that waits for a reader. Dropping it ends the wait.
pub(crate) struct Waiting {
    line: Arc<ReaderLine>,
    /// True if no reader was free when it came.
    had_to_wait: bool,
}

impl Waiting {
    /// Returns true if the read would probably not end within `left`. A request that found a free reader always tries:
    /// the estimate may be wrong, and only reads correct it.
    pub(crate) fn is_late(&self, left: Duration) -> bool {
        let state = self.line.lock();
        self.had_to_wait && state.reading > 0 && state.longest() > left
    }

    /// Ends the wait and begins the read.
    pub(crate) fn begin(self) -> ReadingTime {
        self.line.lock().reading += 1;
        ReadingTime { line: Arc::clone(&self.line), begun: Instant::now() }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.line.lock().waiting -= 1;
    }
}

/// Read in progress. Dropping it adds its duration to the estimates.
pub(crate) struct ReadingTime {
    line: Arc<ReaderLine>,
    begun: Instant,
}

impl Drop for ReadingTime {
    fn drop(&mut self) {
        let seconds = self.begun.elapsed().as_secs_f64();
        let mut state = self.line.lock();
        state.reading -= 1;
        state.learn(seconds);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_that_would_wait_too_long_are_refused_at_once() {
        let line = ReaderLine::new(2);
        let most = Duration::from_millis(50);
        let reading = line.enter(most).unwrap().begin();
        std::thread::sleep(Duration::from_millis(60));
        drop(reading);
        assert_eq!(line.estimated_wait(), Duration::ZERO, "both readers are free");
        let reading = [(); 2].map(|()| line.enter(most).unwrap().begin());
        assert!(line.estimated_wait() >= Duration::from_millis(60));
        // One request may always wait, because the mean may be wrong.
        let waiting = line.enter(most).unwrap();
        assert!(line.enter(most).is_none() && line.enter(Duration::from_mins(1)).is_some());
        drop((reading, waiting));
        assert!(line.estimated_wait().is_zero() && line.enter(most).is_some());
    }

    #[test]
    fn reads_that_would_end_too_late_do_not_begin() {
        let line = ReaderLine::new(2);
        for seconds in [9.0, 11.0, 9.0, 11.0] {
            line.lock().learn(seconds);
        }
        let longest = line.lock().longest().as_secs_f64();
        assert!(longest > 15.0 && longest < 30.0, "{longest}");
        let (early, late) = (Duration::from_secs(30), Duration::from_secs(12));
        // A free reader tries it, because the estimate may be wrong.
        let reading = [(); 2].map(|()| {
            let waiting = line.enter(late).unwrap();
            assert!(!waiting.is_late(late));
            waiting.begin()
        });
        // It would wait for 10 s and take up to `longest`.
        let waiting = line.enter(late).unwrap();
        assert!(line.enter(late).is_none() && line.enter(early).is_some());
        assert!(waiting.is_late(late) && !waiting.is_late(early));
        drop(reading);
        assert!(!waiting.is_late(late), "no other read slows it down");
    }
}
