//! Claim of a message, which its node extends.

use std::sync::Arc;
use std::time::Duration;

use async_nats::jetstream::message::{AckKind, Acker};
use futures_util::future::BoxFuture;
use tokio::task::JoinSet;
use tokio::time::sleep;

use super::endings::Endings;
use crate::jobs::broker::ClaimEnd;

/// Extends the claim of a message at regular intervals. Returns the function that ends the claim.
pub(super) fn extend(
    acker: Acker,
    interval: Duration,
    endings: Endings,
) -> impl FnOnce(ClaimEnd) -> BoxFuture<'static, ()> + Send + Sync {
    let acker = Arc::new(acker);
    let extended = Arc::clone(&acker);
    // Dropping the set ends its task.
    let mut extension = JoinSet::new();
    extension.spawn(async move {
        loop {
            sleep(interval).await;
            if let Err(error) = extended.ack_with(AckKind::Progress).await {
                tracing::debug!(%error, "the claim of a job was not extended");
            }
        }
    });
    move |end| {
        match end {
            ClaimEnd::Done => {
                return Box::pin(async move {
                    // A job whose message stays is claimed once more, and found ended.
                    if let Err(error) = acker.double_ack().await {
                        tracing::debug!(%error, "the end of a claim was not acknowledged");
                    }
                    drop(extension);
                });
            }
            ClaimEnd::Release(delay) => endings.send(async move {
                if let Err(error) = acker.ack_with(AckKind::Nak(Some(delay))).await {
                    tracing::debug!(%error, "a job returns to the queue when its claim expires");
                }
                drop(extension);
            }),
            // Acknowledging would remove the message of the other claim.
            ClaimEnd::Abandon => {}
        }
        Box::pin(std::future::ready(()))
    }
}
