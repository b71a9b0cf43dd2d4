//! Record of a durable job: the state that survives the process.

use std::fmt;
use std::str::FromStr;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use thiserror::Error;

use crate::formats::Format;
use crate::pipeline::{MapFile, params};
use crate::store::{Digest, Namespace, OWNER_DIGITS, Secret, derive};
use crate::telemetry::{SpanParent, Tracer, read_trace_context, shorten, traceparent, tracestate};

/// Error of a text that is not a job id.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a job id has 32 lower-case hexadecimal digits")]
pub(crate) struct BadJobId;

/// Digits of a job id.
const DIGITS: usize = 32;

/// Writes bytes as hexadecimal digits, an even number of them.
fn hex(bytes: &[u8; 32], digits: usize) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).take(digits / 2).collect()
}

/// Id of a job. It is a secret: every client of its namespace that knows it can see and cancel the job.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub(crate) struct JobId(String);

impl JobId {
    /// Creates an id of 96 random bits and the number of `client`.
    pub(super) fn random(secret: &Secret, client: u64) -> std::io::Result<Self> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes).map_err(std::io::Error::from)?;
        Ok(Self::new(&bytes, secret, client))
    }

    /// Returns the first digits of `unique` and the number of `client`, so that the store counts the jobs of each
    /// client without reading their records. The number is an HMAC: it does not reveal the client.
    fn new(unique: &[u8; 32], secret: &Secret, client: u64) -> Self {
        Self(hex(unique, DIGITS - OWNER_DIGITS) + &Self::owner_digits(secret, client))
    }

    /// Returns the last digits of the ids of the jobs of `client`. Clients may share them.
    pub(super) fn owner_digits(secret: &Secret, client: u64) -> String {
        hex(&derive(secret, &format!("client\n{client:x}")), OWNER_DIGITS)
    }

    /// Returns the id for an idempotency key: the same for the same key of the same client in a namespace, even after a
    /// restart. Client and key alone do not reveal it.
    pub(super) fn from_key(secret: &Secret, namespace: Namespace, client: u64, key: &str) -> Self {
        // A key has no line break, so the text is unambiguous.
        let space = if namespace.is_common() { String::new() } else { format!("{namespace}\n") };
        Self::new(&derive(secret, &format!("idempotency\n{client:x}\n{space}{key}")), secret, client)
    }

    /// Returns the whole id.
    pub(crate) fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for JobId {
    /// Writes the first digits, for logs and traces: the whole id gives access to the job.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&shorten(&self.0))
    }
}

impl FromStr for JobId {
    type Err = BadJobId;

    fn from_str(text: &str) -> Result<Self, BadJobId> {
        let hex = |c: u8| c.is_ascii_digit() || (b'a'..=b'f').contains(&c);
        if text.len() == DIGITS && text.bytes().all(hex) { Ok(Self(text.to_owned())) } else { Err(BadJobId) }
    }
}

impl TryFrom<String> for JobId {
    type Error = BadJobId;

    fn try_from(text: String) -> Result<Self, BadJobId> {
        text.parse()
    }
}

/// Status of a job, as in OGC API Processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Status {
    /// Queued.
    Accepted,
    /// Running.
    Running,
    /// Finished with a result.
    Successful,
    /// Finished without a result.
    Failed,
    /// Cancelled.
    Dismissed,
}

impl Status {
    /// All statuses.
    pub(crate) const ALL: [Self; 5] = [Self::Accepted, Self::Running, Self::Successful, Self::Failed, Self::Dismissed];

    /// Returns the name of the status.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Running => "running",
            Self::Successful => "successful",
            Self::Failed => "failed",
            Self::Dismissed => "dismissed",
        }
    }

    /// Returns true if the job has ended.
    pub(crate) const fn is_final(self) -> bool {
        matches!(self, Self::Successful | Self::Failed | Self::Dismissed)
    }
}

