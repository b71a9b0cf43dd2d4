//! `If-Match` and `If-None-Match` (RFC 9110).

use axum::body::{Body, HttpBody as _, to_bytes};
use axum::extract::Request;
use axum::http::header::{CACHE_CONTROL, CONTENT_LENGTH, ETAG, HeaderName, IF_MATCH, IF_NONE_MATCH};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::Response;

use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::store::Digest;

/// Maximum size of a document whose digest is its `ETag`, bytes.
const MAX_DOCUMENT: usize = 8 << 20;

/// Middleware: documents in memory that caches must compare before each use (`no-cache`) get their digest as `ETag`,
/// and a client that has them gets 304.
pub(super) async fn validate(request: Request, next: Next) -> Result<Response, Problem> {
    let mut conditions = HeaderMap::new();
    for name in [IF_MATCH, IF_NONE_MATCH] {
        conditions.extend(request.headers().get_all(&name).iter().map(|value| (name.clone(), value.clone())));
    }
    let is_read = [Method::GET, Method::HEAD].contains(request.method());
    let response = next.run(request).await;
    let headers = response.headers();
    let is_compared = headers.get(CACHE_CONTROL).is_some_and(|value| value.as_bytes().ends_with(b"no-cache"));
    let size = response.body().size_hint().exact().and_then(|size| usize::try_from(size).ok());
    let is_document = size.is_some_and(|size| (1..=MAX_DOCUMENT).contains(&size));
    if !is_read || response.status() != StatusCode::OK || !is_compared || headers.contains_key(ETAG) || !is_document {
        return Ok(response);
    }
    let (mut parts, body) = response.into_parts();
    let bytes = to_bytes(body, MAX_DOCUMENT).await.map_err(Problem::internal)?;
    let etag = HeaderValue::from_str(&format!("\"{}\"", Digest::of(&bytes))).map_err(Problem::internal)?;
    check_match(&conditions, &etag)?;
    let is_unchanged = is_unchanged(&conditions, &etag);
    parts.headers.insert(ETAG, etag);
    if is_unchanged {
        parts.status = StatusCode::NOT_MODIFIED;
        parts.headers.remove(CONTENT_LENGTH);
        return Ok(Response::from_parts(parts, Body::empty()));
    }
    Ok(Response::from_parts(parts, Body::from(bytes)))
}

/// Returns true if the client has the file with this `etag`, by weak comparison.
pub(super) fn is_unchanged(headers: &HeaderMap, etag: &HeaderValue) -> bool {
    tags(headers, IF_NONE_MATCH).any(|tag| tag == "*" || tag.strip_prefix("W/").unwrap_or(tag).as_bytes() == etag)
}

/// Returns true if the client names any current file (`If-None-Match: *`) instead of a tag.
pub(super) fn names_any(headers: &HeaderMap) -> bool {
    tags(headers, IF_NONE_MATCH).any(|tag| tag == "*")
}

/// Fails if the client expects a file with another `etag`, by strong comparison.
pub(super) fn check_match(headers: &HeaderMap, etag: &HeaderValue) -> Result<(), Problem> {
    if !headers.contains_key(IF_MATCH) || tags(headers, IF_MATCH).any(|tag| tag == "*" || tag.as_bytes() == etag) {
        return Ok(());
    }
    Err(Problem::new(ProblemType::PreconditionFailed, "no `ETag` in `If-Match` is that of the current file"))
}

/// Returns the tags in a header, which may occur several times.
fn tags(headers: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    let values = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
    values.flat_map(|value| value.split(',')).map(str::trim)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tags_are_compared_weakly() {
        let etag = HeaderValue::from_static("\"abc\"");
        for (sent, unchanged) in [
            ("\"abc\"", true),
            ("W/\"abc\"", true),
            ("\"x\", \"abc\"", true),
            ("*", true),
            ("\"x\"", false),
            ("abc", false),
        ] {
            let headers = HeaderMap::from_iter([(IF_NONE_MATCH, HeaderValue::from_static(sent))]);
            assert_eq!(is_unchanged(&headers, &etag), unchanged, "{sent}");
        }
        assert!(!is_unchanged(&HeaderMap::new(), &etag));
    }

    #[test]
    fn expected_tags_are_compared_strongly() {
        let etag = HeaderValue::from_static("\"abc\"");
        for (sent, matches) in [
            ("\"abc\"", true),
            ("\"x\", \"abc\"", true),
            ("*", true),
            ("W/\"abc\"", false),
            ("\"x\"", false),
            ("abc", false),
            ("", false),
        ] {
            let headers = HeaderMap::from_iter([(IF_MATCH, HeaderValue::from_static(sent))]);
            assert_eq!(check_match(&headers, &etag).is_ok(), matches, "{sent}");
        }
        assert!(check_match(&HeaderMap::new(), &etag).is_ok());
    }
}
