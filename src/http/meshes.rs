//! `POST /v1/meshes`: the mesh of an upload, or of the structure that a JSON document names.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::http::header::HeaderMap;
use axum::http::{HeaderValue, header};
use axum::response::Response;

use super::guard::Caller;
use super::mesh_request::MeshRequest;
use super::openapi::bodies::{AS_FOR_MESHES, STRUCTURE_TO_MESH, StructureFile};
use super::openapi::meshes::{MeshOrJob, ReportResponse};
use super::openapi::parameters::{ContentEncodingHeader, MeshParameters, PreferenceHeaders};
use super::openapi::problem_responses;
use super::parsed_request::{Pairs, ParsedRequest};
use super::preferences::RequestPreferences;
use super::problem::Problem;
use super::state::Shared;
use super::timing::Timing;

problem_responses!(MeshProblems: [BODY STRUCTURE ENTRY PARAMETERS READING MESHING SUBMITTING] NotAcceptable);

/// Mesh a structure
///
/// The parameter `format` sets the format of the mesh; without it the server uses the format that `Accept` prefers, or
/// GLB. `POST /v1/report` returns the report without the mesh.
#[utoipa::path(post, path = "/v1/meshes", tag = "meshes", operation_id = "createMesh",
    params(MeshParameters, PreferenceHeaders, ContentEncodingHeader),
    request_body(content = StructureFile, description = STRUCTURE_TO_MESH, content_type = "application/octet-stream"),
    responses(MeshOrJob, MeshProblems))]
pub(super) async fn create(
    State(app): State<Shared>,
    query: Pairs,
    headers: HeaderMap,
    caller: Caller,
    body: Body,
) -> Result<Response, Problem> {
    answer(&app, caller, query, &headers, body, false).await
}

problem_responses!(ReportProblems: [BODY STRUCTURE ENTRY PARAMETERS READING MESHING WAITING]);

/// Mesh a structure and return the report
///
/// Accepts the same requests as `POST /v1/meshes`. Computes the mesh and returns its report instead of the file: atoms,
/// grid, area, volume, components, voids, validation and times.
#[utoipa::path(post, path = "/v1/report", tag = "meshes", operation_id = "createReport",
    params(MeshParameters, ContentEncodingHeader),
    request_body(content = StructureFile, description = AS_FOR_MESHES, content_type = "application/octet-stream"),
    responses(ReportResponse, ReportProblems))]
pub(super) async fn report(
    State(app): State<Shared>,
    query: Pairs,
    mut headers: HeaderMap,
    caller: Caller,
    body: Body,
) -> Result<Response, Problem> {
    // `Accept` applies to the report, not to a mesh format.
    headers.remove(header::ACCEPT);
    answer(&app, caller, query, &headers, body, true).await
}

/// Answers an upload with its mesh or its report.
async fn answer(
    app: &Shared,
    caller: Caller,
    query: Pairs,
    headers: &HeaderMap,
    body: Body,
    report: bool,
) -> Result<Response, Problem> {
    let timing = Timing::start();
    let preferences = RequestPreferences::of(headers, caller.client)?;
    let parsed = ParsedRequest::from_body(app, &caller, query, headers, body).await?;
    let request = MeshRequest::from_upload(Arc::clone(app), caller, parsed, report, preferences, timing);
    let mut response = request.answer().await?;
    if !report {
        response.headers_mut().append(header::VARY, HeaderValue::from_static("accept"));
    }
    Ok(response)
}
