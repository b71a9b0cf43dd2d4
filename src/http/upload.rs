//! Request bodies: raw bytes or multipart, counted against the limits while they come.

use axum::body::Body;
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE};
use bytes::{Bytes, BytesMut};
use futures_util::StreamExt as _;

use super::declared::Declared;
use super::form;
use super::kinds::Kind;
use super::problem::Problem;
use super::state::App;
use crate::jobs::Lease;

/// Most that is set aside before anything has come: what a length header promises costs its sender nothing.
const MAX_RESERVED_BYTES: u64 = 1 << 20;

/// A structure file that was received.
pub(super) struct Upload {
    pub(super) bytes: Bytes,
    pub(super) lease: Lease,
    /// Form fields besides the file: parameters.
    pub(super) fields: Vec<(String, String)>,
    pub(super) declared: Declared,
}

/// Whether the body is a form.
pub(super) fn is_multipart(headers: &HeaderMap) -> bool {
    text(headers, &CONTENT_TYPE).is_some_and(|t| t.trim_start().to_ascii_lowercase().starts_with("multipart/form-data"))
}

/// Whether the body says that it is a JSON document.
pub(super) fn is_json(headers: &HeaderMap) -> bool {
    let essence = text(headers, &CONTENT_TYPE).and_then(|t| t.split(';').next()).unwrap_or_default();
    essence.trim().eq_ignore_ascii_case("application/json")
}

/// A limit, and the key of the configuration that sets it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit {
    pub(super) key: &'static str,
    pub(super) most: u64,
}

impl Limit {
    /// The problem of a body that is too large.
    pub(super) fn exceeded_by_body(self) -> Problem {
        self.exceeded("the body has", "bytes")
    }

    /// The problem of something that has more than the limit; `what` begins the sentence.
    pub(super) fn exceeded(self, what: &str, unit: &str) -> Problem {
        let Self { key, most } = self;
        Problem::new(Kind::BodyTooLarge, format!("{what} more than {most} {unit} ({key})")).with("limit", most)
    }
}

/// Receives a structure: a file, or a form around one.
pub(super) async fn receive(app: &App, headers: &HeaderMap, body: Body) -> Result<Upload, Problem> {
    receive_within(app, headers, body, Limit { key: "limits.body_bytes", most: app.config.limits.body_bytes }).await
}

/// Receives a JSON document.
pub(super) async fn receive_json(app: &App, headers: &HeaderMap, body: Body) -> Result<Upload, Problem> {
    receive_within(app, headers, body, Limit { key: "limits.json_bytes", most: app.config.limits.json_bytes }).await
}

async fn receive_within(app: &App, headers: &HeaderMap, body: Body, limit: Limit) -> Result<Upload, Problem> {
    let announced = text(headers, &CONTENT_LENGTH).and_then(|length| length.parse::<u64>().ok());
    if let Some(length) = announced.filter(|length| *length > limit.most) {
        return Err(limit.exceeded_by_body().with("actual", length));
    }
    let coding = content_encoding(headers)?;
    let receive = async {
        if is_multipart(headers) {
            if coding.is_some() {
                return Err(bad_encoding("a form cannot be compressed as a whole; compress the file in it"));
            }
            let content_type = text(headers, &CONTENT_TYPE).unwrap_or_default();
            form::read(&app.config.limits, limit, content_type, body, app.pool.budget().lease()).await
        } else {
            let mut lease = app.pool.budget().lease();
            let bytes = collect(body, announced.unwrap_or(0), limit, &mut lease).await?;
            let declared = Declared::new(text(headers, &CONTENT_TYPE).unwrap_or_default());
            Ok(Upload { bytes, lease, fields: Vec::new(), declared })
        }
    };
    let timeout = app.config.server.body_timeout();
    let upload = tokio::time::timeout(timeout, receive).await.map_err(|_elapsed| {
        let ms = app.config.server.body_timeout_ms;
        Problem::new(Kind::BodyTimeout, format!("the body was not complete after {ms} ms")).with("limit", ms)
    })??;
    if let Some(coding) = coding.filter(|coding| !coding.fits(&upload.bytes)) {
        return Err(bad_encoding(&format!("the body says it is {}, but is not", coding.name())));
    }
    upload.declared.check_bytes(&upload.bytes)?;
    Ok(upload)
}

fn text<'a>(headers: &'a HeaderMap, name: &axum::http::HeaderName) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

/// A body that ends early; its sender is most likely gone.
fn broken(error: &dyn std::fmt::Display) -> Problem {
    Problem::new(Kind::BadRequest, format!("the body cannot be read: {error}"))
}

/// Reads a body into one piece; a body of one frame is not copied.
async fn collect(body: Body, announced: u64, limit: Limit, lease: &mut Lease) -> Result<Bytes, Problem> {
    let mut stream = body.into_data_stream();
    let (mut first, mut all, mut length) = (Bytes::new(), BytesMut::new(), 0u64);
    while let Some(data) = stream.next().await {
        let data = data.map_err(|e| broken(&e))?;
        length += data.len() as u64;
        if length > limit.most {
            return Err(limit.exceeded_by_body());
        }
        lease.grow(data.len() as u64)?;
        if first.is_empty() && all.is_empty() {
            first = data;
            continue;
        }
        if all.is_empty() {
            all.reserve(usize::try_from(announced.clamp(length, MAX_RESERVED_BYTES.max(length))).unwrap_or(0));
            all.extend_from_slice(&std::mem::take(&mut first));
        }
        all.extend_from_slice(&data);
    }
    Ok(if all.is_empty() { first } else { all.freeze() })
}

/// A content coding that the reader undoes.
#[derive(Debug, Clone, Copy)]
enum Coding {
    Gzip,
    Zstd,
}

impl Coding {
    const fn name(self) -> &'static str {
        match self {
            Self::Gzip => "gzip",
            Self::Zstd => "zstd",
        }
    }

    fn fits(self, bytes: &[u8]) -> bool {
        match self {
            Self::Gzip => bytes.starts_with(&[0x1f, 0x8b]),
            Self::Zstd => bytes.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]),
        }
    }
}

fn bad_encoding(detail: &str) -> Problem {
    Problem::new(Kind::UnsupportedEncoding, detail).with("available", vec!["gzip", "zstd", "identity"])
}

/// The body's coding; the reader recognises it by itself, so this only has to be true.
fn content_encoding(headers: &HeaderMap) -> Result<Option<Coding>, Problem> {
    let mut codings = headers.get_all(CONTENT_ENCODING).iter().flat_map(|value| value.as_bytes().split(|&b| b == b','));
    let (first, second) = (codings.next(), codings.next());
    let name = String::from_utf8_lossy(first.unwrap_or_default()).trim().to_ascii_lowercase();
    match (name.as_str(), second) {
        ("" | "identity", None) => Ok(None),
        ("gzip" | "x-gzip", None) => Ok(Some(Coding::Gzip)),
        ("zstd", None) => Ok(Some(Coding::Zstd)),
        (_, Some(_)) => Err(bad_encoding("more than one content encoding")),
        (other, None) => Err(bad_encoding(&format!("unknown content encoding `{other}`"))),
    }
}
