//! Progress of a job: combines the fractions of its stages into one fraction, which never decreases.

use std::sync::atomic::{AtomicU32, Ordering};

use super::ProgressSink;

/// Resolution of a stage's fraction.
const UNIT: f64 = 1000.0;

/// Stages with their typical shares of the time, in execution order.
const STAGES: [(&str, f64); 22] = [
    ("read", 0.09),
    ("select", 0.02),
    ("index", 0.01),
    ("exact", 0.01),
    ("pockets", 0.01),
    ("bin", 0.03),
    ("field", 0.30),
    ("classify", 0.05),
    ("scan", 0.02),
    ("refine", 0.02),
    ("interpolate", 0.08),
    ("emit", 0.10),
    ("write", 0.05),
    ("improve", 0.05),
    ("cavities", 0.01),
    ("simplify", 0.01),
    ("clip", 0.01),
    ("color", 0.01),
    ("measure", 0.04),
    ("draw", 0.03),
    ("png", 0.01),
    ("encode", 0.04),
];

/// Stages that run at the same time on different bricks.
const INTERLEAVED: [&str; 6] = ["field", "classify", "refine", "interpolate", "emit", "write"];

/// Progress of each stage. Several threads may update and read it.
#[derive(Debug, Default)]
pub struct Tracker {
    fractions: [AtomicU32; STAGES.len()],
    /// Index of the latest stage that has begun.
    current: AtomicU32,
}

impl Tracker {
    /// Returns the current stage and the progress of the whole job, from 0 to 1.
    #[must_use]
    pub fn now(&self) -> (&'static str, f64) {
        let current = self.current.load(Ordering::Relaxed) as usize;
        let part = |ix: usize| match ix {
            // Earlier stages are complete, except those that run interleaved.
            _ if ix < current && !INTERLEAVED.contains(&STAGES[ix].0) => 1.0,
            _ => f64::from(self.fractions[ix].load(Ordering::Relaxed)) / UNIT,
        };
        let overall = (0..STAGES.len()).map(|ix| STAGES[ix].1 * part(ix)).sum();
        (STAGES[current].0, overall)
    }
}

impl ProgressSink for Tracker {
    fn progress(&self, stage: &'static str, fraction: f64) {
        let Some(ix) = STAGES.iter().position(|(name, _)| *name == stage) else { return };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to 0..=1000")]
        let parts = (fraction.clamp(0.0, 1.0) * UNIT) as u32;
        // The start of a stage completes the stages before it.
        if self.fractions[ix].load(Ordering::Relaxed) == 0 {
            self.current.fetch_max(u32::try_from(ix).unwrap_or(0), Ordering::Relaxed);
        }
        self.fractions[ix].fetch_max(parts, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_add_up_to_one() {
        let sum: f64 = STAGES.iter().map(|(_, share)| share).sum();
        assert!((sum - 1.0).abs() < 1e-9, "{sum}");
    }

    #[test]
    fn progress_never_decreases_and_ends_at_one() {
        let tracker = Tracker::default();
        let mut last = 0.0;
        for (name, _) in STAGES {
            for step in [0.0, 0.3, 1.0] {
                tracker.progress(name, step);
                let (_, now) = tracker.now();
                assert!(now >= last - 1e-12, "{name} {step}: {now} after {last}");
                last = now;
            }
        }
        assert!((last - 1.0).abs() < 1e-9, "{last}");
        tracker.progress("no such stage", 1.0);
        assert_eq!(tracker.now().0, "encode");
    }

    #[test]
    fn every_stage_of_the_core_is_known() {
        for stage in molmesh_surface::Stage::ALL {
            assert!(STAGES.iter().any(|(name, _)| *name == stage.name()), "{}", stage.name());
        }
    }
}
