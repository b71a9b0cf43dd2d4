//! `multipart/form-data` bodies: a structure file, a map, and parameters. Every part is limited before it is buffered.

use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll, ready};

use axum::body::{Body, BodyDataStream};
use axum::http::HeaderMap;
use bytes::{Bytes, BytesMut};
use futures_util::{Stream, StreamExt as _};
use multer::{Constraints, Multipart, SizeLimit};
use thiserror::Error;

use super::body_hasher::BodyHasher;
use super::content_type::DeclaredType;
use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::jobs::{MemoryReservation, UploadedMap};
use crate::store::Digest;
use crate::surface::{Exceeded, Limit};

/// Maximum size of the headers of a part, and of the preamble before the first part, bytes. Browsers send a few
/// hundred.
pub(super) const MAX_HEAD_BYTES: usize = 16 << 10;
/// Maximum number of parts. One file and all parameters are fewer than half.
pub(super) const MAX_PARTS: usize = 128;
/// Maximum size of a parameter field, bytes.
const MAX_FIELD_BYTES: usize = 4096;
/// Maximum length of a boundary (RFC 2046, 5.1.1).
const MAX_BOUNDARY: usize = 70;
/// Size of the pieces that the parser gets, bytes. The parser searches its whole buffer for each piece.
const PIECE: usize = 64 << 10;

/// Error of the parser's input.
#[derive(Debug, Error)]
enum FeedError {
    #[error("the head of a part is too long")]
    HeadTooLong,
    #[error(transparent)]
    Body(#[from] axum::Error),
}

/// Passes a body to the parser in pieces, at most `allowance` bytes: the parser buffers the preamble and the head of a
/// part until it finds their end.
struct Feed<'a> {
    body: BodyDataStream,
    rest: Bytes,
    allowance: &'a AtomicUsize,
    /// Set after each piece, which the parser must process before it gets the next one.
    paused: bool,
}

impl Stream for Feed<'_> {
    type Item = Result<Bytes, FeedError>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if std::mem::take(&mut self.paused) {
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        while self.rest.is_empty() {
            match ready!(self.body.poll_next_unpin(cx)) {
                Some(data) => self.rest = data?,
                None => return Poll::Ready(None),
            }
        }
        let allowance = self.allowance.load(Ordering::Relaxed);
        let length = self.rest.len().min(allowance).min(PIECE);
        if length == 0 {
            return Poll::Ready(Some(Err(FeedError::HeadTooLong)));
        }
        if allowance != UNBOUNDED {
            self.allowance.store(allowance - length, Ordering::Relaxed);
        }
        self.paused = true;
        Poll::Ready(Some(Ok(self.rest.split_to(length))))
    }
}

/// Allowance for the content of a part, which the parser does not buffer.
const UNBOUNDED: usize = usize::MAX;

fn head_too_long() -> Problem {
    Problem::from(&Exceeded::new(Limit::PartHeadBytes, MAX_HEAD_BYTES as u64))
}

/// Returns the problem of an error of the parser, for a body with this limit.
fn unreadable(error: &multer::Error, body: &Exceeded) -> Problem {
    match error {
        multer::Error::StreamSizeExceeded { .. } => body.into(),
        multer::Error::StreamReadFailed(cause)
            if matches!(cause.downcast_ref::<FeedError>(), Some(FeedError::HeadTooLong)) =>
        {
            head_too_long()
        }
        other => Problem::new(ProblemType::BadRequest, format!("the form cannot be read: {other}")),
    }
}

/// Received structure file.
pub(super) struct UploadedFile {
    pub(super) bytes: Bytes,
    /// SHA-256 of `bytes`.
    pub(super) digest: Digest,
    pub(super) reservation: MemoryReservation,
    /// Map from the field `map` of a form.
    pub(super) map: Option<UploadedMap>,
    /// Parameters from the other fields of a form.
    pub(super) fields: Vec<(String, String)>,
    /// Content type of the file.
    pub(super) declared: DeclaredType,
}

