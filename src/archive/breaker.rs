//! Circuit breaker of a host. Repeated failures open it: requests fail at once for a while, then one trial request
//! decides.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::gauge;

use crate::telemetry::ARCHIVE_BREAKER;

/// Retry time for other requests during a trial.
const PROBE_WAIT: Duration = Duration::from_secs(1);

#[derive(Debug)]
enum BreakerState {
    Closed {
        failures: u32,
    },
    Open {
        until: Instant,
    },
    /// One request tests the host.
    Probing,
}

impl BreakerState {
    /// Returns the time to wait, or `None` if a request is allowed.
    fn wait(&self) -> Option<Duration> {
        match self {
            Self::Closed { .. } => None,
            Self::Open { until } => Some(until.saturating_duration_since(Instant::now())).filter(|d| !d.is_zero()),
            Self::Probing => Some(PROBE_WAIT),
        }
    }
}

/// Circuit breaker of a host.
#[derive(Debug)]
pub(super) struct Breaker {
    host: String,
    /// Consecutive failures that open the breaker.
    max_failures: u32,
    pause: Duration,
    state: Mutex<BreakerState>,
}

impl Breaker {
    pub(super) fn new(host: &str, max_failures: u32, pause: Duration) -> Self {
        let breaker = Self {
            host: host.to_owned(),
            max_failures,
            pause,
            state: Mutex::new(BreakerState::Closed { failures: 0 }),
        };
        breaker.publish(false);
        breaker
    }

    pub(super) fn host(&self) -> &str {
        &self.host
    }

    /// Returns the time for which the breaker stays open, or `None` if requests are allowed.
    pub(super) fn open_for(&self) -> Option<Duration> {
        self.state().wait()
    }

    /// Returns a permit for one request, or the time to wait while the breaker is open.
    pub(super) fn acquire(&self) -> Result<Permit<'_>, Duration> {
        let mut state = self.state();
        if let Some(wait) = state.wait() {
            return Err(wait);
        }
        let trial = matches!(*state, BreakerState::Open { .. });
        if trial {
            *state = BreakerState::Probing;
        }
        Ok(Permit { breaker: self, trial, reported: false })
    }

    fn state(&self) -> MutexGuard<'_, BreakerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn publish(&self, open: bool) {
        gauge!(ARCHIVE_BREAKER, "host" => self.host.clone()).set(if open { 1.0 } else { 0.0 });
    }

    fn open(&self, state: &mut BreakerState, pause: Duration) {
        tracing::warn!(host = self.host, ms = pause.as_millis(), "requests to the archive are paused");
        *state = BreakerState::Open { until: Instant::now() + pause };
        self.publish(true);
    }
}

/// Permit for one request. Reports its outcome; a drop without a report means unknown.
#[derive(Debug)]
pub(super) struct Permit<'a> {
    breaker: &'a Breaker,
    trial: bool,
    reported: bool,
}

impl Permit<'_> {
    /// Reports a success and closes the breaker after a trial.
    pub(super) fn succeeded(mut self) {
        self.reported = true;
        let mut state = self.breaker.state();
        if self.trial {
            tracing::info!(host = self.breaker.host, "the archive is available again");
            self.breaker.publish(false);
        }
        if self.trial || matches!(*state, BreakerState::Closed { .. }) {
            *state = BreakerState::Closed { failures: 0 };
        }
    }

    /// Reports a failure.
    pub(super) fn failed(mut self) {
        self.reported = true;
        let mut state = self.breaker.state();
        match *state {
            BreakerState::Closed { failures } if failures + 1 < self.breaker.max_failures => {
                *state = BreakerState::Closed { failures: failures + 1 };
            }
            BreakerState::Closed { .. } => self.breaker.open(&mut state, self.breaker.pause),
            _ if self.trial => self.breaker.open(&mut state, self.breaker.pause),
            BreakerState::Open { .. } | BreakerState::Probing => {}
        }
    }

    /// Opens the breaker for the `pause` that the host requested.
    pub(super) fn asked_to_wait(mut self, pause: Duration) {
        self.reported = true;
        let mut state = self.breaker.state();
        self.breaker.open(&mut state, pause);
    }
}

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        if self.trial && !self.reported {
            // The next request becomes the trial.
            *self.breaker.state() = BreakerState::Open { until: Instant::now() };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opens_after_consecutive_failures_and_allows_one_probe() {
        let breaker = Breaker::new("h", 2, Duration::from_millis(30));
        breaker.acquire().unwrap().failed();
        breaker.acquire().unwrap().succeeded();
        breaker.acquire().unwrap().failed();
        assert_eq!(breaker.open_for(), None, "a success resets the count");
        let late = breaker.acquire().unwrap();
        breaker.acquire().unwrap().failed();
        assert!(breaker.acquire().unwrap_err() <= Duration::from_millis(30));
        // Requests that began before neither close nor prolong it.
        late.succeeded();
        assert!(breaker.open_for().is_some());
        std::thread::sleep(Duration::from_millis(40));
        let trial = breaker.acquire().unwrap();
        assert_eq!(breaker.acquire().unwrap_err(), PROBE_WAIT);
        trial.failed();
        assert!(breaker.acquire().is_err());
        std::thread::sleep(Duration::from_millis(40));
        drop(breaker.acquire().unwrap());
        breaker.acquire().unwrap().succeeded();
        assert!(breaker.open_for().is_none() && breaker.acquire().is_ok());
    }

    #[test]
    fn stays_open_for_the_requested_time() {
        let breaker = Breaker::new("h", 5, Duration::from_millis(1));
        breaker.acquire().unwrap().asked_to_wait(Duration::from_secs(100));
        assert!(breaker.acquire().unwrap_err() > Duration::from_secs(90));
    }
}
