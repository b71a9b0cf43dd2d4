//! `POST /v1/estimate`: size and duration of a mesh, and a resolution that should fit if it is too large. Takes the
//! requests of `POST /v1/meshes`.

use std::sync::Arc;

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::Extensions;
use axum::http::header::{ACCEPT, CACHE_CONTROL, HeaderMap};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;

use super::errors::file_too_large;
use super::guard::Caller;
use super::openapi::bodies::{AS_FOR_MESHES, StructureFile};
use super::openapi::parameters::{ContentEncodingHeader, MeshParameters};
use super::openapi::problem_responses;
use super::openapi::problems::ProblemDocument;
use super::parsed_request::{Pairs, ParsedRequest};
use super::problem::Problem;
use super::request_id::RequestId;
use super::source::Loaded;
use super::state::Shared;
use crate::jobs::{Pool, Rank};
use crate::pipeline::params::Request;
use crate::pipeline::{self, Estimate, MeshEstimate};
use crate::surface::Control;

/// Estimated size and cost of a mesh. Counts of atoms, cells, bricks and grid points are exact; the size of the mesh
/// and the times are estimates.
#[derive(Debug, Serialize, ToSchema)]
#[schema(example = json!({
    "accepted": true, "problem": null, "atoms": 454, "atoms_in_file": 514, "resolution": 0.5,
    "resolution_from": "resolution", "surface": "gaussian", "format": "glb", "box_cells": 464_940, "bricks": 391,
    "grid_points": 200_192, "area": 3475.0, "vertices": 20_850, "triangles": 41_700, "mesh_bytes": 1_000_800,
    "structure": "edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087", "seconds": 0.01,
    "wait_seconds": 0.0, "backend": "cpu",
}))]
pub(super) struct EstimateDocument {
    /// True if `POST /v1/meshes` would accept the request.
    accepted: bool,
    /// Error that `POST /v1/meshes` would return; null if it would accept the request.
    #[schema(required, value_type = Option<ProblemDocument>)]
    problem: Option<Value>,
    /// Atoms to mesh, including all copies in an assembly.
    atoms: u64,
    /// Atoms in all models of the file.
    atoms_in_file: u64,
    /// Grid spacing in Å; an estimate if it follows from `max_triangles`.
    resolution: f64,
    /// Parameter that sets the spacing: `resolution`, `detail` or `max_triangles`.
    resolution_from: &'static str,
    /// Type of the surface.
    surface: &'static str,
    /// Mesh format, as a file name extension.
    format: &'static str,
    /// Cells of a dense grid over the bounding box.
    box_cells: u64,
    /// Grid bricks (8 × 8 × 8 points) within reach of an atom; null if the request would be rejected before they are
    /// known.
    #[schema(required)]
    bricks: Option<u64>,
    /// Grid points to evaluate; null like `bricks`.
    #[schema(required)]
    grid_points: Option<u64>,
    /// Surface area in Å²; null like `bricks`.
    #[schema(required)]
    area: Option<f64>,
    /// Vertices; null like `bricks`.
    #[schema(required)]
    vertices: Option<u64>,
    /// Triangles; null like `bricks`.
    #[schema(required)]
    triangles: Option<u64>,
    /// Size of the mesh file in bytes, 0 for pictures; null like `bricks`.
    #[schema(required)]
    mesh_bytes: Option<u64>,
    /// SHA-256 digest of the structure, in hexadecimal.
    structure: String,
    /// Computing time in s.
    seconds: f64,
    /// Time in the queue in s.
    wait_seconds: f64,
    /// Backend that would compute the mesh: `cpu` or `gpu`.
    backend: &'static str,
}

problem_responses!(EstimateProblems: [BODY STRUCTURE ENTRY PARAMETERS READING WAITING]
    EmptySelection TooManyCopies TooManyParts TooManyCandidates PictureTooLarge Internal Deadline
);

