//! `POST /v1/meshes`: the mesh of an upload, or of the structure that a JSON document names.

use axum::body::Body;
use axum::extract::State;
use axum::http::header::HeaderMap;
use axum::http::{Extensions, HeaderValue, Method, header};
use axum::response::Response;

use super::kinds::Kind;
use super::mesh_request::MeshRequest;
use super::openapi::bodies::{MeshForm, MeshOrder, StructureFile};
use super::openapi::meshes::Uploaded;
use super::openapi::parameters::{Coding, MeshParameters, Wishes};
use super::openapi::problems::{ASKING, BODY, MESHING, NAMED, PARAMETERS, READING};
use super::openapi::refusals;
use super::parsed_request::{Pairs, ParsedRequest};
use super::preferences::RequestPreferences;
use super::problem::Problem;
use super::state::Shared;
use super::timing::Timing;

refusals!(MeshRefusals: [BODY, NAMED, PARAMETERS, READING, MESHING, ASKING, [Kind::NotAcceptable]]);

/// Meshes a structure.
///
/// The body is a file, a form with a file, or a JSON document that names a structure. The format is that of `format`,
/// else what `Accept` prefers, else GLB.
#[utoipa::path(post, path = "/v1/meshes", tag = "meshes", operation_id = "createMesh",
    params(MeshParameters, Wishes, Coding),
    request_body(description = "A structure, or a document that names one.", content(
        (StructureFile = "application/octet-stream"), (StructureFile = "chemical/x-pdb"),
        (StructureFile = "chemical/x-mmcif"), (MeshForm = "multipart/form-data"), (MeshOrder = "application/json"),
    )),
    responses(Uploaded, MeshRefusals))]
pub(super) async fn create(
    State(app): State<Shared>,
    query: Pairs,
    headers: HeaderMap,
    extensions: Extensions,
    body: Body,
) -> Result<Response, Problem> {
    let timing = Timing::start();
    let preferences = RequestPreferences::of(&headers, &extensions)?;
    let parsed = ParsedRequest::from_body(&app, query, &headers, body).await?;
    let request = MeshRequest::of_upload(parsed, preferences, timing);
    // Conditions and ranges apply to GET requests only.
    let mut response = request.answer(&app, &Method::POST, &HeaderMap::new()).await?;
    response.headers_mut().append(header::VARY, HeaderValue::from_static("accept"));
    Ok(response)
}
