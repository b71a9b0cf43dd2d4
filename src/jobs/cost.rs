//! Duration estimate of a job that has not been read: one constant per machine, learned from finished jobs.

/// Time of a unit of work before any job has run, s: one atom at 0.5 Å on two cores.
const FIRST_GUESS: f64 = 4e-6;
/// Weight of the newest job in the moving average.
const NEWEST: f64 = 0.2;

/// Seconds per unit of work, as a moving average.
#[derive(Debug, Clone, Copy)]
pub(super) struct WorkRate {
    per_unit: f64,
}

impl Default for WorkRate {
    fn default() -> Self {
        Self { per_unit: FIRST_GUESS }
    }
}

impl WorkRate {
    /// Returns the expected duration of `units` of work, s.
    pub(super) fn seconds(self, units: f64) -> f64 {
        self.per_unit * units
    }

    /// Learns from a job of `units` of work that took `seconds`.
    pub(super) fn learn(&mut self, units: f64, seconds: f64) {
        // Compares with the present estimate, not with that at acceptance: a full queue would correct the same error
        // for every job. On a logarithmic scale, a job that takes 100 times as long as expected weighs as much as one
        // that takes a hundredth.
        let miss = (seconds.max(1e-6) / self.seconds(units).max(1e-9)).ln();
        self.per_unit *= (NEWEST * miss.clamp(-4.0, 4.0)).exp();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_follows_the_machine() {
        let mut rate = WorkRate::default();
        for _ in 0..50 {
            rate.learn(1e5, 2.0);
        }
        assert!((rate.seconds(1e5) - 2.0).abs() < 0.01, "{rate:?}");
        // One outlier changes little.
        rate.learn(1e5, 2e4);
        assert!(rate.seconds(1e5) < 5.0, "{rate:?}");
        // It converges to the new duration.
        for _ in 0..500 {
            rate.learn(1e5, 0.02);
        }
        assert!((rate.seconds(1e5) - 0.02).abs() < 1e-3, "{rate:?}");
    }
}
