//! Jobs that this process knows of: those whose state it holds, and all unfinished ones, with their dispatches and the
//! pins of their inputs.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use super::broker::Dispatch;
use super::durable_job::{DurableJob, Ownership};
use super::record::JobId;
use crate::store::Pin;

/// Number of ended jobs that are held in memory; older ones are read from the store. A record takes up to 64 KiB, the
/// size of a request without its structure.
pub(super) const MAX_ENDED: usize = 256;

/// Unfinished job on record.
pub(super) struct OpenJob {
    /// Position in the order of insertion.
    order: u64,
    /// `None` for a job of another release, which this process does not dispatch.
    dispatch: Option<Dispatch>,
    /// Keeps inputs and record in the store.
    _pins: Vec<Pin>,
}

/// Jobs by id.
#[derive(Default)]
pub(super) struct JobMap {
    /// Jobs that run in this process, are watched, or have ended recently.
    pub(super) jobs: HashMap<JobId, Arc<DurableJob>>,
    /// Number of jobs at which ended ones are removed.
    trim_at: usize,
    open: HashMap<JobId, OpenJob>,
    next: u64,
}

impl JobMap {
    /// Adds a job unless there is one with its id, and returns the job in the map.
    pub(super) fn insert(&mut self, job: &Arc<DurableJob>) -> Arc<DurableJob> {
        let inserted = Arc::clone(self.jobs.entry(job.id()).or_insert_with(|| Arc::clone(job)));
        // Slack of 10 %, so that not every insertion sorts.
        if self.jobs.len() > self.trim_at.max(MAX_ENDED + MAX_ENDED / 10) {
            let mut ended: Vec<_> = self.jobs.values().filter_map(|job| job.ended()).collect();
            ended.sort_unstable();
            for (_, id) in ended.iter().take(ended.len().saturating_sub(MAX_ENDED)) {
                self.jobs.remove(id);
            }
            self.trim_at = MAX_ENDED / 10 + self.jobs.len();
        }
        inserted
    }

    /// Makes the caller the runner of a job. `None` if the job has one, or is not in the map any more.
    pub(super) fn own(&self, job: &Arc<DurableJob>) -> Option<Ownership> {
        self.jobs.get(&job.id()).filter(|known| Arc::ptr_eq(known, job)).and_then(Ownership::take)
    }

    /// Adds an unfinished job whose record is stored, without `dispatch` if another release must run it. `pins` keep
    /// its inputs and its record. Returns the entry that it replaces. The caller drops it after the lock is released,
    /// because that unpins.
    pub(super) fn open(&mut self, id: JobId, dispatch: Option<Dispatch>, pins: Vec<Pin>) -> Option<OpenJob> {
        self.next += 1;
        self.open.insert(id, OpenJob { order: self.next, dispatch, _pins: pins })
    }

    /// Removes a job from the unfinished ones. The caller drops the returned value without the lock.
    pub(super) fn close(&mut self, id: &JobId) -> Option<OpenJob> {
        self.open.remove(id)
    }

    /// Returns the ids of all unfinished jobs.
    pub(super) fn open_ids(&self) -> BTreeSet<JobId> {
        self.open.keys().cloned().collect()
    }

    /// Returns the number of unfinished jobs of other releases.
    pub(super) fn other_release_count(&self) -> usize {
        self.open.values().filter(|job| job.dispatch.is_none()).count()
    }

    /// Returns the dispatches of the unfinished jobs of this release, in the order of insertion.
    pub(super) fn dispatches(&self) -> Vec<Dispatch> {
        let mut open: Vec<_> = self.open.values().collect();
        open.sort_unstable_by_key(|job| job.order);
        open.into_iter().filter_map(|job| job.dispatch.clone()).collect()
    }

    /// Returns true if a runner of this process runs a job.
    pub(super) fn is_owned(&self, id: &JobId) -> bool {
        self.jobs.get(id).is_some_and(|job| job.is_owned())
    }
}
