//! Response with a finished job: the mesh, with a summary in headers, or the report.

use std::ops::Range;
use std::sync::Arc;

use axum::http::header::{self, HeaderMap, HeaderName};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;
use utoipa::openapi::schema::Type;

use super::errors::{self, Finding};
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::range::{self, Wanted};
use super::state::{App, Delivery};
use super::stream;
use super::timing::Timing;
use crate::formats::Format;
use crate::jobs::{ContentKey, Finished};
use crate::pipeline::Report;

/// Header that summarizes a member of the report.
pub(super) struct SummaryHeader {
    pub(super) name: &'static str,
    /// Name of the member.
    member: &'static str,
    /// Type of the value, for the OpenAPI document.
    pub(super) kind: Type,
    pub(super) doc: &'static str,
}

const fn summary(name: &'static str, member: &'static str, kind: Type, doc: &'static str) -> SummaryHeader {
    SummaryHeader { name, member, kind, doc }
}

/// Headers of every mesh.
#[rustfmt::skip]
pub(super) static SUMMARY: [SummaryHeader; 17] = [
    summary("molmesh-atoms", "atoms", Type::Integer, "Atoms meshed."),
    summary("molmesh-vertices", "vertices", Type::Integer, "Vertices of the mesh."),
    summary("molmesh-triangles", "triangles", Type::Integer, "Triangles of the mesh."),
    summary("molmesh-area", "area", Type::Number, "Surface area in Å², including the walls of voids."),
    summary("molmesh-volume", "volume", Type::Number, "Enclosed volume in Å³, voids subtracted; absent if the mesh is cut open."),
    summary("molmesh-closed", "closed", Type::Boolean, "`true` if the mesh has no boundary."),
    summary("molmesh-manifold", "manifold", Type::Boolean, "`true` if all edges and vertices are manifold, by a check or by construction: `manifold_from` in the report."),
    summary("molmesh-euler", "euler", Type::Integer, "Euler characteristic: vertices − edges + triangles."),
    summary("molmesh-components", "components", Type::Integer, "Connected components of the mesh."),
    summary("molmesh-surface", "surface", Type::String, "Type of the surface."),
    summary("molmesh-preset", "preset", Type::String, "Preset."),
    summary("molmesh-resolution", "resolution", Type::Number, "Grid spacing in Å."),
    summary("molmesh-resolution-from", "resolution_from", Type::String,
        "Parameter that set the spacing: `resolution`, `detail` or `max_triangles`."),
    summary("molmesh-isovalue", "isovalue", Type::Number, "Isovalue of the density; isosurfaces only."),
    summary("molmesh-radii", "radii", Type::String, "Table of van der Waals radii."),
    summary("molmesh-backend", "backend", Type::String, "Backend that computed the mesh: `cpu`, `gpu` or `reference`."),
    summary("molmesh-backend-reason", "backend_reason", Type::String, "Reason for the choice of the backend."),
];

/// Headers of a picture, with members of the report's `picture`.
#[rustfmt::skip]
pub(super) static PICTURE: [SummaryHeader; 4] = [
    summary("molmesh-renderer", "renderer", Type::String,
        "Backend that rendered the picture: `cpu` or `gpu`. Pictures only."),
    summary("molmesh-renderer-device", "device", Type::String, "Device that rendered the picture. Pictures only."),
    summary("molmesh-renderer-reason", "reason", Type::String, "Reason for the choice of the renderer. Pictures only."),
    summary("molmesh-pixel", "pixel", Type::Number, "Width and height of a pixel in Å. Pictures only."),
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

/// Returns the part of a file of `length` bytes that is requested, with the status and the headers of the response.
/// `etag` is that of the file.
pub(super) fn requested_part(
    request: &HeaderMap,
    etag: &HeaderValue,
    length: u64,
) -> Result<(Range<u64>, StatusCode, HeaderMap), Problem> {
    let mut headers = HeaderMap::from_iter([(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"))]);
    match range::wanted(request, etag, length) {
        Wanted::All => Ok((0..length, StatusCode::OK, headers)),
        Wanted::Part(part) => {
            let content_range = text(&format!("bytes {}-{}/{length}", part.start, part.end - 1));
            headers.insert(header::CONTENT_RANGE, content_range);
            Ok((part, StatusCode::PARTIAL_CONTENT, headers))
        }
        Wanted::Nothing => Err(Problem::new(ProblemType::RangeNotSatisfiable, format!("the file has {length} bytes"))
            .with("actual", length)
            .header(header::CONTENT_RANGE, &format!("bytes */{length}"))),
    }
}

/// Sends the mesh as `format`. `delivery` is dropped after the last byte was written.
pub(super) async fn mesh(
    app: &App,
    finished: Arc<Finished>,
    format: Format,
    key: &ContentKey,
    mut timing: Timing,
    delivery: Delivery,
) -> Result<Response, Problem> {
    let report = &finished.product.report;
    let mut headers = summary_headers(&serde_json::to_value(report).map_err(Problem::internal)?);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(header::CONTENT_DISPOSITION, disposition(report.id.as_deref(), format));
    headers.insert(header::ETAG, etag(key));
    let (length, body) =
        stream::start(finished, format, app.config.limits.output_bytes, app.pool.settings().budget.clone(), delivery)
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
    let mut headers = summary_headers(&serde_json::to_value(report).map_err(Problem::internal)?);
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

/// Returns the summary headers of a report, from its JSON. A member that is null has no header.
pub(super) fn summary_headers(report: &Value) -> HeaderMap {
    let header = |summary: &SummaryHeader, members: &Value| {
        let value = match &members[summary.member] {
            Value::Null => return None,
            Value::String(text) => text.replace('Å', "A"),
            // Areas and volumes to a thousandth.
            Value::Number(number) if ["area", "volume"].contains(&summary.member) => {
                format!("{:.3}", number.as_f64().unwrap_or_default())
            }
            other => other.to_string(),
        };
        Some((HeaderName::from_static(summary.name), text(&value)))
    };
    let mut headers: HeaderMap = SUMMARY.iter().filter_map(|summary| header(summary, report)).collect();
    if let Some(picture) = report.get("picture") {
        headers.extend(PICTURE.iter().filter_map(|summary| header(summary, picture)));
    }
    headers
}