/// Reads a form of `announced` bytes, 0 if unknown: one structure file in `file` or `structure`, at most one map in
/// `map`, parameters in the other fields.
pub(super) async fn read(
    limit: &Exceeded,
    content_type: &str,
    announced: u64,
    body: Body,
    reservation: MemoryReservation,
) -> Result<UploadedFile, Problem> {
    let failed = |error: multer::Error| unreadable(&error, limit);
    let boundary = multer::parse_boundary(content_type).map_err(failed)?;
    if boundary.len() > MAX_BOUNDARY {
        let detail = format!("the form's boundary has more than {MAX_BOUNDARY} characters");
        return Err(Problem::new(ProblemType::BadRequest, detail).with("limit", MAX_BOUNDARY));
    }
    // Upper limit of the parser's buffer.
    reservation.grow((MAX_HEAD_BYTES + PIECE) as u64)?;
    let allowance = AtomicUsize::new(0);
    let mut feed = Feed { body: body.into_data_stream(), rest: Bytes::new(), allowance: &allowance, paused: false };
    let constraints = Constraints::new().size_limit(SizeLimit::new().whole_stream(limit.max));
    let mut form = Multipart::with_constraints(&mut feed, boundary, constraints);
    let (mut file, mut map, mut fields) = (None, None, Vec::new());
    loop {
        allowance.store(MAX_HEAD_BYTES, Ordering::Relaxed);
        let Some(mut field) = form.next_field().await.map_err(failed)? else { break };
        allowance.store(UNBOUNDED, Ordering::Relaxed);
        // The head may have begun in a piece that the allowance did not count.
        if head_bytes(field.headers()) > MAX_HEAD_BYTES {
            return Err(head_too_long());
        }
        if fields.len() + usize::from(file.is_some()) + usize::from(map.is_some()) >= MAX_PARTS {
            return Err(Problem::from(&Exceeded::new(Limit::FormParts, MAX_PARTS as u64)));
        }
        let name = field.name().unwrap_or_default().to_owned();
        reservation.grow(name.len() as u64)?;
        let (is_structure, is_map) = (matches!(name.as_str(), "file" | "structure"), name == "map");
        let is_file = is_structure || is_map;
        if is_structure && file.is_some() {
            return Err(
                Problem::new(ProblemType::BadRequest, "the form has more than one file").with("parameter", name)
            );
        }
        if is_map && map.is_some() {
            return Err(Problem::new(ProblemType::BadRequest, "the form has more than one map").with("parameter", name));
        }
        let declared = DeclaredType::new(field.content_type().map_or("", |mime| mime.as_ref()));
        let (mut content, mut hasher) = (BytesMut::new(), BodyHasher::default());
        while let Some(chunk) = field.chunk().await.map_err(failed)? {
            // A map is the second file, so the announced length is not its own.
            reservation.extend(&mut content, &chunk, if is_structure { announced } else { 0 })?;
            if is_file {
                hasher.update(&chunk, &reservation).await?;
            }
            if !is_file && content.len() > MAX_FIELD_BYTES {
                return Err(field_too_long(&name));
            }
        }
        if is_structure {
            file = Some((content.freeze(), hasher.digest(&reservation).await?, declared));
        } else if is_map {
            map = Some(UploadedMap { bytes: content.freeze(), digest: hasher.digest(&reservation).await? });
        } else {
            fields.push((name, String::from_utf8_lossy(&content).into_owned()));
        }
    }
    drop(form);
    // The epilogue is ignored, but the connection can be reused only if the body is read to its end.
    allowance.store(MAX_HEAD_BYTES, Ordering::Relaxed);
    while let Some(piece) = feed.next().await {
        piece.map_err(|e| failed(multer::Error::StreamReadFailed(e.into())))?;
    }
    let Some((bytes, digest, declared)) = file else {
        let detail = "the form has no file; it belongs in a field named `file` or `structure`";
        return Err(Problem::new(ProblemType::BadRequest, detail).with("expected", "file"));
    };
    Ok(UploadedFile { bytes, digest, reservation, map, fields, declared })
}

/// Returns the size of a part's headers, bytes.
fn head_bytes(headers: &HeaderMap) -> usize {
    headers.iter().map(|(name, value)| name.as_str().len() + ": \r\n".len() + value.len()).sum()
}

fn field_too_long(name: &str) -> Problem {
    let shown: String = name.chars().take(80).collect();
    let detail = format!(
        "the form field `{shown}` has more than {MAX_FIELD_BYTES} bytes; the file belongs in a field named `file` or `structure`"
    );
    Problem::new(ProblemType::BadParameter, detail).with("parameter", shown).with("limit", MAX_FIELD_BYTES)
}
