//! Broker over NATS JetStream, for the nodes of a cluster.
//!
//! Queued and claimed jobs are the messages of a stream with one subject per job, `PREFIX.jobs.QUEUE.ID`: the stream
//! rejects a second message with a subject, and an acknowledged message is removed. Each queue has a consumer. Events
//! of jobs are plain messages, which may be lost.
//!
//! Uses only what servers from version 2.9 on offer.

mod empty_queues;
mod endings;
mod lease;
mod lock;
mod search;
mod streams;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use async_nats::connection::State;
use async_nats::jetstream::consumer::{Consumer, pull};
use async_nats::jetstream::context::PublishErrorKind;
use async_nats::jetstream::message::PublishMessage;
use async_nats::jetstream::response::Response;
use async_nats::jetstream::{Context, ContextBuilder};
use async_nats::{Client as Connection, ConnectOptions, Event};
use futures_util::future::BoxFuture;
use futures_util::stream::{self, BoxStream, StreamExt as _};
use metrics::counter;
use tokio::time::{Instant, sleep};

use empty_queues::EmptyQueues;
use endings::Endings;

use super::order::{QUEUES, QueueOrder};
use super::{Broker, Claim, Dispatch, DispatchError, JobEvent, WorkLock};
use crate::config::BrokerConfig;
use crate::jobs::record::JobId;
use crate::store::Digest;
use crate::telemetry::BROKER_CLAIM_ERRORS;

/// Time limit of a request to the server.
const REQUEST: Duration = Duration::from_secs(5);
/// Interval at which the server is asked for the number of jobs, and idle workers look for jobs.
const POLL: Duration = Duration::from_secs(1);

/// Kind of a request to the server.
#[derive(Debug, Clone, Copy)]
enum RequestKind {
    /// Check of streams and queues.
    Check,
    /// Claim of a job.
    Claim,
}

/// Consumer of one queue.
type Queue = Consumer<pull::Config>;

struct NatsState {
    connection: Connection,
    context: Context,
    config: BrokerConfig,
    /// Identity of the store that all nodes share.
    store: String,
    /// Last error of the connection.
    failure: Arc<Mutex<Option<String>>>,
    endings: Endings,
    /// Queues by number; `None` until they exist.
    queues: Mutex<Option<Arc<[Queue]>>>,
    order: Mutex<QueueOrder>,
    empty: Mutex<EmptyQueues>,
    /// Number of jobs in the stream when it was last asked.
    queued: AtomicUsize,
    /// Number of times that the connection or the stream was lost.
    losses: Arc<AtomicUsize>,
    /// Number of losses when the server was last asked.
    checked: AtomicUsize,
    /// Creation time of the stream, ns since 1970, when the server was last asked.
    created: Mutex<Option<i128>>,
    /// Reason for which the last request of each kind failed.
    failures: Mutex<[Option<String>; 2]>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn options(config: &BrokerConfig) -> ConnectOptions {
    let options = ConnectOptions::new().name("molmesh").connection_timeout(REQUEST).ping_interval(REQUEST);
    match (&config.user, &config.password) {
        (Some(user), Some(password)) => options.user_and_password(user.clone(), password.reveal().to_owned()),
        _ => options,
    }
}

/// Connects to one of the servers `url`, a list with commas.
async fn open(options: ConnectOptions, url: &str) -> Result<(Connection, Context), String> {
    crate::tls::install_provider();
    let addresses: Vec<_> = url.split(',').map(str::trim).collect();
    let connection = options.connect(addresses).await.map_err(|error| error.to_string())?;
    let context = ContextBuilder::new().timeout(REQUEST).ack_timeout(REQUEST).build(connection.clone());
    Ok((connection, context))
}

/// Checks that a server of `url` accepts the credentials and offers JetStream. Changes nothing there.
///
/// # Errors
/// Returns the reason.
pub async fn check_broker(config: &BrokerConfig, url: &str) -> Result<(), String> {
    let (_connection, context) = open(options(config), url).await?;
    // Releases of NATS differ in the fields of the account.
    match context.request::<_, _, Response<serde_json::Value>>("INFO", b"").await.map_err(|error| error.to_string())? {
        Response::Ok(_account) => Ok(()),
        Response::Err { error } => Err(error.to_string()),
    }
}

/// Broker over NATS. Clones share one connection.
#[derive(Clone)]
pub(crate) struct NatsBroker(Arc<NatsState>);

impl NatsBroker {
    /// Connects to the server of the configuration. Does not wait until it answers. `store` identifies the store of the
    /// nodes.
    ///
    /// # Errors
    /// Returns the reason if an address or the credentials are malformed.
    pub(crate) async fn connect(config: &BrokerConfig, url: &str, store: &str) -> Result<Self, String> {
        let (losses, failure) = (Arc::new(AtomicUsize::new(0)), Arc::new(Mutex::new(None)));
        let (counted, failed) = (Arc::clone(&losses), Arc::clone(&failure));
        let options = options(config)
            .retry_on_initial_connect()
            .event_callback(move |event| {
                match event {
                    // The server may have lost its streams.
                    Event::Disconnected => drop(counted.fetch_add(1, Ordering::AcqRel)),
                    Event::ClientError(error) => *lock(&failed) = Some(error.to_string()),
                    Event::ServerError(error) => *lock(&failed) = Some(error.to_string()),
                    _ => {}
                }
                std::future::ready(())
            })
            .reconnect_delay_callback(|attempts| Duration::from_millis(100 * (attempts as u64).clamp(1, 10)));
        let (connection, context) = Box::pin(open(options, url)).await?;
        let broker = Self(Arc::new(NatsState {
            connection,
            context,
            config: config.clone(),
            store: store.to_owned(),
            failure,
            endings: Endings::default(),
            queues: Mutex::new(None),
            order: Mutex::default(),
            empty: Mutex::default(),
            queued: AtomicUsize::new(0),
            losses,
            checked: AtomicUsize::new(usize::MAX),
            created: Mutex::new(None),
            failures: Mutex::default(),
        }));
        broker.0.hear().await?;
        tokio::spawn(streams::watch(Arc::downgrade(&broker.0)));
        Ok(broker)
    }
}

impl NatsState {
    fn queues(&self) -> Option<Arc<[Queue]>> {
        lock(&self.queues).clone()
    }

