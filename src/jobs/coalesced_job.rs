//! Queued or running job that several identical requests share.
//!
//! The job has no deadline, because those of its requests differ. Each request leaves at its own, and the job is
//! cancelled when the last one has left. Its work is charged to the client that asked first.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures_util::future::{BoxFuture, join_all};

use super::rank::{Lane, Rank};
use super::{Outcome, Task};
use crate::pipeline::{ProgressSink, Tracker, params};
use crate::single_flight::ResultSender;
use crate::store::Digest;
use crate::surface::CancelToken;
use crate::sync::Handle;
use crate::telemetry::TraceSpan;

/// Returns the identity of the work of a task: namespace, input, parameters and strictness. Tasks with equal keys share
/// one job.
pub(super) fn work_key(task: &Task) -> Digest {
    let Task { namespace, request, digest, .. } = task;
    let parameters = params::canonical(&request.options);
    Digest::of(format!("{namespace}\n{}\n{parameters}\n{digest}\n", request.strict).as_bytes())
}

/// Progress of a job, written by its worker.
#[derive(Debug, Default)]
pub(crate) struct Progress {
    begun: AtomicBool,
    tracker: Tracker,
    ended: Mutex<Vec<(&'static str, Instant, Duration)>>,
}

impl Progress {
    /// Returns the running stage and the finished fraction of the job, from 0 to 1; `None` while the job is queued.
    pub(crate) fn now(&self) -> Option<(&'static str, f64)> {
        self.begun.load(Ordering::Acquire).then(|| self.tracker.now())
    }

    /// Marks the job as running.
    pub(super) fn begin(&self) {
        self.begun.store(true, Ordering::Release);
    }

    /// Marks the job as queued, and forgets its finished stages.
    pub(super) fn restart(&self) {
        self.begun.store(false, Ordering::Release);
        drop(self.stages());
    }

    /// Takes the finished stages, each with its start and its duration.
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

/// Work that a worker waits for right before it starts a job.
pub(crate) struct OnStart {
    runtime: Handle,
    work: BoxFuture<'static, ()>,
}

impl OnStart {
    /// Creates work that uses the current runtime.
    pub(super) fn new(work: impl Future<Output = ()> + Send + 'static) -> Self {
        Self { runtime: Handle::current(), work: Box::pin(work) }
    }

    /// Runs the work of all requests that share a job concurrently, and waits for its end.
    pub(super) fn run_all(all: Vec<Self>) {
        let Some(runtime) = all.first().map(|first| first.runtime.clone()) else { return };
        // The work runs on a thread of the runtime: threads that it starts would inherit the priority of this one.
        drop(runtime.block_on(runtime.spawn(join_all(all.into_iter().map(|each| each.work)))));
    }
}

/// A queued or running job.
pub(super) struct CoalescedJob {
    pub(super) id: u64,
    pub(super) work: Digest,
    pub(super) rank: Rank,
    pub(super) lane: Lane,
    /// Expected work, in the units of [`crate::pipeline::estimate_work`].
    pub(super) units: f64,
    /// True for a tile, whose time says little about other jobs: the first one prepares the tileset, and others have no
    /// surface.
    pub(super) is_tile: bool,
    /// Start tag of fair queueing: the lowest one runs first.
    pub(super) tag: f64,
    pub(super) accepted: Instant,
    pub(super) begun: Option<Instant>,
    pub(super) cancel: CancelToken,
    /// True from the cancellation of a short job until it is queued in the long lane.
    pub(super) is_moving: bool,
    pub(super) progress: Arc<Progress>,
    /// Span of the job, a child of the span of its first request.
    pub(super) span: TraceSpan,
    /// Sends the outcome to the tickets; `None` once they have received that the service stops.
    pub(super) outcome: Option<ResultSender<Outcome>>,
    pub(super) on_start: Vec<OnStart>,
    /// `None` once a worker has taken it.
    pub(super) task: Option<Task>,
}

impl CoalescedJob {
    /// Returns the time for which the job has run; zero while it is queued.
    pub(super) fn spent(&self, now: Instant) -> Duration {
        self.begun.map_or(Duration::ZERO, |begun| now.saturating_duration_since(begun))
    }

    /// Returns true if no ticket is left.
    pub(super) fn is_abandoned(&self) -> bool {
        self.outcome.as_ref().is_none_or(|sender| sender.receiver_count() == 0)
    }
}

/// A job as a worker takes it from the queue.
pub(super) struct QueuedTask {
    pub(super) id: u64,
    pub(super) task: Task,
    pub(super) cancel: CancelToken,
    pub(super) progress: Arc<Progress>,
    pub(super) on_start: Vec<OnStart>,
    pub(super) accepted: Instant,
    pub(super) span: TraceSpan,
}
