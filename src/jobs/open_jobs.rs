//! Unfinished jobs that this process knows of: what their dispatch needs, and pins of their inputs.

use std::collections::{BTreeSet, HashMap};
use std::sync::PoisonError;

use super::broker::Dispatch;
use super::record::JobId;
use crate::store::Pin;
use crate::sync::{Mutex, MutexGuard};

/// Unfinished job on record.
struct OpenJob {
    /// Position in the order of insertion.
    order: u64,
    dispatch: Dispatch,
    /// Keeps inputs and record in the store.
    _pins: Vec<Pin>,
}

#[derive(Default)]
struct OpenJobTable {
    jobs: HashMap<JobId, OpenJob>,
    next: u64,
}

/// Unfinished jobs by id.
#[derive(Default)]
pub(super) struct OpenJobs(Mutex<OpenJobTable>);

impl OpenJobs {
    fn lock(&self) -> MutexGuard<'_, OpenJobTable> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a job whose record is stored. `pins` keep its inputs and its record.
    pub(super) fn insert(&self, dispatch: Dispatch, pins: Vec<Pin>) {
        let mut open = self.lock();
        let order = open.next;
        open.next += 1;
        let replaced = open.jobs.insert(dispatch.id.clone(), OpenJob { order, dispatch, _pins: pins });
        drop(open);
        // Unpins without the lock.
        drop(replaced);
    }

    /// Removes a job that has ended.
    pub(super) fn remove(&self, id: &JobId) {
        let removed = self.lock().jobs.remove(id);
        // Unpins without the lock.
        drop(removed);
    }

    /// Returns the ids of all jobs.
    pub(super) fn ids(&self) -> BTreeSet<JobId> {
        self.lock().jobs.keys().cloned().collect()
    }

    /// Returns the dispatches of all jobs, in the order of insertion.
    pub(super) fn all(&self) -> Vec<Dispatch> {
        let mut all: Vec<_> = self.lock().jobs.values().map(|job| (job.order, job.dispatch.clone())).collect();
        all.sort_unstable_by_key(|(order, _)| *order);
        all.into_iter().map(|(_, dispatch)| dispatch).collect()
    }
}
