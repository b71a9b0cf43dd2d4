//! The record of a job that was promised: what survives the process.

use std::fmt;
use std::str::FromStr;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use hmac::{Hmac, KeyInit as _, Mac as _};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::Sha256;
use thiserror::Error;

use crate::store::Secret;
use crate::telemetry::{SpanParent, Tracer, read_trace_context, traceparent, tracestate};

/// Not a job's id: 32 hexadecimal digits in lower case are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a job's id has 32 hexadecimal digits in lower case")]
pub struct BadJobId;

/// The id of a job. Whoever knows it may see and cancel the job, so it cannot be guessed.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct JobId(String);

impl JobId {
    /// A new id, of 128 random bits.
    ///
    /// # Errors
    /// That of the system, if it has no random numbers.
    pub fn random() -> std::io::Result<Self> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(std::io::Error::from)?;
        Ok(Self(format!("{:032x}", u128::from_be_bytes(bytes))))
    }

    /// Returns the id for an idempotency key: the same for the same key of the same client, also after a restart.
    /// HMAC-SHA-256 under `secret`, so that client and key alone do not reveal it.
    #[must_use]
    pub(super) fn of_key(secret: &Secret, client: u64, key: &str) -> Self {
        // HMAC pads a key to the block length with zeros.
        let mut block = [0; 64];
        block[..secret.len()].copy_from_slice(secret);
        let mut mac = Hmac::<Sha256>::new(&block.into());
        mac.update(format!("idempotency\n{client:x}\n{key}").as_bytes());
        let bytes = mac.finalize().into_bytes();
        let id = bytes.iter().take(16).fold(0_u128, |id, byte| id << 8 | u128::from(*byte));
        Self(format!("{id:032x}"))
    }

    /// The id.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for JobId {
    type Err = BadJobId;

    fn from_str(text: &str) -> Result<Self, BadJobId> {
        let hex = |c: u8| c.is_ascii_digit() || (b'a'..=b'f').contains(&c);
        if text.len() == 32 && text.bytes().all(hex) { Ok(Self(text.to_owned())) } else { Err(BadJobId) }
    }
}

impl TryFrom<String> for JobId {
    type Error = BadJobId;

    fn try_from(text: String) -> Result<Self, BadJobId> {
        text.parse()
    }
}

impl From<JobId> for String {
    fn from(id: JobId) -> Self {
        id.0
    }
}

/// How a job stands, in the words of OGC API Processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// It waits.
    Accepted,
    /// It runs.
    Running,
    /// Its result is there.
    Successful,
    /// It ended without a result.
    Failed,
    /// It was cancelled.
    Dismissed,
}

impl Status {
    /// The status's name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Running => "running",
            Self::Successful => "successful",
            Self::Failed => "failed",
            Self::Dismissed => "dismissed",
        }
    }

    /// Whether nothing will change any more.
    #[must_use]
    pub const fn is_final(self) -> bool {
        matches!(self, Self::Successful | Self::Failed | Self::Dismissed)
    }
}

/// What is on record about a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Its id.
    pub id: JobId,
    /// SHA-256 of its input.
    pub input: String,
    /// Its parameters as they were given, name by name.
    pub parameters: Vec<(String, String)>,
    /// The mesh format, as a file name's extension.
    pub format: String,
    /// The client, for fairness after a restart.
    pub client: u64,
    /// Its urgency among the client's jobs.
    pub urgency: u8,
    /// How it stands. A record of a running job is one of a job that was running when it was last written.
    pub status: Status,
    /// Times that it was begun.
    pub attempts: u32,
    /// When it was accepted, ms since 1970.
    pub created_ms: u64,
    /// When it was begun last.
    pub started_ms: Option<u64>,
    /// When it ended.
    pub finished_ms: Option<u64>,
    /// The key of its result.
    pub result: Option<String>,
    /// Why there is none: a problem document.
    pub problem: Option<Value>,
    /// Who asked for it.
    #[serde(default)]
    pub requester: Requester,
}

/// Who asked for a job: the request, and its place in a trace as W3C writes it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Requester {
    /// The request's id.
    pub request: Option<String>,
    /// The span of the request.
    pub traceparent: Option<String>,
    /// What vendors had added.
    pub tracestate: Option<String>,
}

impl Requester {
    /// Returns the part of a span's parent that is stored.
    #[must_use]
    pub fn of(parent: &SpanParent) -> Self {
        Self {
            request: parent.request.as_deref().map(str::to_owned),
            traceparent: parent.context.as_ref().map(traceparent),
            tracestate: parent.context.as_ref().and_then(tracestate),
        }
    }

