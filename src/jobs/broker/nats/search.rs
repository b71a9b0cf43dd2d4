//! Search for the next job: asks the queues in order, then waits for the announcement of a new job.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use async_nats::jetstream::message::AckKind;
use async_nats::{Client as Connection, HeaderMap, Message, Subscriber};
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::time::{Instant, timeout, timeout_at};

use super::{NatsState, POLL, Queue, REQUEST, RequestKind, lease, lock};
use crate::jobs::broker::order::{QUEUES, suits_gpu};
use crate::jobs::broker::{Claim, Dispatch};
use crate::telemetry::BROKER_REDELIVERIES;

/// Time that an idle worker waits before it claims a new job that suits the other kind of workers.
const PRECEDENCE: Duration = Duration::from_millis(5);
/// Header of an announcement that a node has passed on.
const PASSED_ON: &str = "Passed-On";

/// Republishes the announcements that arrive before the subscription ends: this node is no longer idle. Those with a
/// header were passed on already. Thus a job has at most four announcements, however many nodes there are. A node that
/// stops passes on none: another idle node counts the jobs within [`POLL`], and looks for them at its next interval.
async fn pass_on(mut announcements: Subscriber, connection: Connection) {
    let mut headers = HeaderMap::new();
    headers.insert(PASSED_ON, "true");
    drop(announcements.drain().await);
    while let Some(message) = announcements.next().await {
        if message.headers.is_none() {
            drop(connection.publish_with_headers(message.subject, headers.clone(), message.payload).await);
        }
    }
}

/// Returns the number of the queue that an announcement names.
fn announced_queue(message: &Message) -> Option<usize> {
    QUEUES.iter().position(|name| message.payload == name.as_bytes())
}

impl NatsState {
    /// Returns the subject of announcements to workers of a kind, whose content is the name of a queue with a new job.
    /// Each kind has its own: a node that passes an announcement on must not send it to both kinds again.
    fn announcement(&self, to_gpu: bool) -> String {
        format!("{}.new.{}", self.config.prefix, if to_gpu { "gpu" } else { "cpu" })
    }

    /// Tells an idle node of each kind that there is a new job.
    pub(super) async fn announce(&self, job: &Dispatch) {
        for to_gpu in [false, true] {
            // Idle nodes also look for jobs at intervals.
            drop(self.connection.publish(self.announcement(to_gpu), QUEUES[job.queue()].into()).await);
        }
    }

    /// Notes the jobs that any node announces, until the broker is dropped: a busy node also asks their queues again.
    pub(super) async fn hear(self: &Arc<Self>) -> Result<(), String> {
        // Each job is announced to both kinds of workers.
        let heard = self.connection.subscribe(self.announcement(false)).await;
        let (mut heard, broker) = (heard.map_err(|error| error.to_string())?, Arc::downgrade(self));
        tokio::spawn(async move {
            loop {
                let next = timeout(POLL, heard.next()).await;
                let Some(state) = broker.upgrade() else { return };
                match next.map(|message| message.as_ref().map(announced_queue)) {
                    Ok(Some(Some(queue))) => lock(&state.empty).note_job(queue, Instant::now()),
                    Ok(Some(None)) | Err(_) => {}
                    Ok(None) => return,
                }
            }
        });
        Ok(())
    }

    /// Subscribes an idle node to announcements, of which each idle node of its kind gets a part.
    async fn announcements(&self, prefers_gpu: bool) -> Result<Subscriber, String> {
        let announcements = self.connection.queue_subscribe(self.announcement(prefers_gpu), "idle".to_owned()).await;
        announcements.map_err(|error| error.to_string())
    }