/// Stored state of a job. A field that this release does not know means a record of another release, because writing
/// the record would remove the field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct JobRecord {
    /// Id of the job.
    pub(crate) id: JobId,
    /// Namespace of the job, its input and its result.
    #[serde(default, skip_serializing_if = "Namespace::is_common")]
    pub(crate) namespace: Namespace,
    /// SHA-256 of the input.
    pub(crate) input: Digest,
    /// SHA-256 of the map that was sent beside the input.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) map: Option<Digest>,
    /// Names and values of the parameters, as the client wrote them.
    pub(crate) parameters: Vec<(String, String)>,
    /// Mesh format, as a file name extension.
    pub(crate) format: String,
    /// Number of the client, for its shares and quotas after a restart.
    pub(crate) client: u64,
    /// Batch of the job, whose record is kept until the job has ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) batch: Option<JobId>,
    /// Urgency from 0 (first) to 7 (last).
    pub(crate) urgency: u8,
    /// True for a job that workers with a GPU should run.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) suits_gpu: bool,
    /// Status at the last write.
    pub(crate) status: Status,
    /// Number of attempts to run the job.
    pub(crate) attempts: u32,
    /// Number of attempts that ended for lack of memory. They do not count as attempts.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(crate) memory_waits: u32,
    /// Time of acceptance, ms since 1970.
    pub(crate) created_ms: u64,
    /// Start of the last attempt, ms since 1970.
    pub(crate) started_ms: Option<u64>,
    /// End, ms since 1970.
    pub(crate) finished_ms: Option<u64>,
    /// Key of the result.
    pub(crate) result: Option<String>,
    /// Problem document of a failed job.
    pub(crate) problem: Option<Value>,
    /// Request that created the job.
    #[serde(default)]
    pub(crate) requester: Requester,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde calls")]
fn is_zero(n: &u32) -> bool {
    *n == 0
}

/// Id and W3C trace context of the request that created a job.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Requester {
    /// Id of the request.
    pub(crate) request: Option<String>,
    /// `traceparent` of the request's span.
    pub(crate) traceparent: Option<String>,
    /// `tracestate` of the request.
    pub(crate) tracestate: Option<String>,
}

impl Requester {
    /// Converts the parent of a span to its stored form.
    pub(crate) fn of(parent: &SpanParent) -> Self {
        Self {
            request: parent.request.as_deref().map(str::to_owned),
            traceparent: parent.context.as_ref().map(traceparent),
            tracestate: parent.context.as_ref().and_then(tracestate),
        }
    }

    /// Returns the stored parent for spans that `tracer` records.
    pub(crate) fn parent(&self, tracer: &Tracer) -> SpanParent {
        let text = |text: &'_ Option<String>| text.clone().unwrap_or_default();
        SpanParent {
            request: self.request.as_deref().map(Into::into),
            context: read_trace_context(&text(&self.traceparent), &text(&self.tracestate)),
            tracer: tracer.clone(),
        }
    }
}

/// Version of the record format.
const VERSION: u64 = 1;
/// Name of the last field, the SHA-256 of all bytes before it. The first records have neither checksum nor version.
const CHECKSUM: &str = "sha256";
/// Last field up to its value.
const CHECKSUM_FIELD: &[u8] = b",\"sha256\":\"";

/// Record with the version of its format.
#[derive(Debug, Serialize)]
struct Versioned<'a, T> {
    version: u64,
    #[serde(flatten)]
    content: &'a T,
}

/// Divides a record into the bytes before the checksum, and the checksum; `None` for a record without one.
fn split_checksum(bytes: &[u8]) -> Option<(&[u8], Digest)> {
    let (rest, digest) = bytes.strip_suffix(b"\"}")?.split_last_chunk::<64>()?;
    let digest = std::str::from_utf8(digest).ok()?.parse().ok()?;
    Some((rest.strip_suffix(CHECKSUM_FIELD)?, digest))
}

/// Error of a stored record.
#[derive(Debug, Error)]
pub(super) enum BadRecord {
    /// The record is torn or was changed.
    #[error("it is damaged: {0}")]
    Damaged(String),
    /// Another release wrote the record.
    #[error("{0}")]
    OtherRelease(String),
}

/// Returns the document to store of the record of a job or a batch.
pub(super) fn encode<T: Serialize>(content: &T) -> Bytes {
    let mut text = serde_json::to_vec(&Versioned { version: VERSION, content }).unwrap_or_default();
    // The brace follows the checksum.
    text.pop();
    let checksum = Digest::of(&text);
    text.extend_from_slice(CHECKSUM_FIELD);
    text.extend_from_slice(format!("{checksum}\"}}").as_bytes());
    Bytes::from(text)
}

/// Parses a stored document. A checksum that matches distinguishes a record of another release from a damaged one.
pub(super) fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, BadRecord> {
    let checked = split_checksum(bytes);
    if let Some((content, checksum)) = checked
        && Digest::of(content) != checksum
    {
        return Err(BadRecord::Damaged("its checksum does not match".to_owned()));
    }
    let mut fields: Map<String, Value> =
        serde_json::from_slice(bytes).map_err(|error| BadRecord::Damaged(error.to_string()))?;
    let version = fields.remove("version").unwrap_or(VERSION.into());
    if version != VERSION {
        return Err(BadRecord::OtherRelease(format!("it has version {version}, expected {VERSION}")));
    }
    if checked.is_some() {
        fields.remove(CHECKSUM);
    }
    serde_json::from_value(fields.into()).map_err(|error| match checked {
        Some(_) => BadRecord::OtherRelease(error.to_string()),
        None => BadRecord::Damaged(error.to_string()),
    })
}

