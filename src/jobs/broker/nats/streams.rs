//! Streams and queues: checked at regular intervals, created if they are missing.

use std::sync::Weak;
use std::sync::atomic::Ordering;
use std::time::Duration;

use async_nats::jetstream::consumer::{AckPolicy, pull};
use async_nats::jetstream::stream::{Config, DiscardPolicy, Info, RetentionPolicy};
use metrics::gauge;
use tokio::time::{sleep, timeout};

use super::{NatsBroker, NatsState, POLL, REQUEST, RequestKind, lock};
use crate::jobs::broker::Broker as _;
use crate::jobs::broker::order::QUEUES;
use crate::telemetry::{BROKER_QUEUED, BROKER_UP};

/// Checks streams and queues at regular intervals.
pub(super) async fn watch(broker: Weak<NatsState>) {
    loop {
        let Some(state) = broker.upgrade() else { return };
        let losses = state.losses.load(Ordering::Acquire);
        let asked =
            timeout(REQUEST, state.check_streams()).await.unwrap_or_else(|_elapsed| Err("no answer".to_owned()));
        state.set_failure(RequestKind::Check, asked.err());
        state.checked.store(losses, Ordering::Release);
        gauge!(BROKER_UP).set(f64::from(u8::from(NatsBroker(state).down().is_none())));
        sleep(POLL).await;
    }
}

impl NatsState {
    fn stream(&self) -> String {
        format!("{}-jobs", self.config.prefix)
    }

    /// Returns the description of the stream, which names the store of its jobs.
    fn description(&self) -> String {
        format!("jobs of the store {}", self.store)
    }

    /// Sets or clears the reason for which requests of a kind fail. Logs only the first failure and the end of the last
    /// one.
    pub(super) fn set_failure(&self, kind: RequestKind, why: Option<String>) {
        let mut failures = lock(&self.failures);
        let failed = failures.iter().any(Option::is_some);
        failures[kind as usize] = why;
        match (failed, failures.iter().flatten().next()) {
            (false, Some(why)) => tracing::warn!(why, "the broker fails"),
            (true, None) => tracing::info!("the broker works again"),
            _ => {}
        }
    }

    /// Updates the number of jobs. Creates streams and queues if they are missing.
    async fn check_streams(&self) -> Result<(), String> {
        let name = self.stream();
        let found = self.context.get_stream(&name).await.map(|stream| stream.cached_info().clone());
        let has_locks = self.context.get_stream(self.locks()).await.is_ok();
        if found.as_ref().is_ok_and(|info| info.config.description.as_ref() != Some(&self.description())) {
            // Its jobs are not in the store of this node.
            *lock(&self.queues) = None;
            return Err(format!("the stream {name} is that of another store: check store.url and broker.prefix"));
        }
        let existed = self.queues().is_some();
        let info = match found {
            Ok(info) if existed && has_locks && info.state.consumer_count >= QUEUES.len() => info,
            found => {
                let info = self.create().await?;
                if existed {
                    let consumers = found.map(|info| info.state.consumer_count).map_err(|error| error.to_string());
                    tracing::warn!(?consumers, has_locks, "created streams or consumers of the broker that were lost");
                }
                info
            }
        };
        let created = info.created.unix_timestamp_nanos();
        if lock(&self.created).replace(created).is_some_and(|before| before != created) {
            // Its jobs are dispatched again.
            self.losses.fetch_add(1, Ordering::AcqRel);
        }
        let jobs = usize::try_from(info.state.messages).unwrap_or(usize::MAX);
        self.queued.store(jobs, Ordering::Relaxed);
        gauge!(BROKER_QUEUED).set(u32::try_from(jobs).unwrap_or(u32::MAX));
        Ok(())
    }

    /// Creates streams and queues, or updates their settings.
    async fn create(&self) -> Result<Info, String> {
        let config = Config {
            name: self.stream(),
            description: Some(self.description()),
            subjects: vec![format!("{}.jobs.>", self.config.prefix)],
            retention: RetentionPolicy::WorkQueue,
            discard: DiscardPolicy::New,
            max_messages: i64::try_from(self.config.queue).unwrap_or(i64::MAX),
            max_messages_per_subject: 1,
            num_replicas: self.config.replicas,
            ..Config::default()
        };
        let info = self.context.create_or_update_stream(config).await.map_err(|error| error.to_string())?;
        self.context.create_or_update_stream(self.lock_stream()).await.map_err(|error| error.to_string())?;
        let mut queues = Vec::new();
        for name in QUEUES {
            let config = pull::Config {
                durable_name: Some(name.to_owned()),
                filter_subject: format!("{}.jobs.{name}.*", self.config.prefix),
                ack_policy: AckPolicy::Explicit,
                ack_wait: Duration::from_millis(self.config.lease_ms),
                max_ack_pending: i64::from(u32::MAX),
                ..pull::Config::default()
            };
            let queue = self.context.create_consumer_on_stream(config, self.stream()).await;
            queues.push(queue.map_err(|error| error.to_string())?);
        }
        *lock(&self.queues) = Some(queues.into());
        Ok(info)
    }
}
