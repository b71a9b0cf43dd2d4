//! `/v1/structures`: structures that are uploaded once and meshed many times, named by the SHA-256 of the uploaded
//! bytes.

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::header::{self, HeaderMap};
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::delivery;
use super::kinds::Kind;
use super::mesh_request::MeshRequest;
use super::openapi::bodies::{StructureFile, StructureForm};
use super::openapi::meshes::{Addressed, NotModified};
use super::openapi::parameters::{Coding, Parts, StructurePath, SurfaceParameters, Unchanged, Wishes};
use super::openapi::problems::{ASKING, BODY, MESHING, PARAMETERS, READING};
use super::openapi::refusals;
use super::problem::Problem;
use super::source::{Input, StructureSource};
use super::state::Shared;
use super::upload::{self, Upload};
use crate::jobs::Failure;
use crate::store::{Digest, Name};
use crate::structure::contents::Counts;
use crate::structure::{self, Contents, Structure};

/// Maximum number of listed chains.
const MAX_CHAINS: usize = 1000;

/// Contents of a structure.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct StructureDocument {
    /// SHA-256 of the uploaded bytes.
    digest: String,
    /// Size of the upload, bytes.
    bytes: usize,
    /// `pdb`, `mmcif` or `bcif`.
    format: &'static str,
    /// PDB id or data block name.
    #[schema(required)]
    id: Option<String>,
    /// Title.
    #[schema(required)]
    title: Option<String>,
    /// Number of atoms in all models.
    atoms: u64,
    /// Numbers of the models.
    models: Vec<i32>,
    /// Model that the counts refer to.
    model: i32,
    atoms_in_model: KindCounts,
    /// Number of atoms with alternative locations.
    alternatives: u64,
    /// Number of atoms of unknown elements.
    unknown_elements: u64,
    /// Unreadable values that do not affect the mesh, at most 12.
    warnings: Vec<String>,
    /// Number of chains.
    chain_count: usize,
    /// First 1000 chains.
    chains: Vec<ChainDocument>,
    /// Address of a mesh.
    surface: String,
}

/// Chain of a structure.
#[derive(Debug, Serialize, ToSchema)]
struct ChainDocument {
    /// Name by the author.
    name: String,
    /// Number of atoms.
    atoms: u64,
    of: KindCounts,
}

/// Numbers of atoms by kind.
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

/// Stores a structure.
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
    if upload::is_json(&headers) {
        let detail =
            "a structure is uploaded as a file, not as JSON; `POST /v1/meshes` takes JSON that names a structure";
        return Err(Problem::new(Kind::UnsupportedMediaType, detail).with("declared", "application/json"));
    }
    let Upload { bytes, lease, fields, declared } = upload::receive(&app, &headers, body).await?;
    if let Some((name, _)) = fields.first() {
        return Err(Problem::new(
            Kind::BadParameter,
            format!("a structure has no parameter `{name}`; parameters belong to meshes"),
        )
        .with("parameter", name.as_str()));
    }
    let _permit = app.delivery()?;
    let input = Input::uploaded(bytes, lease).await?;
    let digest = input.digest;
    // Parse before storing, so that only readable structures are stored.
    let summary = summarise(&app, input.clone()).await.map_err(|failure| declared.explain(failure))?;
    declared.check_format(summary.format)?;
    let created = app.store.put_new(&Name::input(&digest), input.bytes).await?;
    let status = if created { StatusCode::CREATED } else { StatusCode::OK };
    let location = delivery::text(&format!("/v1/structures/{digest}"));
    Ok((status, [(header::LOCATION, location)], Json(summary)).into_response())
}

/// Describes a stored structure.
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
    source: StructureSource,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let write = async |input| Ok(Json(summarise(&app, input).await?).into_response());
    source.document(&app, &headers, write).await
}

/// Meshes a stored structure.
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
    headers: HeaderMap,
    request: MeshRequest,
) -> Result<Response, Problem> {
    request.answer(&app, &method, &headers).await
}

/// Parses a structure and describes its contents, on a blocking thread.
async fn summarise(app: &Shared, input: Input) -> Result<StructureDocument, Failure> {
    let limits = app.config.limits.job().read;
    let parsing = tokio::task::spawn_blocking(move || {
        let structure = structure::read(&input.bytes, &limits)?;
        Ok(summary(&input.digest, input.bytes.len(), &structure))
    });
    let parsed = parsing.await.map_err(|error| Failure::Panicked { message: error.to_string() })?;
    parsed.map_err(|error: structure::StructureError| Failure::Job { error: error.into(), diagnostics: Vec::new() })
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
