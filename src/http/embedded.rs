//! Embedded files: stored with gzip, inflated for clients that do not accept it.

use std::io::Read as _;

use axum::http::HeaderMap;
use axum::http::header::{ACCEPT_ENCODING, CONTENT_ENCODING, VARY};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::problem::Problem;

/// Answers with an embedded file; `bytes` are compressed with gzip. The caller adds the content type.
pub(super) fn file(request: &HeaderMap, bytes: &'static [u8]) -> Result<Response, Problem> {
    let takes = |coding: &str| {
        let (name, weight) = coding.split_once(';').unwrap_or((coding, "q=1"));
        matches!(name.trim(), "gzip" | "*") && weight.trim().strip_prefix("q=").is_none_or(|q| q.parse() != Ok(0.0))
    };
    let accepted = request.get_all(ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
    if accepted.flat_map(|value| value.split(',')).any(takes) {
        let coding = [(CONTENT_ENCODING, "gzip"), (VARY, "accept-encoding")];
        return Ok((coding, Bytes::from_static(bytes)).into_response());
    }
    let mut plain = Vec::new();
    flate2::read::GzDecoder::new(bytes).read_to_end(&mut plain).map_err(Problem::internal)?;
    Ok(([(VARY, "accept-encoding")], plain).into_response())
}