/// Estimate a mesh
///
/// Accepts the same requests as `POST /v1/meshes`. Returns the expected size and time of the mesh without computing it.
#[utoipa::path(post, path = "/v1/estimate", tag = "meshes", operation_id = "estimateMesh",
    params(MeshParameters, ContentEncodingHeader),
    request_body(content = StructureFile, description = AS_FOR_MESHES, content_type = "application/octet-stream"),
    responses((status = 200, description = "The estimate.", body = EstimateDocument), EstimateProblems))]
pub(super) async fn create(
    State(app): State<Shared>,
    query: Pairs,
    mut headers: HeaderMap,
    extensions: Extensions,
    body: Body,
) -> Result<Response, Problem> {
    let caller = Caller::of(&extensions);
    let instance = extensions.get::<RequestId>().cloned().unwrap_or_default();
    app.admit_work(&caller)?;
    // The response is no mesh, so `Accept` does not choose a format.
    headers.remove(ACCEPT);
    let parsed = ParsedRequest::from_body(&app, &caller, query, &headers, body).await?;
    let ParsedRequest { source, request: Request { options, format, .. }, declared, .. } = parsed;
    // An estimate is about half the work of a mesh, so it takes a delivery slot as well.
    let delivery = app.delivery(caller.client)?;
    let digest = source.digest(&app, &caller).await?;
    let Loaded { input, digest, reservation } = source.find(&app, &caller, &digest, None).await?;
    drop(source);
    let (expected, lane) = (app.pool.expected(&input, &options), Pool::lane(&Rank::default(), &input, &options));
    let backend = app.pool.choice(&input, &options).backend.name();
    let reading = app.read(&caller, (reservation, delivery), {
        let (app, options, namespace) = (Arc::clone(&app), options.clone(), caller.namespace);
        move |control| {
            let choice = app.pool.choice(&input, &options);
            let limits = app.config.limits.job();
            let read = |control: &Control<'_>| app.structures().get((namespace, digest), &input, &limits.read, control);
            pipeline::estimate(read, &options, &limits, &choice, control)
        }
    });
    let estimate = reading.await?.map_err(|error| declared.explain(error.into()))?;
    // The estimate from the file size does not include the copies in an assembly.
    let guess = expected.as_secs_f64() * estimate.atoms as f64 / estimate.distinct_atoms as f64;
    let seconds = estimate.work(&options).map_or(guess, |units| app.pool.seconds(units));
    let wait = app.pool.estimated_wait(lane).as_secs_f64();
    let mesh = estimate.mesh.as_ref().ok();
    let file_bytes = |m: &MeshEstimate| match options.compress.compressed_vertex_bytes() {
        0 => format.estimated_bytes(m.bytes, m.vertices, m.triangles),
        bytes => bytes.saturating_mul(m.vertices),
    };
    let bytes = mesh.map(file_bytes);
    let problem = refusal(&estimate, bytes, app.config.limits.output_bytes);
    let document = EstimateDocument {
        accepted: problem.is_none(),
        problem: problem.map(|problem| problem.record(instance.as_str())),
        atoms: estimate.atoms,
        atoms_in_file: estimate.atoms_in_file,
        resolution: estimate.resolution,
        resolution_from: options.spacing.parameter(),
        surface: options.params.surface.name(),
        format: format.name(),
        box_cells: estimate.box_cells,
        bricks: mesh.map(|m| m.bricks),
        grid_points: mesh.map(|m| m.grid_points),
        area: mesh.map(|m| m.area),
        vertices: mesh.map(|m| m.vertices),
        triangles: mesh.map(|m| m.triangles),
        mesh_bytes: bytes,
        structure: digest.to_string(),
        seconds,
        wait_seconds: wait,
        backend,
    };
    Ok(([(CACHE_CONTROL, "no-store")], Json(document)).into_response())
}

/// Returns the problem for which the mesh would be rejected; `None` if there is none. `bytes` and `limit` are the size
/// and the maximum size of its file.
fn refusal(estimate: &Estimate, bytes: Option<u64>, limit: u64) -> Option<Problem> {
    let too_large = bytes.filter(|bytes| *bytes > limit);
    let problem = too_large.map(|bytes| file_too_large(bytes, limit, estimate.resolution));
    problem.or_else(|| estimate.mesh.as_ref().err().map(|error| Problem::from(error.clone())))
}
