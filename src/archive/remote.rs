//! The remote archive: addresses in order, attempts with pauses, hosts that are left alone, places for so many at once.

use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::sync::Arc;
use std::time::Duration;

use reqwest::Client;
use tokio::sync::{OnceCell, Semaphore};
use tokio::time::Instant;

use super::breaker::Breaker;
use super::client::{self, Answer, Failed, Limits, Validators};
use super::error::{FetchError, Why};
use super::memory::{Memory, NoMemory};
use crate::config::{ArchiveConfig, Template};
use crate::structure::EntryId;
use crate::telemetry::{SpanKind, SpanParent, TraceSpan};

/// Longest that a host is left alone on its own word.
const LONGEST: Duration = Duration::from_mins(10);
/// What callers are told where nothing better is known.
const LATER: Duration = Duration::from_secs(1);

/// Where the copy that we have came from, and what was said of it.
#[derive(Debug, Clone)]
pub(super) struct Origin {
    pub(super) url: String,
    pub(super) validators: Validators,
}

/// The remote archive.
#[derive(Debug)]
pub(super) struct Remote {
    /// Every address with the breaker of its host.
    sources: Vec<(Template, Arc<Breaker>)>,
    config: ArchiveConfig,
    limits: Limits,
    places: Semaphore,
    memory: Arc<dyn Memory>,
    /// Made when it is first needed: it reads the system's certificates.
    client: OnceCell<Client>,
}

impl Remote {
    /// The archive of a configuration, if it names one. What it sends is counted by `memory`.
    pub(super) fn new(config: &ArchiveConfig, inflated: u64, memory: Arc<dyn Memory>) -> Option<Self> {
        let mut sources: Vec<(Template, Arc<Breaker>)> = Vec::new();
        for template in config.url.as_ref()?.as_slice() {
            let known = sources.iter().find(|(_, breaker)| breaker.host() == template.host());
            let new = || Arc::new(Breaker::new(template.host(), config.breaker_failures, config.breaker()));
            let breaker = known.map_or_else(new, |(_, breaker)| Arc::clone(breaker));
            sources.push((template.clone(), breaker));
        }
        let limits = Limits {
            head: config.connect_timeout() + config.first_byte_timeout(),
            pause: config.first_byte_timeout(),
            bytes: config.max_bytes,
            inflated,
        };
        let places = Semaphore::new(config.concurrent);
        Some(Self { sources, config: config.clone(), limits, places, memory, client: OnceCell::new() })
    }

    /// Asks every address for the head of one well-known entry: whether somebody answers there, each host with its status.
    pub(super) async fn reach(&self, id: &EntryId, limit: Duration) -> Vec<(String, Result<u16, String>)> {
        let mut reached = Vec::new();
        for (template, breaker) in &self.sources {
            let ask = async {
                let failed = |failed: Failed| match failed {
                    Failed::TooLarge(_) => "too large".to_owned(),
                    Failed::Memory(none) => format!("no memory: {} of {} bytes are in use", none.held, none.limit),
                    Failed::Other { detail, .. } => detail,
                };
                let client = self.client().await.map_err(failed)?;
                let url = template.url(id).ok_or("the address is no URL")?;
                client::head(client, url).await.map_err(failed)
            };
            let answer = tokio::time::timeout(limit, ask).await;
            let silent = |_elapsed| Err(format!("no answer within {} ms", limit.as_millis()));
            reached.push((breaker.host().to_owned(), answer.unwrap_or_else(silent)));
        }
        reached
    }

    /// Asks every address in order until one has the entry.
    pub(super) async fn fetch(&self, id: &EntryId, copy: Option<&Origin>) -> Result<Answer, FetchError> {
        let deadline = Instant::now() + self.config.timeout();
        let mut failure = None;
        for (template, breaker) in &self.sources {
            match self.ask(id, template, breaker, copy, deadline).await {
                Ok(Answer::Absent) => {}
                Ok(answer) => return Ok(answer),
                Err(error @ (FetchError::TooLarge { .. } | FetchError::Memory { .. })) => return Err(error),
                // Another address may still have it; if none does, this one might have had it.
                Err(error) => {
                    failure.get_or_insert(error);
                }
            }
        }
        Err(failure.unwrap_or_else(|| FetchError::NotFound { id: id.clone() }))
    }

