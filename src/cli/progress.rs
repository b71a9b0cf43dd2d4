//! A progress bar for work that takes long: it appears after 300 ms, and only on a terminal.
//!
//! Workers store fractions; a thread of its own draws. Without a terminal there is neither.

use std::io::IsTerminal;
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;
use std::{io, sync::Arc};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use molmesh::pipeline::{ProgressSink, Tracker};

/// Work that is shorter shows no bar.
const PATIENCE: Duration = Duration::from_millis(300);
/// Between two drawings.
const FRAME: Duration = Duration::from_millis(80);
/// Steps of the bar.
const STEPS: u64 = 1000;

/// The bar. It is gone when this is dropped.
pub(crate) struct Progress {
    tracker: Arc<Tracker>,
    painter: Option<(SyncSender<()>, JoinHandle<()>)>,
}

impl Progress {
    /// A bar on stderr, if that is a terminal and `wanted`.
    pub(crate) fn new(wanted: bool) -> Self {
        let tracker = Arc::new(Tracker::default());
        let painter = (wanted && io::stderr().is_terminal()).then(|| paint(Arc::clone(&tracker))).flatten();
        Self { tracker, painter }
    }
}

impl ProgressSink for Progress {
    fn progress(&self, stage: &'static str, fraction: f64) {
        if self.painter.is_some() {
            self.tracker.progress(stage, fraction);
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
fn paint(tracker: Arc<Tracker>) -> Option<(SyncSender<()>, JoinHandle<()>)> {
    let (stop, stopped) = sync_channel::<()>(0);
    let draw = move || {
        let over = |wait| !matches!(stopped.recv_timeout(wait), Err(RecvTimeoutError::Timeout));
        if over(PATIENCE) {
            return;
        }
        let bar = ProgressBar::with_draw_target(Some(STEPS), ProgressDrawTarget::stderr());
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg:<12} [{bar:32}] {percent:>3} %  {elapsed}") {
            bar.set_style(style.progress_chars("█▉▊▋▌▍▎▏ "));
        }
        loop {
            let (stage, overall) = tracker.now();
            bar.set_message(stage);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and 1000")]
            bar.set_position((overall * STEPS as f64) as u64);
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
