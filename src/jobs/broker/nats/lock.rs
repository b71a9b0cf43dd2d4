//! Locks of work: one message per work in a stream, which expires unless it is written again.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use async_nats::jetstream::Context;
use async_nats::jetstream::context::PublishErrorKind;
use async_nats::jetstream::message::PublishMessage;
use async_nats::jetstream::stream::{Config, StorageType};
use tokio::time::sleep;

use super::NatsState;
use crate::jobs::broker::WorkLock;
use crate::store::Digest;

/// Writes the message of a lock if the last one is `last`, 0 for none, and returns its sequence number.
async fn write(context: &Context, subject: &str, last: u64) -> Result<u64, PublishErrorKind> {
    let message = PublishMessage::build().expected_last_subject_sequence(last);
    let sent = context.send_publish(subject.to_owned(), message).await.map_err(|error| error.kind())?;
    Ok(sent.await.map_err(|error| error.kind())?.sequence)
}

impl NatsState {
    /// Returns the name of the stream of locks.
    pub(super) fn locks(&self) -> String {
        format!("{}-work", self.config.prefix)
    }

    /// Returns the configuration of the stream of locks. It need not survive the server.
    pub(super) fn lock_stream(&self) -> Config {
        Config {
            name: self.locks(),
            subjects: vec![format!("{}.work.*", self.config.prefix)],
            max_age: Duration::from_millis(self.config.lease_ms),
            max_messages_per_subject: 1,
            storage: StorageType::Memory,
            num_replicas: self.config.replicas,
            ..Config::default()
        }
    }

    /// Locks work; see [`Broker::lock`](crate::jobs::broker::Broker::lock).
    pub(super) async fn lock_work(&self, work: &Digest) -> Option<WorkLock> {
        let subject = format!("{}.work.{work}", self.config.prefix);
        let first = match write(&self.context, &subject, 0).await {
            Ok(first) => first,
            Err(PublishErrorKind::WrongLastSequence) => return None,
            Err(kind) => {
                tracing::debug!(%kind, "work is not locked");
                return Some(WorkLock::new(|| {}));
            }
        };
        let (context, interval) = (self.context.clone(), Duration::from_millis(self.config.lease_ms / 3));
        let last = Arc::new(AtomicU64::new(first));
        let written = Arc::clone(&last);
        let extend = tokio::spawn(async move {
            loop {
                sleep(interval).await;
                match write(&context, &subject, written.load(Ordering::Acquire)).await {
                    Ok(sequence) => written.store(sequence, Ordering::Release),
                    // The lock had expired, and another node has it.
                    Err(PublishErrorKind::WrongLastSequence) => return,
                    Err(kind) => tracing::debug!(%kind, "the lock of some work was not extended"),
                }
            }
        });
        let (extend, context, stream) = (extend.abort_handle(), self.context.clone(), self.locks());
        let endings = self.endings.clone();
        Some(WorkLock::new(move || {
            extend.abort();
            endings.send(async move {
                let Ok(stream) = context.get_stream_no_info(stream).await else { return };
                if let Err(error) = stream.delete_message(last.load(Ordering::Acquire)).await {
                    tracing::debug!(%error, "the lock of some work ends when it expires");
                }
            });
        }))
    }
}
