//! Reconciliation of the store and the broker of a cluster on request. Each node also does it at regular intervals.

use std::time::Duration;

use serde::Serialize;

use super::server::{ServeError, connect_broker};
use crate::config::Config;
use crate::jobs::{Broker as _, Dispatch, DispatchError, rfc3339, unfinished_jobs};
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
    /// Number of records that cannot be parsed. The next node that reads them moves them into quarantine.
    pub unreadable: usize,
    /// Unfinished jobs that the broker did not have, oldest first.
    pub lost: Vec<LostJob>,
}

/// Unfinished job that the broker did not have.
#[derive(Debug, Clone, Serialize)]
pub struct LostJob {
    /// Beginning of the id, as in the log.
    pub id: String,
    /// Status at the last write: `accepted` or `running`.
    pub status: &'static str,
    /// Time of acceptance.
    pub created: String,
}

/// Dispatches the unfinished jobs of the store that the broker does not have. A dry run only lists them. Waits at most
/// `limit` for the broker. A job that is being accepted or has just ended may be listed as well; to dispatch it is
/// harmless.
///
/// # Errors
/// Returns a [`ServeError`] if `broker.url` is not set, or the store or the broker cannot be used.
pub async fn reconcile(config: &Config, dry_run: bool, limit: Duration) -> Result<Reconciled, ServeError> {
    let Some(url) = &config.broker.url else {
        let why = "it is not set; a service without a broker dispatches the jobs of its store when it starts";
        return Err(ServeError::Broker(why.to_owned()));
    };
    let store = Store::open_shared(&config.store, &config.server.data_dir).await?;
    let broker = connect_broker(config, url, &store.secret().await?).await?;
    let end = tokio::time::Instant::now() + limit;
    while let Some(why) = broker.down() {
        if tokio::time::Instant::now() >= end {
            return Err(ServeError::Broker(why));
        }
        tokio::time::sleep(CHECK).await;
    }
    let (records, unreadable) = unfinished_jobs(&store).await?;
    let mut result = Reconciled { unfinished: records.len(), dispatched: 0, unreadable, lost: Vec::new() };
    for record in records {
        let (dispatch, failed) = (Dispatch::of(&record), |error: DispatchError| ServeError::Broker(error.to_string()));
        if broker.holds(&dispatch).await.map_err(failed)? {
            continue;
        }
        if !dry_run {
            result.dispatched += usize::from(broker.dispatch(&dispatch).await.map_err(failed)?);
        }
        let (id, created) = (record.id.to_string(), rfc3339(record.created_ms));
        result.lost.push(LostJob { id, status: record.status.name(), created });
    }
    Ok(result)
}
