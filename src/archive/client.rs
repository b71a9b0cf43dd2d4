//! One HTTP request to a remote archive. The memory of the body is counted while it arrives.

use std::error::Error;
use std::path::Path;
use std::time::{Duration, SystemTime};

use bytes::{Bytes, BytesMut};
use reqwest::header::{ETAG, HeaderMap, HeaderName, IF_MODIFIED_SINCE, IF_NONE_MATCH, LAST_MODIFIED, RETRY_AFTER};
use reqwest::redirect::{Attempt, Policy};
use reqwest::{Client, Proxy, Response, StatusCode, Url};
use serde::{Deserialize, Serialize};
use tokio::time::Instant;

use super::address::{PublicResolver, Refused};
use super::error::UnavailableReason;
use crate::config::{ArchiveConfig, Templates};
use crate::memory_budget::MemoryReservation;
use crate::readers::{Busy, Readers};
use crate::store::Digest;
use crate::structure::is_complete_gzip;
use crate::surface::{CancelOnDrop, OutOfMemory};
use crate::telemetry::{SpanContext, traceparent};

/// Maximum number of redirects.
const MAX_REDIRECTS: usize = 3;
/// Longest accepted `Retry-After`.
const MAX_RETRY_AFTER: Duration = Duration::from_hours(24);
const USER_AGENT: &str = concat!("molmesh/", env!("CARGO_PKG_VERSION"), " (molecular surface service)");

const TRACEPARENT: HeaderName = HeaderName::from_static("traceparent");

/// URL of a response and its validators, for a later conditional request.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Origin {
    pub(super) url: String,
    pub(super) etag: Option<String>,
    pub(super) last_modified: Option<String>,
}

/// Answer of an archive.
#[derive(Debug)]
pub(super) enum Answer {
    /// The entry. Its bytes hold their reservation.
    Body { bytes: Bytes, digest: Digest, origin: Origin },
    /// The copy is still current.
    Unchanged,
    /// The archive does not have the entry.
    Absent,
}

/// Resources for checking a body.
#[derive(Debug)]
pub(super) struct Checks<'a> {
    /// Inflated bytes after which the check of a gzip file stops.
    pub(super) inflated_bytes: u64,
    pub(super) readers: &'a Readers,
    /// Time until which a check must end.
    pub(super) end: Instant,
}

/// Failure of a request.
#[derive(Debug)]
pub(super) enum Failed {
    /// The body is too large. Contains the announced size, bytes, if any.
    TooLarge(Option<u64>),
    /// The memory limit is reached.
    Memory(OutOfMemory),
    /// No reader was free to check the body.
    Busy(Busy),
    /// Any other failure: cause, `Retry-After` of the host, details for the log.
    Other { reason: UnavailableReason, retry_after: Option<Duration>, detail: String },
}

impl Failed {
    pub(super) fn other(reason: UnavailableReason, detail: &(impl ToString + ?Sized)) -> Self {
        Self::Other { reason, retry_after: None, detail: detail.to_string() }
    }
}

/// Creates the HTTP client. Blocks, because it reads the system's certificates.
pub(super) fn build(config: &ArchiveConfig) -> Result<Client, reqwest::Error> {
    crate::tls::install_provider();
    let builder = || {
        let builder = Client::builder()
            .user_agent(USER_AGENT)
            .connect_timeout(Duration::from_millis(config.connect_timeout_ms))
            .redirect(Policy::custom(follow))
            .referer(false)
            .dns_resolver(PublicResolver { allow_private: config.allow_private || config.proxy.is_some() });
        Ok(match &config.proxy {
            Some(proxy) => builder.proxy(Proxy::all(proxy)?),
            None => builder.no_proxy(),
        })
    };
    let templates = config.url.as_ref().map(Templates::as_slice).unwrap_or_default();
    let needs_tls = templates.iter().any(|t| t.to_string().starts_with("https:"));
    match builder()?.build() {
        // Plain HTTP also works on machines without certificates.
        Err(_no_certificates) if !needs_tls => builder()?.tls_certs_only([]).build(),
        built => built,
    }
}

