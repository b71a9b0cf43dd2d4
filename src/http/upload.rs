//! Request bodies: raw bytes, multipart forms or JSON, checked against the limits while they arrive.

use std::io;
use std::time::Duration;

use axum::body::Body;
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE};
use bytes::{Bytes, BytesMut};
use futures_util::StreamExt as _;
use tokio::fs::File;
use tokio::io::AsyncWriteExt as _;

use super::body_hasher::BodyHasher;
use super::content_type::DeclaredType;
use super::form::{self, UploadedFile};
use super::guard::Caller;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::App;
use crate::jobs::MemoryReservation;
use crate::pipeline::JobError;
use crate::store::Digest;
use crate::structure::stream::ScratchFile;
use crate::structure::{GZIP_MAGIC, SourceFormat, StructureError, ZSTD_MAGIC, detect_format};
use crate::surface::{Exceeded, Limit, MemoryMeter as _};

/// Maximum size of a JSON body, bytes. A document names a structure and about thirty parameters.
pub(super) const MAX_JSON_BYTES: u64 = 64 << 10;
/// Advice if a body that is declared as JSON is too large.
const NOT_JSON: &str = "a structure file must not be declared as application/json";
/// Length from which the start of a form body must have a line end, bytes.
const MAX_LINE_BYTES: usize = 160;
/// Length of the start of a body in which line ends are sought, bytes.
const LINE_SAMPLE: usize = 64 << 10;

/// Returns true if the body is declared as a form.
pub(super) fn is_multipart(headers: &HeaderMap) -> bool {
    text(headers, &CONTENT_TYPE).is_some_and(|t| t.trim_start().to_ascii_lowercase().starts_with("multipart/form-data"))
}

/// Returns true if the body is declared as JSON.
pub(super) fn is_json(headers: &HeaderMap) -> bool {
    let essence = text(headers, &CONTENT_TYPE).and_then(|t| t.split(';').next()).unwrap_or_default();
    essence.trim().eq_ignore_ascii_case("application/json")
}

/// Receives a structure: a file, or a form around one.
pub(super) async fn receive(
    app: &App,
    caller: &Caller,
    headers: &HeaderMap,
    body: Body,
) -> Result<UploadedFile, Problem> {
    let limit = Exceeded::new(Limit::BodyBytes, app.config.limits.body_bytes);
    let announced = announced(headers, &limit)?;
    let reservation = app.uploads.for_client(caller.client.0).reservation();
    // A declared length is rejected before the body arrives.
    reservation.check(announced)?;
    let coding = content_encoding(headers)?;
    let upload = if is_multipart(headers) {
        if coding.is_some() {
            return Err(bad_encoding("a form cannot be compressed as a whole; compress the file in it"));
        }
        let content_type = text(headers, &CONTENT_TYPE).unwrap_or_default();
        let form = form::read(&limit, content_type, announced, body, reservation);
        in_time(app, form).await?
    } else {
        let (bytes, digest) = in_time(app, collect(body, announced, &limit, &reservation)).await?;
        let declared = DeclaredType::new(text(headers, &CONTENT_TYPE).unwrap_or_default());
        UploadedFile { bytes, digest, reservation, map: None, fields: Vec::new(), declared }
    };
    if let Some((name, _)) = coding.filter(|(_, magic)| !upload.bytes.starts_with(magic)) {
        return Err(bad_encoding(&format!("the body is declared as {name}, but is not {name} data")));
    }
    upload.declared.check_bytes(&upload.bytes)?;
    // A job on a file of an unknown format is not accepted.
    let format = detect_format(&upload.bytes);
    if !matches!(format, Ok(Some(SourceFormat::BinaryCif) | None)) {
        check_lines(headers, &upload.bytes)?;
    }
    if let Some(format) = format.map_err(|error| upload.declared.explain(JobError::from(error).into()))? {
        upload.declared.check_format(format.name())?;
    }
    Ok(upload)
}

/// Rejects a text without line ends that curl has sent with `-d`, which removes them.
fn check_lines(headers: &HeaderMap, bytes: &[u8]) -> Result<(), Problem> {
    let essence = text(headers, &CONTENT_TYPE).and_then(|t| t.split(';').next()).unwrap_or_default();
    let is_form = essence.trim().eq_ignore_ascii_case("application/x-www-form-urlencoded");
    if is_form
        && bytes.len() > MAX_LINE_BYTES
        && memchr::memchr2(b'\n', b'\r', &bytes[..bytes.len().min(LINE_SAMPLE)]).is_none()
    {
        let detail = "the file has no line ends: curl removes them with `-d`; use `--data-binary`";
        return Err(Problem::new(ProblemType::UnreadableStructure, detail));
    }
    Ok(())
}

/// Receives a JSON document.
pub(super) async fn receive_json(
    app: &App,
    caller: &Caller,
    headers: &HeaderMap,
    body: Body,
) -> Result<Bytes, Problem> {
    let limit = Exceeded::capped(Limit::BodyBytes, u64::MAX, MAX_JSON_BYTES);
    let announced = announced(headers, &limit).map_err(|problem| problem.advise(NOT_JSON))?;
    if content_encoding(headers)?.is_some() {
        return Err(bad_encoding("a JSON document cannot be compressed"));
    }
    let reservation = app.uploads.for_client(caller.client.0).reservation();
    let received = in_time(app, collect(body, announced, &limit, &reservation)).await;
    let (bytes, _digest) = received.map_err(|problem| problem.advise(NOT_JSON))?;
    // The document is charged until it has been parsed.
    Ok(reservation.attach(bytes))
}

