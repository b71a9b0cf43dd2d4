//! Requests that wait for a reader, and the estimate of their waiting time.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Weight of the newest read in the mean duration.
const NEWEST: f64 = 0.2;

/// Requests at a [`ReaderLine`].
#[derive(Debug, Default)]
struct LineState {
    waiting: u32,
    reading: u32,
    /// Mean duration of a read, s; 0 before the first one.
    mean: f64,
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
}

/// Counts of requests that wait for one of the readers of structures or are read, with the mean duration of a read.
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

    /// Counts a request that waits. `None` if others wait and the estimated wait exceeds `max_wait`.
    pub(crate) fn enter(self: &Arc<Self>, max_wait: Duration) -> Option<Waiting> {
        let mut state = self.lock();
        if state.waiting > 0 && state.wait(self.readers) > max_wait {
            return None;
        }
        state.waiting += 1;
        Some(Waiting(Arc::clone(self)))
    }
}

/// Request that waits for a reader. Dropping it ends the wait.
pub(crate) struct Waiting(Arc<ReaderLine>);

impl Waiting {
    /// Ends the wait and begins the read.
    pub(crate) fn begin(self) -> ReadingTime {
        self.0.lock().reading += 1;
        ReadingTime { line: Arc::clone(&self.0), begun: Instant::now() }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.0.lock().waiting -= 1;
    }
}

/// Read in progress. Dropping it adds its duration to the mean.
pub(crate) struct ReadingTime {
    line: Arc<ReaderLine>,
    begun: Instant,
}

impl Drop for ReadingTime {
    fn drop(&mut self) {
        let seconds = self.begun.elapsed().as_secs_f64();
        let mut state = self.line.lock();
        state.reading -= 1;
        state.mean = if state.mean == 0.0 { seconds } else { state.mean + NEWEST * (seconds - state.mean) };
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
}