/// Follows redirects that stay on their host and do not drop TLS.
fn follow(attempt: Attempt<'_>) -> reqwest::redirect::Action {
    let why = match attempt.previous() {
        [] => "a redirect without an origin",
        previous if previous.len() > MAX_REDIRECTS => "too many redirects",
        [.., last] if !may_follow(last, attempt.url()) => "a redirect to another host, port or scheme",
        _ => return attempt.follow(),
    };
    attempt.error(why)
}

fn may_follow(from: &Url, to: &Url) -> bool {
    let same_origin = from.scheme() == to.scheme() && from.port_or_known_default() == to.port_or_known_default();
    let upgrade = from.scheme() == "http" && to.scheme() == "https" && from.port().is_none() && to.port().is_none();
    from.host_str() == to.host_str() && (same_origin || upgrade)
}

/// Sends a HEAD request and returns the status of the response.
pub(super) async fn head(client: &Client, url: Url) -> Result<u16, Failed> {
    client.head(url).send().await.map(|answer| answer.status().as_u16()).map_err(|error| from_client(&error))
}

/// Sends one GET request, a conditional one if a copy is `known`. `reservation` is charged with the body while it
/// arrives and until the response is dropped. Nothing of the client's request is passed on except the id of a `trace`
/// that is exported.
pub(super) async fn get(
    client: &Client,
    url: Url,
    known: Option<&Origin>,
    config: &ArchiveConfig,
    checks: &Checks<'_>,
    reservation: MemoryReservation,
    trace: Option<&SpanContext>,
) -> Result<Answer, Failed> {
    let compressed = Path::new(url.path()).extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gz"));
    let name = url.to_string();
    let mut request = client.get(url);
    if let Some(trace) = trace {
        request = request.header(TRACEPARENT, traceparent(trace));
    }
    if let Some(Origin { etag, last_modified, .. }) = known {
        for (header, value) in [(IF_NONE_MATCH, etag), (IF_MODIFIED_SINCE, last_modified)] {
            request = value.iter().fold(request, |request, value| request.header(header.clone(), value));
        }
    }
    let head_timeout = Duration::from_millis(config.connect_timeout_ms.saturating_add(config.first_byte_timeout_ms));
    let response = tokio::time::timeout(head_timeout, request.send())
        .await
        .map_err(|_elapsed| Failed::other(UnavailableReason::Timeout, "the response did not begin in time"))?
        .map_err(|error| from_client(&error))?;
    match response.status() {
        StatusCode::OK => {}
        StatusCode::NOT_MODIFIED if known.is_some() => return Ok(Answer::Unchanged),
        StatusCode::NOT_FOUND | StatusCode::GONE => return Ok(Answer::Absent),
        // Redirects without a valid location.
        status if status.is_redirection() && status != StatusCode::NOT_MODIFIED => {
            return Err(Failed::other(UnavailableReason::Redirect, &status));
        }
        status => {
            let retry_after = retry_after(response.headers());
            return Err(Failed::Other {
                reason: UnavailableReason::Status(status.as_u16()),
                retry_after,
                detail: status.to_string(),
            });
        }
    }
    let text = |name: HeaderName| Some(response.headers().get(name)?.to_str().ok()?.to_owned());
    let origin = Origin { url: name, etag: text(ETAG), last_modified: text(LAST_MODIFIED) };
    let bytes = body(response, config, &reservation).await?;
    // A truncated HTTP/1.1 body may look complete, but gzip has a length and a checksum, and a damaged file must not be
    // cached for a day. The deadline drops this future, which ends the check.
    let end = checks.end.into_std();
    let reading = checks.readers.wait(None, end, end).await.map_err(Failed::Busy)?;
    let request = CancelOnDrop::default();
    let (cancel, inflated_bytes) = (request.0.clone(), checks.inflated_bytes);
    let checked = tokio::task::spawn_blocking(move || {
        let is_damaged = compressed && !is_complete_gzip(&bytes, inflated_bytes, &cancel);
        let digest = if is_damaged { None } else { Some(Digest::of(&bytes)) };
        let bytes = reservation.attach(bytes);
        drop(reading);
        Some((bytes, digest?))
    });
    let checked = checked.await.map_err(|error| Failed::other(UnavailableReason::Client, &error))?;
    let damaged = || Failed::other(UnavailableReason::Damaged, "the file is incomplete");
    let (bytes, digest) = checked.ok_or_else(damaged)?;
    Ok(Answer::Body { bytes, digest, origin })
}

