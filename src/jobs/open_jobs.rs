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
    /// `None` for a job of another release, which this process does not dispatch.
    dispatch: Option<Dispatch>,
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

    /// Adds a job whose record is stored, without `dispatch` if another release must run it. `pins` keep its inputs and
    /// its record.
    pub(super) fn insert(&self, id: JobId, dispatch: Option<Dispatch>, pins: Vec<Pin>) {
        let mut open = self.lock();
        let order = open.next;
        open.next += 1;
        let replaced = open.jobs.insert(id, OpenJob { order, dispatch, _pins: pins });
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

    /// Returns the number of jobs of other releases.
    pub(super) fn other_release_count(&self) -> usize {
        self.lock().jobs.values().filter(|job| job.dispatch.is_none()).count()
    }

    /// Returns the dispatches of the jobs of this release, in the order of insertion.
    pub(super) fn all(&self) -> Vec<Dispatch> {
        let open = self.lock();
        let mut all: Vec<_> = open.jobs.values().filter_map(|job| Some((job.order, job.dispatch.clone()?))).collect();
        drop(open);
        all.sort_unstable_by_key(|(order, _)| *order);
        all.into_iter().map(|(_, dispatch)| dispatch).collect()
    }
}
