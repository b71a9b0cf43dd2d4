//! Content codings (RFC 9110): `zstd`, `br` or `gzip` by `Accept-Encoding`, applied while a response is sent.
//!
//! Compressed responses are not stored. `zstd` compresses a mesh faster than most networks transfer it, and the store
//! would need room for each coding. No response has a secret beside text that another party chooses, so the length of a
//! compressed response reveals nothing (BREACH).

use std::io;

use async_compression::Level;
use async_compression::brotli::EncoderParams as BrotliParams;
use async_compression::tokio::bufread::{BrotliEncoder, GzipEncoder, ZstdEncoder};
use axum::body::{Body, HttpBody as _};
use axum::extract::{Request, State};
use axum::http::header::{
    ACCEPT_ENCODING, ACCEPT_RANGES, CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE, ETAG, IF_MATCH, IF_NONE_MATCH, VARY,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::Response;
use futures_util::TryStreamExt as _;
use tokio::io::AsyncRead;
use tokio_util::io::{ReaderStream, StreamReader};

use super::conditional;
use super::guard::Caller;
use super::negotiate::weight;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::Shared;
use crate::jobs::MemoryReservation;

/// Size of a response below which a coding gains nothing, bytes.
const MIN_BYTES: u64 = 1 << 10;
/// Size of the pieces of a compressed response, bytes.
const PIECE: usize = 64 << 10;
/// Binary logarithm of the window of `br`, bytes. The default of 22 takes 16 times the memory.
const BROTLI_WINDOW: i32 = 18;
/// Media types that compress well, by their beginnings.
const TYPES: [&str; 6] =
    ["model/", "application/json", "application/ply", "application/yaml", "image/svg+xml", "text/"];
/// Type of event streams, whose events must not wait for more.
const EVENTS: &str = "text/event-stream";

/// Content coding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Coding {
    Zstd,
    Brotli,
    Gzip,
}

impl Coding {
    /// All codings. Of those with the same weight, the first one is used.
    const ALL: [Self; 3] = [Self::Zstd, Self::Brotli, Self::Gzip];

    /// Returns the name in headers.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Zstd => "zstd",
            Self::Brotli => "br",
            Self::Gzip => "gzip",
        }
    }

    /// Returns the memory of an encoder, bytes.
    const fn bytes(self) -> u64 {
        match self {
            Self::Zstd | Self::Brotli => 4 << 20,
            Self::Gzip => 512 << 10,
        }
    }

    /// Compresses a body, and holds `memory` until it ends.
    fn encode(self, body: Body, memory: MemoryReservation) -> Body {
        let plain = StreamReader::new(body.into_data_stream().map_err(io::Error::other));
        match self {
            Self::Zstd => stream(ZstdEncoder::with_quality(plain, Level::Default), memory),
            Self::Brotli => {
                let params = BrotliParams::default().quality(Level::Precise(4)).window_size(BROTLI_WINDOW);
                stream(BrotliEncoder::with_params(plain, params), memory)
            }
            Self::Gzip => stream(GzipEncoder::with_quality(plain, Level::Precise(4)), memory),
        }
    }

    /// Returns the end of the entity tags of compressed responses, which differ from that of the same response in
    /// another coding.
    fn tag_end(self) -> String {
        format!("-{}\"", self.name())
    }

    /// Returns the entity tag of a compressed response. `etag` is that of the response without a coding.
    fn etag(self, etag: &HeaderValue) -> Option<HeaderValue> {
        HeaderValue::from_str(&format!("{}{}", etag.to_str().ok()?.strip_suffix('"')?, self.tag_end())).ok()
    }
}

fn stream(coded: impl AsyncRead + Send + 'static, memory: MemoryReservation) -> Body {
    Body::from_stream(ReaderStream::with_capacity(coded, PIECE).inspect_ok(move |_piece| _ = &memory))
}

