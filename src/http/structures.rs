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
use super::openapi::bodies::{StructureFile, StructureForm};
use super::openapi::meshes::{Addressed, NotModified};
use super::openapi::parameters::{Coding, Parts, StructurePath, SurfaceParameters, Unchanged, Wishes};
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

/// What a structure holds.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct StructureDocument {
    /// SHA-256 of its bytes as they came.
    digest: String,
    /// How many these are.
    bytes: usize,
    /// `pdb`, `mmcif` or `bcif`.
    format: &'static str,
    /// PDB id or data block name.
    #[schema(required)]
    id: Option<String>,
    /// Its title.
    #[schema(required)]
    title: Option<String>,
    /// Atoms, all models.
    atoms: u64,
    /// The numbers of its models.
    models: Vec<i32>,
    /// The model that the counts are of.
    model: i32,
    atoms_in_model: KindCounts,
    /// Atoms with alternative locations.
    alternatives: u64,
    /// Atoms of unknown elements.
    unknown_elements: u64,
    /// Values that could not be read and do not matter for a mesh, at most 12.
    warnings: Vec<String>,
    /// Chains.
    chain_count: usize,
    /// The first thousand of them.
    chains: Vec<ChainDocument>,
    /// A mesh of it.
    surface: String,
}

/// A chain.
#[derive(Debug, Serialize, ToSchema)]
struct ChainDocument {
    /// The author's name for it.
    name: String,
    /// Its atoms.
    atoms: u64,
    of: KindCounts,
}

/// Atoms by what they belong to.
#[derive(Debug, Serialize, ToSchema)]
struct KindCounts {
    polymer: u64,
    ligand: u64,
    water: u64,
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

/// Takes a structure in, to be meshed many times.
#[utoipa::path(post, path = "/v1/structures", tag = "structures", operation_id = "createStructure", params(Coding),
    request_body(description = "The structure.", content(
        (StructureFile = "application/octet-stream"), (StructureFile = "chemical/x-pdb"),
        (StructureFile = "chemical/x-mmcif"), (StructureForm = "multipart/form-data"),
    )),
    responses(
        (status = 201, description = "It is kept now.", body = StructureDocument,
            headers(("Location" = String, description = "The structure's address."))),
        (status = 200, description = "It was there already.", body = StructureDocument,
            headers(("Location" = String, description = "The structure's address."))),
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

/// What a structure holds.
#[utoipa::path(get, path = "/v1/structures/{digest}", tag = "structures", operation_id = "showStructure",
    params(StructurePath, Unchanged),
    responses(
        (status = 200, description = "What the structure holds.", body = StructureDocument, headers(
            ("ETag" = String, description = "The digest."),
            ("Cache-Control" = String, description = "How long the answer stays good."),
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

/// Meshes a structure that was uploaded.
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
    let mut timing = Timing::start();
    let Path((text, file)) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let named = pdb::named(&app, &file, query)?;
    let digest = digest_of(&text)?;
    let wish = Wish::of(&headers, &extensions)?;
    timing.lap("receive");
    let mut ask = named.ask(digest, wish, timing);
    if app.store.head(&Name::input(&digest)).await?.is_none() {
        return Err(none(&text));
    }
    if let Some(response) = ask.answer_without_work(&app, &method, &headers).await? {
        return Ok(response);
    }
    ask.timing.lap("lookup");
    let input = input(&app, &digest).await?;
    ask.timing.lap("load");
    ask.make(&app, input).await
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