    /// Waits for a job and claims it, or returns an error of the server. `None` if there are no queues.
    pub(super) async fn search(&self, prefers_gpu: bool) -> Result<Option<Claim>, String> {
        // A busy node finds jobs in the queues. It does not join those that share announcements and must pass them on.
        let mut announcements = None;
        let mut poll = Instant::now() + POLL;
        let mut asked = lock(&self.order).next(prefers_gpu).to_vec();
        asked.retain(|queue| !lock(&self.empty).contains(*queue, Instant::now()));
        while let Some(queues) = self.queues() {
            for queue in asked {
                let begun = Instant::now();
                let claim = self.fetch(&queues[queue]).await?;
                self.set_failure(RequestKind::Claim, None);
                if claim.is_some() {
                    lock(&self.order).claimed(queue);
                    if let Some(announcements) = announcements {
                        tokio::spawn(pass_on(announcements, self.connection.clone()));
                    }
                    return Ok(claim);
                }
                lock(&self.empty).note_empty(queue, begun);
            }
            asked = if let Some(announcements) = &mut announcements {
                self.announced(announcements, prefers_gpu, &mut poll).await?
            } else {
                // Jobs that are dispatched from now on are announced; earlier ones are found in the queues.
                announcements = Some(self.announcements(prefers_gpu).await?);
                lock(&self.order).next(prefers_gpu).to_vec()
            };
        }
        Ok(None)
    }

    /// Waits until there may be a job. Returns the numbers of the queues to be asked: at `poll`, which then becomes the
    /// next such time, all of them, otherwise those with an announced job.
    async fn announced(
        &self,
        announcements: &mut Subscriber,
        prefers_gpu: bool,
        poll: &mut Instant,
    ) -> Result<Vec<usize>, String> {
        // Queues of new jobs that suit the other kind of workers.
        let mut unsuited = Vec::new();
        let mut end = *poll;
        loop {
            // A timeout alone would not end while messages arrive.
            let message = if Instant::now() < end { timeout_at(end, announcements.next()).await.ok() } else { None };
            match message {
                Some(Some(message)) => {
                    let queue = announced_queue(&message).filter(|queue| !unsuited.contains(queue));
                    let Some(queue) = queue else { continue };
                    if suits_gpu(queue) == prefers_gpu {
                        unsuited.insert(0, queue);
                        return Ok(unsuited);
                    }
                    if unsuited.is_empty() {
                        end = Instant::now() + PRECEDENCE;
                    }
                    unsuited.push(queue);
                }
                Some(None) => return Err("the connection is closed".to_owned()),
                None if !unsuited.is_empty() => return Ok(unsuited),
                None => {
                    *poll = Instant::now() + POLL;
                    // A job of a stopped worker returns without an announcement.
                    if self.queued.load(Ordering::Relaxed) > 0 {
                        return Ok(lock(&self.order).next(prefers_gpu).to_vec());
                    }
                    end = *poll;
                }
            }
        }
    }

    /// Claims the first job of a queue, and removes messages of other programs before it.
    async fn fetch(&self, queue: &Queue) -> Result<Option<Claim>, String> {
        loop {
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
            if let Some(id) = message.subject.as_str().rsplit('.').next().and_then(|id| id.parse().ok()) {
                let interval = Duration::from_millis(self.config.lease_ms / 3);
                return Ok(Some(Claim::new(id, lease::extend(acker, interval, self.endings.clone()))));
            }
            drop(acker.ack_with(AckKind::Term).await);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::broker::tests::on_nats;

    #[tokio::test]
    async fn an_announcement_is_passed_on_once() {
        on_nats(async |server| {
            let connection = async_nats::connect(server.address()).await.unwrap();
            let mut passed_on = HeaderMap::new();
            passed_on.insert(PASSED_ON, "true");
            for (headers, expected) in [(None, 1), (Some(passed_on), 0)] {
                let received = connection.subscribe("announcements").await.unwrap();
                let mut observed = connection.subscribe("announcements").await.unwrap();
                if let Some(headers) = headers {
                    connection.publish_with_headers("announcements", headers, "job".into()).await.unwrap();
                } else {
                    connection.publish("announcements", "job".into()).await.unwrap();
                }
                assert_eq!(observed.next().await.unwrap().payload.as_ref(), b"job");
                pass_on(received, connection.clone()).await;
                connection.publish("announcements", "end".into()).await.unwrap();
                let mut n = 0;
                while observed.next().await.unwrap().payload.as_ref() != b"end" {
                    n += 1;
                }
                assert_eq!(n, expected);
            }
        })
        .await;
    }
}