    /// Returns the stored parent, for spans of `tracer`.
    #[must_use]
    pub fn parent(&self, tracer: &Tracer) -> SpanParent {
        let text = |text: &'_ Option<String>| text.clone().unwrap_or_default();
        SpanParent {
            request: self.request.as_deref().map(Into::into),
            context: read_trace_context(&text(&self.traceparent), &text(&self.tracestate)),
            tracer: tracer.clone(),
        }
    }
}

impl Record {
    /// Whether both are of requests for the same thing.
    #[must_use]
    pub fn asks_as(&self, other: &Self) -> bool {
        (&self.input, &self.parameters, &self.format) == (&other.input, &other.parameters, &other.format)
    }
}

/// Milliseconds since 1970.
#[must_use]
pub fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// A time as RFC 3339 writes it.
#[must_use]
pub fn rfc3339(ms: u64) -> String {
    humantime::format_rfc3339_millis(UNIX_EPOCH + Duration::from_millis(ms.min(MAX_MS))).to_string()
}

/// The end of the year 9999, up to which RFC 3339 counts.
const MAX_MS: u64 = 253_402_300_799_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::Digest;

    #[test]
    fn ids_are_random_or_follow_their_key() {
        let (a, b) = (JobId::random().unwrap(), JobId::random().unwrap());
        assert_ne!(a, b);
        assert_eq!(a.as_str().parse(), Ok(a.clone()));
        let of = |secret: u8, client, key| JobId::of_key(&[secret; 32], client, key);
        assert_eq!(of(0, 1, "x"), of(0, 1, "x"));
        assert_eq!(of(0, 1, "x").as_str().parse(), Ok(of(0, 1, "x")));
        for other in [of(1, 1, "x"), of(0, 2, "x"), of(0, 1, "y")] {
            assert_ne!(of(0, 1, "x"), other);
        }
        // HMAC-SHA-256, computed elsewhere.
        assert_eq!(of(7, 255, "upload-1").as_str(), "0a0f88f773ba0077f73431b46274a47a");
        for bad in ["", "..", &"A".repeat(32), &"a".repeat(31), &"a".repeat(33), "../../../../etc/passwd0123456789"] {
            assert_eq!(bad.parse::<JobId>(), Err(BadJobId), "{bad}");
        }
    }

    #[test]
    fn records_come_back_as_they_were() {
        let record = Record {
            id: JobId::random().unwrap(),
            input: Digest::of(b"x").to_string(),
            parameters: vec![("resolution".to_owned(), "0.5".to_owned())],
            format: "glb".to_owned(),
            client: u64::MAX,
            urgency: 3,
            status: Status::Accepted,
            attempts: 1,
            created_ms: 1,
            started_ms: None,
            finished_ms: None,
            result: None,
            problem: None,
            requester: Requester { request: Some("r".to_owned()), ..Requester::default() },
        };
        let text = serde_json::to_vec(&record).unwrap();
        assert_eq!(serde_json::from_slice::<Record>(&text).unwrap(), record);
        // Records of earlier versions say nothing of who asked.
        let mut old = serde_json::to_value(&record).unwrap();
        old.as_object_mut().unwrap().remove("requester").unwrap();
        assert_eq!(serde_json::from_value::<Record>(old).unwrap().requester, Requester::default());
        let hostile = String::from_utf8(text).unwrap().replace(record.id.as_str(), "../../x");
        assert!(serde_json::from_str::<Record>(&hostile).is_err());
    }

    #[test]
    fn who_asked_comes_back_as_it_was() {
        let parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";
        let context = read_trace_context(parent, "a=1");
        let origin = SpanParent { request: Some("r".into()), context, tracer: Tracer::default() };
        let kept = Requester::of(&origin);
        assert_eq!(kept.traceparent.as_deref(), Some(parent));
        let back = kept.parent(&Tracer::default());
        assert_eq!((&back.request, &back.context), (&origin.request, &origin.context));
        // Whoever changes a record cannot put more into it than into a request.
        let hostile = Requester { traceparent: Some("00-x".to_owned()), ..kept };
        assert_eq!(hostile.parent(&Tracer::default()).context, None);
    }

    #[test]
    fn times_are_written_as_the_web_does() {
        assert_eq!(rfc3339(1_700_000_000_123), "2023-11-14T22:13:20.123Z");
        assert!(rfc3339(u64::MAX).starts_with("9999-12-31"));
        assert!(now_ms() > 1_700_000_000_000);
    }
}
