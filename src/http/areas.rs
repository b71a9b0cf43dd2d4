//! Exact areas of the atoms, residues or chains of a structure as CSV, without a mesh: `…/areas` for a structure that
//! the path names, `POST /v1/areas` for an upload.

use axum::body::Body;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::content_type::DeclaredType;
use super::document;
use super::guard::Caller;
use super::openapi::bodies::{AS_FOR_MESHES, StructureFile};
use super::openapi::meshes::NotModified;
use super::openapi::parameters::{AreaParameters, ConditionHeaders, ContentEncodingHeader, StructurePath};
use super::openapi::problem_responses;
use super::parsed_request::{BodyParameters, Pairs, ParsedRequest};
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::{DocumentRequest, Loaded};
use super::state::{App, Delivery, Shared};
use crate::jobs::{Failure, UploadedMap};
use crate::pipeline::areas;
use crate::pipeline::params;
use crate::pipeline::params::areas::AreasRequest;
use crate::surface::SurfaceKind;

problem_responses!(ListProblems: [READING LISTING] TooManyCopies);

/// List the exact areas of a structure
///
/// A CSV table with the exact area of the van der Waals, solvent-accessible or solvent-excluded surface of each
/// residue, atom or chain. No mesh is made. With `interface`, the table has the chains of both sides, with the surface
/// area buried between them.
#[utoipa::path(get, path = "/v1/structures/{digest}/areas", tag = "structures", operation_id = "listAreas",
    params(StructurePath, AreaParameters, ConditionHeaders),
    responses(
        (status = 200, description = "The areas.", body = String, content_type = "text/csv", headers(("ETag"), ("Cache-Control"))),
        NotModified, ListProblems,
    ))]
pub(super) async fn list(request: DocumentRequest, query: Pairs) -> Result<Response, Problem> {
    let parameters = params::areas::parse(&query.0)?;
    respond(&request, parameters, DeclaredType::Neutral).await
}

problem_responses!(CreateProblems: [BODY STRUCTURE ENTRY PARAMETERS READING WAITING]
    EmptySelection TooManyCopies TooManyCandidates
);

/// List the exact areas of an upload
///
/// Returns the table of `GET /v1/structures/{digest}/areas` for the file in the body, which is not stored.
#[utoipa::path(post, path = "/v1/areas", tag = "structures", operation_id = "measureAreas",
    params(AreaParameters, ContentEncodingHeader),
    request_body(content = StructureFile, description = AS_FOR_MESHES, content_type = "application/octet-stream"),
    responses(
        (status = 200, description = "The areas.", body = String, content_type = "text/csv", headers(("ETag"))),
        CreateProblems,
    ))]
pub(super) async fn create(
    State(app): State<Shared>,
    caller: Caller,
    query: Pairs,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    let ParsedRequest { source, request: parameters, declared, .. } =
        ParsedRequest::<AreasRequest>::from_body(&app, &caller, query, &headers, body).await?;
    let request = DocumentRequest::from_body(app, caller, source);
    let mut response = respond(&request, parameters, declared).await?;
    // It belongs to this request alone.
    response.headers_mut().remove(header::CACHE_CONTROL);
    Ok(response)
}

impl BodyParameters for AreasRequest {
    fn check(pairs: &[(String, String)]) -> Result<(), Problem> {
        let mut pairs = pairs.to_vec();
        // The body may name it.
        if pairs.iter().all(|(name, _)| name != "surface") {
            pairs.push(("surface".to_owned(), SurfaceKind::Ses.name().to_owned()));
        }
        params::areas::parse(&pairs)?;
        Ok(())
    }

    fn parse(_: &App, pairs: &[(String, String)], _: &HeaderMap, map: Option<&UploadedMap>) -> Result<Self, Problem> {
        if map.is_some() {
            let detail = "areas have no parameter `map`, which colours a mesh";
            return Err(Problem::new(ProblemType::BadParameter, detail).with("parameter", "map"));
        }
        Ok(params::areas::parse(pairs)?)
    }
}

/// Responds with the table for the structure of a request, whose file has the type `declared`.
async fn respond(
    request: &DocumentRequest,
    parameters: AreasRequest,
    declared: DeclaredType,
) -> Result<Response, Problem> {
    let DocumentRequest { app, caller, .. } = request;
    let write = async |loaded: Loaded, delivery| {
        let table = table(app, caller, loaded, delivery, &parameters, declared).await?;
        Ok(([(header::CONTENT_TYPE, "text/csv")], Body::from(table)).into_response())
    };
    request.document(&parameters.canonical, None, write).await
}

/// Returns the table of the areas of a structure, whose file has the type `declared`.
pub(super) async fn table(
    app: &Shared,
    caller: &Caller,
    loaded: Loaded,
    delivery: Delivery,
    request: &AreasRequest,
    declared: DeclaredType,
) -> Result<Bytes, Problem> {
    let AreasRequest { options, level, .. } = request.clone();
    let surface = app.config.limits.job().surface;
    let listing = loaded.list_atoms(app, caller, delivery, move |structure, limits, control, memory| {
        declared.check_format(structure.format.name())?;
        let measured = areas::measure_selection(structure, &options, limits, &surface, control);
        let areas = measured.map_err(Failure::from)?.areas;
        document::collect(memory, control, |out| areas.write_csv(structure, level, control, out))
    });
    listing.await
}