impl JobRecord {
    /// Returns the document to store.
    pub(super) fn to_bytes(&self) -> Bytes {
        encode(self)
    }

    /// Parses the stored parameters and the format.
    pub(crate) fn request(&self) -> Result<params::Request, String> {
        let format: Format = self.format.parse().map_err(|_bad| format!("its format `{}` is unknown", self.format))?;
        let pairs = self.parameters.iter().map(|(name, value)| (name, value));
        let request = params::parse_with(pairs, |_| Ok::<_, params::ParamError>(format));
        let mut request = request.map_err(|error| error.to_string())?;
        request.options.map = self.map.map(|digest| MapFile::not_loaded(digest.to_string()));
        Ok(request)
    }

    /// Returns true if both records describe the same request: equal input, map, format and parsed parameters.
    pub(super) fn is_same_request(&self, other: &Self) -> bool {
        let parsed = |record: &Self| {
            let request = record.request().ok()?;
            Some((params::canonical(&request.options), request.strict))
        };
        let same_parameters =
            || self.parameters == other.parameters || parsed(self).is_some_and(|own| parsed(other) == Some(own));
        (self.input, self.map, &self.format) == (other.input, other.map, &other.format) && same_parameters()
    }
}

/// Returns the present time, ms since 1970.
pub(crate) fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// Formats a time, ms since 1970, as RFC 3339.
pub(crate) fn rfc3339(ms: u64) -> String {
    humantime::format_rfc3339_millis(UNIX_EPOCH + Duration::from_millis(ms.min(MAX_MS))).to_string()
}

