//! Rate-limited, time-bounded health check of the store.

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;

use crate::config::StoreConfig;
use crate::store::{Store, StoreError};

/// Maximum wait for a running check. Probes of orchestrators commonly time out after a second.
const MAX_WAIT: Duration = Duration::from_millis(500);
/// Time after which a check fails. A busy disk takes seconds, and load must not make the service unready.
const CHECK_TIMEOUT: Duration = Duration::from_secs(10);

/// Health check of the store. Clones share one state.
#[derive(Debug, Clone)]
pub(super) struct StoreHealth(watch::Sender<Verdict>);

#[derive(Debug, Clone)]
struct Verdict {
    /// End of the last check.
    at: Instant,
    /// Public reason of a failure.
    failed: Option<&'static str>,
    /// Start of the running check.
    begun: Option<Instant>,
}

impl Verdict {
    /// Returns the reason of a failure; `None` if the store works. A check that takes too long has failed.
    fn failure(&self) -> Option<&'static str> {
        let silent = self.begun.is_some_and(|begun| begun.elapsed() >= CHECK_TIMEOUT);
        if silent { Some("it does not answer") } else { self.failed }
    }
}

impl StoreHealth {
    /// Creates the check of a store that was just opened, and so works.
    pub(super) fn new() -> Self {
        Self(watch::channel(Verdict { at: Instant::now(), failed: None, begun: None }).0)
    }

    /// Returns the reason of a failure; `None` if the store works.
    pub(super) async fn failure(&self, store: &Store, config: &StoreConfig) -> Option<&'static str> {
        let mut verdict = self.0.subscribe();
        if verdict.borrow_and_update().at.elapsed() >= Duration::from_millis(config.check_interval_ms) {
            let mine = self
                .0
                .send_if_modified(|verdict| verdict.begun.is_none() && verdict.begun.replace(Instant::now()).is_none());
            verdict.mark_unchanged();
            if mine {
                let (health, store) = (self.clone(), store.clone());
                tokio::spawn(async move {
                    let outcome = store.check().await;
                    health.conclude(store.location(), &outcome);
                });
            }
            drop(tokio::time::timeout(MAX_WAIT, verdict.wait_for(|verdict| verdict.begun.is_none())).await);
        }
        verdict.borrow().failure()
    }

    fn conclude(&self, location: &str, outcome: &Result<(), StoreError>) {
        let failed = outcome.as_ref().err().map(|error| match error {
            StoreError::NoSpace { .. } => "no space is left",
            StoreError::Denied { .. } => "writing is not permitted",
            _ => "it cannot be written or read; the log gives the reason",
        });
        self.0.send_modify(|verdict| {
            match (outcome, verdict.failed) {
                (Err(error), None) => tracing::error!(%error, "the store has failed: not ready"),
                (Ok(()), Some(_)) => tracing::info!(location, "the store works again"),
                _ => {}
            }
            *verdict = Verdict { at: Instant::now(), failed, begun: None };
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_check_fails_after_its_timeout() {
        let verdict = |failed, begun| Verdict { at: Instant::now(), failed, begun };
        let now = Instant::now();
        assert_eq!(verdict(None, None).failure(), None);
        assert_eq!(verdict(None, Some(now)).failure(), None);
        assert_eq!(verdict(Some("full"), Some(now)).failure(), Some("full"));
        assert_eq!(verdict(None, now.checked_sub(CHECK_TIMEOUT)).failure(), Some("it does not answer"));
    }
}
