//! How an answer is wished for: at once or later, how urgently, and under which key it may be asked for again.

use std::time::Duration;

use axum::http::header::HeaderName;
use axum::http::{Extensions, HeaderMap, HeaderValue};

use super::guard::Caller;
use super::kinds::Kind;
use super::problem::Problem;
use crate::jobs::{Rank, USUAL_URGENCY};

/// `Prefer` (RFC 7240).
pub(super) const PREFER: HeaderName = HeaderName::from_static("prefer");
/// What of it was heeded.
pub(super) const PREFERENCE_APPLIED: HeaderName = HeaderName::from_static("preference-applied");
/// `Priority` (RFC 9218).
pub(super) const PRIORITY: HeaderName = HeaderName::from_static("priority");
/// The key under which a request may be sent again.
pub(super) const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");
/// Characters of such a key at most.
const MAX_KEY: usize = 255;

/// The wishes of a request.
#[derive(Debug, Clone)]
pub(super) struct Wish {
    /// `respond-async`: an answer at once, the mesh later.
    pub(super) later: bool,
    /// `wait=`: how long the client would wait for the mesh itself.
    pub(super) wait: Option<Duration>,
    pub(super) rank: Rank,
    /// Whose request it is.
    pub(super) caller: Caller,
    pub(super) idempotency: Option<String>,
}

impl Wish {
    /// Reads the wishes of a request.
    pub(super) fn of(headers: &HeaderMap, extensions: &Extensions) -> Result<Self, Problem> {
        let preferences = || list(headers, PREFER);
        let wait = preferences().find_map(|p| parameter(p, "wait")?.parse().ok().map(Duration::from_secs));
        let later = preferences().any(|p| p.eq_ignore_ascii_case("respond-async"));
        let urgency = list(headers, PRIORITY)
            .find_map(|p| parameter(p, "u")?.parse().ok())
            .filter(|u| (0..=7).contains(u))
            .unwrap_or(USUAL_URGENCY);
        let caller = Caller::of(extensions);
        Ok(Self {
            later,
            wait,
            rank: Rank { client: caller.client, batch: later, urgency },
            caller,
            idempotency: headers.get(&IDEMPOTENCY_KEY).map(key).transpose()?,
        })
    }

    /// What the answer says of the preferences.
    pub(super) fn applied(&self, later: bool) -> Option<HeaderValue> {
        (self.later && later).then(|| HeaderValue::from_static("respond-async"))
    }
}

/// The members of a list header.
fn list(headers: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    let values = headers.get_all(name).iter().filter_map(|value| value.to_str().ok());
    // A preference may carry parameters behind a semicolon, which are not ours.
    values.flat_map(|value| value.split(',')).map(|member| member.split(';').next().unwrap_or_default().trim())
}

fn parameter<'a>(member: &'a str, name: &str) -> Option<&'a str> {
    let (key, value) = member.split_once('=')?;
    key.trim().eq_ignore_ascii_case(name).then(|| value.trim().trim_matches('"'))
}

fn key(value: &HeaderValue) -> Result<String, Problem> {
    let text = value.to_str().unwrap_or_default().trim().trim_matches('"');
    if text.is_empty() || text.len() > MAX_KEY {
        let detail = format!("`Idempotency-Key` has 1 to {MAX_KEY} visible characters");
        return Err(Problem::new(Kind::BadRequest, detail).with("parameter", "Idempotency-Key").with("limit", MAX_KEY));
    }
    Ok(text.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wish(headers: &[(&'static str, &'static str)]) -> Result<Wish, Problem> {
        let headers = headers.iter().map(|(n, v)| (HeaderName::from_static(n), HeaderValue::from_static(v))).collect();
        Wish::of(&headers, &Extensions::new())
    }

    #[test]
    fn preferences_are_read_as_the_standard_writes_them() {
        for (value, later, wait) in [
            ("respond-async", true, None),
            ("Respond-Async, wait=5", true, Some(5)),
            ("wait=\"7\"; foo", false, Some(7)),
            ("return=minimal", false, None),
            ("wait=soon", false, None),
            ("", false, None),
        ] {
            let wish = wish(&[("prefer", value)]).unwrap();
            assert_eq!((wish.later, wish.wait.map(|w| w.as_secs())), (later, wait), "{value}");
            assert_eq!(wish.rank.batch, later);
            assert_eq!(wish.applied(true).is_some(), later);
            assert!(wish.applied(false).is_none());
        }
    }

    #[test]
    fn urgencies_and_keys_are_bounded() {
        for (value, urgency) in [("u=1", 1), ("u=7, i", 7), ("u=8", USUAL_URGENCY), ("u=-1", USUAL_URGENCY), ("i", 3)] {
            assert_eq!(wish(&[("priority", value)]).unwrap().rank.urgency, urgency, "{value}");
        }
        assert_eq!(wish(&[("idempotency-key", "\"abc\"")]).unwrap().idempotency.as_deref(), Some("abc"));
        assert!(wish(&[("idempotency-key", "")]).is_err());
        let long: &'static str = Box::leak("x".repeat(MAX_KEY + 1).into_boxed_str());
        assert!(wish(&[("idempotency-key", long)]).is_err());
    }
}
