//! Answer of a finished job: the mesh, with a summary in headers, or the report.

use std::sync::Arc;

use axum::http::HeaderValue;
use axum::http::header::{self, HeaderMap, HeaderName};
use axum::response::{IntoResponse, Response};

use serde::Serialize;
use serde_json::Value;
use tokio::sync::OwnedSemaphorePermit;

use super::errors::{self, Finding};
use super::problem::Problem;
use super::state::App;
use super::stream;
use super::timing::Timing;
use crate::formats::Format;
use crate::jobs::{ContentKey, Finished};
use crate::pipeline::Report;
use utoipa::ToSchema;

/// Headers that summarise the report.
pub(super) const SUMMARY: [&str; 17] = [
    "molmesh-atoms",
    "molmesh-vertices",
    "molmesh-triangles",
    "molmesh-area",
    "molmesh-volume",
    "molmesh-closed",
    "molmesh-manifold",
    "molmesh-euler",
    "molmesh-components",
    "molmesh-kernel",
    "molmesh-preset",
    "molmesh-resolution",
    "molmesh-resolution-from",
    "molmesh-isovalue",
    "molmesh-radii",
    "molmesh-backend",
    "molmesh-backend-reason",
];

/// Headers that summarise the report of a picture, with the members of its `picture`.
pub(super) const PICTURE: [(&str, &str); 4] = [
    ("molmesh-renderer", "renderer"),
    ("molmesh-renderer-device", "device"),
    ("molmesh-renderer-reason", "reason"),
    ("molmesh-pixel", "pixel"),
];

/// Report of a request, with the findings of the strict validator.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ReportDocument {
    #[serde(flatten)]
    report: Report,
    /// Findings of the strict validator; absent without `check=strict`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    diagnostics: Option<Vec<Finding>>,
}

/// Sends the mesh as `format`. `permit` is dropped after the last byte was written.
pub(super) async fn mesh(
    app: &App,
    finished: Arc<Finished>,
    format: Format,
    key: &ContentKey,
    mut timing: Timing,
    permit: OwnedSemaphorePermit,
) -> Result<Response, Problem> {
    let report = &finished.product.report;
    let mut headers = summary(&serde_json::to_value(report).map_err(Problem::internal)?);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(header::CONTENT_DISPOSITION, disposition(report.id.as_deref(), format));
    headers.insert(header::ETAG, etag(key));
    let (length, body) =
        stream::start(finished, format, app.config.limits.output_bytes, app.pool.settings().budget.clone(), permit)
            .await?;
    if let Some(length) = length {
        headers.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    }
    timing.head();
    let mut response = (headers, body).into_response();
    response.extensions_mut().insert(timing);
    Ok(response)
}

/// Sends the report as JSON.
pub(super) fn report(finished: &Finished, mut timing: Timing) -> Result<Response, Problem> {
    let report = &finished.product.report;
    let mut headers = summary(&serde_json::to_value(report).map_err(Problem::internal)?);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/json"));
    // Every report holds the times of its own run.
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    let diagnostics = finished.diagnostics.as_deref().map(errors::findings);
    let document = ReportDocument { report: report.clone(), diagnostics };
    let mut response = (headers, serde_json::to_string(&document).map_err(Problem::internal)?).into_response();
    timing.head();
    response.extensions_mut().insert(timing);
    Ok(response)
}

/// Returns the strong validator of a mesh file.
pub(super) fn etag(key: &ContentKey) -> HeaderValue {
    HeaderValue::from_str(&format!("\"{key}\"")).unwrap_or_else(|_| HeaderValue::from_static("\"\""))
}

/// Returns the file name for browsers, which show pictures and save meshes.
pub(super) fn disposition(id: Option<&str>, format: Format) -> HeaderValue {
    let safe = |c: &char| c.is_ascii_alphanumeric() || "-_.".contains(*c);
    let stem: String = id.unwrap_or_default().chars().filter(safe).take(64).collect();
    let stem = if stem.trim_matches('.').is_empty() { "surface" } else { &stem };
    let kind = if format.is_picture() { "inline" } else { "attachment" };
    text(&format!("{kind}; filename=\"{stem}.{}\"", format.extension()))
}

/// Returns a header value; characters that are not printable ASCII become `?`.
pub(super) fn text(value: &str) -> HeaderValue {
    let plain: String = value.chars().map(|c| if (' '..='~').contains(&c) { c } else { '?' }).collect();
    HeaderValue::from_str(&plain).unwrap_or_else(|_| HeaderValue::from_static("?"))
}

/// Returns the summary headers of a report, from its JSON.
pub(super) fn summary(report: &Value) -> HeaderMap {
    let header = |name: &'static str, value: &Value| {
        let value = match value {
            Value::String(text) => text.replace('Å', "A"),
            // Areas and volumes to a thousandth.
            Value::Number(number) if name == "molmesh-area" || name == "molmesh-volume" => {
                format!("{:.3}", number.as_f64().unwrap_or_default())
            }
            other => other.to_string(),
        };
        (HeaderName::from_static(name), text(&value))
    };
    let member = |name: &str| name.trim_start_matches("molmesh-").replace('-', "_");
    let mut headers: HeaderMap = SUMMARY.into_iter().map(|name| header(name, &report[member(name).as_str()])).collect();
    if let Some(picture) = report.get("picture") {
        headers.extend(PICTURE.into_iter().map(|(name, of)| header(name, &picture[of])));
    }
    headers
}
