//! Whether the store works: asked no more often than it is worth, and never waited for for long.

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;

use super::state::Shared;
use crate::store::StoreError;

/// How long a question waits for a probe that runs; probes of orchestrators commonly wait for a second.
const PATIENCE: Duration = Duration::from_millis(500);

/// What is known of the store.
#[derive(Debug)]
pub(super) struct Probe(watch::Sender<Verdict>);

#[derive(Debug, Clone)]
struct Verdict {
    /// When the last probe ended.
    at: Instant,
    /// Why it failed, in words for everybody.
    failed: Option<&'static str>,
    /// When the probe that runs began.
    begun: Option<Instant>,
}

impl Verdict {
    /// Why the store does not work, if a probe may take `limit`.
    fn failure(&self, limit: Duration) -> Option<&'static str> {
        let silent = self.begun.is_some_and(|begun| begun.elapsed() >= limit);
        if silent { Some("it does not answer") } else { self.failed }
    }
}

impl Probe {
    /// A store that has just been opened, which is a probe.
    pub(super) fn new() -> Self {
        Self(watch::channel(Verdict { at: Instant::now(), failed: None, begun: None }).0)
    }

    /// Why the store does not work; none if it does. A probe that takes long changes nothing until it has taken
    /// `store.probe_timeout_ms`: a busy disk is no broken one.
    pub(super) async fn failure(&self, app: &Shared) -> Option<&'static str> {
        let config = &app.config.store;
        let mut verdict = self.0.subscribe();
        if verdict.borrow_and_update().at.elapsed() >= config.probe() {
            let mine = self
                .0
                .send_if_modified(|verdict| verdict.begun.is_none() && verdict.begun.replace(Instant::now()).is_none());
            verdict.mark_unchanged();
            if mine {
                let app = app.clone();
                tokio::spawn(async move {
                    let outcome = app.store.probe().await;
                    app.probe.conclude(app.store.place(), &outcome);
                });
            }
            drop(tokio::time::timeout(PATIENCE, verdict.wait_for(|verdict| verdict.begun.is_none())).await);
        }
        verdict.borrow().failure(config.probe_timeout())
    }

    fn conclude(&self, place: &str, outcome: &Result<(), StoreError>) {
        let failed = outcome.as_ref().err().map(|error| match error {
            StoreError::NoSpace { .. } => "there is no space left",
            StoreError::Denied { .. } => "writing is not permitted",
            _ => "it cannot be written or read; the log says why",
        });
        self.0.send_modify(|verdict| {
            match (outcome, verdict.failed) {
                (Err(error), None) => tracing::error!(%error, "the store has stopped working: not ready"),
                (Ok(()), Some(_)) => tracing::info!(place, "the store works again"),
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
    fn a_slow_probe_changes_nothing_until_its_time_is_up() {
        let hour = Duration::from_hours(1);
        let verdict = |failed, begun| Verdict { at: Instant::now(), failed, begun };
        let now = Some(Instant::now());
        assert_eq!(verdict(None, None).failure(Duration::ZERO), None);
        assert_eq!(verdict(None, now).failure(hour), None);
        assert_eq!(verdict(Some("full"), now).failure(hour), Some("full"));
        assert_eq!(verdict(None, now).failure(Duration::ZERO), Some("it does not answer"));
    }
}
