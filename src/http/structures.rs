//! `/v1/structures`: upload once, mesh many times. A structure's name is the SHA-256 of its bytes as they came.

use axum::Json;
use axum::body::Body;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{Extensions, HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::Serialize;
use utoipa::ToSchema;

use super::ask::{self, Input};
use super::kinds::Kind;
use super::meshes::Pairs;
use super::openapi::bodies::StructureFile;
use super::openapi::meshes::{Addressed, NotModified, Reported};
use super::openapi::parameters::{Coding, MeshParameters, Parts, StructurePath, SurfaceParameters, Unchanged, Wishes};
use super::openapi::problems::{ASKING, BODY, MESHING, PARAMETERS, READING};
use super::openapi::refusals;
use super::problem::Problem;
use super::state::Shared;
use super::timing::Timing;
use super::upload::{self, Upload};
use super::wish::Wish;
use super::{conditional, delivery, pdb};
use crate::jobs::Failure;
use crate::store::{Digest, Name};
use crate::structure::contents::Counts;
use crate::structure::{self, Contents, Structure};

/// The name says what the bytes are, and the mesh follows from them and the parameters.
const CACHE: HeaderValue = HeaderValue::from_static("public, max-age=86400, stale-while-revalidate=604800");
/// Chains that a summary lists at most.
const MAX_CHAINS: usize = 1000;

/// The digest that a client names.
pub(super) fn digest_of(text: &str) -> Result<Digest, Problem> {
    text.parse().map_err(|_bad| none(text))
}

fn none(digest: &str) -> Problem {
    let shown: String = digest.chars().take(80).collect();
    Problem::new(
        Kind::NoSuchStructure,
        format!(
            "there is no structure `{shown}`: structures are kept for some time after their last use; upload it again"
        ),
    )
}

/// Contents of a structure.
#[derive(Debug, Serialize, ToSchema)]
#[schema(example = json!({
    "digest": "edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087", "bytes": 71_928, "format": "pdb",
    "id": "4PTI", "title": "THE GEOMETRY OF THE REACTIVE SITE", "atoms": 514, "models": [1], "model": 1,
    "atoms_in_model": { "polymer": 454, "ligand": 0, "water": 60, "hydrogens": 0, "virtual_sites": 0 },
    "alternatives": 0, "unknown_elements": 0, "warnings": [], "chain_count": 1,
    "chains": [{
        "name": "A", "atoms": 514,
        "of": { "polymer": 454, "ligand": 0, "water": 60, "hydrogens": 0, "virtual_sites": 0 },
    }],
    "surface": "/v1/structures/edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087/surface.glb",
}))]
pub(super) struct StructureDocument {
    /// SHA-256 digest of the bytes as uploaded, in hexadecimal. Identifies the structure.
    digest: String,
    /// Size of the file as uploaded, in bytes.
    bytes: usize,
    /// File format: `pdb`, `mmcif` or `bcif`.
    format: &'static str,
    /// PDB id or data block name; null if the file has none.
    #[schema(required)]
    id: Option<String>,
    /// Title; null if the file has none.
    #[schema(required)]
    title: Option<String>,
    /// Atoms in all models.
    atoms: u64,
    /// Model numbers.
    models: Vec<i32>,
    /// Number of the model that the counts below refer to.
    model: i32,
    /// Atoms of the model by kind.
    atoms_in_model: KindCounts,
    /// Atoms with alternative locations.
    alternatives: u64,
    /// Atoms of unknown elements.
    unknown_elements: u64,
    /// Unreadable values that do not affect a mesh, at most 12.
    warnings: Vec<String>,
    /// Number of chains.
    chain_count: usize,
    /// The first 1,000 chains.
    chains: Vec<ChainDocument>,
    /// Path of the mesh with default parameters.
    surface: String,
}

/// Chain of a structure.
#[derive(Debug, Serialize, ToSchema)]
struct ChainDocument {
    /// Name given by the author.
    name: String,
    /// Number of atoms.
    atoms: u64,
    /// Atoms by kind.
    of: KindCounts,
}

