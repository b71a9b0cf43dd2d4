//! Search for the next job among the consumers of all lanes.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use async_nats::jetstream::message::AckKind;
use async_nats::{Client as Connection, Subscriber};
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::time::{sleep, timeout};

use super::lease::NatsLease;
use super::{CLASSES, LANES, NatsState, POLL, QUEUES, Queue, REQUEST, RequestKind, lane_and_class};
use crate::jobs::broker::{Claim, Dispatch};
use crate::telemetry::BROKER_REDELIVERIES;

/// Time for which a queue without jobs is not asked again, so that a busy worker asks each queue once a second.
const EMPTY: Duration = Duration::from_secs(1);
/// Time that an idle worker waits before it claims a new job that suits the other kind of workers.
const PRECEDENCE: Duration = Duration::from_millis(5);
/// Every fourth claim from a lane prefers jobs that suit the other kind of workers, so that none starves.
const OTHER_KIND: usize = 4;

/// State of the search for jobs.
pub(super) struct JobSearch {
    /// Time until which each queue is assumed to be empty.
    empty_until: [Instant; QUEUES],
    /// Lane whose turn it is.
    turn: usize,
    /// Number of claims from each lane.
    claims: [usize; LANES],
    /// Announcements of new jobs. Each idle node gets its share.
    announcements: Option<Subscriber>,
}

impl Default for JobSearch {
    fn default() -> Self {
        Self { empty_until: [Instant::now(); QUEUES], turn: 0, claims: [0; LANES], announcements: None }
    }
}

/// Republishes the announcements that arrive before the subscription ends: this node is no longer idle.
async fn pass_on(mut announcements: Subscriber, connection: Connection) {
    drop(announcements.drain().await);
    while let Some(message) = announcements.next().await {
        drop(connection.publish(message.subject, message.payload).await);
    }
}

impl NatsState {
    /// Returns the subject of announcements, whose content is the number of a queue with a new job.
    fn announcement(&self) -> String {
        format!("{}.new", self.config.prefix)
    }

    /// Tells an idle node of each kind that there is a new job.
    pub(super) async fn announce(&self, job: &Dispatch) {
        let (lane, class) = lane_and_class(job);
        let queue = (lane * CLASSES + class).to_string();
        // Idle nodes also look for jobs at intervals.
        drop(self.connection.publish(self.announcement(), queue.into()).await);
    }

    /// Ends the subscription to announcements, which idle nodes have.
    fn leave(&self, search: &mut JobSearch) {
        if let Some(announcements) = search.announcements.take() {
            tokio::spawn(pass_on(announcements, self.connection.clone()));
        }
    }

    /// Ends the search for jobs, and leaves announced ones to other nodes.
    pub(super) fn stop_claiming(self: &Arc<Self>) {
        let state = Arc::clone(self);
        tokio::spawn(async move { state.leave(&mut *state.search.lock().await) });
    }

    /// Waits for a job and claims it, or returns an error of the server.
    pub(super) async fn next(&self, prefers_gpu: bool) -> Result<Claim, String> {
        let mut search = self.search.lock().await;
        let search = &mut *search;
        // Time of the search for an announced job of the other kind.
        let mut due: Option<Instant> = None;
        loop {
            let Some(queues) = self.queues() else {
                // The check of the streams reports why they do not exist.
                sleep(POLL).await;
                continue;
            };
            if let Some(claim) = self.scan(search, &queues, prefers_gpu).await? {
                self.leave(search);
                return Ok(claim);
            }
            let Some(announcements) = &mut search.announcements else {
                // Jobs that are dispatched from now on are announced; earlier ones are found by another search.
                let group = if prefers_gpu { "idle-gpu" } else { "idle" };
                let announcements = self.connection.queue_subscribe(self.announcement(), group.to_owned()).await;
                search.announcements = Some(announcements.map_err(|error| error.to_string())?);
                self.connection.flush().await.map_err(|error| error.to_string())?;
                search.empty_until = [Instant::now(); QUEUES];
                continue;
            };
            loop {
                let wait = due.map_or(POLL, |due| due.saturating_duration_since(Instant::now()));
                match timeout(wait, announcements.next()).await {
                    Ok(Some(message)) => {
                        let queue = std::str::from_utf8(&message.payload).ok().and_then(|text| text.parse().ok());
                        let Some(until) = queue.and_then(|queue: usize| search.empty_until.get_mut(queue)) else {
                            continue;
                        };
                        // As the numbers of classes, those of queues are odd for jobs that suit a GPU.
                        if queue.is_some_and(|queue| queue % 2 == usize::from(prefers_gpu)) {
                            *until = Instant::now();
                            break;
                        }
                        *until = *due.get_or_insert_with(|| Instant::now() + PRECEDENCE);
                    }
                    Ok(None) => {
                        search.announcements = None;
                        break;
                    }
                    // A job of a stopped worker returns without an announcement.
                    Err(_elapsed) if due.take().is_some() || self.queued.load(Ordering::Relaxed) > 0 => break,
                    Err(_elapsed) => {}
                }
            }
        }
    }

    /// Claims the first job of the lane whose turn it is, or of the next lane that has any.
    async fn scan(&self, search: &mut JobSearch, queues: &[Queue], prefers_gpu: bool) -> Result<Option<Claim>, String> {
        for step in 0..LANES {
            let lane = (search.turn + step) % LANES;
            let prefers_gpu = prefers_gpu ^ (search.claims[lane] % OTHER_KIND == OTHER_KIND - 1);
            for class in 0..CLASSES {
                let number = lane * CLASSES + (class ^ usize::from(prefers_gpu));
                if search.empty_until[number] > Instant::now() {
                    continue;
                }
                let claim = self.fetch(&queues[number]).await?;
                self.set_failure(RequestKind::Claim, None);
                if let Some(claim) = claim {
                    search.turn = lane + 1;
                    search.claims[lane] += 1;
                    return Ok(Some(claim));
                }
                search.empty_until[number] = Instant::now() + EMPTY;
            }
        }
        Ok(None)
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
