//! Caps on the number of jobs on record, in total and for each client. At a cap, the record of the ended job that was
//! not used for the longest time is removed.

use std::collections::BTreeMap;

use super::error::StoreError;
use super::handle::Store;
use super::index::{EvictionCandidate, Use};
use super::name::Name;
use crate::surface::{Exceeded, Limit};

/// Jobs that share a cap: those of one client, see [`Name::owner`], or all.
pub(super) type Scope = Option<u32>;

/// Caps on the number of jobs on record.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RecordCaps {
    /// Jobs of all clients.
    pub(crate) total: usize,
    /// Jobs of one client.
    pub(crate) per_client: usize,
}

/// Jobs of a scope.
#[derive(Debug, Default)]
struct Jobs {
    /// Number of jobs, on record and admitted.
    count: usize,
    /// Records of ended jobs.
    ended: BTreeMap<Use, Name>,
}

/// Number and order of the job records in every scope.
#[derive(Debug, Default)]
pub(super) struct JobRecords(BTreeMap<Scope, Jobs>);

fn scopes(name: &Name) -> [Scope; 2] {
    [Some(name.owner()), None]
}

impl JobRecords {
    /// Counts the job of a record.
    pub(super) fn add(&mut self, name: &Name) {
        for scope in scopes(name) {
            self.0.entry(scope).or_default().count += 1;
        }
    }

    /// Ends the counting of a job.
    pub(super) fn remove(&mut self, name: &Name) {
        for scope in scopes(name) {
            if let Some(jobs) = self.0.get_mut(&scope) {
                jobs.count -= 1;
                if jobs.count == 0 {
                    self.0.remove(&scope);
                }
            }
        }
    }

    /// Changes the last use of the record of an ended job. The job must be counted.
    pub(super) fn reorder(&mut self, name: &Name, old: Option<Use>, new: Option<Use>) {
        for scope in scopes(name) {
            let Some(jobs) = self.0.get_mut(&scope) else { continue };
            old.and_then(|old| jobs.ended.remove(&old));
            new.and_then(|new| jobs.ended.insert(new, name.clone()));
        }
    }

    /// Returns the first scope of a new job that is at its cap, with the cap and the records of its ended jobs, oldest
    /// first.
    pub(super) fn at_cap(&self, name: &Name, caps: RecordCaps) -> Option<(Scope, usize, impl Iterator<Item = &Name>)> {
        scopes(name).into_iter().zip([caps.per_client, caps.total]).find_map(|(scope, cap)| {
            let jobs = self.0.get(&scope)?;
            (jobs.count >= cap).then_some((scope, cap, jobs.ended.values()))
        })
    }
}

/// Outcome of an attempt to admit a job.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Admission {
    Admitted,
    /// The record of this ended job must be removed first.
    Remove(EvictionCandidate),
    /// All jobs of the scope are open. The cap.
    Full(Scope, usize),
}

/// Reservation of a job below the caps, until its record is written.
#[derive(Debug)]
pub(crate) struct RecordReservation {
    store: Store,
    name: Name,
}

impl Drop for RecordReservation {
    fn drop(&mut self) {
        self.store.index().records.remove(&self.name);
    }
}

impl Store {
    /// Admits the record `name` of a new job. At a cap, removes the records of ended jobs and returns their names.
    ///
    /// # Errors
    /// Returns [`StoreError::TooManyRecords`] if all jobs on record are open, or another [`StoreError`].
    pub(crate) async fn admit_record(
        &self,
        name: &Name,
        caps: RecordCaps,
    ) -> Result<(RecordReservation, Vec<Name>), StoreError> {
        let mut removed = Vec::new();
        loop {
            let admission = self.index().admit_record(name, caps);
            match admission {
                Admission::Admitted => {
                    return Ok((RecordReservation { store: self.clone(), name: name.clone() }, removed));
                }
                Admission::Full(scope, limit) => {
                    let mut error = Exceeded::new(Limit::JobRecords, limit as u64);
                    if scope.is_none() {
                        (error.subject, error.is_fixed) = ("the service".into(), true);
                    }
                    return Err(StoreError::TooManyRecords(error.into()));
                }
                Admission::Remove(candidate) => {
                    if self.evict_record(&candidate).await? {
                        removed.extend(candidate.names);
                    }
                }
            }
        }
    }
}
