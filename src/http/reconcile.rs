//! Reconciliation of the store and the broker of a cluster on request. Each node also does it at regular intervals.

use std::time::Duration;

use serde::Serialize;

use super::server::{ServeError, connect_broker};
use crate::config::Config;
use crate::jobs::{
    Broker as _, Dispatch, DispatchError, JobRecord, NatsBroker, UnfinishedJobs, rfc3339, unfinished_jobs,
};
use crate::store::Store;

/// Interval at which the broker is asked whether it answers.
const CHECK: Duration = Duration::from_millis(50);

/// Result of a reconciliation.
#[derive(Debug, Clone, Serialize)]
pub struct Reconciled {
    /// Number of unfinished jobs on record.
    pub unfinished: usize,
    /// Number of lost jobs that were dispatched; 0 for a dry run.
    pub dispatched: usize,
    /// Number of unfinished jobs that are left to the releases that wrote their records.
    pub other_release_count: usize,
    /// Number of damaged records. The next node that reads them moves them into quarantine.
    pub unreadable: usize,
    /// Unfinished jobs that the broker did not have, oldest first.
    pub lost: Vec<LostJob>,
    /// Error of the broker, after which no further job was examined; null without one.
    pub error: Option<String>,
}

/// Unfinished job that the broker did not have.
#[derive(Debug, Clone, Serialize)]
pub struct LostJob {
    /// Id of the job.
    pub id: String,
    /// Status at the last write: `accepted` or `running`.
    pub status: &'static str,
    /// Time of acceptance.
    pub created: String,
}

/// Dispatches the unfinished jobs of the store that the broker at `url` does not have. A dry run only lists them. Waits
/// at most `limit` for the broker. Creates neither store nor streams. A job that is being accepted or has just ended
/// may be listed as well; dispatching it again is harmless.
///
/// # Errors
/// Returns a [`ServeError`] if the store or the broker cannot be used. After a later error of the broker, the result
/// contains it.
pub async fn reconcile(config: &Config, url: &str, dry_run: bool, limit: Duration) -> Result<Reconciled, ServeError> {
    let store = Store::open_existing(&config.store, &config.server.data_dir).await?;
    let broker = connect_broker(config, url, &store.secret().await?, false).await?;
    let end = tokio::time::Instant::now() + limit;
    while let Some(why) = broker.down() {
        if tokio::time::Instant::now() >= end {
            return Err(ServeError::Broker(why));
        }
        tokio::time::sleep(CHECK).await;
    }
    let UnfinishedJobs { records, other_release_count, unreadable } = unfinished_jobs(&store).await?;
    let unfinished = records.len();
    let mut result =
        Reconciled { unfinished, dispatched: 0, other_release_count, unreadable, lost: Vec::new(), error: None };
    for record in records {
        if let Err(error) = result.examine(&record, &broker, dry_run).await {
            result.error = Some(error.to_string());
            break;
        }
    }
    Ok(result)
}

impl Reconciled {
    /// Lists a job if the broker does not have it, and dispatches it unless in a dry run.
    async fn examine(&mut self, record: &JobRecord, broker: &NatsBroker, dry_run: bool) -> Result<(), DispatchError> {
        let dispatch = Dispatch::of(record);
        if broker.holds(&dispatch).await? {
            return Ok(());
        }
        let (id, created) = (record.id.as_str().to_owned(), rfc3339(record.created_ms));
        self.lost.push(LostJob { id, status: record.status.name(), created });
        if !dry_run {
            self.dispatched += usize::from(broker.dispatch(&dispatch).await?);
        }
        Ok(())
    }
}
