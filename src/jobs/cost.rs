//! What a job will cost, before it is read: a model with one constant per machine, learned from the jobs that have run.

/// Assumed time of a unit of work before any job has run, s: an atom at 0.5 Å on two cores.
const FIRST_GUESS: f64 = 4e-6;
/// Weight of the newest job in the moving averages.
const NEWEST: f64 = 0.2;

/// Seconds per unit, and seconds per job, as lately measured.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rate {
    per_unit: f64,
    per_job: Option<f64>,
}

impl Default for Rate {
    fn default() -> Self {
        Self { per_unit: FIRST_GUESS, per_job: None }
    }
}

impl Rate {
    /// Expected seconds of so many units.
    pub(super) fn seconds(&self, units: f64) -> f64 {
        self.per_unit * units
    }

    /// Mean seconds of the jobs of late; `expected` before there were any.
    pub(super) fn mean(&self, expected: f64) -> f64 {
        self.per_job.unwrap_or(expected)
    }

    /// A job of so many units took `seconds`.
    pub(super) fn learn(&mut self, units: f64, seconds: f64) {
        // Against what is expected now, not when the job came: a full queue would correct the same mistake a hundred times.
        // By the logarithm: a job a hundred times as long as expected says no more than one a hundredth as long.
        let miss = (seconds.max(1e-6) / self.seconds(units).max(1e-9)).ln();
        self.per_unit *= (NEWEST * miss.clamp(-4.0, 4.0)).exp();
        self.per_job = Some(self.per_job.map_or(seconds, |mean| mean + NEWEST * (seconds - mean)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_follows_the_machine() {
        let mut rate = Rate::default();
        for _ in 0..50 {
            rate.learn(1e5, 2.0);
        }
        assert!((rate.seconds(1e5) - 2.0).abs() < 0.01, "{rate:?}");
        assert!((rate.mean(0.0) - 2.0).abs() < 1e-9);
        // One stray job does not turn everything over.
        rate.learn(1e5, 2e4);
        assert!(rate.seconds(1e5) < 5.0, "{rate:?}");
        // However many were expected to take something else when they came, it settles.
        for _ in 0..500 {
            rate.learn(1e5, 0.02);
        }
        assert!((rate.seconds(1e5) - 0.02).abs() < 1e-3, "{rate:?}");
    }
}
