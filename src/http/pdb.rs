//! `GET /v1/pdb/{id}/surface.{ext}` and `report.json`: the mesh of an archive entry at a cacheable address, and its
//! report.

use axum::response::Response;

use super::mesh_request::MeshRequest;
use super::openapi::meshes::{CacheableMeshOrJob, ReportResponse};
use super::openapi::parameters::{
    ConditionHeaders, EntryPath, MeshParameters, PreferenceHeaders, RangeHeaders, SurfaceParameters,
};
use super::openapi::problem_responses;
use super::openapi::problems::{MESHING, PARAMETERS, READING, SUBMITTING};
use super::problem::Problem;
use super::problem_types::ProblemType;

problem_responses!(SurfaceProblems: [PARAMETERS, READING, MESHING, SUBMITTING, [
    ProblemType::NotFound, ProblemType::NotInArchive, ProblemType::EntryTooLarge, ProblemType::PreconditionFailed, ProblemType::RangeNotSatisfiable,
    ProblemType::ArchiveUnavailable,
]]);

/// Mesh an archive entry
///
/// The path names the format, so that the response can be cached and linked to.
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/{file}",
    tag = "meshes",
    operation_id = "meshEntry",
    params(EntryPath, SurfaceParameters, PreferenceHeaders, ConditionHeaders, RangeHeaders),
    responses(CacheableMeshOrJob, SurfaceProblems)
)]
pub(super) async fn surface(request: MeshRequest) -> Result<Response, Problem> {
    request.answer().await
}

problem_responses!(ReportProblems: [PARAMETERS, READING, MESHING, [
    ProblemType::NotInArchive, ProblemType::EntryTooLarge, ProblemType::ArchiveUnavailable, ProblemType::QueueFull, ProblemType::TooManyDeliveries,
    ProblemType::ShareExceeded,
]]);

/// Mesh an archive entry and return the report
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/report.json",
    tag = "meshes",
    operation_id = "reportEntry",
    params(EntryPath, MeshParameters),
    responses(ReportResponse, ReportProblems)
)]
pub(super) async fn report(request: MeshRequest) -> Result<Response, Problem> {
    request.answer().await
}
