//! One question to a remote archive: the address of an entry to its bytes, counted while they come.

use std::error::Error;
use std::path::Path;
use std::time::{Duration, SystemTime};

use bytes::{Bytes, BytesMut};
use reqwest::header::{ETAG, HeaderMap, HeaderName, IF_MODIFIED_SINCE, IF_NONE_MATCH, LAST_MODIFIED, RETRY_AFTER};
use reqwest::redirect::{Attempt, Policy};
use reqwest::{Client, Proxy, Response, StatusCode, Url};

use super::address::{Checked, Refused};
use super::error::Why;
use super::gzip;
use super::memory::{NoMemory, Share};
use crate::config::{ArchiveConfig, Templates};
use crate::store::Digest;
use crate::telemetry::{SpanContext, traceparent, tracestate};

/// Redirects that are followed.
const HOPS: usize = 3;
/// Memory that is set aside on the word of a `Content-Length`.
const TRUSTED: u64 = 1 << 20;
/// Longest `Retry-After` that is taken for meant.
const DAY: Duration = Duration::from_hours(24);
/// Who asks.
const USER_AGENT: &str = concat!("molmesh/", env!("CARGO_PKG_VERSION"), " (molecular surface service)");

const TRACEPARENT: HeaderName = HeaderName::from_static("traceparent");
const TRACESTATE: HeaderName = HeaderName::from_static("tracestate");

/// What an archive says of the version that it sent, to ask later whether that is still the one.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Validators {
    pub(super) etag: Option<String>,
    pub(super) last_modified: Option<String>,
}

/// What an archive answered.
#[derive(Debug)]
pub(super) enum Answer {
    /// The entry.
    Body { bytes: Bytes, digest: Digest, url: String, validators: Validators, share: Box<dyn Share> },
    /// What we have is still the one.
    Unchanged,
    /// It has no such entry.
    Absent,
}

/// Why there is no answer.
#[derive(Debug)]
pub(super) enum Failed {
    /// The answer is longer than allowed; the bytes that were announced, if any.
    TooLarge(Option<u64>),
    /// There is no memory for it.
    Memory(NoMemory),
    /// Anything else: what, when to come back if the host said so, details for the log.
    Other { why: Why, retry_after: Option<Duration>, detail: String },
}

impl Failed {
    pub(super) fn other(why: Why, detail: &(impl ToString + ?Sized)) -> Self {
        Self::Other { why, retry_after: None, detail: detail.to_string() }
    }
}

/// Limits of a question.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    /// Time for the head, redirects included, and longest pause within the body.
    pub(super) head: Duration,
    pub(super) pause: Duration,
    pub(super) bytes: u64,
    /// Inflated bytes after which the completeness check of a gzip file stops.
    pub(super) inflated: u64,
}

/// The client of all questions. Blocks: it reads the system's certificates.
pub(super) fn build(config: &ArchiveConfig) -> Result<Client, reqwest::Error> {
    crate::tls::install_provider();
    let builder = || {
        let builder = Client::builder()
            .user_agent(USER_AGENT)
            .connect_timeout(config.connect_timeout())
            .redirect(Policy::custom(follow))
            .referer(false)
            .dns_resolver(Checked { allow_private: config.allow_private || config.proxy.is_some() });
        Ok(match &config.proxy {
            Some(proxy) => builder.proxy(Proxy::all(proxy.as_str())?),
            None => builder.no_proxy(),
        })
    };
    let templates = config.url.as_ref().map(Templates::as_slice).unwrap_or_default();
    let needs_tls = templates.iter().any(|t| t.to_string().starts_with("https:"));
    match builder()?.build() {
        // A machine without certificates can still speak plain HTTP.
        Err(_no_certificates) if !needs_tls => builder()?.tls_certs_only([]).build(),
        built => built,
    }
}

/// Redirects stay on their host, and what was encrypted stays so.
fn follow(attempt: Attempt<'_>) -> reqwest::redirect::Action {
    let why = match attempt.previous() {
        [] => "from nowhere",
        previous if previous.len() > HOPS => "too many redirects",
        [.., last] if !may_follow(last, attempt.url()) => "a redirect to another host, port or scheme",
        _ => return attempt.follow(),
    };
    attempt.error(why)
}

fn may_follow(from: &Url, to: &Url) -> bool {
    let same_place = from.scheme() == to.scheme() && from.port_or_known_default() == to.port_or_known_default();
    let upgrade = from.scheme() == "http" && to.scheme() == "https" && from.port().is_none() && to.port().is_none();
    from.host_str() == to.host_str() && (same_place || upgrade)
}

/// Asks for a head alone: the status of the answer.
pub(super) async fn head(client: &Client, url: Url) -> Result<u16, Failed> {
    client.head(url).send().await.map(|answer| answer.status().as_u16()).map_err(|error| of_client(&error))
}

