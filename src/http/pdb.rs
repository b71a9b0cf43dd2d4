//! `GET /v1/pdb/{id}/surface.{ext}` and `report.json`: the mesh of an archive entry at a cacheable address, and its
//! report.

use axum::response::Response;

use super::kinds::Kind;
use super::mesh_request::MeshRequest;
use super::openapi::meshes::{Addressed, Reported};
use super::openapi::parameters::{EntryPath, MeshParameters, Parts, SurfaceParameters, Unchanged, Wishes};
use super::openapi::problems::{ASKING, MESHING, PARAMETERS, READING};
use super::openapi::refusals;
use super::problem::Problem;

refusals!(SurfaceRefusals: [PARAMETERS, READING, MESHING, ASKING, [
    Kind::NotFound, Kind::NotInArchive, Kind::EntryTooLarge, Kind::RangeNotSatisfiable, Kind::ArchiveUnavailable,
]]);

/// Mesh an archive entry
///
/// The path names the format, so that the response can be cached and linked to.
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/{file}",
    tag = "meshes",
    operation_id = "meshEntry",
    params(EntryPath, SurfaceParameters, Wishes, Unchanged, Parts),
    responses(Addressed, SurfaceRefusals)
)]
pub(super) async fn surface(request: MeshRequest) -> Result<Response, Problem> {
    request.answer().await
}

refusals!(ReportRefusals: [PARAMETERS, READING, MESHING, [
    Kind::NotInArchive, Kind::EntryTooLarge, Kind::ArchiveUnavailable, Kind::QueueFull, Kind::TooManyDeliveries,
]]);

/// Mesh an archive entry and return the report
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/report.json",
    tag = "meshes",
    operation_id = "reportEntry",
    params(EntryPath, MeshParameters),
    responses(Reported, ReportRefusals)
)]
pub(super) async fn report(request: MeshRequest) -> Result<Response, Problem> {
    request.answer().await
}
