//! A circuit breaker: a host that fails again and again is left alone for a while, so that asking costs nothing; then
//! one request tries whether it is back.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::gauge;

use crate::telemetry::ARCHIVE_BREAKER;

/// What others are told while one request tries.
const SOON: Duration = Duration::from_secs(1);

#[derive(Debug, Clone, Copy)]
enum State {
    Closed {
        failures: u32,
    },
    Open {
        until: Instant,
    },
    /// One request is out to see.
    Probing,
}

/// The breaker of a host.
#[derive(Debug)]
pub(super) struct Breaker {
    host: String,
    /// Failures in a row that open it.
    allowed: u32,
    pause: Duration,
    state: Mutex<State>,
}

impl Breaker {
    pub(super) fn new(host: &str, allowed: u32, pause: Duration) -> Self {
        let breaker = Self { host: host.to_owned(), allowed, pause, state: Mutex::new(State::Closed { failures: 0 }) };
        breaker.publish(false);
        breaker
    }

    pub(super) fn host(&self) -> &str {
        &self.host
    }

    /// How long the host is left alone from now; none if it may be asked.
    pub(super) fn left_alone_for(&self) -> Option<Duration> {
        match *self.state() {
            State::Closed { .. } => None,
            State::Open { until } => Some(until.saturating_duration_since(Instant::now())).filter(|d| !d.is_zero()),
            State::Probing => Some(SOON),
        }
    }

    /// Leave to ask the host, or how long it is left alone.
    pub(super) fn enter(&self) -> Result<Pass<'_>, Duration> {
        if let Some(wait) = self.left_alone_for() {
            return Err(wait);
        }
        let mut state = self.state();
        match *state {
            State::Closed { .. } => Ok(Pass { breaker: self, probe: false, told: false }),
            State::Open { .. } => {
                *state = State::Probing;
                Ok(Pass { breaker: self, probe: true, told: false })
            }
            // Somebody else was faster.
            State::Probing => Err(SOON),
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn publish(&self, open: bool) {
        gauge!(ARCHIVE_BREAKER, "host" => self.host.clone()).set(if open { 1.0 } else { 0.0 });
    }

    fn open(&self, state: &mut State, pause: Duration) {
        tracing::warn!(host = self.host, ms = pause.as_millis(), "the archive is left alone");
        *state = State::Open { until: Instant::now() + pause };
        self.publish(true);
    }
}

/// Leave to ask once. Says how it went, or, dropped untold, that nobody knows.
#[derive(Debug)]
pub(super) struct Pass<'a> {
    breaker: &'a Breaker,
    probe: bool,
    told: bool,
}

impl Pass<'_> {
    /// The host answered.
    pub(super) fn succeeded(mut self) {
        self.told = true;
        let mut state = self.breaker.state();
        if self.probe {
            tracing::info!(host = self.breaker.host, "the archive is back");
            self.breaker.publish(false);
        }
        if self.probe || matches!(*state, State::Closed { .. }) {
            *state = State::Closed { failures: 0 };
        }
    }

    /// It did not, or with an error of its own.
    pub(super) fn failed(mut self) {
        self.told = true;
        let mut state = self.breaker.state();
        match *state {
            State::Closed { failures } if failures + 1 < self.breaker.allowed => {
                *state = State::Closed { failures: failures + 1 };
            }
            State::Closed { .. } => self.breaker.open(&mut state, self.breaker.pause),
            _ if self.probe => self.breaker.open(&mut state, self.breaker.pause),
            State::Open { .. } | State::Probing => {}
        }
    }

    /// It asked to be left alone for `pause`.
    pub(super) fn told_to_wait(mut self, pause: Duration) {
        self.told = true;
        let mut state = self.breaker.state();
        self.breaker.open(&mut state, pause);
    }
}

impl Drop for Pass<'_> {
    fn drop(&mut self) {
        if self.probe && !self.told {
            // The next one tries.
            *self.breaker.state() = State::Open { until: Instant::now() };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_opens_after_failures_in_a_row_and_lets_one_try() {
        let breaker = Breaker::new("h", 2, Duration::from_millis(30));
        breaker.enter().unwrap().failed();
        breaker.enter().unwrap().succeeded();
        breaker.enter().unwrap().failed();
        assert_eq!(breaker.left_alone_for(), None, "a success starts the count anew");
        let late = breaker.enter().unwrap();
        breaker.enter().unwrap().failed();
        assert!(breaker.enter().unwrap_err() <= Duration::from_millis(30));
        // Whoever was under way neither closes it nor lengthens it.
        late.succeeded();
        assert!(breaker.left_alone_for().is_some());
        std::thread::sleep(Duration::from_millis(40));
        let probe = breaker.enter().unwrap();
        assert_eq!(breaker.enter().unwrap_err(), SOON);
        probe.failed();
        assert!(breaker.enter().is_err());
        std::thread::sleep(Duration::from_millis(40));
        drop(breaker.enter().unwrap());
        breaker.enter().unwrap().succeeded();
        assert!(breaker.left_alone_for().is_none() && breaker.enter().is_ok());
    }

    #[test]
    fn it_waits_as_long_as_it_is_told() {
        let breaker = Breaker::new("h", 5, Duration::from_millis(1));
        breaker.enter().unwrap().told_to_wait(Duration::from_secs(100));
        assert!(breaker.enter().unwrap_err() > Duration::from_secs(90));
    }
}
