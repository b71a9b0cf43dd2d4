//! Clock for times of use. It does not follow jumps of the system clock, so that a jump of a day neither expires all
//! objects nor keeps them for another day.

#[cfg(test)]
use std::time::Duration;
use std::time::{Instant, SystemTime};

/// Clock that runs evenly from the time of the system at its start.
#[derive(Debug)]
pub(super) struct Clock {
    start: SystemTime,
    since: Instant,
    /// Jump of the system clock: 1 is a day forward, -1 a day back.
    #[cfg(test)]
    pub(super) jump: std::sync::atomic::AtomicI32,
}

impl Clock {
    /// Starts a clock with the time of the system.
    pub(super) fn start() -> Self {
        Self {
            start: SystemTime::now(),
            since: Instant::now(),
            #[cfg(test)]
            jump: std::sync::atomic::AtomicI32::new(0),
        }
    }

    /// Returns the present time.
    pub(super) fn now(&self) -> SystemTime {
        self.start + self.since.elapsed()
    }

    /// Returns the present time of the system, as files have it.
    #[cfg_attr(not(test), expect(clippy::unused_self, reason = "tests set the clock"))]
    pub(super) fn system(&self) -> SystemTime {
        let now = SystemTime::now();
        #[cfg(test)]
        let now = match self.jump.load(std::sync::atomic::Ordering::Relaxed) {
            days if days < 0 => now - Duration::from_hours(24),
            0 => now,
            _ => now + Duration::from_hours(24),
        };
        now
    }

    /// Converts a time of this clock to a time of the system.
    pub(super) fn to_system(&self, at: SystemTime) -> SystemTime {
        shift(at, self.now(), self.system())
    }

    /// Converts a time of the system to a time of this clock.
    pub(super) fn to_clock(&self, at: SystemTime) -> SystemTime {
        shift(at, self.system(), self.now())
    }
}

/// Returns the time that is as far from `to` as `at` is from `from`.
fn shift(at: SystemTime, from: SystemTime, to: SystemTime) -> SystemTime {
    let shifted = match at.duration_since(from) {
        Ok(ahead) => to.checked_add(ahead),
        Err(behind) => to.checked_sub(behind.duration()),
    };
    shifted.unwrap_or(to)
}
