//! Spans on their way to a collector: a bounded queue that nobody waits at, and one task that empties it.

use std::time::Duration;

use metrics::counter;
use reqwest::header::{CONTENT_TYPE, HeaderMap, HeaderValue};
use reqwest::redirect::Policy;
use reqwest::{Client, StatusCode};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

use super::otlp::{Batch, Refused};
use super::scope::Finished;
use super::{TRACE_SPANS, TraceContext};
use crate::config::{CollectorUrl, TelemetryConfig};

/// Spans of one request to the collector at most, as OpenTelemetry's own exporters send.
const BATCH: usize = 512;
/// How long the first span of a batch waits for others.
const GATHER: Duration = Duration::from_secs(1);
/// Attempts to send a batch, the first included.
const ATTEMPTS: u32 = 3;
/// Pause before the second attempt; it doubles.
const PAUSE: Duration = Duration::from_millis(250);
/// Longest answer of a collector that is read.
const MAX_ANSWER: usize = 64 << 10;

/// Where spans go; nowhere by default. Clones are the same one.
#[derive(Debug, Clone, Default)]
pub struct Tracer(Option<Sending>);

#[derive(Debug, Clone)]
struct Sending {
    queue: mpsc::Sender<Finished>,
    /// Traces that begin here are recorded if the last 56 bits of their ids are below this.
    below: u64,
}

impl Tracer {
    /// Whether a trace that begins here is recorded.
    pub(super) fn samples(&self, trace: u128) -> bool {
        // All services that decide by these bits decide alike.
        let bits = u64::try_from(trace & 0x00ff_ffff_ffff_ffff).unwrap_or(u64::MAX);
        self.0.as_ref().is_some_and(|sending| bits < sending.below)
    }

    /// Whether spans of this place in a trace go anywhere.
    pub(super) fn records(&self, context: &TraceContext) -> bool {
        self.0.is_some() && context.is_sampled()
    }

    /// Queues a span, or counts it where there is no room.
    pub(super) fn send(&self, span: Finished) {
        if let Some(Sending { queue, .. }) = &self.0
            && queue.try_send(span).is_err()
        {
            counter!(TRACE_SPANS, "result" => "queue-full").increment(1);
        }
    }
}

/// The task that empties the queue.
#[derive(Debug)]
pub struct Exporter {
    task: JoinHandle<()>,
    stop: watch::Sender<bool>,
    patience: Duration,
}

impl Exporter {
    /// The tracer of a configuration, and what sends its spans where it names a collector. Must be called on a tokio runtime
    /// with timers.
    #[must_use]
    pub fn start(config: &TelemetryConfig) -> (Tracer, Option<Self>) {
        let Some(endpoint) = &config.endpoint else { return (Tracer::default(), None) };
        let (queue, spans) = mpsc::channel(config.queue);
        let (stop, stopping) = watch::channel(false);
        let sender = Sender {
            url: CollectorUrl::traces(endpoint),
            headers: headers(config),
            timeout: config.timeout(),
            service: config.service_name.clone(),
            client: None,
        };
        let task = tokio::spawn(sender.work(spans, stopping));
        let tracer = Tracer(Some(Sending { queue, below: threshold(config.sample_ratio.get()) }));
        (tracer, Some(Self { task, stop, patience: config.flush_timeout() }))
    }

    /// Sends what waits and ends, within the time that the configuration gives.
    pub async fn finish(mut self) {
        self.stop.send_replace(true);
        if tokio::time::timeout(self.patience, &mut self.task).await.is_err() {
            tracing::warn!("the collector of traces did not take the last spans in time");
            self.task.abort();
        }
    }
}

/// The ratio of 2⁵⁶.
fn threshold(ratio: f64) -> u64 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a ratio is from 0 to 1")]
    let below = (ratio * (1_u64 << 56) as f64) as u64;
    below
}

fn headers(config: &TelemetryConfig) -> HeaderMap {
    let mut headers = config.secret_headers.as_ref().map(|secret| secret.reveal().clone()).unwrap_or_default();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/x-protobuf"));
    headers
}

struct Sender {
    url: String,
    headers: HeaderMap,
    timeout: Duration,
    service: String,
    /// Made when it is first needed: it reads the system's certificates.
    client: Option<Client>,
}

/// Why a batch was not sent.
enum Failed {
    /// It may be otherwise in a moment.
    MayPass(String),
    ForGood(String),
}