    fn subject_of(&self, job: &Dispatch) -> String {
        format!("{}.jobs.{}.{}", self.config.prefix, QUEUES[job.queue()], job.id.as_str())
    }

    fn events_of(&self, id: &JobId) -> String {
        format!("{}.events.{}", self.config.prefix, id.as_str())
    }
}

impl Broker for NatsBroker {
    fn dispatch<'a>(&'a self, job: &'a Dispatch) -> BoxFuture<'a, Result<bool, DispatchError>> {
        Box::pin(async move {
            let message = PublishMessage::build().expected_last_subject_sequence(0);
            let failed = |error: &dyn std::fmt::Display| DispatchError::Unavailable { why: error.to_string() };
            let sent = self.0.context.send_publish(self.0.subject_of(job), message).await;
            match sent.map_err(|error| failed(&error))?.await {
                Ok(_) => {
                    self.0.queued.fetch_add(1, Ordering::Relaxed);
                    // The announcement reaches this node later.
                    lock(&self.0.empty).note_job(job.queue(), Instant::now());
                    self.0.announce(job).await;
                    Ok(true)
                }
                Err(error) if error.kind() == PublishErrorKind::WrongLastSequence => Ok(false),
                Err(error) if error.to_string().contains("maximum messages exceeded") => {
                    self.0.queued.fetch_max(self.0.config.queue, Ordering::Relaxed);
                    Err(DispatchError::Full)
                }
                Err(error) => Err(failed(&error)),
            }
        })
    }

    fn claim(&self, prefers_gpu: bool) -> BoxFuture<'_, Claim> {
        Box::pin(async move {
            loop {
                let losses = self.losses();
                match self.0.search(prefers_gpu).await {
                    Ok(Some(claim)) => return claim,
                    // The check of the streams reports why there are no queues.
                    Ok(None) => {}
                    Err(why) => {
                        counter!(BROKER_CLAIM_ERRORS).increment(1);
                        // A loss is reported already, and the next request may be answered.
                        if losses == self.losses() {
                            self.0.set_failure(RequestKind::Claim, Some(format!("no job can be claimed: {why}")));
                        }
                    }
                }
                sleep(POLL).await;
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

    fn flush(&self) -> BoxFuture<'_, ()> {
        Box::pin(self.0.flush())
    }

    fn queued(&self) -> usize {
        self.0.queued.load(Ordering::Relaxed)
    }

    fn limit(&self) -> usize {
        self.0.config.queue
    }

    fn losses(&self) -> usize {
        self.0.losses.load(Ordering::Acquire)
    }

    fn down(&self) -> Option<String> {
        if self.0.connection.connection_state() != State::Connected {
            let failure = lock(&self.0.failure).clone().unwrap_or_else(|| "connecting".to_owned());
            return Some(format!("not connected: {failure}"));
        }
        if self.0.checked.load(Ordering::Acquire) != self.losses() {
            return Some("the broker is being asked for its queue".to_owned());
        }
        lock(&self.0.failures).iter().flatten().next().cloned()
    }
}
