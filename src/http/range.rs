//! `Range` and `If-Range` (RFC 9110): one range of bytes. A request for several ranges gets the whole file, as the RFC
//! allows.

use std::ops::Range;

use axum::http::header::{IF_RANGE, RANGE};
use axum::http::{HeaderMap, HeaderValue};

/// Requested part of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Wanted {
    All,
    /// Non-empty range within the file.
    Part(Range<u64>),
    /// Range outside the file.
    Nothing,
}

/// Returns the requested part of a file of `length` bytes with the strong validator `etag`.
pub(super) fn wanted(headers: &HeaderMap, etag: &HeaderValue, length: u64) -> Wanted {
    let Some(text) = headers.get(RANGE).and_then(|value| value.to_str().ok()) else { return Wanted::All };
    // A range of another version is useless. Dates are not supported as validators.
    if headers.get(IF_RANGE).is_some_and(|tag| tag != etag) {
        return Wanted::All;
    }
    let Some(spec) = text.trim().strip_prefix("bytes=").map(str::trim) else { return Wanted::All };
    let Some((first, last)) = spec.split_once('-') else { return Wanted::All };
    let number = |text: &str| text.bytes().all(|c| c.is_ascii_digit()).then(|| text.parse::<u64>().unwrap_or(u64::MAX));
    match (first.trim(), last.trim()) {
        ("", "") => Wanted::All,
        ("", last) => match number(last) {
            None => Wanted::All,
            Some(0) => Wanted::Nothing,
            Some(_) if length == 0 => Wanted::Nothing,
            Some(n) => Wanted::Part(length.saturating_sub(n)..length),
        },
        (first, last) => {
            let end = if last.is_empty() { Some(u64::MAX) } else { number(last) };
            match (number(first), end) {
                (Some(first), Some(last)) if first > last => Wanted::All,
                (Some(first), Some(_)) if first >= length => Wanted::Nothing,
                (Some(first), Some(last)) => Wanted::Part(first..last.saturating_add(1).min(length)),
                _ => Wanted::All,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table() {
        let etag = HeaderValue::from_static("\"x\"");
        for (range, expected) in [
            ("bytes=0-9", Wanted::Part(0..10)),
            ("bytes=0-0", Wanted::Part(0..1)),
            ("bytes=90-", Wanted::Part(90..100)),
            ("bytes=90-1000", Wanted::Part(90..100)),
            ("bytes=-10", Wanted::Part(90..100)),
            ("bytes=-1000", Wanted::Part(0..100)),
            ("bytes=99999999999999999999-", Wanted::Nothing),
            ("bytes=100-", Wanted::Nothing),
            ("bytes=-0", Wanted::Nothing),
            ("bytes=5-4", Wanted::All),
            ("bytes=0-1,5-6", Wanted::All),
            ("bytes=-", Wanted::All),
            ("bytes=+1-2", Wanted::All),
            ("lines=0-9", Wanted::All),
            ("nonsense", Wanted::All),
        ] {
            let headers = HeaderMap::from_iter([(RANGE, HeaderValue::from_static(range))]);
            assert_eq!(wanted(&headers, &etag, 100), expected, "{range}");
        }
        assert_eq!(wanted(&HeaderMap::new(), &etag, 100), Wanted::All);
    }

    #[test]
    fn parts_of_another_version_are_not_sent() {
        let etag = HeaderValue::from_static("\"x\"");
        for (tag, expected) in [("\"x\"", Wanted::Part(0..10)), ("\"y\"", Wanted::All), ("W/\"x\"", Wanted::All)] {
            let range = (RANGE, HeaderValue::from_static("bytes=0-9"));
            let headers = HeaderMap::from_iter([range, (IF_RANGE, HeaderValue::from_static(tag))]);
            assert_eq!(wanted(&headers, &etag, 100), expected, "{tag}");
        }
    }
}
