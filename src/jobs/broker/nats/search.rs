//! Search for the next job: asks the queues in order, then waits for the announcement of a new job.

use std::sync::atomic::Ordering;
use std::time::Duration;

use async_nats::jetstream::message::AckKind;
use async_nats::{Client as Connection, Subscriber};
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::time::{sleep, timeout};

use super::lease::NatsLease;
use super::{NatsState, POLL, Queue, REQUEST, RequestKind, lock};
use crate::jobs::broker::order::{QUEUES, suits_gpu};
use crate::jobs::broker::{Claim, Dispatch};
use crate::telemetry::BROKER_REDELIVERIES;

/// Time that an idle worker waits before it claims a new job that suits the other kind of workers.
const PRECEDENCE: Duration = Duration::from_millis(5);

/// Republishes the announcements that arrive before the subscription ends: this node is no longer idle.
async fn pass_on(mut announcements: Subscriber, connection: Connection) {
    drop(announcements.drain().await);
    while let Some(message) = announcements.next().await {
        drop(connection.publish(message.subject, message.payload).await);
    }
}

impl NatsState {
    /// Returns the subject of announcements, whose content is the name of a queue with a new job.
    fn announcement(&self) -> String {
        format!("{}.new", self.config.prefix)
    }

    /// Tells an idle node of each kind that there is a new job.
    pub(super) async fn announce(&self, job: &Dispatch) {
        // Idle nodes also look for jobs at intervals.
        drop(self.connection.publish(self.announcement(), QUEUES[job.queue()].into()).await);
    }

    /// Waits for a job and claims it, or returns an error of the server. `None` if there are no queues.
    pub(super) async fn search(&self, prefers_gpu: bool) -> Result<Option<Claim>, String> {
        // Jobs that are dispatched from now on are announced; earlier ones are found in the queues.
        let group = if prefers_gpu { "idle-gpu" } else { "idle-cpu" };
        let announcements = self.connection.queue_subscribe(self.announcement(), group.to_owned()).await;
        let mut announcements = announcements.map_err(|error| error.to_string())?;
        let mut asked = lock(&self.order).next(prefers_gpu).to_vec();
        while let Some(queues) = self.queues() {
            for queue in asked {
                let claim = self.fetch(&queues[queue]).await?;
                self.set_failure(RequestKind::Claim, None);
                if claim.is_some() {
                    lock(&self.order).claimed(queue);
                    tokio::spawn(pass_on(announcements, self.connection.clone()));
                    return Ok(claim);
                }
            }
            asked = self.announced(&mut announcements, prefers_gpu).await?;
        }
        Ok(None)
    }

    /// Waits until there may be a job. Returns the numbers of the queues to be asked.
    async fn announced(&self, announcements: &mut Subscriber, prefers_gpu: bool) -> Result<Vec<usize>, String> {
        loop {
            match timeout(POLL, announcements.next()).await {
                Ok(Some(message)) => {
                    let queue = QUEUES.iter().position(|name| message.payload == name.as_bytes());
                    let Some(queue) = queue else { continue };
                    if suits_gpu(queue) != prefers_gpu {
                        sleep(PRECEDENCE).await;
                    }
                    return Ok(vec![queue]);
                }
                Ok(None) => return Err("the connection is closed".to_owned()),
                // A job of a stopped worker returns without an announcement.
                Err(_elapsed) if self.queued.load(Ordering::Relaxed) > 0 => {
                    return Ok(lock(&self.order).next(prefers_gpu).to_vec());
                }
                Err(_elapsed) => {}
            }
        }
    }

    /// Claims the first job of a queue.
    async fn fetch(&self, queue: &Queue) -> Result<Option<Claim>, String> {
        let fetched = async {
            let mut messages = queue.fetch().max_messages(1).messages().await.map_err(|error| error.to_string())?;
            messages.next().await.transpose().map_err(|error| error.to_string())
        };
        let fetched =
            timeout(REQUEST, fetched).await.map_err(|_elapsed| "no answer to a request for jobs".to_owned())??;
        let Some(message) = fetched else { return Ok(None) };
        if message.info().is_ok_and(|info| info.delivered > 1) {
            counter!(BROKER_REDELIVERIES).increment(1);
        }
        let (message, acker) = message.split();
        let id = message.subject.as_str().rsplit('.').next().and_then(|id| id.parse().ok());
        let Some(id) = id else {
            // A message of another program.
            drop(acker.ack_with(AckKind::Term).await);
            return Ok(None);
        };
        let interval = Duration::from_millis(self.config.lease_ms / 3);
        Ok(Some(Claim::new(id, NatsLease::start(acker, interval, self.endings.clone()))))
    }
}