/// Numbers of atoms by kind. Hydrogens are counted apart from the heavy atoms of their residues.
#[derive(Debug, Serialize, ToSchema)]
struct KindCounts {
    /// Heavy atoms of polymers.
    polymer: u64,
    /// Heavy atoms of ligands.
    ligand: u64,
    /// Heavy atoms of water.
    water: u64,
    /// Hydrogen atoms.
    hydrogens: u64,
    /// Sites that are not atoms: charge sites of water models, lone pairs, Drude particles.
    virtual_sites: u64,
}

impl From<&Counts> for KindCounts {
    fn from(counts: &Counts) -> Self {
        let Counts { polymer, ligand, water, hydrogens, virtual_sites } = *counts;
        Self { polymer, ligand, water, hydrogens, virtual_sites }
    }
}

refusals!(CreateRefusals: [
    BODY, READING, [Kind::BadParameter, Kind::TooManyDeliveries, Kind::StoreFull, Kind::StoreFailed],
]);
refusals!(ShowRefusals: [
    READING,
    [Kind::BadRequest, Kind::NoSuchStructure, Kind::MemoryFull, Kind::TooManyDeliveries, Kind::StoreFailed],
]);
refusals!(SurfaceRefusals: [
    PARAMETERS, READING, MESHING, ASKING, [Kind::NotFound, Kind::NoSuchStructure, Kind::RangeNotSatisfiable],
]);

/// Upload a structure
///
/// Stores a structure, so that it can be meshed several times without another upload. Uploading the same bytes again
/// returns 200 and the same digest.
#[utoipa::path(post, path = "/v1/structures", tag = "structures", operation_id = "createStructure", params(Coding),
    request_body(
        content = StructureFile,
        description = "A structure file, or `multipart/form-data` with the file in the field `file`.",
        content_type = "application/octet-stream",
    ),
    responses(
        (status = 201, description = "The structure was stored.", body = StructureDocument,
            headers(("Location" = String, description = "Path of the structure.")),
            links(("mesh" = (operation_id = "meshStructure", parameters(("digest" = "$response.body#/digest")))))),
        (status = 200, description = "The structure was already stored.", body = StructureDocument,
            headers(("Location" = String, description = "Path of the structure."))),
        CreateRefusals,
    ))]
pub(super) async fn create(State(app): State<Shared>, headers: HeaderMap, body: Body) -> Result<Response, Problem> {
    let Upload { bytes, lease, fields, declared } = upload::receive(&app, &headers, body).await?;
    if let Some((name, _)) = fields.first() {
        return Err(Problem::new(Kind::BadParameter, format!("a structure has no parameter `{name}`; meshes have"))
            .with("parameter", name.as_str()));
    }
    let _place = app.delivery()?;
    let digest = ask::digest(&bytes).await?;
    // Read before it is kept: what cannot be read is nobody's structure.
    let summary = summarise(&app, digest, bytes.clone()).await.map_err(|failure| declared.explain(failure))?;
    declared.check_format(summary.format)?;
    let created = app.store.put_new(&Name::input(&digest), bytes).await?;
    drop(lease);
    let status = if created { StatusCode::CREATED } else { StatusCode::OK };
    let location = delivery::text(&format!("/v1/structures/{digest}"));
    Ok((status, [(header::LOCATION, location)], Json(summary)).into_response())
}

/// Get the contents of a structure
#[utoipa::path(get, path = "/v1/structures/{digest}", tag = "structures", operation_id = "showStructure",
    params(StructurePath, Unchanged),
    responses(
        (status = 200, description = "Contents of the structure.", body = StructureDocument, headers(
            ("ETag" = String, description = "Strong validator of the document."),
            ("Cache-Control" = String, description = "Caching rules."),
        )),
        NotModified, ShowRefusals,
    ))]
pub(super) async fn show(
    State(app): State<Shared>,
    path: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(text) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let digest = digest_of(&text)?;
    let etag = HeaderValue::from_str(&format!("\"{digest}\"")).map_err(Problem::internal)?;
    let caching = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, CACHE)];
    // Whoever has the summary is answered without reading the structure.
    if conditional::is_unchanged(&headers, &etag) && app.store.head(&Name::input(&digest)).await?.is_some() {
        return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    let _place = app.delivery()?;
    let Input { bytes, lease: _lease, .. } = input(&app, &digest).await?;
    let summary = summarise(&app, digest, bytes).await?;
    Ok((caching, Json(summary)).into_response())
}