/// Receives the body up to the limit.
async fn body(
    mut response: Response,
    config: &ArchiveConfig,
    reservation: &MemoryReservation,
) -> Result<Bytes, Failed> {
    let announced = response.content_length();
    if announced.is_some_and(|bytes| bytes > config.max_bytes) {
        return Err(Failed::TooLarge(announced));
    }
    let mut body = BytesMut::new();
    loop {
        let chunk = tokio::time::timeout(Duration::from_millis(config.first_byte_timeout_ms), response.chunk())
            .await
            .map_err(|_elapsed| Failed::other(UnavailableReason::Timeout, "the body stalled"))?;
        let Some(chunk) = chunk.map_err(|error| from_client(&error))? else { break };
        if body.len() as u64 + chunk.len() as u64 > config.max_bytes {
            return Err(Failed::TooLarge(None));
        }
        reservation.extend(&mut body, &chunk, announced.unwrap_or(0)).map_err(Failed::Memory)?;
    }
    match announced {
        Some(bytes) if bytes != body.len() as u64 => Err(Failed::other(
            UnavailableReason::Broken,
            &format!("received {} of {bytes} announced bytes", body.len()),
        )),
        _ => Ok(body.freeze()),
    }
}

/// Converts an error of the HTTP client.
fn from_client(error: &reqwest::Error) -> Failed {
    let (mut causes, mut next): (Vec<&dyn Error>, Option<&dyn Error>) = (Vec::new(), Some(error));
    while let Some(cause) = next {
        causes.push(cause);
        next = cause.source();
    }
    let reason = if causes.iter().any(|cause| cause.is::<Refused>()) {
        UnavailableReason::Private
    } else if error.is_redirect() {
        UnavailableReason::Redirect
    } else if error.is_timeout() {
        UnavailableReason::Timeout
    } else if error.is_connect() {
        UnavailableReason::Connect
    } else {
        UnavailableReason::Broken
    };
    let words: Vec<String> = causes.iter().map(ToString::to_string).collect();
    Failed::other(reason, &words.join(": "))
}

/// Returns the value of `Retry-After`, given in seconds or as a date.
fn retry_after(headers: &HeaderMap) -> Option<Duration> {
    let text = headers.get(RETRY_AFTER)?.to_str().ok()?.trim();
    if let Ok(seconds) = text.parse() {
        return Some(Duration::from_secs(seconds).min(MAX_RETRY_AFTER));
    }
    let date = httpdate::parse_http_date(text).ok()?;
    Some(date.duration_since(SystemTime::now()).unwrap_or_default().min(MAX_RETRY_AFTER))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redirects_keep_host_port_and_tls() {
        let may = |from: &str, to: &str| may_follow(&from.parse().unwrap(), &to.parse().unwrap());
        assert!(may("https://h/a", "https://h/b?c"));
        assert!(may("https://h/a", "https://h:443/b"));
        assert!(may("http://h/a", "https://h/a"));
        assert!(may("http://h:81/a", "http://h:81/b"));
        for (from, to) in [
            ("https://h/a", "http://h/a"),
            ("https://h/a", "https://i/a"),
            ("https://h/a", "https://www.h/a"),
            ("https://h/a", "https://h:444/a"),
            ("http://h:81/a", "https://h/a"),
            ("http://h/a", "http://127.0.0.1/a"),
            ("http://h/a", "ftp://h/a"),
        ] {
            assert!(!may(from, to), "{from} {to}");
        }
    }

    #[test]
    fn retry_after_is_parsed_as_seconds_or_a_date() {
        let of = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(RETRY_AFTER, text.parse().unwrap());
            retry_after(&headers)
        };
        assert_eq!(of("7"), Some(Duration::from_secs(7)));
        let soon = httpdate::fmt_http_date(SystemTime::now() + Duration::from_secs(100));
        assert!(of(&soon).is_some_and(|d| (95..=100).contains(&d.as_secs())), "{soon}");
        assert_eq!(of("Wed, 21 Oct 2015 07:28:00 GMT"), Some(Duration::ZERO));
        assert_eq!(of("18446744073709551615"), Some(MAX_RETRY_AFTER));
        assert_eq!((of("soon"), of("-1"), of("1e9")), (None, None, None));
        assert_eq!(retry_after(&HeaderMap::new()), None);
    }
}
