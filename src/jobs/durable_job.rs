//! One durable job from its acceptance to its end, and the state that its watchers see.

use std::borrow::Cow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::{Notify, watch};

use super::job_store::JobView;
use super::record::{JobId, JobRecord, Status, now_ms};

/// A job whose record is in the store.
pub(super) struct DurableJob {
    pub(super) state: watch::Sender<JobView>,
    /// Signals the runner to stop the work: the job has ended, or a later attempt runs in another process.
    stop: Mutex<Arc<Notify>>,
    /// Held while the record is written.
    pub(super) writing: tokio::sync::Mutex<()>,
    /// True while a [`Runner`](super::runner::Runner) of this process runs the job.
    owned: AtomicBool,
}

impl DurableJob {
    pub(super) fn new(record: JobRecord) -> Self {
        let fraction = if record.status == Status::Successful { 1.0 } else { 0.0 };
        // Later than every version of an earlier process, unless the job has ended.
        let version = record.finished_ms.unwrap_or_else(now_ms);
        let (state, _) = watch::channel(JobView { record, stage: None, fraction, version, end: None });
        let (stop, writing) = (Mutex::default(), tokio::sync::Mutex::default());
        Self { state, stop, writing, owned: AtomicBool::new(false) }
    }

    /// Makes the caller the runner of the job. Returns false if it has one in this process.
    pub(super) fn try_own(&self) -> bool {
        let is_new = !self.owned.swap(true, Ordering::AcqRel);
        if is_new {
            // A signal to an earlier runner does not stop this one.
            *self.stop.lock().unwrap_or_else(PoisonError::into_inner) = Arc::default();
        }
        is_new
    }

    /// Returns the signal to stop the work of the present runner.
    pub(super) fn stop(&self) -> Arc<Notify> {
        Arc::clone(&self.stop.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Ends the ownership of the runner.
    pub(super) fn release(&self) {
        self.owned.store(false, Ordering::Release);
    }

    /// Returns true while a runner of this process runs the job.
    pub(super) fn is_owned(&self) -> bool {
        self.owned.load(Ordering::Acquire)
    }

    pub(super) fn id(&self) -> JobId {
        self.state.borrow().record.id.clone()
    }

    /// Returns the latest record. It contains the end once that is decided, even if it is not visible yet.
    pub(super) fn record(&self) -> JobRecord {
        let view = self.state.borrow();
        view.end.as_deref().unwrap_or(&view.record).clone()
    }

    pub(super) fn view(&self) -> JobView {
        self.state.borrow().clone()
    }

    /// Returns the time of its end, ms since 1970, and its id; `None` if it has not ended.
    pub(super) fn ended(&self) -> Option<(u64, JobId)> {
        let view = self.state.borrow();
        view.record.finished_ms.map(|ms| (ms, view.record.id.clone()))
    }

    /// Calls `change` with the state and the present time unless the job has ended. If it returns true, the time
    /// becomes the version of the state, and watchers are notified. Returns the value of `change`, or false.
    fn update(&self, change: impl FnOnce(&mut JobView, u64) -> bool) -> bool {
        self.state.send_if_modified(|view| {
            let now = now_ms().max(view.version + 1);
            let is_open = !view.record.status.is_final() && view.end.is_none();
            let changed = is_open && change(view, now);
            if changed {
                view.version = now;
            }
            changed
        })
    }

    /// Marks the job as running and counts an attempt, if `may_begin` returns true. Returns false otherwise, or if the
    /// job has ended, for example by a dismissal.
    pub(super) fn begin(&self, may_begin: impl FnOnce() -> bool) -> bool {
        self.update(|view, now| {
            if !may_begin() {
                return false;
            }
            view.record.attempts += 1;
            view.record.status = Status::Running;
            view.record.started_ms = Some(now);
            true
        })
    }

    /// Marks the job as accepted again, with `attempts` attempts, and `memory_waits` more that lacked memory. Returns
    /// true if that changed the record.
    pub(super) fn return_to_queue(&self, attempts: u32, memory_waits: u32) -> bool {
        self.update(|view, _| {
            if view.record.attempts == attempts && view.record.started_ms.is_none() && memory_waits == 0 {
                return false;
            }
            view.record.attempts = attempts;
            view.record.memory_waits += memory_waits;
            view.record.status = Status::Accepted;
            view.record.started_ms = None;
            view.stage = None;
            true
        })
    }

    /// Returns true if the end of the job is decided.
    pub(super) fn is_decided(&self) -> bool {
        let view = self.state.borrow();
        view.end.is_some() || view.record.status.is_final()
    }

    /// Decides the end of the job: sets `status` and applies `change` to the record. Returns false if the end was
    /// decided before. [`Self::publish_end`] makes it visible.
    pub(super) fn end(&self, status: Status, change: impl FnOnce(&mut JobRecord)) -> bool {
        let mut decided = false;
        self.update(|view, now| {
            let mut record = view.record.clone();
            record.status = status;
            record.finished_ms = Some(now);
            change(&mut record);
            view.end = Some(Box::new(record));
            decided = true;
            false
        });
        decided
    }

    /// Makes the end of the job visible, unless it is already. `record` is the end on record, which may be another one
    /// than was decided here.
    pub(super) fn publish_end(&self, record: JobRecord) {
        self.state.send_if_modified(|view| {
            if view.record.status.is_final() {
                return false;
            }
            view.end = None;
            view.version = record.finished_ms.unwrap_or(view.version + 1);
            view.stage = None;
            if record.status == Status::Successful {
                view.fraction = 1.0;
            }
            view.record = record;
            true
        });
    }

    /// Replaces the record of an open job by the stored one, which another process may have written.
    pub(super) fn adopt(&self, record: JobRecord) {
        self.update(|view, _| {
            let changed = view.record != record;
            if record.status == Status::Accepted {
                view.stage = None;
            }
            view.record = record;
            changed
        });
    }

    /// Publishes the stage and the finished fraction of attempt `attempts` if they have advanced. Returns true if they
    /// have.
    pub(super) fn publish_stage(
        &self,
        (attempts, started_ms): (u32, Option<u64>),
        stage: Cow<'static, str>,
        fraction: f64,
    ) -> bool {
        self.update(|view, now| {
            let begins = view.record.status == Status::Accepted || view.record.attempts < attempts;
            if !begins && view.stage.as_ref() == Some(&stage) && fraction <= view.fraction + 0.004 {
                return false;
            }
            if begins {
                view.record.attempts = view.record.attempts.max(attempts);
                view.record.status = Status::Running;
                view.record.started_ms = started_ms.or(Some(now));
            }
            view.stage = Some(stage);
            view.fraction = view.fraction.max(fraction);
            true
        })
    }
}
