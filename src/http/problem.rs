//! Problems: RFC 9457 `application/problem+json` for everything that is not a success, ours and the libraries'.
//!
//! Handlers return a [`Problem`]; the errors of the other rooms become one here and nowhere else. The answer is
//! written by [`render`], a middleware, because it alone knows the request's id.

use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, HeaderName, RETRY_AFTER};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use metrics::counter;
use serde::Serialize;
use serde_json::{Map, Value};
use utoipa::ToSchema;

use super::kinds::{KINDS, Kind};
use super::request_id::RequestId;
use super::unfit;
use crate::jobs::{EndError, Exhausted, Failure, PromiseError, Refusal, SaveError};
use crate::picture::PictureError;
use crate::pipeline::JobError;
use crate::pipeline::params::ParamError;
use crate::store::StoreError;
use crate::structure::StructureError;
use crate::structure::referee::Diagnostic;
use crate::surface::SurfaceError;
use crate::telemetry::REJECTED;

/// Media type of problems.
pub(super) const MEDIA_TYPE: &str = "application/problem+json";

/// Something to tell the client instead of what it asked for.
#[derive(Debug, Clone)]
pub(super) struct Problem {
    kind: Kind,
    detail: String,
    members: Map<String, Value>,
    retry_after_s: Option<u32>,
    header: Option<Box<(HeaderName, HeaderValue)>>,
}

impl Problem {
    /// A problem with its explanation for this occurrence.
    pub(super) fn new(kind: Kind, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into(), members: Map::new(), retry_after_s: None, header: None }
    }

    /// A mistake of ours. The message goes to the log, not to the client.
    pub(super) fn internal(message: impl std::fmt::Display) -> Self {
        tracing::error!(%message, "internal error");
        Self::new(Kind::Internal, "The request could not be answered.")
    }

    /// Whether it is one of `kind`.
    pub(super) fn is(&self, kind: Kind) -> bool {
        self.kind == kind
    }

    /// Adds a member.
    pub(super) fn with(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.members.insert(name.to_owned(), value.into());
        self
    }

    /// Says when to try again.
    pub(super) fn retry_after(mut self, wait: Duration) -> Self {
        self.retry_after_s = u32::try_from((wait + Duration::from_millis(999)).as_secs().clamp(1, 600)).ok();
        self
    }

    /// Says when to try again, however far away that is: a quota's window is known to the second.
    pub(super) fn retry_after_window(mut self, wait: Duration) -> Self {
        self.retry_after_s = u32::try_from(wait.as_millis().div_ceil(1000).max(1)).ok();
        self
    }

    /// Adds a header.
    pub(super) fn header(mut self, name: HeaderName, value: &str) -> Self {
        self.header = HeaderValue::from_str(value).ok().map(|value| Box::new((name, value)));
        self
    }

    /// The document for a job's record, which [`Self::recorded`] reads.
    pub(super) fn record(&self) -> Value {
        serde_json::from_slice(&self.document("")).unwrap_or_default()
    }

    /// The problem of a job's record.
    pub(super) fn recorded(document: Option<&Value>) -> Self {
        let lost = || Self::internal("a job's problem is not on record");
        let Some(members) = document.and_then(Value::as_object) else { return lost() };
        let text = |name: &str| members.get(name).and_then(Value::as_str);
        let slug = text("type").and_then(|t| t.rsplit('/').next());
        let Some(row) = KINDS.iter().find(|row| Some(row.slug) == slug) else { return lost() };
        let mut problem = Self::new(row.kind, text("detail").unwrap_or_default());
        let own = ["type", "title", "status", "detail", "instance"];
        let others = members.iter().filter(|(name, _)| !own.contains(&name.as_str()));
        problem.members.extend(others.map(|(name, value)| (name.clone(), value.clone())));
        problem
    }

    /// Adds what the referee found, if it found anything.
    fn diagnosed(self, diagnostics: &[Diagnostic]) -> Self {
        if diagnostics.is_empty() {
            return self;
        }
        match serde_json::to_value(findings(diagnostics)) {
            Ok(findings) => self.with("diagnostics", findings),
            Err(error) => Self::internal(error),
        }
    }

    /// The document.
    pub(super) fn document(&self, instance: &str) -> Vec<u8> {
        let row = self.kind.row();
        let mut document = Map::new();
        document.insert("type".to_owned(), format!("/problems/{}", row.slug).into());
        document.insert("title".to_owned(), row.title.into());
        document.insert("status".to_owned(), row.status.as_u16().into());
        document.insert("detail".to_owned(), self.detail.as_str().into());
        document.insert("instance".to_owned(), instance.into());
        document.extend(self.members.iter().map(|(name, value)| (name.clone(), value.clone())));
        let mut bytes = Value::Object(document).to_string().into_bytes();
        bytes.push(b'\n');
        bytes
    }
}

