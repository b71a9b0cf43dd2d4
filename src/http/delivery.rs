//! A finished job as an answer: the mesh with its summary in headers, or the report.

use std::sync::Arc;

use axum::http::HeaderValue;
use axum::http::header::{self, HeaderMap, HeaderName};
use axum::response::{IntoResponse, Response};

use serde::Serialize;
use serde_json::Value;
use tokio::sync::OwnedSemaphorePermit;

use super::problem::{self, Finding, Problem};
use super::state::App;
use super::stream;
use super::timing::Timing;
use crate::formats::Format;
use crate::jobs::{ContentKey, Finished};
use crate::pipeline::Report;
use utoipa::ToSchema;

/// Headers that sum up the report.
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

/// Headers that sum up the report of a picture, and the members of its `picture`.
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

/// The mesh as `format`; `place` is given back when its last byte is written.
pub(super) async fn mesh(
    app: &App,
    finished: Arc<Finished>,
    format: Format,
    key: &ContentKey,
    mut timing: Timing,
    place: OwnedSemaphorePermit,
) -> Result<Response, Problem> {
    let report = &finished.product.report;
    let mut headers = summary(&serde_json::to_value(report).map_err(Problem::internal)?);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(header::CONTENT_DISPOSITION, disposition(report.id.as_deref(), format));
    headers.insert(header::ETAG, etag(key));
    let (length, body) =
        stream::start(finished, format, app.config.limits.output_bytes, app.pool.budget().clone(), place).await?;
    if let Some(length) = length {
        headers.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    }
    timing.head();
    let mut response = (headers, body).into_response();
    response.extensions_mut().insert(timing);
    Ok(response)
}

/// The report as JSON.
pub(super) fn report(finished: &Finished, mut timing: Timing) -> Result<Response, Problem> {
    let report = &finished.product.report;
    let mut headers = summary(&serde_json::to_value(report).map_err(Problem::internal)?);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/json"));
    // Times differ from run to run, so no two reports are the same.
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    let diagnostics = finished.diagnostics.as_deref().map(problem::findings);
    let document = ReportDocument { report: report.clone(), diagnostics };
    let mut response = (headers, serde_json::to_string(&document).map_err(Problem::internal)?).into_response();
    timing.head();
    response.extensions_mut().insert(timing);
    Ok(response)
}

/// The strong validator of a mesh file.
pub(super) fn etag(key: &ContentKey) -> HeaderValue {
    HeaderValue::from_str(&format!("\"{key}\"")).unwrap_or_else(|_| HeaderValue::from_static("\"\""))
}

/// A file name for browsers, which show pictures and save meshes.
pub(super) fn disposition(id: Option<&str>, format: Format) -> HeaderValue {
    let safe = |c: &char| c.is_ascii_alphanumeric() || "-_.".contains(*c);
    let stem: String = id.unwrap_or_default().chars().filter(safe).take(64).collect();
    let stem = if stem.trim_matches('.').is_empty() { "surface" } else { &stem };
    let way = if format.is_picture() { "inline" } else { "attachment" };
    text(&format!("{way}; filename=\"{stem}.{}\"", format.extension()))
}

/// A header value; characters that headers cannot hold are written as `?`.
pub(super) fn text(value: &str) -> HeaderValue {
    let plain: String = value.chars().map(|c| if (' '..='~').contains(&c) { c } else { '?' }).collect();
    HeaderValue::from_str(&plain).unwrap_or_else(|_| HeaderValue::from_static("?"))
}

/// The headers that sum up a report, from its JSON: fresh or kept, the same.
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
