//! Remote archive: URLs in order, retries, a circuit breaker per host and a limit of concurrent fetches.

use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::sync::Arc;
use std::time::Duration;

use reqwest::Client;
use tokio::sync::{OnceCell, Semaphore};
use tokio::time::Instant;

use super::breaker::Breaker;
use super::client::{self, Answer, Checks, Failed, Origin};
use super::error::{FetchError, UnavailableReason};
use crate::config::{ArchiveConfig, Config, Template};
use crate::memory_budget::Budget;
use crate::readers::{Busy, Readers};
use crate::structure::EntryId;
use crate::surface::{Exceeded, Limit};
use crate::telemetry::{SpanKind, SpanParent, TraceSpan};

/// Longest pause that a host can request.
const MAX_PAUSE: Duration = Duration::from_mins(10);
/// Longest `Retry-After` of a host that a fetch waits for, because callers wait meanwhile. For longer ones, requests to
/// the host pause until then.
const MAX_RETRY_AFTER: Duration = Duration::from_secs(5);
/// Retry time reported to callers if no better one is known.
const DEFAULT_RETRY_AFTER: Duration = Duration::from_secs(1);

/// The remote archive.
#[derive(Debug)]
pub(super) struct Remote {
    /// URL templates with the circuit breakers of their hosts.
    sources: Vec<(Template, Arc<Breaker>)>,
    config: ArchiveConfig,
    inflated_bytes: u64,
    readers: Readers,
    /// Pass on the trace context, since its spans are exported.
    sends_trace: bool,
    permits: Semaphore,
    memory: Budget,
    /// Created on first use, because it reads the system's certificates.
    client: OnceCell<Client>,
}

impl Remote {
    /// Creates the remote archive of a configuration, if it names one. Bodies that arrive are charged to `memory`, and
    /// checked with a permit of `readers`.
    pub(super) fn new(config: &Config, memory: Budget, readers: Readers) -> Option<Self> {
        let inflated_bytes = config.limits.inflated_bytes;
        let sends_trace = config.telemetry.endpoint.is_some();
        let config = &config.archive;
        let pause = Duration::from_millis(config.breaker_ms);
        let mut sources: Vec<(Template, Arc<Breaker>)> = Vec::new();
        for template in config.url.as_ref()?.as_slice() {
            let known = sources.iter().find(|(_, breaker)| breaker.host() == template.host());
            let new = || Arc::new(Breaker::new(template.host(), config.breaker_failures, pause));
            let breaker = known.map_or_else(new, |(_, breaker)| Arc::clone(breaker));
            sources.push((template.clone(), breaker));
        }
        let permits = Semaphore::new(config.concurrent);
        let client = OnceCell::new();
        Some(Self { sources, config: config.clone(), inflated_bytes, readers, sends_trace, permits, memory, client })
    }

    /// Sends a HEAD request for `id` to every URL. Returns the hosts with the status or the error.
    pub(super) async fn reach(&self, id: &EntryId, limit: Duration) -> Vec<(String, Result<u16, String>)> {
        let mut reached = Vec::new();
        for (template, breaker) in &self.sources {
            let request = async {
                let failed = |failed: Failed| match failed {
                    Failed::TooLarge(_) => "too large".to_owned(),
                    Failed::Memory(error) => error.to_string(),
                    Failed::Busy(_) => "no reader was free".to_owned(),
                    Failed::Other { detail, .. } => detail,
                };
                let client = self.client().await.map_err(failed)?;
                let url = template.url(id).ok_or("the URL is invalid")?;
                client::head(client, url).await.map_err(failed)
            };
            let answer = tokio::time::timeout(limit, request).await;
            let silent = |_elapsed| Err(format!("no answer within {} ms", limit.as_millis()));
            reached.push((breaker.host().to_owned(), answer.unwrap_or_else(silent)));
        }
        reached
    }