/// Mesh an uploaded structure
///
/// The path names the format, so that the response can be cached and linked to.
#[utoipa::path(
    get,
    path = "/v1/structures/{digest}/{file}",
    tag = "meshes",
    operation_id = "meshStructure",
    params(StructurePath, SurfaceParameters, Wishes, Unchanged, Parts),
    responses(Addressed, SurfaceRefusals)
)]
pub(super) async fn surface(
    State(app): State<Shared>,
    method: Method,
    path: Result<Path<(String, String)>, PathRejection>,
    query: Pairs,
    headers: HeaderMap,
    extensions: Extensions,
) -> Result<Response, Problem> {
    let Path((text, file)) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let named = pdb::named(&app, Some(&file), query)?;
    answer(&app, &method, &text, named, &headers, &extensions).await
}

refusals!(ReportRefusals: [
    PARAMETERS, READING, MESHING,
    [Kind::NoSuchStructure, Kind::QueueFull, Kind::TooManyDeliveries, Kind::StoreFailed],
]);

/// Mesh an uploaded structure and return the report
#[utoipa::path(
    get,
    path = "/v1/structures/{digest}/report.json",
    tag = "meshes",
    operation_id = "reportStructure",
    params(StructurePath, MeshParameters),
    responses(Reported, ReportRefusals)
)]
pub(super) async fn report(
    State(app): State<Shared>,
    method: Method,
    path: Result<Path<String>, PathRejection>,
    query: Pairs,
    headers: HeaderMap,
    extensions: Extensions,
) -> Result<Response, Problem> {
    let Path(text) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let named = pdb::named(&app, None, query)?;
    answer(&app, &method, &text, named, &headers, &extensions).await
}

/// Answers a request for the mesh or the report of a structure.
async fn answer(
    app: &Shared,
    method: &Method,
    text: &str,
    named: pdb::Named,
    headers: &HeaderMap,
    extensions: &Extensions,
) -> Result<Response, Problem> {
    let mut timing = Timing::start();
    let digest = digest_of(text)?;
    let wish = Wish::of(headers, extensions)?;
    timing.lap("receive");
    let mut ask = named.ask(digest, wish, timing);
    if app.store.head(&Name::input(&digest)).await?.is_none() {
        return Err(none(text));
    }
    if let Some(response) = ask.answer_without_work(app, method, headers).await? {
        return Ok(response);
    }
    ask.timing.lap("lookup");
    let input = input(app, &digest).await?;
    ask.timing.lap("load");
    ask.make(app, input).await
}

/// The bytes of a structure.
pub(super) async fn input(app: &Shared, digest: &Digest) -> Result<Input, Problem> {
    let bytes = app.store.get(&Name::input(digest)).await?.ok_or_else(|| none(&digest.to_string()))?.bytes;
    Input::new(app, bytes, *digest)
}

/// Reads a structure and says what it holds, on a thread that may block.
async fn summarise(app: &Shared, digest: Digest, bytes: Bytes) -> Result<StructureDocument, Failure> {
    let limits = app.config.limits.job().read;
    let reading = tokio::task::spawn_blocking(move || {
        let structure = structure::read(&bytes, &limits)?;
        Ok(summary(&digest, bytes.len(), &structure))
    });
    let read = reading.await.map_err(|error| Failure::Panicked { message: error.to_string() })?;
    read.map_err(|error: structure::StructureError| Failure::Job { error: error.into(), diagnostics: Vec::new() })
}

fn summary(digest: &Digest, bytes: usize, structure: &Structure) -> StructureDocument {
    let contents = Contents::of(structure, None);
    let chains = contents.chains.iter().take(MAX_CHAINS).map(|chain| ChainDocument {
        name: chain.name.clone(),
        atoms: chain.counts.total(),
        of: (&chain.counts).into(),
    });
    StructureDocument {
        digest: digest.to_string(),
        bytes,
        format: structure.format.name(),
        id: structure.id.clone(),
        title: structure.title.clone(),
        atoms: contents.atoms,
        models: contents.models,
        model: contents.model,
        atoms_in_model: (&contents.counts).into(),
        alternatives: contents.alternatives,
        unknown_elements: contents.unknown_elements,
        warnings: structure.warnings.clone(),
        chain_count: contents.chains.len(),
        chains: chains.collect(),
        surface: format!("/v1/structures/{digest}/surface.glb"),
    }
}