    /// Asks one address, several times where that may help.
    async fn ask(
        &self,
        id: &EntryId,
        template: &Template,
        breaker: &Breaker,
        copy: Option<&Origin>,
        deadline: Instant,
    ) -> Result<Answer, FetchError> {
        let unavailable =
            |why, retry_after| FetchError::Unavailable { host: breaker.host().to_owned(), why, retry_after };
        let mut attempt = 1;
        loop {
            let (why, asked_for, detail) = match self.attempt(id, template, breaker, copy, deadline).await {
                Ok(answer) => return Ok(answer),
                Err(Failed::TooLarge(bytes)) => {
                    return Err(FetchError::TooLarge { id: id.clone(), bytes, limit: self.limits.bytes });
                }
                Err(Failed::Memory(NoMemory { limit, held })) => {
                    return Err(FetchError::Memory { id: id.clone(), limit, held });
                }
                Err(Failed::Other { why, retry_after, detail }) => (why, retry_after, detail),
            };
            tracing::debug!(%id, host = breaker.host(), attempt, detail, "an attempt failed");
            let pause = self.pause(attempt, asked_for);
            let again = why.is_temporary()
                && attempt < self.config.attempts
                && breaker.left_alone_for().is_none()
                && Instant::now() + pause < deadline;
            if !again {
                if why != Why::Paused {
                    tracing::warn!(%id, host = breaker.host(), attempt, detail, "the archive cannot be asked");
                }
                let is_temporary = why.is_temporary() || matches!(why, Why::Paused | Why::Busy);
                let later = breaker.left_alone_for().or(asked_for).unwrap_or(LATER);
                return Err(unavailable(why, is_temporary.then_some(later)));
            }
            tokio::time::sleep(pause).await;
            attempt += 1;
        }
    }

    /// The pause after an attempt: a random part of a span that doubles, behind what the host asked for.
    fn pause(&self, attempt: u32, asked_for: Option<Duration>) -> Duration {
        let span = self.config.backoff().saturating_mul(1 << (attempt - 1).min(16));
        asked_for.unwrap_or_default() + span.mul_f64(fraction())
    }

    /// Asks once, if the host is not left alone and there is a place.
    async fn attempt(
        &self,
        id: &EntryId,
        template: &Template,
        breaker: &Breaker,
        copy: Option<&Origin>,
        deadline: Instant,
    ) -> Result<Answer, Failed> {
        let paused = |wait: Duration| Failed::other(Why::Paused, &format!("left alone for {} ms", wait.as_millis()));
        // Nobody waits for a place to ask somebody who is not asked.
        breaker.left_alone_for().map_or(Ok(()), |wait| Err(paused(wait)))?;
        let _place = tokio::time::timeout_at(deadline, self.places.acquire())
            .await
            .map_err(|_elapsed| Failed::other(Why::Busy, "no place in time"))?
            .map_err(|closed| Failed::other(Why::Busy, &closed))?;
        let client = self.client().await?;
        let url = template.url(id).ok_or_else(|| Failed::other(Why::Client, "the address is no URL"))?;
        let known = copy.filter(|copy| copy.url == url.as_str()).map(|copy| &copy.validators);
        let pass = breaker.enter().map_err(paused)?;
        let span = TraceSpan::start(&SpanParent::current(), "GET", SpanKind::Client, std::time::Instant::now());
        let trace = span.context();
        let get = client::get(client, url, known, self.limits, self.memory.begin(), &trace);
        let answer = tokio::time::timeout_at(deadline, get)
            .await
            .unwrap_or_else(|_elapsed| Err(Failed::other(Why::Timeout, "not whole in time")));
        describe(&span, id, breaker.host(), &answer);
        span.end();
        match &answer {
            Ok(_) | Err(Failed::TooLarge(_) | Failed::Memory(_)) => pass.succeeded(),
            Err(Failed::Other { retry_after: Some(wait), why, .. })
                if why.is_temporary() && *wait > self.config.retry_after() =>
            {
                pass.told_to_wait((*wait).min(LONGEST));
            }
            Err(Failed::Other { why, .. }) if why.is_the_hosts_word() => pass.succeeded(),
            Err(Failed::Other { .. }) => pass.failed(),
        }
        answer
    }

    async fn client(&self) -> Result<&Client, Failed> {
        let make = || async {
            let config = self.config.clone();
            let built = tokio::task::spawn_blocking(move || client::build(&config)).await;
            let failed = |words: String| Failed::other(Why::Client, &words);
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
        // It may have been 410: what counts is that there is none.
        Ok(Answer::Absent) => (Some(404), None),
        Err(Failed::Memory(_)) => (Some(200), Some("no memory for it".to_owned())),
        Err(Failed::Other { why, detail, .. }) => match why {
            Why::Status(status) => (Some(i64::from(*status)), Some(detail.clone())),
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

/// A random number of [0, 1). The standard library seeds its hashers at random, which is all that pauses need.
fn fraction() -> f64 {
    let bits = RandomState::new().build_hasher().finish() >> 11;
    bits as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::super::memory::Uncounted;
    use super::*;

    #[test]
    fn pauses_double_and_differ() {
        let config = ArchiveConfig { backoff_ms: 1000, ..ArchiveConfig::default() };
        let remote = Remote::new(&config, 1, Arc::new(Uncounted)).unwrap();
        let longest = |attempt| (0..200).map(|_| remote.pause(attempt, None)).max().unwrap_or_default().as_millis();
        for (attempt, span) in [(1, 1000), (2, 2000), (3, 4000)] {
            let longest = longest(attempt);
            assert!((span * 8 / 10..=span).contains(&longest), "{attempt}: {longest}");
        }
        assert!((0..200).map(|_| remote.pause(1, None)).min().is_some_and(|least| least.as_millis() < 200));
        assert!(remote.pause(99, Some(Duration::from_secs(5))) >= Duration::from_secs(5));
    }
}