    /// Requests the entry from every URL in order until one has it, at most until `deadline`.
    pub(super) async fn fetch(
        &self,
        id: &EntryId,
        copy: Option<&Origin>,
        deadline: Instant,
    ) -> Result<Answer, FetchError> {
        let mut failure = None;
        for (template, breaker) in &self.sources {
            match self.fetch_from(id, template, breaker, copy, deadline).await {
                Ok(Answer::Absent) => {}
                Ok(answer) => return Ok(answer),
                Err(error @ (FetchError::TooLarge(_) | FetchError::Memory { .. } | FetchError::Busy { .. })) => {
                    return Err(error);
                }
                // A later URL may have the entry. If none has, this failure is reported instead of "not found".
                Err(error) => {
                    failure.get_or_insert(error);
                }
            }
        }
        Err(failure.unwrap_or_else(|| FetchError::NotFound { id: id.clone() }))
    }

    /// Requests the entry from one URL, with retries.
    async fn fetch_from(
        &self,
        id: &EntryId,
        template: &Template,
        breaker: &Breaker,
        copy: Option<&Origin>,
        deadline: Instant,
    ) -> Result<Answer, FetchError> {
        let mut attempt = 1;
        loop {
            let (reason, requested, detail) = match self.attempt(id, template, breaker, copy, deadline).await {
                Ok(answer) => return Ok(answer),
                Err(Failed::TooLarge(actual)) => {
                    let subject = format!("the archive's file of entry {id}").into();
                    let error = Exceeded::new(Limit::EntryBytes, self.config.max_bytes);
                    return Err(FetchError::TooLarge(Exceeded { subject, actual, ..error }.into()));
                }
                Err(Failed::Memory(error)) => return Err(FetchError::Memory { id: id.clone(), error }),
                Err(Failed::Busy(Busy { wait })) => {
                    let limit = Duration::from_millis(self.config.timeout_ms);
                    return Err(FetchError::Busy { id: id.clone(), limit, wait });
                }
                Err(Failed::Other { reason, retry_after, detail }) => (reason, retry_after, detail),
            };
            tracing::debug!(%id, host = breaker.host(), attempt, detail, "an attempt failed");
            let pause = self.pause(attempt, requested);
            let again = reason.is_temporary()
                && attempt < self.config.attempts
                && breaker.open_for().is_none()
                && Instant::now() + pause < deadline;
            if !again {
                if reason != UnavailableReason::Paused {
                    tracing::warn!(%id, host = breaker.host(), attempt, detail, "the request to the archive failed");
                }
                let is_temporary =
                    reason.is_temporary() || matches!(reason, UnavailableReason::Paused | UnavailableReason::Busy);
                let retry_after = breaker.open_for().or(requested).unwrap_or(DEFAULT_RETRY_AFTER);
                return Err(FetchError::Unavailable {
                    host: breaker.host().to_owned(),
                    reason,
                    retry_after: is_temporary.then_some(retry_after),
                });
            }
            tokio::time::sleep(pause).await;
            attempt += 1;
        }
    }

    /// Returns the pause after an attempt: the time that the host requested, plus a random part of a span that doubles.
    fn pause(&self, attempt: u32, requested: Option<Duration>) -> Duration {
        let span = Duration::from_millis(self.config.backoff_ms).saturating_mul(1 << (attempt - 1).min(16));
        requested.unwrap_or_default() + span.mul_f64(fraction())
    }

