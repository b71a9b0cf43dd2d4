//! `If-Match` and `If-None-Match` (RFC 9110).

use axum::http::header::{HeaderName, IF_MATCH, IF_NONE_MATCH};
use axum::http::{HeaderMap, HeaderValue};

use super::problem::Problem;
use super::problem_types::ProblemType;

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
