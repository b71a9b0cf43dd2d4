//! A piece of work in the house: whoever asks for the same while it waits or runs takes part in it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::rank::Rank;
use super::{Outcome, Task};
use crate::pipeline::{Job, ProgressSink, Tracker, params};
use crate::store::Digest;
use crate::surface::CancelToken;
use crate::telemetry::TraceSpan;

/// What makes two tasks one: the same input, the same parameters, the same check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct WorkKey(Digest);

impl WorkKey {
    pub(super) fn new(input: &Digest, job: &Job, strict: bool) -> Self {
        Self(Digest::of(format!("{strict}\n{}\n{input}\n", params::canonical(job)).as_bytes()))
    }
}

/// How far a piece of work is. Told by the worker, read by whoever wants to know.
#[derive(Debug, Default)]
pub struct Progress {
    begun: AtomicBool,
    tracker: Tracker,
    ended: Mutex<Vec<(&'static str, Instant, Duration)>>,
}

impl Progress {
    /// The stage that runs and the fraction of the whole; none while the work waits.
    #[must_use]
    pub fn now(&self) -> Option<(&'static str, f64)> {
        self.begun.load(Ordering::Acquire).then(|| self.tracker.now())
    }

    pub(super) fn begin(&self) {
        self.begun.store(true, Ordering::Release);
    }

    /// The stages that are over, with when they began and how long they took.
    pub(super) fn stages(&self) -> Vec<(&'static str, Instant, Duration)> {
        std::mem::take(&mut *self.ended.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl ProgressSink for Progress {
    fn progress(&self, stage: &'static str, fraction: f64) {
        self.tracker.progress(stage, fraction);
    }

    fn ended(&self, stage: &'static str, begun: Instant, time: Duration) {
        self.ended.lock().unwrap_or_else(PoisonError::into_inner).push((stage, begun, time));
    }
}

/// Called on the worker's thread right before the work begins: what must be on record by then.
pub type Claim = Box<dyn FnOnce() + Send>;

/// Whoever waits for an outcome.
pub(super) struct Waiter {
    pub(super) id: u64,
    pub(super) reply: oneshot::Sender<Outcome>,
}

/// A piece of work that waits or runs.
pub(super) struct Flight {
    pub(super) id: u64,
    pub(super) work: WorkKey,
    pub(super) rank: Rank,
    /// Expected work.
    pub(super) units: f64,
    /// Place among the clients' fair shares: lower goes first.
    pub(super) tag: f64,
    pub(super) accepted: Instant,
    pub(super) begun: Option<Instant>,
    pub(super) cancel: CancelToken,
    pub(super) progress: Arc<Progress>,
    /// The span of the work, from its acceptance on, under that of the first who asked.
    pub(super) span: TraceSpan,
    pub(super) waiters: Vec<Waiter>,
    pub(super) claims: Vec<Claim>,
    /// Taken by the worker.
    pub(super) task: Option<Task>,
}

/// What a worker takes.
pub(super) struct Entry {
    pub(super) id: u64,
    pub(super) task: Task,
    pub(super) cancel: CancelToken,
    pub(super) progress: Arc<Progress>,
    pub(super) claims: Vec<Claim>,
    pub(super) accepted: Instant,
    pub(super) span: TraceSpan,
}
