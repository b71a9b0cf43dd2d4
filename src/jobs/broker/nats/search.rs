//! Search for the next job among the consumers of all lanes.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use async_nats::Subscriber;
use async_nats::jetstream::message::AckKind;
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::time::{sleep, timeout};

use super::lease::NatsLease;
use super::{CLASSES, LANES, NatsState, POLL, QUEUES, Queue, REQUEST};
use crate::jobs::broker::Claim;
use crate::telemetry::BROKER_REDELIVERIES;

/// Time for which a queue without jobs is not asked again, so that a busy worker asks each queue once a second.
const EMPTY: Duration = Duration::from_secs(1);
/// Number of searches after an announcement whose job is not found, and the pause before the first one, which doubles.
const RETRIES: u32 = 5;
const FIRST_RETRY: Duration = Duration::from_millis(2);

/// Time for which idle workers leave a new job to those that it suits.
const PRECEDENCE: Duration = Duration::from_millis(20);

/// Returns true if the jobs of a class suit a GPU.
const fn suits_gpu(class: usize) -> bool {
    class % 2 == 1
}

/// State of the search for jobs.
pub(super) struct JobSearch {
    /// Time until which each queue is assumed to be empty.
    empty_until: [Instant; QUEUES],
    /// Lane whose turn it is.
    turn: usize,
    /// Announcements of new jobs. Each idle node gets its share.
    announcements: Option<Subscriber>,
}

impl Default for JobSearch {
    fn default() -> Self {
        Self { empty_until: [Instant::now(); QUEUES], turn: 0, announcements: None }
    }
}

impl NatsState {
    /// Waits for a job and claims it, or returns an error of the server.
    pub(super) async fn next(&self, prefers_gpu: bool) -> Result<Claim, String> {
        let mut search = self.search.lock().await;
        let search = &mut *search;
        let mut retries = 0;
        loop {
            let queues = self.queues().ok_or("the stream does not exist yet")?;
            let before = search.empty_until;
            if let Some(claim) = self.scan(search, &queues, prefers_gpu).await? {
                search.announcements = None;
                return Ok(claim);
            }
            if retries > 0 {
                // An announcement may arrive before its job is in the stream.
                sleep(FIRST_RETRY * (1 << (RETRIES - retries))).await;
                (retries, search.empty_until) = (retries - 1, before);
                continue;
            }
            let Some(announcements) = &mut search.announcements else {
                // Jobs that are dispatched from now on are announced; earlier ones are found by another search.
                let all = format!("{}.jobs.>", self.config.prefix);
                let group = if prefers_gpu { "idle-gpu" } else { "idle" };
                let announcements = self.connection.queue_subscribe(all, group.to_owned()).await;
                search.announcements = Some(announcements.map_err(|error| error.to_string())?);
                self.connection.flush().await.map_err(|error| error.to_string())?;
                search.empty_until = [Instant::now(); QUEUES];
                continue;
            };
            let announced = loop {
                match timeout(POLL, announcements.next()).await {
                    Ok(announced) => break Some(announced),
                    // A job of a stopped worker returns without an announcement.
                    Err(_elapsed) if self.queued.load(Ordering::Relaxed) > 0 => break None,
                    Err(_elapsed) => {}
                }
            };
            let message = match announced {
                None => continue,
                Some(None) => {
                    search.announcements = None;
                    continue;
                }
                Some(Some(message)) => message,
            };
            let mut parts = message.subject.as_str().rsplit('.').skip(1);
            let mut number = || parts.next()?.parse::<usize>().ok();
            if let Some((class, lane)) = number().zip(number())
                && let Some(until) = search.empty_until.get_mut(lane * CLASSES * 2 + class)
            {
                *until = Instant::now();
                retries = RETRIES;
                if suits_gpu(class) != prefers_gpu {
                    sleep(PRECEDENCE).await;
                }
            }
        }
    }

    /// Claims the first job of the lane whose turn it is, or of the next lane that has any.
    async fn scan(&self, search: &mut JobSearch, queues: &[Queue], prefers_gpu: bool) -> Result<Option<Claim>, String> {
        for step in 0..LANES {
            let lane = (search.turn + step) % LANES;
            let numbers = (0..CLASSES * 2).map(|class| lane * CLASSES * 2 + (class ^ usize::from(prefers_gpu)));
            for number in numbers {
                if search.empty_until[number] > Instant::now() {
                    continue;
                }
                if let Some(claim) = self.fetch(&queues[number]).await? {
                    search.turn = lane + 1;
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
        Ok(Some(Claim::new(id, NatsLease::start(acker, Duration::from_millis(self.config.lease_ms / 3)))))
    }
}