impl IntoResponse for Problem {
    /// The status and, for [`render`], the problem itself.
    fn into_response(self) -> Response {
        let mut response = self.kind.row().status.into_response();
        if let Some(wait) = self.retry_after_s {
            response.headers_mut().insert(RETRY_AFTER, HeaderValue::from(wait));
        }
        if let Some((name, value)) = self.header.clone().map(|header| *header) {
            response.headers_mut().insert(name, value);
        }
        response.extensions_mut().insert(self);
        response
    }
}

/// Writes problems, and turns every other answer that is an error into one.
pub(super) async fn render(request: Request, next: Next) -> Response {
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let (head, path) = (request.method() == Method::HEAD, request.uri().path().to_owned());
    let mut response = next.run(request).await;
    let status = response.status();
    if !status.is_client_error() && !status.is_server_error() {
        return response;
    }
    let problem = response.extensions_mut().remove::<Problem>();
    let problem = problem.unwrap_or_else(|| of_library(status, &path));
    let row = problem.kind.row();
    if row.limit {
        counter!(REJECTED, "reason" => row.slug).increment(1);
    }
    let document = problem.document(id.as_str());
    let (mut parts, _body) = response.into_parts();
    parts.status = row.status;
    parts.headers.insert(CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
    parts.headers.insert(CONTENT_LENGTH, HeaderValue::from(document.len()));
    Response::from_parts(parts, if head { Body::empty() } else { Body::from(document) })
}

/// The problem behind an error answer that axum or a layer gave.
fn of_library(status: StatusCode, path: &str) -> Problem {
    let detail = match status {
        StatusCode::NOT_FOUND => format!("There is nothing at {path}."),
        StatusCode::METHOD_NOT_ALLOWED => format!("{path} has other methods; the Allow header lists them."),
        _ => status.canonical_reason().unwrap_or("The request could not be answered").to_owned(),
    };
    Problem::new(Kind::of_status(status), detail)
}

/// Finding of the strict validator.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Finding {
    /// Severity: `note`, `warning` or `error`.
    level: &'static str,
    /// Line of the file, from 1; null if the finding has no line.
    #[schema(required)]
    line: Option<u64>,
    /// Description of the finding.
    message: String,
}

/// The referee's findings.
pub(super) fn findings(diagnostics: &[Diagnostic]) -> Vec<Finding> {
    let finding = |d: &Diagnostic| Finding { level: d.level.name(), line: d.line, message: d.message.clone() };
    diagnostics.iter().map(finding).collect()
}

impl From<ParamError> for Problem {
    fn from(error: ParamError) -> Self {
        let problem = Self::new(Kind::BadParameter, error.to_string());
        match error {
            ParamError::Unknown { name, nearest } => problem.with("parameter", name).with("nearest", nearest),
            ParamError::Repeated { name } => problem.with("parameter", name),
            ParamError::BadValue { name, value, expected } => {
                problem.with("parameter", name).with("value", value.trim_matches('`')).with("expected", expected)
            }
        }
    }
}

impl From<Exhausted> for Problem {
    fn from(error: Exhausted) -> Self {
        Self::new(Kind::MemoryFull, error.to_string())
            .with("limit", error.limit)
            .with("actual", error.held)
            .retry_after(Duration::from_secs(1))
    }
}