/// Asks once. What comes is counted by `share` while it comes, and for as long as the answer lives.
pub(super) async fn get(
    client: &Client,
    url: Url,
    known: Option<&Validators>,
    limits: Limits,
    mut share: Box<dyn Share>,
    trace: &SpanContext,
) -> Result<Answer, Failed> {
    let compressed = Path::new(url.path()).extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gz"));
    let name = url.to_string();
    let mut request = client.get(url).header(TRACEPARENT, traceparent(trace));
    request = tracestate(trace).into_iter().fold(request, |request, state| request.header(TRACESTATE, state));
    if let Some(Validators { etag, last_modified }) = known {
        for (header, value) in [(IF_NONE_MATCH, etag), (IF_MODIFIED_SINCE, last_modified)] {
            request = value.iter().fold(request, |request, value| request.header(header.clone(), value));
        }
    }
    let response = tokio::time::timeout(limits.head, request.send())
        .await
        .map_err(|_elapsed| Failed::other(Why::Timeout, "no head in time"))?
        .map_err(|error| of_client(&error))?;
    match response.status() {
        StatusCode::OK => {}
        StatusCode::NOT_MODIFIED if known.is_some() => return Ok(Answer::Unchanged),
        StatusCode::NOT_FOUND | StatusCode::GONE => return Ok(Answer::Absent),
        // Where the client would not even know how to follow.
        status if status.is_redirection() && status != StatusCode::NOT_MODIFIED => {
            return Err(Failed::other(Why::Redirect, &status));
        }
        status => {
            let retry_after = retry_after(response.headers());
            return Err(Failed::Other { why: Why::Status(status.as_u16()), retry_after, detail: status.to_string() });
        }
    }
    let text = |name: HeaderName| Some(response.headers().get(name)?.to_str().ok()?.to_owned());
    let validators = Validators { etag: text(ETAG), last_modified: text(LAST_MODIFIED) };
    let bytes = body(response, limits, share.as_mut()).await?;
    let (bytes, digest) = tokio::task::spawn_blocking(move || {
        if compressed && !gzip::is_complete_gzip(&bytes, limits.inflated) {
            return Err(Failed::other(Why::Damaged, "the file is incomplete"));
        }
        let digest = Digest::of(&bytes);
        Ok((bytes, digest))
    })
    .await
    .map_err(|error| Failed::other(Why::Client, &error))??;
    Ok(Answer::Body { bytes, digest, url: name, validators, share })
}

/// Receives the body, and no more than is allowed of it.
async fn body(mut response: Response, limits: Limits, share: &mut dyn Share) -> Result<Bytes, Failed> {
    let announced = response.content_length();
    if announced.is_some_and(|bytes| bytes > limits.bytes) {
        return Err(Failed::TooLarge(announced));
    }
    let room = usize::try_from(announced.unwrap_or(0).min(TRUSTED)).unwrap_or(0);
    let mut body = BytesMut::with_capacity(room);
    loop {
        let chunk = tokio::time::timeout(limits.pause, response.chunk())
            .await
            .map_err(|_elapsed| Failed::other(Why::Timeout, "the body stalls"))?;
        let Some(chunk) = chunk.map_err(|error| of_client(&error))? else { break };
        if body.len() as u64 + chunk.len() as u64 > limits.bytes {
            return Err(Failed::TooLarge(None));
        }
        share.grow(chunk.len() as u64).map_err(Failed::Memory)?;
        body.extend_from_slice(&chunk);
    }
    match announced {
        Some(bytes) if bytes != body.len() as u64 => {
            Err(Failed::other(Why::Broken, &format!("{} bytes came where {bytes} were announced", body.len())))
        }
        _ => Ok(body.freeze()),
    }
}

/// What the client's error means to us.
fn of_client(error: &reqwest::Error) -> Failed {
    let (mut causes, mut next): (Vec<&dyn Error>, Option<&dyn Error>) = (Vec::new(), Some(error));
    while let Some(cause) = next {
        causes.push(cause);
        next = cause.source();
    }
    let why = if causes.iter().any(|cause| cause.is::<Refused>()) {
        Why::Private
    } else if error.is_redirect() {
        Why::Redirect
    } else if error.is_timeout() {
        Why::Timeout
    } else if error.is_connect() {
        Why::Connect
    } else {
        Why::Broken
    };
    let words: Vec<String> = causes.iter().map(ToString::to_string).collect();
    Failed::other(why, &words.join(": "))
}

/// `Retry-After`, as seconds or as a date.
fn retry_after(headers: &HeaderMap) -> Option<Duration> {
    let text = headers.get(RETRY_AFTER)?.to_str().ok()?.trim();
    if let Ok(seconds) = text.parse() {
        return Some(Duration::from_secs(seconds).min(DAY));
    }
    let date = httpdate::parse_http_date(text).ok()?;
    Some(date.duration_since(SystemTime::now()).unwrap_or_default().min(DAY))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redirects_stay_where_they_are() {
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
    fn hosts_say_when_to_come_back() {
        let of = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(RETRY_AFTER, text.parse().unwrap());
            retry_after(&headers)
        };
        assert_eq!(of("7"), Some(Duration::from_secs(7)));
        let soon = httpdate::fmt_http_date(SystemTime::now() + Duration::from_secs(100));
        assert!(of(&soon).is_some_and(|d| (95..=100).contains(&d.as_secs())), "{soon}");
        assert_eq!(of("Wed, 21 Oct 2015 07:28:00 GMT"), Some(Duration::ZERO));
        assert_eq!(of("18446744073709551615"), Some(DAY));
        assert_eq!((of("soon"), of("-1"), of("1e9")), (None, None, None));
        assert_eq!(retry_after(&HeaderMap::new()), None);
    }
}
