//! Preferences of a request: synchronous or asynchronous response, urgency, idempotency key.

use std::time::Duration;

use axum::http::HeaderMap;
use axum::http::header::HeaderName;

use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::jobs::{Client, DEFAULT_URGENCY, Rank};

/// `Prefer` (RFC 7240).
pub(super) const PREFER: HeaderName = HeaderName::from_static("prefer");
/// `Preference-Applied` (RFC 7240).
pub(super) const PREFERENCE_APPLIED: HeaderName = HeaderName::from_static("preference-applied");
/// `Priority` (RFC 9218).
pub(super) const PRIORITY: HeaderName = HeaderName::from_static("priority");
/// `Idempotency-Key`: repeated requests with the same key get the same job.
pub(super) const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");
/// Maximum length of an idempotency key.
const MAX_KEY: usize = 255;

/// Preferences of a request.
#[derive(Debug, Clone)]
pub(super) struct RequestPreferences {
    /// `respond-async`: answer with a job at once.
    pub(super) respond_async: bool,
    /// `wait=SECONDS`: answer with a job if the mesh takes longer. `None`: never answer with a job.
    pub(super) wait: Option<Duration>,
    pub(super) rank: Rank,
    pub(super) idempotency_key: Option<String>,
}

impl RequestPreferences {
    /// Reads the preferences of a request of `client`.
    pub(super) fn of(headers: &HeaderMap, client: Client) -> Result<Self, Problem> {
        let preferences = || list(headers, PREFER);
        let wait = preferences().find_map(|p| parameter(p, "wait")?.parse().ok().map(Duration::from_secs));
        let respond_async = preferences().any(|p| p.eq_ignore_ascii_case("respond-async"));
        let urgency = list(headers, PRIORITY)
            .find_map(|p| parameter(p, "u")?.parse().ok())
            .filter(|u| (0..=7).contains(u))
            .unwrap_or(DEFAULT_URGENCY);
        let rank = Rank { client, batch: respond_async, urgency };
        Ok(Self { respond_async, wait, rank, idempotency_key: key(headers)? })
    }
}

/// Members of a list header, without their parameters.
fn list(headers: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    let values = headers.get_all(name).iter().filter_map(|value| value.to_str().ok());
    values.flat_map(|value| value.split(',')).map(|member| member.split(';').next().unwrap_or_default().trim())
}

fn parameter<'a>(member: &'a str, name: &str) -> Option<&'a str> {
    let (key, value) = member.split_once('=')?;
    key.trim().eq_ignore_ascii_case(name).then(|| value.trim().trim_matches('"'))
}

fn key(headers: &HeaderMap) -> Result<Option<String>, Problem> {
    let bad = |detail: String| Problem::new(ProblemType::BadRequest, detail).with("parameter", "Idempotency-Key");
    let mut values = headers.get_all(&IDEMPOTENCY_KEY).iter();
    let Some(value) = values.next() else { return Ok(None) };
    if values.next().is_some() {
        return Err(bad("the request has more than one `Idempotency-Key` header".to_owned()));
    }
    let text = value.to_str().unwrap_or_default().trim().trim_matches('"');
    if text.is_empty() || text.len() > MAX_KEY || text.contains('\t') {
        let detail = format!("`Idempotency-Key` must have 1 to {MAX_KEY} printable ASCII characters");
        return Err(bad(detail).with("limit", MAX_KEY));
    }
    Ok(Some(text.to_owned()))
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn preferences(headers: &[(&'static str, &'static str)]) -> Result<RequestPreferences, Problem> {
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(HeaderName::from_static(name), HeaderValue::from_static(value));
        }
        RequestPreferences::of(&map, Client::default())
    }

    #[test]
    fn prefer_is_parsed_as_in_rfc_7240() {
        for (value, respond_async, wait) in [
            ("respond-async", true, None),
            ("Respond-Async, wait=5", true, Some(5)),
            ("wait=\"7\"; foo", false, Some(7)),
            ("return=minimal", false, None),
            ("wait=soon", false, None),
            ("", false, None),
        ] {
            let found = preferences(&[("prefer", value)]).unwrap();
            assert_eq!((found.respond_async, found.wait.map(|w| w.as_secs())), (respond_async, wait), "{value}");
            assert_eq!(found.rank.batch, respond_async);
        }
    }

    #[test]
    fn urgencies_and_keys_are_bounded() {
        for (value, urgency) in
            [("u=1", 1), ("u=7, i", 7), ("u=8", DEFAULT_URGENCY), ("u=-1", DEFAULT_URGENCY), ("i", 3)]
        {
            assert_eq!(preferences(&[("priority", value)]).unwrap().rank.urgency, urgency, "{value}");
        }
        let key = "idempotency-key";
        assert_eq!(preferences(&[(key, "\"abc\"")]).unwrap().idempotency_key.as_deref(), Some("abc"));
        assert_eq!(preferences(&[(key, "a b\t")]).unwrap().idempotency_key.as_deref(), Some("a b"));
        assert!(preferences(&[(key, "")]).is_err());
        assert!(preferences(&[(key, "a\tb")]).is_err());
        assert!(preferences(&[(key, "a"), (key, "a")]).unwrap_err().is(ProblemType::BadRequest));
        let long: &'static str = Box::leak("x".repeat(MAX_KEY + 1).into_boxed_str());
        assert!(preferences(&[(key, long)]).is_err());
    }
}
