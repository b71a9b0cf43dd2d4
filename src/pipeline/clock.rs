//! The clock that the core does not have: wall time per stage, and progress for whoever watches.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use crate::surface::{Observer, Stage};

/// Told of progress: the stage's name and a fraction from 0 to 1 within it.
pub trait ProgressSink: Sync {
    /// Called from several threads, at most a few thousand times a job.
    fn progress(&self, stage: &'static str, fraction: f64) {
        let _ = (stage, fraction);
    }
}

impl ProgressSink for () {}

/// Measures stages. Stages that run interleaved on several threads (the backend's) share the wall time of
/// their pass in proportion to the threads' time in each, so the stages add up to the wall time.
pub struct StageClock<'a> {
    sink: &'a dyn ProgressSink,
    busy_ns: [AtomicU64; Stage::ALL.len()],
    wall_ms: Mutex<Vec<(&'static str, f64)>>,
}

impl<'a> StageClock<'a> {
    /// A clock that reports to `sink`.
    #[must_use]
    pub fn new(sink: &'a dyn ProgressSink) -> Self {
        Self { sink, busy_ns: Default::default(), wall_ms: Mutex::default() }
    }

    /// Times `work` under `name`.
    pub fn time<T>(&self, name: &'static str, work: impl FnOnce() -> T) -> T {
        self.sink.progress(name, 0.0);
        let start = Instant::now();
        let value = work();
        self.push(name, start.elapsed().as_secs_f64() * 1e3);
        value
    }

    /// Times a backend's pass, whose spans were reported through [`Observer::span`].
    pub fn pass<T>(&self, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let value = work();
        let wall = start.elapsed().as_secs_f64() * 1e3;
        let busy = self.busy_ns.each_ref().map(|ns| ns.swap(0, Ordering::Relaxed) as f64);
        let total: f64 = busy.iter().sum();
        for (stage, share) in Stage::ALL.into_iter().zip(busy) {
            if share > 0.0 {
                self.push(stage.name(), wall * share / total);
            }
        }
        value
    }

    /// Wall time in ms per stage, in the order in which they ran.
    #[must_use]
    pub fn finish(self) -> Vec<(&'static str, f64)> {
        self.wall_ms.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn push(&self, name: &'static str, ms: f64) {
        self.wall_ms.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((name, ms));
    }
}

impl Observer for StageClock<'_> {
    fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
        let start = Instant::now();
        work();
        let ns = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.busy_ns[stage as usize].fetch_add(ns, Ordering::Relaxed);
    }

    fn progress(&self, stage: Stage, done: usize, total: usize) {
        self.sink.progress(stage.name(), done as f64 / total.max(1) as f64);
    }
}
