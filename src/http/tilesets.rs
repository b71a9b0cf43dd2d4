//! `…/tileset.json` and `…/tileset.subtree`: 3D Tiles tileset of a structure, whose tiles are meshes with the parameter
//! `tile`.
//!
//! A tileset has no state of its own: its URL and those of its tiles name the structure and all parameters.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::FromRequestParts;
use axum::http::header;
use axum::http::request::Parts;
use axum::response::{IntoResponse, Response};

use super::openapi::bodies::SubtreeFile;
use super::openapi::meshes::NotModified;
use super::openapi::parameters::{ConditionHeaders, StructurePath, SubtreeParameters, TilesetParameters};
use super::openapi::problem_responses;
use super::parsed_request::{Pairs, reject_format};
use super::problem::Problem;
use super::source::{DocumentRequest, Loaded};
use super::state::{Delivery, Shared};
use crate::formats::Format;
use crate::formats::tileset::{TileAddress, TilesetUris, assembly_document, subtree, tileset_document};
use crate::jobs::{CacheKey, Failure, Input, SharedStructure, SharedTileset};
use crate::pipeline::params::ParamError;
use crate::pipeline::tileset::AssemblyTileset;
use crate::pipeline::{JobError, Options, StageClock, WorkScope, params};
use crate::structure::ReadLimits;
use crate::surface::{Control, SurfaceError};

/// Memory of an instance in the document of an assembly, bytes.
const DOCUMENT_BYTES: u64 = 4096;

problem_responses!(Problems: [READING LISTING] TooManyCopies GridTooLarge);

/// Get the tileset of a structure
///
/// Levels of detail of a large structure, in the format 3D Tiles 1.1. Its tiles are computed when they are requested:
/// `surface.glb` with the parameter `tile`, compressed with meshopt unless `compress` has another value.
#[utoipa::path(get, path = "/v1/structures/{digest}/tileset.json", tag = "tilesets", operation_id = "showTileset",
    params(StructurePath, TilesetParameters, ConditionHeaders),
    responses(
        (status = 200, description = "The tileset.", body = serde_json::Value, headers(("ETag"), ("Cache-Control"))),
        NotModified, Problems,
    ))]
pub(super) async fn show(request: TilesetRequest) -> Result<Response, Problem> {
    request.document().await
}

/// Get a subtree of the tileset of a structure
///
/// Binary file that lists the tiles below `tile`, by default below the root, for clients of `tileset.json`.
#[utoipa::path(get, path = "/v1/structures/{digest}/tileset.subtree", tag = "tilesets", operation_id = "showSubtree",
    params(StructurePath, SubtreeParameters, ConditionHeaders),
    responses(
        (status = 200, description = "The subtree.", body = inline(SubtreeFile), content_type = "application/octet-stream", headers(("ETag"), ("Cache-Control"))),
        NotModified, Problems,
    ))]
pub(super) async fn show_subtree(request: TilesetRequest) -> Result<Response, Problem> {
    request.subtree().await
}

/// Request for a document of a tileset.
pub(super) struct TilesetRequest {
    request: DocumentRequest,
    /// Parameters of the tiles, without `tile`.
    pairs: Vec<(String, String)>,
    options: Options,
}

impl FromRequestParts<Shared> for TilesetRequest {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &Shared) -> Result<Self, Problem> {
        let Pairs(mut pairs) = Pairs::from_request_parts(parts, app).await?;
        reject_format(Format::Glb, &pairs)?;
        let request = params::parse_tileset(&mut pairs)?;
        if request.strict {
            let expected = "no value for a tileset; POST /v1/report checks a file".to_owned();
            return Err(ParamError::BadValue { name: "check", value: "`strict`".to_owned(), expected }.into());
        }
        app.check_options(&request.options)?;
        pairs.retain(|(name, _)| name != "tile");
        let options = request.options;
        Ok(Self { request: DocumentRequest::from_request_parts(parts, app).await?, pairs, options })
    }
}

impl TilesetRequest {
    /// Answers with `tileset.json`.
    async fn document(self) -> Result<Response, Problem> {
        if let Some(tile) = self.options.tile {
            let (value, expected) = (format!("`{}`", tile.path()), "no value for tileset.json".to_owned());
            return Err(ParamError::BadValue { name: "tile", value, expected }.into());
        }
        if self.options.selection.instances {
            return self.assembly().await;
        }
        let query = query(&self.pairs, None);
        let tile = format!("tile={{level}}/{{x}}/{{y}}/{{z}}&{query}");
        // Clients such as 3d-tiles-renderer recognize a subtree by the end of its URL.
        let subtrees = format!("tileset.subtree?{tile}#.subtree");
        let uris = TilesetUris { content: format!("surface.glb?{tile}"), subtrees };
        self.answer("application/json", move |prepared| {
            Ok(tileset_document(&prepared.tileset()?.bounds(), &uris).to_string().into_bytes())
        })
        .await
    }