/// Returns the weight of a coding in `Accept-Encoding`: that of its name, else that of `*`. `None` if it has neither.
/// Malformed members are ignored.
fn weight_of(headers: &HeaderMap, coding: &str) -> Option<f64> {
    let find = |wanted: &str| {
        let values = headers.get_all(ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
        values.flat_map(|value| value.split(',')).find_map(|member| {
            let mut parts = member.split(';').map(str::trim);
            let is_wanted = parts.next().is_some_and(|name| name.eq_ignore_ascii_case(wanted));
            is_wanted.then(|| weight(parts)).flatten()
        })
    };
    find(coding).or_else(|| find("*"))
}

/// Returns true if the client accepts a coding.
pub(super) fn is_accepted(headers: &HeaderMap, coding: Coding) -> bool {
    weight_of(headers, coding.name()).is_some_and(|weight| weight > 0.0)
}

/// Returns the coding that the client prefers; `None` for the plain response.
///
/// # Errors
/// [`ProblemType::NotAcceptable`] if it accepts neither the plain response nor a known coding.
fn preferred(headers: &HeaderMap) -> Result<Option<Coding>, Problem> {
    if !headers.contains_key(ACCEPT_ENCODING) {
        return Ok(None);
    }
    let weights = Coding::ALL.map(|coding| (coding, weight_of(headers, coding.name()).unwrap_or(0.0)));
    // `max_by` returns the last of equal elements; the first one is wanted.
    let best = weights.into_iter().rev().max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, weight)| *weight > 0.0);
    let plain = weight_of(headers, "identity");
    match best {
        Some((coding, weight)) => Ok((plain.is_none_or(|plain| plain <= weight)).then_some(coding)),
        None if plain == Some(0.0) => {
            let available = Coding::ALL.map(Coding::name);
            let detail = format!("the available content codings are {} and identity", available.join(", "));
            Err(Problem::new(ProblemType::NotAcceptable, detail).with("available", available.to_vec()))
        }
        None => Ok(None),
    }
}

/// Replaces the tags of compressed responses in the conditions of a request by those of the plain ones, which handlers
/// know. Returns `If-None-Match` as it was sent.
fn strip_conditions(headers: &mut HeaderMap, coding: Coding) -> HeaderMap {
    let sent = headers.get_all(IF_NONE_MATCH).iter().map(|value| (IF_NONE_MATCH, value.clone())).collect();
    for (_, value) in headers.iter_mut().filter(|(name, _)| [IF_MATCH, IF_NONE_MATCH].contains(name)) {
        let stripped = value.to_str().ok().map(|text| text.replace(&coding.tag_end(), "\""));
        if let Some(stripped) = stripped.and_then(|text| HeaderValue::from_str(&text).ok()) {
            *value = stripped;
        }
    }
    sent
}

/// Returns true if a coding makes a response smaller, or the whole response of which this is a range.
fn is_compressible(response: &Response) -> bool {
    let headers = response.headers();
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let length = text(CONTENT_LENGTH).and_then(|length| length.parse().ok());
    let length = length.or_else(|| response.body().size_hint().exact());
    response.status().is_success()
        && !headers.contains_key(CONTENT_ENCODING)
        && text(CONTENT_TYPE).is_some_and(|t| TYPES.iter().any(|start| t.starts_with(start)) && !t.starts_with(EVENTS))
        && (is_range(response) || length.is_none_or(|length| length >= MIN_BYTES))
}

fn is_range(response: &Response) -> bool {
    response.status() == StatusCode::PARTIAL_CONTENT
}

/// Middleware: compresses responses for clients that accept a coding. Without memory for the encoder, a response stays
/// plain.
pub(super) async fn negotiate(
    State(app): State<Shared>,
    caller: Caller,
    mut request: Request,
    next: Next,
) -> Result<Response, Problem> {
    let coding = preferred(request.headers())?;
    let sent = coding.map(|coding| strip_conditions(request.headers_mut(), coding)).unwrap_or_default();
    let mut response = next.run(request).await;
    if response.status() == StatusCode::NOT_MODIFIED {
        let headers = response.headers_mut();
        let own = coding.zip(headers.get(ETAG)).and_then(|(coding, etag)| coding.etag(etag));
        // A client that has the plain response, or any (`*`), gets the plain tag.
        let is_named = |own: &HeaderValue| conditional::is_unchanged(&sent, own) && !conditional::names_any(&sent);
        if let Some(own) = own.filter(is_named) {
            headers.insert(ETAG, own);
        }
        add_vary(headers);
        return Ok(response);
    }
    if !is_compressible(&response) {
        return Ok(response);
    }
    add_vary(response.headers_mut());
    if is_range(&response) {
        return Ok(response);
    }
    let memory = app.memory(caller.client).reservation();
    let Some(coding) = coding.filter(|coding| memory.grow(coding.bytes()).is_ok()) else { return Ok(response) };
    let headers = response.headers_mut();
    headers.insert(CONTENT_ENCODING, HeaderValue::from_static(coding.name()));
    headers.remove(CONTENT_LENGTH);
    // Ranges are those of the plain response.
    headers.remove(ACCEPT_RANGES);
    if let Some(etag) = headers.get(ETAG).and_then(|etag| coding.etag(etag)) {
        headers.insert(ETAG, etag);
    }
    // The length is unknown for HEAD as well, whose plain body would declare its own.
    Ok(response.map(|body| coding.encode(body, memory)))
}

