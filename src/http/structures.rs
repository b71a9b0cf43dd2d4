//! `/v1/structures`: structures that are uploaded once and meshed many times, named by the SHA-256 of the uploaded
//! bytes. [`surface`] and [`report`] also mesh the archive entries below `/v1/pdb`.

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::StatusCode;
use axum::http::header::{self, HeaderMap};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::form::UploadedFile;
use super::guard::Caller;
use super::mesh_request::MeshRequest;
use super::openapi::bodies::StructureFile;
use super::openapi::meshes::{CacheableMeshOrJob, NotModified, ReportResponse};
use super::openapi::parameters::{
    ConditionHeaders, ContentEncodingHeader, MeshParameters, PreferenceHeaders, RangeHeaders, StructurePath,
    SurfaceParameters,
};
use super::openapi::problem_responses;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::{DocumentRequest, Loaded};
use super::state::{Delivery, Shared};
use super::{delivery, upload};
use crate::jobs::Failure;
use crate::pipeline::JobError;
use crate::store::Digest;
use crate::structure::contents::Counts;
use crate::structure::{Contents, Structure, StructureError};

/// Maximum number of listed models, chains and assemblies each.
const MAX_LISTED: usize = 1000;

/// Contents of a structure.
#[derive(Debug, Serialize, ToSchema)]
#[schema(example = json!({
    "digest": "edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087", "bytes": 71_928, "format": "pdb",
    "id": "4PTI", "title": "THE GEOMETRY OF THE REACTIVE SITE", "atoms": 514, "model_count": 1, "models": [1], "model": 1,
    "atoms_in_model": {
        "polymer": 454, "protein": 454, "nucleic": 0, "ligand": 0, "cofactor": 0, "glycan": 0, "ion": 0, "water": 60,
        "hydrogens": 0, "virtual_sites": 0,
    },
    "alternatives": 0, "unknown_elements": 0, "warnings": [], "chain_count": 1,
    "chains": [{
        "name": "A", "atoms": 514,
        "of": {
        "polymer": 454, "protein": 454, "nucleic": 0, "ligand": 0, "cofactor": 0, "glycan": 0, "ion": 0, "water": 60,
        "hydrogens": 0, "virtual_sites": 0,
    },
    }],
    "assemblies": [{ "id": "1", "copies": 1 }],
    "surface": "/v1/structures/edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087/surface.glb",
}))]
pub(super) struct StructureDocument {
    /// SHA-256 digest of the bytes as uploaded, in hexadecimal. Identifies the structure.
    digest: String,
    /// Size of the file as uploaded, in bytes.
    bytes: usize,
    /// File format: `pdb`, `mmcif`, `bcif`, `pqr` or `xyz`.
    format: &'static str,
    /// PDB id or data block name; null if the file has none.
    #[schema(required)]
    id: Option<String>,
    /// Title; null if the file has none.
    #[schema(required)]
    title: Option<String>,
    /// Atoms in all models.
    atoms: u64,
    /// Number of models.
    model_count: usize,
    /// The first 1,000 model numbers.
    models: Vec<i32>,
    /// Number of the model that the counts below refer to.
    model: i32,
    /// Atoms of the model by kind.
    atoms_in_model: Counts,
    /// Number of atoms with alternative locations.
    alternatives: u64,
    /// Number of atoms of unknown elements.
    unknown_elements: u64,
    /// Unreadable values that do not affect a mesh, at most 12.
    warnings: Vec<String>,
    /// Number of chains.
    chain_count: usize,
    /// The first 1,000 chains.
    chains: Vec<ChainDocument>,
    /// The first 1,000 assemblies, in file order.
    assemblies: Vec<AssemblyDocument>,
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
    of: Counts,
}

/// Assembly of a structure.
#[derive(Debug, Serialize, ToSchema)]
struct AssemblyDocument {
    /// Value of the parameter `assembly`.
    id: String,
    /// Number of copies of chains; null if it exceeds the limit or cannot be read from the file.
    #[schema(required)]
    copies: Option<u64>,
}

problem_responses!(CreateProblems: [BODY READING WAITING] BadParameter StoreFull StoreFailed);
problem_responses!(ShowProblems: [PARAMETERS READING WAITING STRUCTURE] PreconditionFailed TooMuchMemory MemoryFull);
problem_responses!(SurfaceProblems: [PARAMETERS READING MESHING SUBMITTING]
    NotFound PreconditionFailed RangeNotSatisfiable
);

/// Upload a structure
///
/// Stores a structure, so that it can be meshed several times without another upload. Uploading the same bytes again
/// returns 200 and the same digest.
#[utoipa::path(post, path = "/v1/structures", tag = "structures", operation_id = "createStructure",
    params(ContentEncodingHeader),
    request_body(
        content = StructureFile,
        description = "A structure file, or a form with nothing but the file.",
        content_type = "application/octet-stream",
    ),
    responses(
        (status = 201, description = "The structure was stored.", body = StructureDocument, headers(("Location")),
            links(("mesh" = (operation_id = "meshStructure", parameters(("digest" = "$response.body#/digest")))))),
        (status = 200, description = "The structure was already stored.", body = StructureDocument, headers(("Location"))),
        CreateProblems,
    ))]
