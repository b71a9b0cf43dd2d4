//! Request bodies: raw bytes or multipart, counted against the limits while they come.

use axum::body::Body;
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE};
use bytes::{Bytes, BytesMut};
use futures_util::{StreamExt as _, TryStreamExt as _};
use multer::{Constraints, Multipart, SizeLimit};

use super::declared::Declared;
use super::kinds::Kind;
use super::problem::Problem;
use super::state::App;
use crate::jobs::Lease;

/// Bytes of a form field that is a parameter.
const MAX_FIELD_BYTES: usize = 4096;
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

/// Receives the body.
pub(super) async fn receive(app: &App, headers: &HeaderMap, body: Body) -> Result<Upload, Problem> {
    let limit = app.config.limits.body_bytes;
    let announced = text(headers, &CONTENT_LENGTH).and_then(|length| length.parse::<u64>().ok());
    if let Some(length) = announced.filter(|length| *length > limit) {
        return Err(too_large(limit).with("actual", length));
    }
    let coding = content_encoding(headers)?;
    let receive = async {
        if is_multipart(headers) {
            if coding.is_some() {
                return Err(bad_encoding("a form cannot be compressed as a whole; compress the file in it"));
            }
            form(app, text(headers, &CONTENT_TYPE).unwrap_or_default(), body, limit).await
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

fn too_large(limit: u64) -> Problem {
    Problem::new(Kind::BodyTooLarge, format!("the body has more than {limit} bytes")).with("limit", limit)
}

/// A body that ends early; its sender is most likely gone.
fn broken(error: &dyn std::fmt::Display) -> Problem {
    Problem::new(Kind::BadRequest, format!("the body cannot be read: {error}"))
}

/// Reads a body into one piece; a body of one frame is not copied.
async fn collect(body: Body, announced: u64, limit: u64, lease: &mut Lease) -> Result<Bytes, Problem> {
    let mut stream = body.into_data_stream();
    let (mut first, mut all, mut length) = (Bytes::new(), BytesMut::new(), 0u64);
    while let Some(data) = stream.next().await {
        let data = data.map_err(|e| broken(&e))?;
        length += data.len() as u64;
        if length > limit {
            return Err(too_large(limit));
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

/// Reads a form: one file in `file` or `structure`, parameters in the other fields.
async fn form(app: &App, content_type: &str, body: Body, limit: u64) -> Result<Upload, Problem> {
    let bad = |error: multer::Error| match error {
        multer::Error::StreamSizeExceeded { limit } => too_large(limit),
        other => Problem::new(Kind::BadRequest, format!("the form cannot be read: {other}")),
    };
    let boundary = multer::parse_boundary(content_type).map_err(bad)?;
    let constraints = Constraints::new().size_limit(SizeLimit::new().whole_stream(limit));
    let stream = body.into_data_stream().map_err(|e| std::io::Error::other(e.to_string()));
    let mut form = Multipart::with_constraints(stream, boundary, constraints);
    let mut lease = app.pool.budget().lease();
    let (mut file, mut fields) = (None, Vec::new());
    while let Some(mut field) = form.next_field().await.map_err(bad)? {
        let name = field.name().unwrap_or_default().to_owned();
        let is_file = matches!(name.as_str(), "file" | "structure");
        if is_file && file.is_some() {
            return Err(Problem::new(Kind::BadRequest, "the form has more than one file").with("parameter", name));
        }
        let declared = Declared::new(field.content_type().map_or("", |mime| mime.as_ref()));
        let mut content = BytesMut::new();
        while let Some(chunk) = field.chunk().await.map_err(bad)? {
            lease.grow(chunk.len() as u64)?;
            content.extend_from_slice(&chunk);
            if !is_file && content.len() > MAX_FIELD_BYTES {
                let detail = format!("the form field `{name}` has more than {MAX_FIELD_BYTES} bytes");
                return Err(Problem::new(Kind::BadParameter, detail)
                    .with("parameter", name)
                    .with("limit", MAX_FIELD_BYTES));
            }
        }
        if is_file {
            file = Some((content.freeze(), declared));
        } else {
            fields.push((name, String::from_utf8_lossy(&content).into_owned()));
        }
    }
    let Some((bytes, declared)) = file else {
        let detail = "the form has no file; put it into a field named `file` or `structure`";
        return Err(Problem::new(Kind::BadRequest, detail).with("expected", "file"));
    };
    Ok(Upload { bytes, lease, fields, declared })
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