    /// Answers with the `tileset.json` of an assembly that repeats the tilesets of its units.
    async fn assembly(mut self) -> Result<Response, Problem> {
        let pairs = std::mem::take(&mut self.pairs);
        self.answer("application/json", move |prepared| {
            let assembly = prepared.assembly()?;
            let instances: usize = assembly.units().iter().map(|unit| unit.operators.len()).sum();
            let memory = prepared.control.reserve(DOCUMENT_BYTES * instances as u64);
            let _memory = memory.map_err(|error| Failure::from(JobError::from(SurfaceError::from(error))))?;
            let range = assembly.color_range().map(|[low, high]| ("color_range".to_owned(), format!("{low},{high}")));
            let repeated = assembly.repeated(|number| {
                let own = pairs.iter().filter(|(name, _)| name != "instances");
                format!("tileset.json?{}", query(own.chain(&range), Some(("unit", number.to_string()))))
            });
            let root = format!("surface.glb?{}", query(&pairs, Some(("tile", TileAddress::ROOT.path()))));
            Ok(assembly_document(&root, &repeated).to_string().into_bytes())
        })
        .await
    }

    /// Answers with the subtree below a tile, by default the root.
    async fn subtree(self) -> Result<Response, Problem> {
        let root = self.options.tile.unwrap_or(TileAddress::ROOT);
        if self.options.selection.instances {
            let expected = "false for a subtree, which belongs to one unit".to_owned();
            return Err(ParamError::BadValue { name: "instances", value: "`true`".to_owned(), expected }.into());
        }
        self.answer("application/octet-stream", move |prepared| {
            let tileset = prepared.tileset()?;
            let levels = tileset.bounds().subtree_levels();
            if !root.level.is_multiple_of(levels) || !tileset.tiles().contains(&root) {
                let (value, expected) = (format!("`{}`", root.path()), "the root of a subtree".to_owned());
                return Err(ParamError::BadValue { name: "tile", value, expected }.into());
            }
            // A listed tile without a surface is a GLB without a mesh.
            let is_tile = |tile: TileAddress| tileset.tiles().contains(&tile);
            Ok(subtree(root, levels, is_tile, is_tile))
        })
        .await
    }

    /// Answers with the output of `write`. Prepares the tileset on a blocking thread if necessary.
    async fn answer(
        self,
        media_type: &'static str,
        write: impl FnOnce(&Preparation<'_>) -> Result<Vec<u8>, Problem> + Send + 'static,
    ) -> Result<Response, Problem> {
        let Self { request, options, .. } = self;
        let DocumentRequest { app, caller, .. } = &request;
        let variant = format!("{media_type}\n{}", params::canonical(&options));
        // Finds the tileset in the cache, as jobs on its tiles do.
        let tile_options = Options { tile: Some(TileAddress::ROOT), ..options.clone() };
        let respond = async |loaded: Loaded, delivery: Delivery| {
            let Loaded { input, digest, reservation } = loaded;
            let (shared, key) = (Arc::clone(app), (caller.namespace, digest));
            let reading = app.read(caller, (reservation, delivery), move |control| {
                let limits = shared.config.limits.job().read;
                write(&Preparation { app: &shared, key, input: &input, options: &options, limits, control })
            });
            Ok(([(header::CONTENT_TYPE, media_type)], Body::from(reading.await??)).into_response())
        };
        request.document(&variant, Some(&tile_options), respond).await
    }
}

/// Structure and parameters of a document.
struct Preparation<'a> {
    app: &'a Shared,
    key: CacheKey,
    input: &'a Input,
    options: &'a Options,
    limits: ReadLimits,
    control: &'a Control<'a>,
}

impl Preparation<'_> {
    /// Returns the tileset, and prepares it if necessary.
    fn tileset(&self) -> Result<SharedTileset, Problem> {
        let Self { app, key, input, options, limits, control } = self;
        let prepared = app.structures().tileset(*key, input, options, limits, control, &StageClock::new(&()));
        Ok(prepared.map_err(Failure::from)?.0)
    }

    /// Returns the tileset of the assembly.
    fn assembly(&self) -> Result<AssemblyTileset<SharedStructure>, Problem> {
        let Self { app, key, input, options, limits, control } = self;
        let read = |control: &Control<'_>| app.structures().get(*key, input, limits, control);
        let clock = StageClock::new(&());
        let assembly = AssemblyTileset::new(read, options, limits, &WorkScope::new(&clock, control));
        Ok(assembly.map_err(Failure::from)?)
    }
}

/// Returns the query of a URL.
fn query<'a>(pairs: impl IntoIterator<Item = &'a (String, String)>, more: Option<(&str, String)>) -> String {
    let mut query = form_urlencoded::Serializer::new(String::new());
    query.extend_pairs(pairs).extend_pairs(more).finish()
}