    /// Sends one request, unless the circuit breaker is open or no permit is available in time.
    async fn attempt(
        &self,
        id: &EntryId,
        template: &Template,
        breaker: &Breaker,
        copy: Option<&Origin>,
        deadline: Instant,
    ) -> Result<Answer, Failed> {
        let paused =
            |wait: Duration| Failed::other(UnavailableReason::Paused, &format!("paused for {} ms", wait.as_millis()));
        // Checked before waiting for a permit.
        breaker.open_for().map_or(Ok(()), |wait| Err(paused(wait)))?;
        let _permit = tokio::time::timeout_at(deadline, self.permits.acquire())
            .await
            .map_err(|_elapsed| Failed::other(UnavailableReason::Busy, "no permit in time"))?
            .map_err(|closed| Failed::other(UnavailableReason::Busy, &closed))?;
        let client = self.client().await?;
        let url = template.url(id).ok_or_else(|| Failed::other(UnavailableReason::Client, "the URL is invalid"))?;
        let known = copy.filter(|copy| copy.url == url.as_str());
        let permit = breaker.acquire().map_err(paused)?;
        let span = TraceSpan::start(&SpanParent::current(), "GET", SpanKind::Client, std::time::Instant::now());
        let trace = self.sends_trace.then(|| span.context());
        let reservation = self.memory.reservation();
        let checks = Checks { inflated_bytes: self.inflated_bytes, readers: &self.readers, end: deadline };
        let get = client::get(client, url, known, &self.config, &checks, reservation, trace.as_ref());
        let answer = tokio::time::timeout_at(deadline, get)
            .await
            .unwrap_or_else(|_elapsed| Err(Failed::other(UnavailableReason::Timeout, "incomplete at the deadline")));
        describe(&span, id, breaker.host(), &answer);
        span.end();
        match &answer {
            Ok(_) | Err(Failed::TooLarge(_) | Failed::Memory(_) | Failed::Busy(_)) => permit.succeeded(),
            Err(Failed::Other { retry_after: Some(wait), reason, .. })
                if reason.is_temporary() && *wait > MAX_RETRY_AFTER =>
            {
                permit.asked_to_wait((*wait).min(MAX_PAUSE));
            }
            Err(Failed::Other { reason, .. }) if reason.is_host_response() => permit.succeeded(),
            Err(Failed::Other { .. }) => permit.failed(),
        }
        answer
    }

    async fn client(&self) -> Result<&Client, Failed> {
        let make = || async {
            let config = self.config.clone();
            let built = tokio::task::spawn_blocking(move || client::build(&config)).await;
            let failed = |words: String| Failed::other(UnavailableReason::Client, &words);
            built.map_err(|e| failed(e.to_string()))?.map_err(|e| failed(format!("{e:?}")))
        };
        self.client.get_or_try_init(make).await
    }
}

/// Sets the attributes and the status of an attempt's span.
fn describe(span: &TraceSpan, id: &EntryId, host: &str, answer: &Result<Answer, Failed>) {
    span.set("http.request.method", "GET");
    span.set("server.address", host.to_owned());
    span.set("molmesh.entry", id.as_str().to_owned());
    let (status, error) = match answer {
        Ok(Answer::Body { .. }) | Err(Failed::TooLarge(_)) => (Some(200), None),
        Ok(Answer::Unchanged) => (Some(304), None),
        // 410 is reported as 404.
        Ok(Answer::Absent) => (Some(404), None),
        Err(Failed::Memory(_)) => (Some(200), Some("memory limit reached".to_owned())),
        Err(Failed::Busy(_)) => (Some(200), Some("no reader was free".to_owned())),
        Err(Failed::Other { reason, detail, .. }) => match reason {
            UnavailableReason::Status(status) => (Some(i64::from(*status)), Some(detail.clone())),
            _ => (None, Some(detail.clone())),
        },
    };
    if let Some(status) = status {
        span.set("http.response.status_code", status);
    }
    if let Some(error) = error {
        span.fail(error);
    }
}

/// Returns a random number in [0, 1), from the random seeds of the standard library's hashers.
fn fraction() -> f64 {
    let bits = RandomState::new().build_hasher().finish() >> 11;
    bits as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_and_are_random() {
        let mut config = Config::default();
        config.archive.backoff_ms = 1000;
        let remote = Remote::new(&config, Budget::unlimited(), Readers::new(1, 1.0)).unwrap();
        let longest = |attempt| (0..200).map(|_| remote.pause(attempt, None)).max().unwrap_or_default().as_millis();
        for (attempt, span) in [(1, 1000), (2, 2000), (3, 4000)] {
            let longest = longest(attempt);
            assert!((span * 8 / 10..=span).contains(&longest), "{attempt}: {longest}");
        }
        assert!((0..200).map(|_| remote.pause(1, None)).min().is_some_and(|least| least.as_millis() < 200));
        assert!(remote.pause(99, Some(Duration::from_secs(5))) >= Duration::from_secs(5));
    }
}
