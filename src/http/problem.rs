//! Problems: `application/problem+json` (RFC 9457) for every error, including those of libraries.
//!
//! Handlers return a [`Problem`]. The middleware [`render`] writes the response, since it knows the request id.

use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use axum::extract::rejection::PathRejection;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, HeaderName, RETRY_AFTER};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use metrics::counter;
use serde_json::{Map, Value};

use super::problem_types::{ProblemEntry, ProblemType};
use super::request_id::RequestId;
use crate::telemetry::REJECTED;

/// Media type of problems.
pub(super) const MEDIA_TYPE: &str = "application/problem+json";

/// Error response.
#[derive(Debug, Clone)]
pub(super) struct Problem {
    kind: ProblemType,
    detail: String,
    members: Map<String, Value>,
    retry_after_s: Option<u32>,
    header: Option<Box<(HeaderName, HeaderValue)>>,
}

impl Problem {
    /// Creates a problem; `detail` explains this occurrence.
    pub(super) fn new(kind: ProblemType, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into(), members: Map::new(), retry_after_s: None, header: None }
    }

    /// Replaces the explanation of this occurrence.
    pub(super) fn detailed(self, detail: String) -> Self {
        Self { detail, ..self }
    }

    /// Creates the problem of a request or a job that the end of the service cuts off.
    pub(super) fn shutting_down(detail: String) -> Self {
        Self::new(ProblemType::ShuttingDown, detail).retry_after(Duration::from_secs(1))
    }

    /// Creates the problem of a job whose record this release cannot read.
    pub(super) fn other_release() -> Self {
        let detail = "another release of the service wrote the record of the job, and this one cannot read it";
        Self::new(ProblemType::OtherRelease, detail).retry_after(Duration::from_secs(5))
    }

    /// Creates an internal error. The message goes to the log, not to the client.
    pub(super) fn internal(message: impl std::fmt::Display) -> Self {
        tracing::error!(%message, "internal error");
        Self::new(ProblemType::Internal, "The request could not be answered.")
    }

    /// Returns true if the problem is of this type.
    pub(super) fn is(&self, kind: ProblemType) -> bool {
        self.kind == kind
    }

    /// Returns true if a later request may succeed.
    pub(super) fn is_temporary(&self) -> bool {
        matches!(self.kind.row().status, StatusCode::SERVICE_UNAVAILABLE | StatusCode::FAILED_DEPENDENCY)
    }

    /// Returns the name of the problem type.
    pub(super) fn slug(&self) -> &'static str {
        self.kind.row().slug
    }

    /// Returns the explanation of this occurrence.
    pub(super) fn into_detail(self) -> String {
        self.detail
    }

    /// Appends advice to the explanation.
    pub(super) fn advise(mut self, advice: &str) -> Self {
        self.detail.push_str("; ");
        self.detail.push_str(advice);
        self
    }

    /// Adds a member to the document.
    pub(super) fn with(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.members.insert(name.to_owned(), value.into());
        self
    }

    /// Sets `Retry-After`, 1 to 600 s.
    pub(super) fn retry_after(mut self, wait: Duration) -> Self {
        self.retry_after_s =
            u32::try_from(wait.saturating_add(Duration::from_millis(999)).as_secs().clamp(1, 600)).ok();
        self
    }

    /// Sets `Retry-After` without an upper limit: the end of a quota's window is known to the second.
    pub(super) fn retry_after_window(mut self, wait: Duration) -> Self {
        self.retry_after_s = u32::try_from(wait.as_millis().div_ceil(1000).max(1)).ok();
        self
    }

    /// Adds a header to the response.
    pub(super) fn header(mut self, name: HeaderName, value: &str) -> Self {
        self.header = HeaderValue::from_str(value).ok().map(|value| Box::new((name, value)));
        self
    }

    /// Returns the document as a part of another one, such as the record of a job, which [`Self::recorded`] reads.
    pub(super) fn record(&self, instance: &str) -> Value {
        serde_json::from_slice(&self.document(instance)).unwrap_or_default()
    }

    /// Restores the problem of a job's record.
    pub(super) fn recorded(document: Option<&Value>) -> Self {
        let lost = || Self::internal("the record of a job has no valid problem");
        let Some(members) = document.and_then(Value::as_object) else { return lost() };
        let text = |name: &str| members.get(name).and_then(Value::as_str);
        let slug = text("type").and_then(|t| t.rsplit('/').next());
        let Some(row) = slug.and_then(ProblemEntry::find) else { return lost() };
        let mut problem = Self::new(row.problem_type, text("detail").unwrap_or_default());
        let own = ["type", "title", "status", "detail", "instance"];
        let others = members.iter().filter(|(name, _)| !own.contains(&name.as_str()));
        problem.members.extend(others.map(|(name, value)| (name.clone(), value.clone())));
        problem
    }

    /// Returns the document as JSON, with a line break.
    pub(super) fn document(&self, instance: &str) -> Vec<u8> {
        let row = self.kind.row();
        let mut document = Map::new();
        document.insert("type".to_owned(), row.r#type.into());
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

impl From<PathRejection> for Problem {
    fn from(error: PathRejection) -> Self {
        Self::new(ProblemType::BadRequest, error.body_text())
    }
}

impl IntoResponse for Problem {
    /// Sets the status and the headers, and attaches the problem for [`render`].
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

/// Writes problems, and converts every other error response into one.
pub(super) async fn render(request: Request, next: Next) -> Response {
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let (head, path) = (request.method() == Method::HEAD, request.uri().path().to_owned());
    let mut response = next.run(request).await;
    let status = response.status();
    if !status.is_client_error() && !status.is_server_error() {
        return response;
    }
    let problem = response.extensions_mut().remove::<Problem>();
    let problem = problem.unwrap_or_else(|| from_library(status, &path));
    let row = problem.kind.row();
    if row.is_rejection {
        counter!(REJECTED, "reason" => row.slug).increment(1);
    }
    let document = problem.document(id.as_str());
    let (mut parts, _body) = response.into_parts();
    parts.status = row.status;
    parts.headers.insert(CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
    parts.headers.insert(CONTENT_LENGTH, HeaderValue::from(document.len()));
    Response::from_parts(parts, if head { Body::empty() } else { Body::from(document) })
}

/// Returns the problem for an error response of axum or of a layer.
fn from_library(status: StatusCode, path: &str) -> Problem {
    let detail = match status {
        StatusCode::NOT_FOUND => format!("There is nothing at {path}."),
        StatusCode::METHOD_NOT_ALLOWED => format!("{path} has other methods; the Allow header lists them."),
        _ => status.canonical_reason().unwrap_or("The request could not be answered").to_owned(),
    };
    Problem::new(ProblemType::from_status(status), detail)
}
