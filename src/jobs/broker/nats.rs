//! Broker over NATS JetStream, for the nodes of a cluster.
//!
//! Queued and claimed jobs are the messages of a stream with one subject per job, `PREFIX.jobs.LANE.CLASS.ID`: the
//! stream rejects a second message with a subject, and an acknowledged message is removed. Each client belongs to a
//! lane, by its number. Lanes take turns, so a client with many jobs delays those of other lanes by one job only.
//! Within a lane, a class of higher urgency precedes the others. Events of jobs are plain messages, which may be lost.
//!
//! Uses only what servers from version 2.9 on offer.

mod lease;
mod lock;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_nats::connection::State;
use async_nats::jetstream::consumer::{AckPolicy, Consumer, pull};
use async_nats::jetstream::context::PublishErrorKind;
use async_nats::jetstream::message::{AckKind, PublishMessage};
use async_nats::jetstream::stream::{Config as StreamConfig, DiscardPolicy, RetentionPolicy};
use async_nats::jetstream::{Context, ContextBuilder};
use async_nats::{Client as Connection, ConnectOptions, Event, Subscriber};
use futures_util::future::BoxFuture;
use futures_util::stream::{self, BoxStream, StreamExt as _};
use metrics::{counter, gauge};
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::{sleep, timeout};

use lease::NatsLease;

use super::{Broker, Claim, Dispatch, DispatchError, JobEvent, WorkLock};
use crate::config::BrokerConfig;
use crate::jobs::record::JobId;
use crate::store::Digest;
use crate::telemetry::{BROKER_QUEUED, BROKER_REDELIVERIES, BROKER_UP};

/// Number of lanes. Clients share them by the remainder of their numbers.
const LANES: usize = 8;
/// Most urgent class of each urgency from 0 to 7: urgent, normal, background.
const CLASS: [usize; 8] = [0, 0, 0, 1, 2, 2, 2, 2];
/// Number of classes.
const CLASSES: usize = 3;
/// Time limit of a request to the server.
const REQUEST: Duration = Duration::from_secs(5);
/// Interval at which the server is asked for the number of jobs, and idle workers look for jobs.
const POLL: Duration = Duration::from_secs(1);

/// Consumer of one lane and class.
type Queue = Consumer<pull::Config>;

/// State of the search for jobs.
struct JobSearch {
    /// Queues that may have jobs.
    filled: [bool; LANES * CLASSES],
    /// Lane whose turn it is.
    turn: usize,
    /// Announcements of new jobs. Each idle node gets its share.
    announcements: Option<Subscriber>,
}

struct NatsState {
    connection: Connection,
    context: Context,
    config: BrokerConfig,
    /// Queues by lane and class; `None` until they exist.
    queues: Mutex<Option<Arc<[Queue]>>>,
    search: AsyncMutex<JobSearch>,
    /// Number of jobs in the stream when it was last asked.
    queued: AtomicUsize,
    /// Number of lost connections.
    losses: Arc<AtomicUsize>,
    /// Number of lost connections when the server was last asked.
    checked: AtomicUsize,
    /// Reason for which the last request failed.
    down: Mutex<Option<String>>,
}

/// Broker over NATS. Clones share one connection.
#[derive(Clone)]
pub(crate) struct NatsBroker(Arc<NatsState>);

impl NatsBroker {
    /// Connects to the server of the configuration. Does not wait until it answers.
    ///
    /// # Errors
    /// Returns the reason if an address or the credentials are malformed.
    pub(crate) async fn connect(config: &BrokerConfig, url: &str) -> Result<Self, String> {
        crate::tls::install_provider();
        let losses = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&losses);
        let mut options = ConnectOptions::new()
            .name("molmesh")
            .retry_on_initial_connect()
            .connection_timeout(REQUEST)
            .ping_interval(REQUEST)
            .event_callback(move |event| {
                // What was known of the server may have changed.
                if event == Event::Disconnected {
                    counted.fetch_add(1, Ordering::AcqRel);
                }
                std::future::ready(())
            })
            .reconnect_delay_callback(|attempts| Duration::from_millis(100 * (attempts as u64).clamp(1, 10)));
        if let (Some(user), Some(password)) = (&config.user, &config.password) {
            options = options.user_and_password(user.clone(), password.reveal().to_owned());
        }
        let addresses: Vec<_> = url.split(',').map(str::trim).collect();
        let connection = options.connect(addresses).await.map_err(|error| error.to_string())?;
        let context = ContextBuilder::new().timeout(REQUEST).ack_timeout(REQUEST).build(connection.clone());
        let broker = Self(Arc::new(NatsState {
            connection,
            context,
            config: config.clone(),
            queues: Mutex::new(None),
            search: AsyncMutex::new(JobSearch { filled: [true; LANES * CLASSES], turn: 0, announcements: None }),
            queued: AtomicUsize::new(0),
            losses,
            checked: AtomicUsize::new(usize::MAX),
            down: Mutex::new(None),
        }));
        tokio::spawn(watch(Arc::downgrade(&broker.0)));
        Ok(broker)
    }
}

