//! One durable job from its acceptance to its end, and the state that its watchers see.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{Notify, watch};

use super::broker::JobProgress;
use super::job_store::JobView;
use super::record::{JobId, JobRecord, Status, now_ms};

/// A job whose record is in the store.
pub(super) struct DurableJob {
    pub(super) state: watch::Sender<JobView>,
    /// Held while the record is written.
    pub(super) writing: tokio::sync::Mutex<()>,
    /// Signal that stops the runner of this process: the job has ended, or a later attempt runs in another process.
    /// `None` while there is no runner.
    stop: Mutex<Option<Arc<Notify>>>,
}

/// Ownership of a job by its runner in this process, until it is dropped.
pub(super) struct Ownership {
    pub(super) job: Arc<DurableJob>,
    /// Signal to stop the work.
    pub(super) stop: Arc<Notify>,
}

impl Ownership {
    /// Makes the caller the runner of a job. `None` if it has one in this process.
    pub(super) fn take(job: &Arc<DurableJob>) -> Option<Self> {
        let mut signal = job.signal();
        if signal.is_some() {
            return None;
        }
        let stop = Arc::clone(signal.insert(Arc::default()));
        Some(Self { job: Arc::clone(job), stop })
    }
}

impl Drop for Ownership {
    fn drop(&mut self) {
        *self.job.signal() = None;
    }
}

impl DurableJob {
    pub(super) fn new(record: JobRecord) -> Self {
        let fraction = if record.status == Status::Successful { 1.0 } else { 0.0 };
        // Later than every version of an earlier process, unless the job has ended.
        let version = record.finished_ms.unwrap_or_else(now_ms);
        let state = watch::Sender::new(JobView { record, stage: None, fraction, version, end: None });
        Self { state, writing: tokio::sync::Mutex::default(), stop: Mutex::default() }
    }

    fn signal(&self) -> MutexGuard<'_, Option<Arc<Notify>>> {
        self.stop.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Stops the work of the runner of this process, if there is one.
    pub(super) fn stop(&self) {
        if let Some(stop) = &*self.signal() {
            stop.notify_one();
        }
    }

    /// Returns true while a runner of this process runs the job.
    pub(super) fn is_owned(&self) -> bool {
        self.signal().is_some()
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

    /// Marks the job as accepted again, with `attempts` attempts, and perhaps one more that lacked memory. Returns true
    /// if that changed the record.
    pub(super) fn return_to_queue(&self, attempts: u32, lacked_memory: bool) -> bool {
        self.update(|view, _| {
            if view.record.attempts == attempts && view.record.started_ms.is_none() && !lacked_memory {
                return false;
            }
            view.record.attempts = attempts;
            view.record.memory_waits += u32::from(lacked_memory);
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

    /// Publishes the progress of an attempt if it has advanced. Returns true if it has.
    pub(super) fn publish_progress(&self, progress: &JobProgress) -> bool {
        let JobProgress { attempts, started_ms, stage, fraction } = progress;
        self.update(|view, now| {
            let begins = view.record.status == Status::Accepted || view.record.attempts < *attempts;
            if !begins && view.stage.as_ref() == Some(stage) && *fraction <= view.fraction + 0.004 {
                return false;
            }
            if begins {
                view.record.attempts = view.record.attempts.max(*attempts);
                view.record.status = Status::Running;
                view.record.started_ms = started_ms.or(Some(now));
            }
            view.stage = Some(stage.clone());
            view.fraction = view.fraction.max(*fraction);
            true
        })
    }
}
