//! Lists of durable jobs, in the order of their ids: it does not change while jobs are added, run and end, and the
//! store has the records in this order already.

use std::str::FromStr;
use std::time::{Duration, Instant};

use futures_util::{StreamExt as _, stream};

use super::durable_job::DurableJob;
use super::job_store::{JobStore, JobStoreState, JobView};
use super::rank::Client;
use super::record::{BadJobId, JobId, JobRecord, Status};
use crate::store::{Name, Namespace, StoreError};

/// Maximum number of records that are read for a page.
pub(crate) const MAX_READS: usize = 1000;
/// Memory of a record while its page is selected, bytes: its name and metadata, as the store lists them, and its id.
pub(crate) const LISTED_BYTES: u64 = 300;
/// Time after which a page ends early.
const PAGE_TIME: Duration = Duration::from_secs(10);
/// Concurrent reads of records for one page.
const PAGE_READS: usize = 16;
/// Concurrent reads of records for all pages, so that others find a free thread.
pub(super) const CONCURRENT_READS: usize = 64;
/// Maximum number of jobs whose namespaces are remembered, that of all jobs on record.
pub(super) const MAX_NAMESPACES: usize = 100_000;

/// Jobs to list.
#[derive(Debug, Clone, Copy)]
pub(crate) struct JobFilter {
    /// Namespace of the jobs.
    pub(crate) namespace: Namespace,
    /// Client of the jobs; `None` for all clients of the namespace.
    pub(crate) client: Option<Client>,
    /// Status of the jobs; `None` for every status.
    pub(crate) status: Option<Status>,
}

impl JobFilter {
    /// Returns true if a job belongs to the list.
    fn admits(&self, record: &JobRecord) -> bool {
        record.namespace == self.namespace
            && self.client.is_none_or(|client| client.0 == record.client)
            && self.status.is_none_or(|status| status == record.status)
    }
}

/// Beginning of a page: the shortest prefix of its first id that no earlier id reaches. The whole id may be that of
/// another client's job, to which it gives access.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct JobCursor(String);

impl JobCursor {
    /// Returns the beginning of the page after `last`, whose first candidate is `next`.
    fn between(last: &JobId, next: &JobId) -> Self {
        let (last, next) = (last.as_str(), next.as_str());
        let n_equal = last.bytes().zip(next.bytes()).take_while(|(a, b)| a == b).count();
        Self(next.chars().take(n_equal + 1).collect())
    }

