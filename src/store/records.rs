//! Caps on the number of jobs on record, in total and for each client. At a cap, the record of the ended job that was
//! not used for the longest time is removed.

use std::collections::BTreeMap;

use metrics::counter;

use super::error::StoreError;
use super::handle::Store;
use super::index::{EvictionCandidate, Use};
use super::name::Name;
use crate::config::JobsConfig;
use crate::surface::{Exceeded, Limit};
use crate::telemetry::STORE_REMOVED;

/// Jobs that share a cap: those of one client, see [`Name::owner`], or all.
pub(super) type Scope = Option<u32>;

/// Jobs of a scope.
#[derive(Debug, Default)]
struct Jobs {
    /// Number of jobs, on record and admitted.
    count: usize,
    /// Records of ended jobs, and of batches, which count as jobs.
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
    pub(super) fn at_cap(&self, name: &Name, caps: &JobsConfig) -> Option<(Scope, usize, impl Iterator<Item = &Name>)> {
        scopes(name).into_iter().zip([caps.records_per_client, caps.records]).find_map(|(scope, cap)| {
            let jobs = self.0.get(&scope)?;
            (jobs.count >= cap).then_some((scope, cap, jobs.ended.values()))
        })
    }
}

/// Error of a job that a cap does not admit.
#[derive(Debug)]
pub(super) struct AtCap {
    pub(super) scope: Scope,
    pub(super) limit: usize,
    /// Record of an ended job that must be removed first. `None` if all jobs of the scope are open.
    pub(super) oldest: Option<EvictionCandidate>,
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
        caps: &JobsConfig,
    ) -> Result<(RecordReservation, Vec<Name>), StoreError> {
        let mut removed = Vec::new();
        loop {
            let admitted = self.index().admit_record(name, caps);
            let Err(AtCap { scope, limit, oldest }) = admitted else {
                return Ok((RecordReservation { store: self.clone(), name: name.clone() }, removed));
            };
            let Some(oldest) = oldest else {
                let mut error = Exceeded::new(Limit::JobRecords, limit as u64);
                if scope.is_none() {
                    (error.subject, error.is_fixed) = ("the service".into(), true);
                }
                return Err(StoreError::TooManyRecords(error.into()));
            };
            if self.remove_candidate(&oldest).await? {
                counter!(STORE_REMOVED, "reason" => "records").increment(1);
                removed.extend(oldest.names);
            }
        }
    }
}