/// Asks the server for the number of jobs at regular intervals, and creates stream and queues if they are missing.
async fn watch(broker: std::sync::Weak<NatsState>) {
    loop {
        let Some(state) = broker.upgrade() else { return };
        let losses = state.losses.load(Ordering::Acquire);
        let asked =
            timeout(REQUEST, state.check_streams()).await.unwrap_or_else(|_elapsed| Err("no answer".to_owned()));
        gauge!(BROKER_UP).set(f64::from(u8::from(asked.is_ok())));
        state.set_unavailable(asked.err());
        state.checked.store(losses, Ordering::Release);
        drop(state);
        sleep(POLL).await;
    }
}

impl NatsState {
    fn stream(&self) -> String {
        format!("{}-jobs", self.config.prefix)
    }

    fn set_unavailable(&self, why: Option<String>) {
        let mut down = self.down.lock().unwrap_or_else(PoisonError::into_inner);
        match (&*down, &why) {
            (None, Some(why)) => tracing::warn!(why, "the broker does not answer"),
            (Some(_), None) => tracing::info!("the broker answers"),
            _ => {}
        }
        *down = why;
    }

    /// Updates the number of jobs. Creates streams and consumers if they are missing.
    async fn check_streams(&self) -> Result<(), String> {
        let found = self.context.get_stream(self.stream()).await;
        let has_locks = self.context.get_stream(self.locks()).await.is_ok();
        let jobs = match found {
            Ok(stream) if self.queues().is_some() && has_locks => stream.cached_info().state.messages,
            _ => self.create().await?,
        };
        let jobs = usize::try_from(jobs).unwrap_or(usize::MAX);
        self.queued.store(jobs, Ordering::Relaxed);
        gauge!(BROKER_QUEUED).set(u32::try_from(jobs).unwrap_or(u32::MAX));
        Ok(())
    }

    /// Creates stream and queues, or updates their settings. Returns the number of jobs.
    async fn create(&self) -> Result<u64, String> {
        let config = StreamConfig {
            name: self.stream(),
            subjects: vec![format!("{}.jobs.>", self.config.prefix)],
            retention: RetentionPolicy::WorkQueue,
            discard: DiscardPolicy::New,
            max_messages: i64::try_from(self.config.queue).unwrap_or(i64::MAX),
            max_messages_per_subject: 1,
            num_replicas: self.config.replicas,
            ..StreamConfig::default()
        };
        let info = self.context.create_or_update_stream(config).await.map_err(|error| error.to_string())?;
        self.context.create_or_update_stream(self.lock_stream()).await.map_err(|error| error.to_string())?;
        let mut queues = Vec::new();
        for lane in 0..LANES {
            for class in 0..CLASSES {
                let config = pull::Config {
                    durable_name: Some(format!("lane-{lane}-{class}")),
                    filter_subject: format!("{}.jobs.{lane}.{class}.*", self.config.prefix),
                    ack_policy: AckPolicy::Explicit,
                    ack_wait: Duration::from_millis(self.config.lease_ms),
                    max_ack_pending: i64::from(u32::MAX),
                    ..pull::Config::default()
                };
                let queue = self.context.create_consumer_on_stream(config, self.stream()).await;
                queues.push(queue.map_err(|error| error.to_string())?);
            }
        }
        *self.queues.lock().unwrap_or_else(PoisonError::into_inner) = Some(queues.into());
        Ok(info.state.messages)
    }