    /// Returns the text for clients.
    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for JobCursor {
    type Err = BadJobId;

    fn from_str(text: &str) -> Result<Self, BadJobId> {
        // An id with the text as its first digits.
        let _id: JobId = format!("{text:0<32}").parse()?;
        if text.is_empty() { Err(BadJobId) } else { Ok(Self(text.to_owned())) }
    }
}

/// Id of a job on record, and true if it has ended.
type Candidate = (JobId, bool);

/// Returns the jobs of `records`, which are in the order of their names, from `first` on.
fn candidates(records: &[Name], first: Option<&JobCursor>, is_listed: impl Fn(&str, bool) -> bool) -> Vec<Candidate> {
    let begin = first.map_or(0, |first| records.partition_point(|name| name.stem() < first.as_str()));
    let mut found: Vec<Candidate> = Vec::new();
    let mut previous = "";
    for name in &records[begin..] {
        // The record of an end precedes that of the open job.
        if name.stem() != previous
            && is_listed(name.stem(), name.is_ended_job())
            && let Ok(id) = name.stem().parse()
        {
            found.push((id, name.is_ended_job()));
        }
        previous = name.stem();
    }
    found
}

impl JobStoreState {
    /// Returns the state of a candidate if it belongs to the list. A job whose record this process cannot read does
    /// not: its namespace is unknown.
    async fn listed(&self, (id, is_ended): &Candidate, filter: &JobFilter) -> Result<Option<JobView>, StoreError> {
        let known = self.lock().jobs.get(id).map(|job| job.view());
        let view = if known.is_some() {
            known
        } else {
            // The semaphore is never closed.
            let _permit = self.record_reads.acquire().await;
            match self.peek(id, *is_ended).await {
                Ok(record) => record.map(|record| DurableJob::new(record).view()),
                Err(StoreError::Quarantined { .. } | StoreError::OtherRelease { .. }) => None,
                Err(error) => return Err(error),
            }
        };
        if let Some(view) = &view
            && !filter.namespace.is_common()
        {
            self.namespaces.insert(view.record.id.clone(), view.record.namespace);
        }
        Ok(view.filter(|view| filter.admits(&view.record)))
    }
}

impl JobStore {
    /// Passes the jobs from `first` on to `add`, at most `limit`, until it returns false. Returns the beginning of the
    /// next page; `None` after the last one. A page ends early after [`MAX_READS`] or [`PAGE_TIME`].
    ///
    /// Listing a job does not count as a use: otherwise a list would keep ended jobs on record, even those of others.
    pub(crate) async fn list(
        &self,
        filter: &JobFilter,
        first: Option<&JobCursor>,
        limit: usize,
        mut add: impl FnMut(&JobView) -> bool,
    ) -> Result<Option<JobCursor>, StoreError> {
        let inner = &self.0;
        let owner = filter.client.map(|client| inner.owner_digits(client));
        let records = inner.store.job_records().await?;
        let mut jobs = candidates(&records, first, |id, is_ended| {
            owner.as_ref().is_none_or(|owner| id.ends_with(owner.as_str()))
                && filter.status.is_none_or(|status| status.is_final() == is_ended)
        });
        drop(records);
        // A list does not read the records of other namespaces each time.
        jobs.retain(|(id, _)| inner.namespaces.get(id).is_none_or(|known| known == filter.namespace));
        let begun = Instant::now();
        let read = |job: Candidate| async move { inner.listed(&job, filter).await };
        let begin = jobs.iter().take(MAX_READS).cloned().collect::<Vec<_>>();
        let reads = stream::iter(begin).map(read);
        let mut views = reads.buffered(PAGE_READS);
        let (mut n_seen, mut n_added) = (0, 0);
        while n_added < limit && begun.elapsed() < PAGE_TIME {
            let Some(view) = views.next().await else { break };
            if let Some(view) = view? {
                if !add(&view) {
                    break;
                }
                n_added += 1;
            }
            n_seen += 1;
        }
        drop(views);
        let (seen, rest) = jobs.split_at(n_seen);
        Ok(seen.last().zip(rest.first()).map(|((last, _), (next, _))| JobCursor::between(last, next)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(text: &str) -> JobId {
        format!("{text:0<32}").parse().unwrap()
    }

    #[test]
    fn cursors_separate_ids_and_reveal_little() {
        for (last, next, expected) in [("1", "2", "2"), ("12f", "1300", "13"), ("0", "00000001", "00000001")] {
            let cursor = JobCursor::between(&id(last), &id(next));
            assert_eq!(cursor.as_str(), expected);
            assert!(id(last).as_str() < cursor.as_str() && cursor.as_str() <= id(next).as_str());
            assert_eq!(cursor.as_str().parse(), Ok(cursor));
        }
        for bad in ["", "g", "A", "../x", "é", &"1".repeat(33)] {
            assert_eq!(bad.parse::<JobCursor>(), Err(BadJobId), "{bad}");
        }
    }

    #[test]
    fn a_job_with_both_records_has_ended_and_is_listed_once() {
        let (open, ended) =
            (|text| Name::job(id(text).as_str()).unwrap(), |text| Name::ended_job(id(text).as_str()).unwrap());
        let mut records = vec![open("1"), open("2"), ended("2"), ended("3"), Name::job("4").unwrap()];
        records.sort();
        let all = |_: &str, _| true;
        let expected = [(id("1"), false), (id("2"), true), (id("3"), true)];
        assert_eq!(candidates(&records, None, all), expected);
        assert_eq!(candidates(&records, Some(&JobCursor("2".to_owned())), all), expected[1..]);
        assert_eq!(candidates(&records, Some(&JobCursor("21".to_owned())), all), expected[2..]);
        assert_eq!(candidates(&records, None, |_, is_ended| !is_ended), expected[..1], "an ended job is not open");
    }
}