/// Receives the archive of a batch into a temporary file.
pub(super) async fn spool(app: &App, caller: &Caller, headers: &HeaderMap, body: Body) -> Result<ScratchFile, Problem> {
    if is_multipart(headers) {
        let detail = "an archive must be the whole body, not a part of a form";
        return Err(Problem::new(ProblemType::UnsupportedMediaType, detail));
    }
    if let Some((name, _)) = content_encoding(headers)?.filter(|(_, magic)| *magic != GZIP_MAGIC) {
        return Err(bad_encoding(&format!("an archive cannot be compressed with {name}")));
    }
    let limit = Exceeded::new(Limit::BodyBytes, app.config.limits.body_bytes);
    let announced = announced(headers, &limit)?;
    let ScratchFile { file, meter } = app.structures().scratch_file(caller.client)?;
    // Rejected before the body arrives.
    meter.check(announced).map_err(StructureError::DiskSpace)?;
    let receive = async {
        let (mut stream, mut file, mut length) = (body.into_data_stream(), File::from_std(file), 0);
        while let Some(data) = stream.next().await {
            let data = data.map_err(|e| broken(&e))?;
            length += data.len() as u64;
            if length > limit.max {
                return Err(Problem::from(&limit));
            }
            meter.grow(data.len() as u64).map_err(StructureError::DiskSpace)?;
            file.write_all(&data).await.map_err(|e| not_written(&e))?;
        }
        file.flush().await.map_err(|e| not_written(&e))?;
        Ok(file.into_std().await)
    };
    let file = in_time(app, receive).await?;
    Ok(ScratchFile { file, meter })
}

fn not_written(error: &io::Error) -> Problem {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => StructureError::DiskFull.into(),
        _ => Problem::internal(format!("the archive of a batch cannot be written: {error}")),
    }
}

/// Returns the length that the headers announce, 0 if they do not.
fn announced(headers: &HeaderMap, limit: &Exceeded) -> Result<u64, Problem> {
    let length = text(headers, &CONTENT_LENGTH).and_then(|length| length.parse::<u64>().ok()).unwrap_or(0);
    if length <= limit.max {
        return Ok(length);
    }
    Err(Problem::from(&Exceeded { actual: Some(length), ..limit.clone() }))
}

/// Limits the time for the reception of a body.
async fn in_time<T>(app: &App, receive: impl Future<Output = Result<T, Problem>>) -> Result<T, Problem> {
    tokio::time::timeout(Duration::from_millis(app.config.server.body_timeout_ms), receive).await.map_err(
        |_elapsed| {
            let ms = app.config.server.body_timeout_ms;
            Problem::new(ProblemType::BodyTimeout, format!("the body was not complete after {ms} ms")).with("limit", ms)
        },
    )?
}

fn text<'a>(headers: &'a HeaderMap, name: &axum::http::HeaderName) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

/// Returns the problem of a body that ends early, most likely because the client left.
fn broken(error: &dyn std::fmt::Display) -> Problem {
    Problem::new(ProblemType::BadRequest, format!("the body cannot be read: {error}"))
}

/// Reads a body into one buffer and hashes it while it arrives; a body of one frame is not copied.
async fn collect(
    body: Body,
    announced: u64,
    limit: &Exceeded,
    reservation: &MemoryReservation,
) -> Result<(Bytes, Digest), Problem> {
    let mut stream = body.into_data_stream();
    let (mut first, mut all, mut length, mut hasher) = (Bytes::new(), BytesMut::new(), 0u64, BodyHasher::default());
    while let Some(data) = stream.next().await {
        let data = data.map_err(|e| broken(&e))?;
        length += data.len() as u64;
        if length > limit.max {
            return Err(limit.into());
        }
        hasher.update(&data, reservation).await?;
        if first.is_empty() && all.is_empty() {
            reservation.grow(data.len() as u64)?;
            first = data;
            continue;
        }
        if !first.is_empty() {
            reservation.extend(&mut all, &first, announced)?;
            reservation.shrink(first.len() as u64);
            first = Bytes::new();
        }
        reservation.extend(&mut all, &data, announced)?;
    }
    let digest = hasher.digest(reservation).await?;
    Ok((if all.is_empty() { first } else { all.freeze() }, digest))
}

/// Content coding that the structure reader supports: its name and the first bytes of a compressed file.
type Coding = (&'static str, &'static [u8]);

fn bad_encoding(detail: &str) -> Problem {
    Problem::new(ProblemType::UnsupportedEncoding, detail).with("available", vec!["gzip", "zstd", "identity"])
}

/// Returns the declared coding. The reader detects the coding from the bytes, so the header is only checked.
fn content_encoding(headers: &HeaderMap) -> Result<Option<Coding>, Problem> {
    let mut codings = headers.get_all(CONTENT_ENCODING).iter().flat_map(|value| value.as_bytes().split(|&b| b == b','));
    let (first, second) = (codings.next(), codings.next());
    let name = String::from_utf8_lossy(first.unwrap_or_default()).trim().to_ascii_lowercase();
    match (name.as_str(), second) {
        ("" | "identity", None) => Ok(None),
        ("gzip" | "x-gzip", None) => Ok(Some(("gzip", GZIP_MAGIC))),
        ("zstd", None) => Ok(Some(("zstd", ZSTD_MAGIC))),
        (_, Some(_)) => Err(bad_encoding("the request has more than one content encoding")),
        (other, None) => Err(bad_encoding(&format!("unknown content encoding `{other}`"))),
    }
}