/// Tells caches that the response depends on `Accept-Encoding`.
fn add_vary(headers: &mut HeaderMap) {
    if !headers.get_all(VARY).iter().any(|value| value == ACCEPT_ENCODING.as_str()) {
        headers.append(VARY, HeaderValue::from(ACCEPT_ENCODING));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn accepting(header: &str) -> HeaderMap {
        HeaderMap::from_iter([(ACCEPT_ENCODING, header.parse().unwrap())])
    }

    #[test]
    fn the_heaviest_known_coding_is_preferred() {
        use Coding::{Brotli, Gzip, Zstd};
        for (header, expected) in [
            ("gzip", Some(Gzip)),
            ("gzip, deflate, br", Some(Brotli)),
            ("gzip, deflate, br, zstd", Some(Zstd)),
            ("br, GZIP;q=0.5", Some(Brotli)),
            ("br;q=0.5, gzip; q=0.7", Some(Gzip)),
            ("*", Some(Zstd)),
            ("zstd;q=0, *", Some(Brotli)),
            ("identity;q=0.5, gzip;q=0.5", Some(Gzip)),
            ("identity, gzip;q=0.5", None),
            ("identity;q=0, gzip;q=0.1", Some(Gzip)),
            ("gzip;q=0", None),
            ("gzip; q=0.000", None),
            ("deflate", None),
            ("", None),
            (";;;,gzip;q=nonsense,,", None),
        ] {
            assert_eq!(preferred(&accepting(header)).unwrap(), expected, "{header}");
        }
        assert_eq!(preferred(&HeaderMap::new()).unwrap(), None);
        for header in ["identity;q=0", "*;q=0", "identity;q=0, deflate", "*;q=0, gzip;q=0"] {
            assert!(preferred(&accepting(header)).is_err(), "{header}");
        }
    }

    #[test]
    fn gzip_is_accepted_by_name_or_by_wildcard() {
        for (header, accepted) in [
            ("gzip", true),
            ("*;q=0, gzip", true),
            ("br;q=1, *;q=0.1", true),
            ("br", false),
            ("gzip;q=0, *", false),
            ("*, gzip;q=0", false),
        ] {
            assert_eq!(is_accepted(&accepting(header), Coding::Gzip), accepted, "{header}");
        }
        assert!(!is_accepted(&HeaderMap::new(), Coding::Gzip));
    }

    #[test]
    fn tags_of_compressed_responses_are_those_of_the_plain_ones_for_handlers() {
        let etag = HeaderValue::from_static("\"abc\"");
        let coded = Coding::Zstd.etag(&etag).unwrap();
        assert_eq!(coded, "\"abc-zstd\"");
        let lines = ["\"x-br\", W/\"abc-zstd\"", "\"def-zstd\""];
        let mut headers: HeaderMap =
            lines.map(|line| (IF_NONE_MATCH, HeaderValue::from_static(line))).into_iter().collect();
        let sent = strip_conditions(&mut headers, Coding::Zstd);
        let values = |headers: &HeaderMap| headers.get_all(IF_NONE_MATCH).iter().cloned().collect::<Vec<_>>();
        assert_eq!(values(&sent), lines);
        assert_eq!(values(&headers), ["\"x-br\", W/\"abc\"", "\"def\""]);
    }
}