    fn queues(&self) -> Option<Arc<[Queue]>> {
        self.queues.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn subject_of(&self, job: &Dispatch) -> String {
        let lane = job.client.0 % LANES as u64;
        let class = CLASS[usize::from(job.urgency.min(7))];
        format!("{}.jobs.{lane}.{class}.{}", self.config.prefix, job.id.as_str())
    }

    fn events_of(&self, id: &JobId) -> String {
        format!("{}.events.{}", self.config.prefix, id.as_str())
    }

    /// Waits for a job and claims it, or returns an error of the server.
    async fn next(&self) -> Result<Claim, String> {
        let mut search = self.search.lock().await;
        let search = &mut *search;
        loop {
            let queues = self.queues().ok_or("the stream does not exist yet")?;
            if let Some(claim) = self.scan(search, &queues).await? {
                search.announcements = None;
                return Ok(claim);
            }
            let Some(announcements) = &mut search.announcements else {
                // Jobs that are dispatched from now on are announced; earlier ones are found by another search.
                let all = format!("{}.jobs.>", self.config.prefix);
                let announcements = self.connection.queue_subscribe(all, "idle".to_owned()).await;
                search.announcements = Some(announcements.map_err(|error| error.to_string())?);
                self.connection.flush().await.map_err(|error| error.to_string())?;
                search.filled.fill(true);
                continue;
            };
            match timeout(POLL, announcements.next()).await {
                Ok(Some(message)) => {
                    let mut parts = message.subject.as_str().rsplit('.').skip(1);
                    let mut number = || parts.next()?.parse::<usize>().ok();
                    if let Some((class, lane)) = number().zip(number())
                        && let Some(filled) = search.filled.get_mut(lane * CLASSES + class)
                    {
                        *filled = true;
                    }
                }
                Ok(None) => search.announcements = None,
                Err(_elapsed) => search.filled.fill(true),
            }
        }
    }

    /// Claims the first job of the lane whose turn it is, or of the next lane that has any.
    async fn scan(&self, search: &mut JobSearch, queues: &[Queue]) -> Result<Option<Claim>, String> {
        for step in 0..LANES {
            let lane = (search.turn + step) % LANES;
            let of_lane = search.filled.iter_mut().zip(queues).skip(lane * CLASSES).take(CLASSES);
            for (filled, queue) in of_lane.filter(|(filled, _)| **filled) {
                if let Some(claim) = self.fetch(queue).await? {
                    search.turn = lane + 1;
                    return Ok(Some(claim));
                }
                *filled = false;
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
        let claims = message.info().map_or(1, |info| u32::try_from(info.delivered).unwrap_or(1));
        if claims > 1 {
            counter!(BROKER_REDELIVERIES).increment(1);
        }
        let (message, acker) = message.split();
        let id = message.subject.as_str().rsplit('.').next().and_then(|id| id.parse().ok());
        let Some(id) = id else {
            // A message of another program.
            drop(acker.ack_with(AckKind::Term).await);
            return Ok(None);
        };
        Ok(Some(Claim::new(id, claims, NatsLease::start(acker, Duration::from_millis(self.config.lease_ms / 3)))))
    }
}

impl Broker for NatsBroker {
    fn dispatch<'a>(&'a self, job: &'a Dispatch) -> BoxFuture<'a, Result<bool, DispatchError>> {
        Box::pin(async move {
            let message = PublishMessage::build().expected_last_subject_sequence(0);
            let failed = |error: &dyn std::fmt::Display| DispatchError::Unavailable { why: error.to_string() };
            let sent = self.0.context.send_publish(self.0.subject_of(job), message).await;
            match sent.map_err(|error| failed(&error))?.await {
                Ok(_) => Ok(true),
                Err(error) if error.kind() == PublishErrorKind::WrongLastSequence => Ok(false),
                Err(error) if error.to_string().contains("maximum messages exceeded") => Err(DispatchError::Full),
                Err(error) => Err(failed(&error)),
            }
        })
    }

    fn claim(&self) -> BoxFuture<'_, Claim> {
        Box::pin(async {
            loop {
                match self.0.next().await {
                    Ok(claim) => return claim,
                    Err(why) => {
                        tracing::debug!(why, "no job was claimed");
                        sleep(POLL).await;
                    }
                }
            }
        })
    }

    fn lock<'a>(&'a self, work: &'a Digest) -> BoxFuture<'a, Option<WorkLock>> {
        Box::pin(self.0.lock_work(work))
    }

    fn publish(&self, id: &JobId, event: JobEvent) {
        // Followers read the record at intervals, so no event is queued for a lost connection.
        if self.0.connection.connection_state() != State::Connected {
            return;
        }
        let (connection, subject) = (self.0.connection.clone(), self.0.events_of(id));
        let payload = serde_json::to_vec(&event).unwrap_or_default();
        tokio::spawn(async move { drop(connection.publish(subject, payload.into()).await) });
    }

    fn events(&self, id: &JobId) -> BoxFuture<'_, BoxStream<'static, JobEvent>> {
        let subject = self.0.events_of(id);
        Box::pin(async move {
            match self.0.connection.subscribe(subject).await {
                Ok(events) => {
                    events.filter_map(|event| std::future::ready(serde_json::from_slice(&event.payload).ok())).boxed()
                }
                Err(error) => {
                    tracing::debug!(%error, "the events of a job are not followed");
                    stream::pending().boxed()
                }
            }
        })
    }

    fn queued(&self) -> usize {
        self.0.queued.load(Ordering::Relaxed)
    }

    fn down(&self) -> Option<String> {
        if self.0.connection.connection_state() != State::Connected {
            return Some("the broker is not connected".to_owned());
        }
        if self.0.checked.load(Ordering::Acquire) != self.0.losses.load(Ordering::Acquire) {
            return Some("the broker is being asked for its queue".to_owned());
        }
        self.0.down.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}
