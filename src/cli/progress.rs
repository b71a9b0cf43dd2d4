//! A progress bar for work that takes long: it appears after 300 ms, and only on a terminal.
//!
//! Workers store fractions; a thread of its own draws. Without a terminal there is neither.

use std::io::IsTerminal;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;
use std::{io, sync::Arc};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use molmesh::pipeline::ProgressSink;

/// Work that is shorter shows no bar.
const PATIENCE: Duration = Duration::from_millis(300);
/// Between two drawings.
const FRAME: Duration = Duration::from_millis(80);
/// Parts of a stage's fraction.
const UNIT: f64 = 1000.0;

/// Stages with their usual share of the time, in the order in which they run.
const STAGES: [(&str, f64); 11] = [
    ("read", 0.10),
    ("select", 0.02),
    ("bin", 0.03),
    ("field", 0.40),
    ("classify", 0.05),
    ("scan", 0.02),
    ("interpolate", 0.10),
    ("emit", 0.10),
    ("write", 0.05),
    ("measure", 0.08),
    ("encode", 0.05),
];

/// How far each stage is.
#[derive(Debug, Default)]
struct State {
    fractions: [AtomicU32; STAGES.len()],
    /// Index of the stage that spoke last.
    current: AtomicU32,
}

impl State {
    fn set(&self, stage: &str, fraction: f64) {
        let Some(ix) = STAGES.iter().position(|(name, _)| *name == stage) else { return };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to 0..=1000")]
        let parts = (fraction.clamp(0.0, 1.0) * UNIT) as u32;
        // A stage that begins ends those before it, whether they reported it or not.
        if self.fractions[ix].load(Ordering::Relaxed) == 0 {
            self.current.fetch_max(u32::try_from(ix).unwrap_or(0), Ordering::Relaxed);
        }
        self.fractions[ix].fetch_max(parts, Ordering::Relaxed);
    }

    fn now(&self) -> (&'static str, f64) {
        let current = self.current.load(Ordering::Relaxed) as usize;
        let part = |ix: usize| match ix {
            // Stages of one pass run interleaved, so that an earlier one may not be done; the others are.
            _ if ix < current && !INTERLEAVED.contains(&STAGES[ix].0) => 1.0,
            _ => f64::from(self.fractions[ix].load(Ordering::Relaxed)) / UNIT,
        };
        let overall = (0..STAGES.len()).map(|ix| STAGES[ix].1 * part(ix)).sum();
        (STAGES[current].0, overall)
    }
}

/// Stages of which several run at a time, on different bricks.
const INTERLEAVED: [&str; 5] = ["field", "classify", "interpolate", "emit", "write"];

/// The bar. It is gone when this is dropped.
pub(crate) struct Progress {
    state: Arc<State>,
    painter: Option<(SyncSender<()>, JoinHandle<()>)>,
}

impl Progress {
    /// A bar on stderr, if that is a terminal and `wanted`.
    pub(crate) fn new(wanted: bool) -> Self {
        let state = Arc::new(State::default());
        let painter = (wanted && io::stderr().is_terminal()).then(|| paint(Arc::clone(&state))).flatten();
        Self { state, painter }
    }
}

impl ProgressSink for Progress {
    fn progress(&self, stage: &'static str, fraction: f64) {
        if self.painter.is_some() {
            self.state.set(stage, fraction);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some((stop, painter)) = self.painter.take() {
            drop(stop);
            // A painter that panicked has nothing to say about the work.
            drop(painter.join());
        }
    }
}

/// Starts the thread that draws; it ends when the sender is dropped.
fn paint(state: Arc<State>) -> Option<(SyncSender<()>, JoinHandle<()>)> {
    let (stop, stopped) = sync_channel::<()>(0);
    let draw = move || {
        let over = |wait| !matches!(stopped.recv_timeout(wait), Err(RecvTimeoutError::Timeout));
        if over(PATIENCE) {
            return;
        }
        let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::stderr());
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg:<12} [{bar:32}] {percent:>3} %  {elapsed}") {
            bar.set_style(style.progress_chars("█▉▊▋▌▍▎▏ "));
        }
        loop {
            let (stage, overall) = state.now();
            bar.set_message(stage);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and 1000")]
            bar.set_position((overall * UNIT) as u64);
            bar.tick();
            if over(FRAME) {
                break;
            }
        }
        bar.finish_and_clear();
    };
    let painter = std::thread::Builder::new().name("progress".to_owned()).spawn(draw).ok()?;
    Some((stop, painter))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_add_up_to_the_whole() {
        let sum: f64 = STAGES.iter().map(|(_, share)| share).sum();
        assert!((sum - 1.0).abs() < 1e-9, "{sum}");
    }

    #[test]
    fn it_never_goes_back_and_ends_at_one() {
        let state = State::default();
        let mut last = 0.0;
        for (name, _) in STAGES {
            for step in [0.0, 0.3, 1.0] {
                state.set(name, step);
                let (_, now) = state.now();
                assert!(now >= last - 1e-12, "{name} {step}: {now} after {last}");
                last = now;
            }
        }
        assert!((last - 1.0).abs() < 1e-9, "{last}");
        state.set("no such stage", 1.0);
        assert_eq!(state.now().0, "encode");
    }

    #[test]
    fn every_stage_of_the_core_is_known() {
        for stage in molmesh::surface::Stage::ALL {
            assert!(STAGES.iter().any(|(name, _)| *name == stage.name()), "{}", stage.name());
        }
    }
}
