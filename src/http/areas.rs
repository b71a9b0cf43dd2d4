//! `…/areas`: exact areas of the atoms, residues or chains of a structure as CSV, without a mesh.

use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse, Response};

use super::document;
use super::openapi::meshes::NotModified;
use super::openapi::parameters::{AreaParameters, ConditionHeaders, StructurePath};
use super::openapi::problem_responses;
use super::parsed_request::Pairs;
use super::problem::Problem;
use super::source::{DocumentRequest, Loaded};
use crate::jobs::Failure;
use crate::pipeline::areas;
use crate::pipeline::params;
use crate::pipeline::params::areas::AreasRequest;

problem_responses!(Problems: [READING LISTING] TooManyCopies);

/// List the exact areas of a structure
///
/// A CSV table with the exact area of the van der Waals, solvent-accessible or solvent-excluded surface of each
/// residue, atom or chain. No mesh is made. With `interface`, the table has the chains of both sides, with the surface
/// area buried between them.
#[utoipa::path(get, path = "/v1/structures/{digest}/areas", tag = "structures", operation_id = "listAreas",
    params(StructurePath, AreaParameters, ConditionHeaders),
    responses(
        (status = 200, description = "The areas.", body = String, content_type = "text/csv", headers(("ETag"), ("Cache-Control"))),
        NotModified, Problems,
    ))]
pub(super) async fn list(request: DocumentRequest, query: Pairs) -> Result<Response, Problem> {
    let DocumentRequest { app, caller, .. } = &request;
    let AreasRequest { options, level, canonical } = params::areas::parse(&query.0)?;
    let surface = app.config.limits.job().surface;
    let write = async |loaded: Loaded, delivery| {
        let listing = loaded.list_atoms(app, caller, delivery, move |structure, limits, control, memory| {
            let measured = areas::measure_selection(structure, &options, limits, &surface, control);
            let areas = measured.map_err(Failure::from)?.areas;
            document::collect(memory, control, |out| areas.write_csv(structure, level, control, out))
        });
        Ok(([(header::CONTENT_TYPE, "text/csv")], Body::from(listing.await?)).into_response())
    };
    request.document(&canonical, None, write).await
}