impl From<Refusal> for Problem {
    fn from(error: Refusal) -> Self {
        match error {
            Refusal::QueueFull { waiting, limit, wait } => Self::new(Kind::QueueFull, error.to_string())
                .with("limit", limit)
                .with("actual", waiting)
                .with("estimated_wait_s", wait.as_secs_f64())
                .retry_after(wait),
            Refusal::TooLate { wait, allowed } => Self::new(Kind::QueueFull, error.to_string())
                .with("limit", u64::try_from(allowed.as_millis()).unwrap_or(u64::MAX))
                .with("estimated_wait_s", wait.as_secs_f64())
                .retry_after(wait.saturating_sub(allowed)),
            Refusal::Draining => Self::new(Kind::ShuttingDown, error.to_string()).retry_after(Duration::from_secs(1)),
        }
    }
}

impl From<Failure> for Problem {
    fn from(error: Failure) -> Self {
        match error {
            Failure::Job { error: JobError::Structure(error), diagnostics } => {
                Self::from(error).diagnosed(&diagnostics)
            }
            Failure::Job { error: JobError::Surface(error), .. } => error.into(),
            Failure::Job { error: JobError::Picture(error), .. } => error.into(),
            Failure::Check { ref diagnostics } => Self::new(Kind::UnreadableStructure, error.to_string())
                .with("parameter", "check")
                .diagnosed(diagnostics),
            Failure::Deadline { limit } => Self::new(Kind::Deadline, error.to_string())
                .with("limit", u64::try_from(limit.as_millis()).unwrap_or(u64::MAX)),
            Failure::Memory(error) => error.into(),
            Failure::Stopped => Self::new(Kind::ShuttingDown, error.to_string()).retry_after(Duration::from_secs(1)),
            Failure::Panicked { .. } => Self::internal(error),
        }
    }
}

impl From<EndError> for Problem {
    fn from(error: EndError) -> Self {
        match error {
            EndError::Job(failure) => failure.into(),
            EndError::Save { error: SaveError::Format(error), resolution } => unfit::of_format(&error, resolution),
            EndError::Save { error: SaveError::TooLarge { bytes, limit }, resolution } => {
                unfit::file_too_large(bytes, limit, resolution)
            }
            EndError::Save { error: SaveError::Store(error), .. } => error.into(),
            EndError::Save { error: SaveError::Other(error), .. } => Self::internal(error),
            EndError::Poison { attempts } => Self::new(Kind::JobAbandoned, error.to_string()).with("actual", attempts),
            EndError::Lost { .. } => Self::new(Kind::JobAbandoned, error.to_string()),
        }
    }
}

impl From<PromiseError> for Problem {
    fn from(error: PromiseError) -> Self {
        match error {
            PromiseError::Refused(refusal) => refusal.into(),
            PromiseError::Store(error) => error.into(),
            PromiseError::OtherRequest => {
                Self::new(Kind::OtherRequest, error.to_string()).with("parameter", "Idempotency-Key")
            }
            PromiseError::Random(_) => Self::internal(error),
        }
    }
}

impl From<StoreError> for Problem {
    /// Places and the system's words are for the log.
    fn from(error: StoreError) -> Self {
        let wait = Duration::from_secs(5);
        match error {
            StoreError::TooLarge { bytes, max_bytes } => Self::new(Kind::StoreFull, error.to_string())
                .with("actual", bytes)
                .with("limit", max_bytes)
                .retry_after(wait),
            StoreError::Full { held, max_bytes, .. } => Self::new(Kind::StoreFull, error.to_string())
                .with("actual", held)
                .with("limit", max_bytes)
                .retry_after(wait),
            other => {
                tracing::error!(error = %other, "the store failed");
                Self::new(Kind::StoreFailed, "what the service keeps cannot be reached").retry_after(wait)
            }
        }
    }
}

