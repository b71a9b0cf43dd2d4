//! Claim of a message, which its node extends.

use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream::message::{AckKind, Acker};
use futures_util::future::BoxFuture;
use tokio::task::AbortHandle;
use tokio::time::sleep;

use super::endings::Endings;
use crate::jobs::broker::Lease;

/// Claim of a message, which is extended until the lease is dropped.
pub(super) struct NatsLease {
    acker: Arc<Acker>,
    extend: AbortHandle,
    endings: Endings,
}

impl NatsLease {
    /// Extends the claim of a message at regular intervals.
    pub(super) fn start(acker: Acker, interval: Duration, endings: Endings) -> Self {
        let acker = Arc::new(acker);
        let extended = Arc::clone(&acker);
        let extend = tokio::spawn(async move {
            loop {
                sleep(interval).await;
                if let Err(error) = extended.ack_with(AckKind::Progress).await {
                    tracing::debug!(%error, "the claim of a job was not extended");
                }
            }
        });
        Self { acker, extend: extend.abort_handle(), endings }
    }
}

impl Drop for NatsLease {
    fn drop(&mut self) {
        self.extend.abort();
    }
}

impl Lease for NatsLease {
    fn done(self: Box<Self>) -> BoxFuture<'static, ()> {
        Box::pin(async move {
            // A job whose message stays is claimed once more, and found ended.
            if let Err(error) = self.acker.double_ack().await {
                tracing::debug!(%error, "the end of a claim was not acknowledged");
            }
        })
    }

    fn abandon(self: Box<Self>) {
        // Acknowledging would remove the message of the other claim.
    }

    fn release(self: Box<Self>, delay: Duration) {
        let endings = self.endings.clone();
        endings.send(async move {
            if let Err(error) = self.acker.ack_with(AckKind::Nak(Some(delay))).await {
                tracing::debug!(%error, "a job returns to the queue when its claim expires");
            }
        });
    }
}