/// End of the year 9999, the last one of RFC 3339.
const MAX_MS: u64 = 253_402_300_799_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_random_or_follow_their_key() {
        let random = |client| JobId::random(&[0; 32], client).unwrap();
        let (a, b) = (random(1), random(1));
        assert_ne!(a, b);
        assert_eq!(a.as_str().parse(), Ok(a.clone()));
        let owner = |id: &JobId| id.as_str()[DIGITS - OWNER_DIGITS..].to_owned();
        assert!(owner(&a) == owner(&b) && owner(&a) != owner(&random(2)));
        let of = |secret: u8, client, key| JobId::from_key(&[secret; 32], Namespace::default(), client, key);
        assert_eq!(of(0, 1, "x"), of(0, 1, "x"));
        assert_eq!(of(0, 1, "x").as_str().parse(), Ok(of(0, 1, "x")));
        for other in [of(1, 1, "x"), of(0, 2, "x"), of(0, 1, "y")] {
            assert_ne!(of(0, 1, "x"), other);
        }
        // Computed with another implementation of HMAC-SHA-256.
        assert_eq!(of(7, 255, "upload-1").as_str(), "0a0f88f773ba0077f73431b4ed19acb5");
        for bad in ["", "..", &"A".repeat(32), &"a".repeat(31), &"a".repeat(33), "../../../../etc/passwd0123456789"] {
            assert_eq!(bad.parse::<JobId>(), Err(BadJobId), "{bad}");
        }
    }

    fn record(parameters: &[(&str, &str)]) -> JobRecord {
        JobRecord {
            id: JobId::random(&[0; 32], 1).unwrap(),
            namespace: Namespace::default(),
            input: Digest::of(b"x"),
            map: None,
            parameters: parameters.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect(),
            format: "glb".to_owned(),
            client: u64::MAX,
            batch: None,
            urgency: 3,
            suits_gpu: false,
            status: Status::Accepted,
            attempts: 1,
            memory_waits: 0,
            created_ms: 1,
            started_ms: None,
            finished_ms: None,
            result: None,
            problem: None,
            requester: Requester { request: Some("r".to_owned()), ..Requester::default() },
        }
    }

    #[test]
    fn requests_are_compared_by_their_parsed_parameters() {
        let (a, b) = (
            record(&[("resolution", "0.70"), ("atom_ids", "true")]),
            record(&[("atom_ids", "true"), ("resolution", "0.7")]),
        );
        assert!(a.is_same_request(&b));
        assert!(!a.is_same_request(&record(&[("resolution", "0.71"), ("atom_ids", "true")])));
        assert!(!a.is_same_request(&JobRecord { format: "stl".to_owned(), ..b.clone() }));
        let mapped = |map: &str| JobRecord { map: Some(Digest::of(map.as_bytes())), ..b.clone() };
        assert!(mapped("1").is_same_request(&mapped("1")));
        assert!(!mapped("1").is_same_request(&mapped("2")) && !mapped("1").is_same_request(&b));
        assert!(!record(&[("check", "strict")]).is_same_request(&record(&[])));
        // Parameters that this version cannot parse are compared as text.
        let unknown = record(&[("unknown", "1")]);
        assert!(unknown.is_same_request(&unknown) && !unknown.is_same_request(&record(&[("unknown", "2")])));
    }

    #[test]
    fn records_survive_a_round_trip() {
        let record = record(&[("resolution", "0.5")]);
        let text = record.to_bytes().to_vec();
        assert_eq!(decode::<JobRecord>(&text).unwrap(), record);
        // Records of earlier versions have no requester.
        let mut old = serde_json::to_value(&record).unwrap();
        old.as_object_mut().unwrap().remove("requester").unwrap();
        assert_eq!(serde_json::from_value::<JobRecord>(old).unwrap().requester, Requester::default());
        let old = serde_json::to_vec(&record).unwrap();
        assert_eq!(decode::<JobRecord>(&old).unwrap(), record, "the first records have neither version nor checksum");
        let hostile = String::from_utf8(old).unwrap().replace(record.id.as_str(), "../../x");
        assert!(matches!(decode::<JobRecord>(hostile.as_bytes()), Err(BadRecord::Damaged(_))));
    }

    /// Returns a record with this field, and a checksum that matches.
    fn with_field(record: &JobRecord, name: &str, value: Value) -> Vec<u8> {
        let mut fields = serde_json::to_value(Versioned { version: VERSION, content: record }).unwrap();
        fields[name] = value;
        let text = fields.to_string();
        let content = text.strip_suffix('}').unwrap();
        let checksum = Digest::of(content.as_bytes());
        format!("{content},\"{CHECKSUM}\":\"{checksum}\"}}").into_bytes()
    }

    #[test]
    fn records_of_other_releases_are_not_taken_for_damaged_ones() {
        let record = record(&[("resolution", "0.5")]);
        assert_eq!(with_field(&record, "attempts", 1.into()), record.to_bytes(), "the control");
        let with_later = |value: &str| with_field(&record, "later", value.into());
        let later = [
            with_field(&record, "version", 2.into()),
            with_field(&record, "version", "next".into()),
            with_field(&record, "status", "paused".into()),
            with_field(&record, "requester", serde_json::json!({ "region": "x" })),
            with_later("x"),
            br#"{"version":2,"id":7}"#.to_vec(),
        ];
        for bytes in later {
            let found = decode::<JobRecord>(&bytes);
            assert!(matches!(found, Err(BadRecord::OtherRelease(_))), "{found:?}");
        }
        let text = record.to_bytes();
        for damaged in [b"".as_slice(), b"[]", br#"{"version":1}"#, b"{\"later\":1}"] {
            assert!(matches!(decode::<JobRecord>(damaged), Err(BadRecord::Damaged(_))), "{damaged:?}");
        }
        for length in 0..text.len() {
            assert!(matches!(decode::<JobRecord>(&text[..length]), Err(BadRecord::Damaged(_))), "{length}");
        }
        for bit in 0..8 * text.len() {
            let mut flipped = text.to_vec();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(matches!(decode::<JobRecord>(&flipped), Err(BadRecord::Damaged(_))), "bit {bit}");
        }
    }

    #[test]
    fn requesters_survive_a_round_trip() {
        let parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";
        let context = read_trace_context(parent, "a=1");
        let origin = SpanParent { request: Some("r".into()), context, tracer: Tracer::default() };
        let kept = Requester::of(&origin);
        assert_eq!(kept.traceparent.as_deref(), Some(parent));
        let back = kept.parent(&Tracer::default());
        assert_eq!((&back.request, &back.context), (&origin.request, &origin.context));
        // A changed record cannot hold more than a request can.
        let hostile = Requester { traceparent: Some("00-x".to_owned()), ..kept };
        assert_eq!(hostile.parent(&Tracer::default()).context, None);
    }

    #[test]
    fn times_are_written_as_rfc_3339() {
        assert_eq!(rfc3339(1_700_000_000_123), "2023-11-14T22:13:20.123Z");
        assert!(rfc3339(u64::MAX).starts_with("9999-12-31"));
        assert!(now_ms() > 1_700_000_000_000);
    }
}
