//! `GET /v1/pdb/{id}/surface.{ext}`: the mesh of an archive entry at a cacheable address.

use axum::extract::State;
use axum::http::Method;
use axum::http::header::HeaderMap;
use axum::response::Response;

use super::kinds::Kind;
use super::mesh_request::MeshRequest;
use super::openapi::meshes::Addressed;
use super::openapi::parameters::{EntryPath, Parts, SurfaceParameters, Unchanged, Wishes};
use super::openapi::problems::{ASKING, MESHING, PARAMETERS, READING};
use super::openapi::refusals;
use super::problem::Problem;
use super::state::Shared;

refusals!(SurfaceRefusals: [PARAMETERS, READING, MESHING, ASKING, [
    Kind::NotFound, Kind::NotInArchive, Kind::EntryTooLarge, Kind::RangeNotSatisfiable, Kind::ArchiveUnavailable,
]]);

/// Meshes an entry of the archive.
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/{file}",
    tag = "meshes",
    operation_id = "meshEntry",
    params(EntryPath, SurfaceParameters, Wishes, Unchanged, Parts),
    responses(Addressed, SurfaceRefusals)
)]
pub(super) async fn surface(
    State(app): State<Shared>,
    method: Method,
    headers: HeaderMap,
    request: MeshRequest,
) -> Result<Response, Problem> {
    request.answer(&app, &method, &headers).await
}