impl From<StructureError> for Problem {
    fn from(error: StructureError) -> Self {
        use StructureError as E;
        let detail = error.to_string();
        match error {
            E::UnknownFormat { found } => Self::new(Kind::UnreadableStructure, detail).with("found", found),
            E::Syntax { line, column, found, expected } => Self::new(Kind::UnreadableStructure, detail)
                .with("line", line)
                .with("column", column)
                .with("found", found)
                .with("expected", expected),
            E::Malformed { place, found, expected } => Self::new(Kind::UnreadableStructure, detail)
                .with("place", place)
                .with("found", found)
                .with("expected", expected),
            E::Decompress { encoding, .. } => Self::new(Kind::UnreadableStructure, detail).with("encoding", encoding),
            E::InflatedTooLarge { limit } => Self::new(Kind::InflatedTooLarge, detail).with("limit", limit),
            E::TooManyAtoms { limit } => Self::new(Kind::TooManyAtoms, detail).with("limit", limit),
            E::NoAtoms { found } => Self::new(Kind::NoAtoms, detail).with("found", found),
            E::EmptySelection { holds } => Self::new(Kind::EmptySelection, detail).with("found", holds),
            E::NotFound { what, asked, available } => Self::new(Kind::EmptySelection, detail)
                .with("parameter", if what == "chain" { "chains" } else { what })
                .with("value", asked.trim_matches('`'))
                .with("expected", available),
        }
    }
}

impl From<PictureError> for Problem {
    fn from(error: PictureError) -> Self {
        let detail = error.to_string();
        match error {
            PictureError::TooLarge { side, pixels, limit } => Self::new(Kind::PictureTooLarge, detail)
                .with("parameter", side)
                .with("limit", limit)
                .with("actual", pixels),
            // The rest is dealt with before it comes here.
            _ => Self::internal(detail),
        }
    }
}

impl From<SurfaceError> for Problem {
    fn from(error: SurfaceError) -> Self {
        use SurfaceError as E;
        let detail = error.to_string();
        match error {
            E::NoSpheres => Self::new(Kind::NoAtoms, detail),
            E::BadSphere { index, expected, .. } => {
                Self::new(Kind::UnreadableStructure, detail).with("atom", index).with("expected", expected)
            }
            E::BadParameter { .. } => ParamError::from(error).into(),
            E::GridTooLarge { samples, limit, resolution, suggested_resolution } => {
                Self::new(Kind::GridTooLarge, detail)
                    .with("limit", limit)
                    .with("actual", samples)
                    .with("resolution", resolution)
                    .with("suggested_resolution", suggested_resolution)
            }
            E::TooManyCandidates { candidates, limit, resolution, suggested_resolution } => {
                let problem = Self::new(Kind::TooManyCandidates, detail)
                    .with("limit", limit)
                    .with("actual", candidates)
                    .with("resolution", resolution);
                suggested_resolution.into_iter().fold(problem, |p, h| p.with("suggested_resolution", h))
            }
            E::MeshTooLarge { bytes, limit, suggested_resolution } => Self::new(Kind::MeshTooLarge, detail)
                .with("limit", limit)
                .with("actual", bytes)
                .with("suggested_resolution", suggested_resolution),
            E::TooManyTriangles { triangles, limit, resolution } => Self::new(Kind::MeshTooLarge, detail)
                .with("parameter", "max_triangles")
                .with("limit", limit)
                .with("actual", triangles)
                .with("resolution", resolution),
            E::NoSurface { isovalue } => {
                Self::new(Kind::NoSurface, detail).with("parameter", "isovalue").with("isovalue", isovalue)
            }
            E::DeviceMemory { needed, available, suggested_resolution } => Self::new(Kind::DeviceMemory, detail)
                .with("limit", available)
                .with("actual", needed)
                .with("suggested_resolution", suggested_resolution),
            // What drivers say is for the log, where the job's worker put it.
            E::Device { .. } => {
                Self::new(Kind::DeviceFailed, "no device could run the job").retry_after(Duration::from_secs(1))
            }
            E::Deadline => Self::new(Kind::Deadline, detail),
            E::Cancelled => Self::from(Failure::Stopped),
            // No sink takes part in an answer.
            E::Sink => Self::internal(detail),
        }
    }
}