pub(super) async fn create(
    State(app): State<Shared>,
    caller: Caller,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    if upload::is_json(&headers) {
        let detail =
            "a structure is uploaded as a file, not as JSON; `POST /v1/meshes` takes JSON that names a structure";
        return Err(Problem::new(ProblemType::UnsupportedMediaType, detail).with("declared", "application/json"));
    }
    let UploadedFile { bytes, digest, reservation, map, fields, declared } =
        upload::receive(&app, &caller, &headers, body).await?;
    if let Some(name) = map.map(|_| "map").or(fields.first().map(|(name, _)| name.as_str())) {
        return Err(Problem::new(
            ProblemType::BadParameter,
            format!("a structure has no parameter `{name}`; parameters belong to meshes"),
        )
        .with("parameter", name));
    }
    let delivery = app.delivery(caller.client)?;
    let loaded = Loaded::file(bytes.clone(), digest, reservation);
    // Parse before storing, so that only readable structures are stored.
    let summary =
        summarize(&app, &caller, loaded.clone(), delivery).await.map_err(|failure| declared.explain(failure))?;
    declared.check_format(summary.format)?;
    let created = app.store.put_input(&digest, caller.namespace, bytes).await?;
    let status = if created { StatusCode::CREATED } else { StatusCode::OK };
    let location = delivery::text(&format!("/v1/structures/{digest}"));
    Ok((status, [(header::LOCATION, location)], Json(summary)).into_response())
}

/// Get the contents of a structure
#[utoipa::path(get, path = "/v1/structures/{digest}", tag = "structures", operation_id = "showStructure",
    params(StructurePath, ConditionHeaders),
    responses(
        (status = 200, description = "Contents of the structure.", body = StructureDocument, headers(("ETag"), ("Cache-Control"))),
        NotModified, ShowProblems,
    ))]
pub(super) async fn show(request: DocumentRequest) -> Result<Response, Problem> {
    let DocumentRequest { app, caller, .. } = &request;
    let write = async |loaded, delivery| Ok(Json(summarize(app, caller, loaded, delivery).await?).into_response());
    request.document("", None, write).await
}

/// Mesh an uploaded structure
///
/// The path names the format, so that the response can be cached and linked to.
#[utoipa::path(
    get,
    path = "/v1/structures/{digest}/{file}",
    tag = "meshes",
    operation_id = "meshStructure",
    params(StructurePath, SurfaceParameters, PreferenceHeaders, ConditionHeaders, RangeHeaders),
    responses(CacheableMeshOrJob, SurfaceProblems)
)]
pub(super) async fn surface(request: MeshRequest) -> Result<Response, Problem> {
    request.answer().await
}

problem_responses!(ReportProblems: [PARAMETERS READING MESHING WAITING]);

/// Mesh an uploaded structure and return the report
#[utoipa::path(
    get,
    path = "/v1/structures/{digest}/report.json",
    tag = "meshes",
    operation_id = "reportStructure",
    params(StructurePath, MeshParameters),
    responses(ReportResponse, ReportProblems)
)]
pub(super) async fn report(request: MeshRequest) -> Result<Response, Problem> {
    request.answer().await
}

/// Parses a structure and describes its contents, on a blocking thread.
async fn summarize(
    app: &Shared,
    caller: &Caller,
    loaded: Loaded,
    delivery: Delivery,
) -> Result<StructureDocument, Failure> {
    let limits = app.config.limits.job().read;
    let (structures, namespace) = (app.structures(), caller.namespace);
    let Loaded { input, digest, reservation } = loaded;
    let parsing = app.read(caller, (reservation, delivery), move |control| {
        let kept = structures.get((namespace, digest), &input, &limits, control)?;
        let _contents = control.reserve(kept.table_bytes())?;
        Ok(summary(&digest, input.file_bytes(), &kept, limits.max_copies))
    });
    parsing.await?.map_err(|error: StructureError| JobError::from(error).into())
}

fn summary(digest: &Digest, bytes: usize, structure: &Structure, max_copies: u64) -> StructureDocument {
    let contents = Contents::of(structure, None);
    let chains = contents.chains.iter().take(MAX_LISTED).map(|chain| ChainDocument {
        name: chain.name.clone(),
        atoms: chain.counts.total(),
        of: chain.counts,
    });
    let assemblies = structure.assemblies.list(max_copies).into_iter().take(MAX_LISTED);
    StructureDocument {
        digest: digest.to_string(),
        bytes,
        format: structure.format.name(),
        id: structure.id.clone(),
        title: structure.title.clone(),
        atoms: contents.atoms,
        model_count: contents.models.len(),
        models: contents.models.into_iter().take(MAX_LISTED).collect(),
        model: contents.model,
        atoms_in_model: contents.counts,
        alternatives: contents.alternatives,
        unknown_elements: contents.unknown_elements,
        warnings: structure.warnings.clone(),
        chain_count: contents.chains.len(),
        chains: chains.collect(),
        assemblies: assemblies.map(|(id, copies)| AssemblyDocument { id: id.to_owned(), copies }).collect(),
        surface: format!("/v1/structures/{digest}/surface.glb"),
    }
}
