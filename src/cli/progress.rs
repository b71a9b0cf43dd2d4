//! Progress bar for long work: appears after 300 ms, only on a terminal.
//!
//! Workers store fractions, and a separate thread draws the bar. Without a terminal there is neither.

use std::io::IsTerminal;
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;
use std::{io, sync::Arc};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use molmesh::pipeline::{ProgressSink, Tracker};

/// Delay before the bar appears.
const DELAY: Duration = Duration::from_millis(300);
/// Interval between updates.
const INTERVAL: Duration = Duration::from_millis(80);
/// Steps of the bar.
const STEPS: u64 = 1000;

/// Progress bar. Dropping it removes it from the terminal.
pub(crate) struct Progress {
    tracker: Arc<Tracker>,
    thread: Option<(SyncSender<()>, JoinHandle<()>)>,
}

impl Progress {
    /// Creates a bar on stderr if that is a terminal and `wanted` is true.
    pub(crate) fn new(wanted: bool) -> Self {
        let tracker = Arc::new(Tracker::default());
        let thread = (wanted && io::stderr().is_terminal()).then(|| paint(Arc::clone(&tracker))).flatten();
        Self { tracker, thread }
    }
}

impl ProgressSink for Progress {
    fn progress(&self, stage: &'static str, fraction: f64) {
        if self.thread.is_some() {
            self.tracker.progress(stage, fraction);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some((stop, thread)) = self.thread.take() {
            drop(stop);
            // A panic of this thread does not affect the work.
            drop(thread.join());
        }
    }
}

/// Starts the thread that draws the bar. It ends when the sender is dropped.
fn paint(tracker: Arc<Tracker>) -> Option<(SyncSender<()>, JoinHandle<()>)> {
    let (stop, stopped) = sync_channel::<()>(0);
    let draw = move || {
        let over = |wait| !matches!(stopped.recv_timeout(wait), Err(RecvTimeoutError::Timeout));
        if over(DELAY) {
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
            if over(INTERVAL) {
                break;
            }
        }
        bar.finish_and_clear();
    };
    let thread = std::thread::Builder::new().name("progress".to_owned()).spawn(draw).ok()?;
    Some((stop, thread))
}