impl Sender {
    /// Sends batches until the service stops and nothing waits any more, or nobody is left who could record a span.
    async fn work(mut self, mut spans: mpsc::Receiver<Finished>, mut stop: watch::Receiver<bool>) {
        let mut healthy = true;
        loop {
            let mut batch = Vec::new();
            tokio::select! {
                biased;
                n = spans.recv_many(&mut batch, BATCH) => if n == 0 { return },
                _ = stop.wait_for(|stop| *stop) => spans.close(),
            }
            let gather = async {
                let mut room = BATCH - batch.len();
                while room > 0 {
                    match spans.recv_many(&mut batch, room).await {
                        0 => return,
                        n => room -= n,
                    }
                }
            };
            tokio::select! {
                biased;
                () = gather => {}
                // What is there already is taken above; nobody waits for more once the service stops.
                _ = stop.wait_for(|stop| *stop) => {}
                () = tokio::time::sleep(GATHER) => {}
            }
            if batch.is_empty() {
                continue;
            }
            let n = batch.len() as u64;
            match self.send(Batch::new(&self.service, batch)).await {
                Ok(Refused { spans, why }) => {
                    let refused = spans.min(n);
                    counter!(TRACE_SPANS, "result" => "exported").increment(n - refused);
                    counter!(TRACE_SPANS, "result" => "refused").increment(refused);
                    if refused > 0 {
                        tracing::warn!(refused, why, "the collector of traces refused spans");
                    }
                    healthy = true;
                }
                Err(why) => {
                    counter!(TRACE_SPANS, "result" => "failed").increment(n);
                    // Once an outage, not once a second.
                    if std::mem::take(&mut healthy) {
                        tracing::warn!(why, "the collector of traces cannot be reached; its spans are thrown away");
                    }
                }
            }
        }
    }

    async fn send(&mut self, batch: Batch) -> Result<Refused, String> {
        let body = bytes::Bytes::from(batch.encode());
        let mut pause = PAUSE;
        for attempt in 1.. {
            match self.attempt(body.clone()).await {
                Ok(refused) => return Ok(refused),
                Err(Failed::MayPass(_)) if attempt < ATTEMPTS => tokio::time::sleep(pause).await,
                Err(Failed::MayPass(why) | Failed::ForGood(why)) => return Err(why),
            }
            pause *= 2;
        }
        Err(String::new())
    }

    async fn attempt(&mut self, body: bytes::Bytes) -> Result<Refused, Failed> {
        let client = self.client().await.map_err(Failed::ForGood)?;
        let request = client.post(&self.url).headers(self.headers.clone()).body(body).timeout(self.timeout);
        let words = |error: reqwest::Error| Failed::MayPass(format!("{:?}", error.without_url()));
        let mut response = request.send().await.map_err(words)?;
        match response.status() {
            status if status.is_success() => {}
            // Those that the protocol calls worth another attempt.
            status @ (StatusCode::TOO_MANY_REQUESTS
            | StatusCode::BAD_GATEWAY
            | StatusCode::SERVICE_UNAVAILABLE
            | StatusCode::GATEWAY_TIMEOUT) => return Err(Failed::MayPass(status.to_string())),
            status => return Err(Failed::ForGood(status.to_string())),
        }
        let mut answer = Vec::new();
        while let Some(chunk) = response.chunk().await.map_err(words)? {
            if answer.len() + chunk.len() > MAX_ANSWER {
                return Ok(Refused::default());
            }
            answer.extend_from_slice(&chunk);
        }
        Ok(Refused::read(&answer))
    }

    /// The client; a clone is the same one.
    async fn client(&mut self) -> Result<Client, String> {
        if let Some(client) = &self.client {
            return Ok(client.clone());
        }
        let needs_tls = self.url.starts_with("https:");
        let build = move || {
            let builder = || Client::builder().no_proxy().redirect(Policy::none());
            match builder().build() {
                // A machine without certificates can still speak plain HTTP.
                Err(_no_certificates) if !needs_tls => builder().tls_certs_only([]).build(),
                built => built,
            }
        };
        let built = tokio::task::spawn_blocking(build).await.map_err(|e| e.to_string())?;
        let client = built.map_err(|e| e.to_string())?;
        self.client = Some(client.clone());
        Ok(client)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_are_kept_by_the_ids_alone() {
        let (queue, _spans) = mpsc::channel(1);
        let of = |ratio| Tracer(Some(Sending { queue: queue.clone(), below: threshold(ratio) }));
        let n = 10_000;
        for (ratio, expected) in [(0.0, 0..=0), (0.25, n / 5..=n * 3 / 10), (1.0, n..=n)] {
            let tracer = of(ratio);
            let sampled = (0..n).filter(|_| TraceContext::root(|id| tracer.samples(id)).is_sampled()).count();
            assert!(expected.contains(&sampled), "{ratio}: {sampled}");
        }
        let context = TraceContext::root(|_| true);
        assert!(of(0.0).records(&context) && !Tracer::default().records(&context));
        assert!(!of(1.0).records(&TraceContext::root(|_| false)));
    }
}
