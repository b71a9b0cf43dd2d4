//! Tileset: levels of detail of a structure, divided into tiles that are meshed independently.
//!
//! Each level is meshed on a grid with half the spacing of the level before. A tile is computed from the atoms that
//! affect it, and its mesh is clipped to its box. Grid points do not depend on the tile, so adjacent tiles of a level
//! have the same vertices at their common face.

mod layout;
mod level;
mod write;

use std::collections::BTreeSet;
use std::ops::Deref;
use std::sync::Arc;

use serde_json::{Map, Value};

use self::layout::Layout;
pub use self::layout::MAX_LEVELS;
use self::level::TilesetLevel;
pub use self::write::{LevelReport, TilesetReport, WriteError};
use super::color::{ColorBlend, Coloring, MeshColors, Scheme};
use super::params::ParamError;
use super::{Job, JobError, ProgressSink, StageClock, load, to_atom_indices};
use crate::formats::tileset::{TileAddress, TilesetBounds};
use crate::formats::{CompressedGlb, Meta, Packing, Pieces, Step, Storage};
use crate::structure::{Context, ReadLimits, Selected, Split, Structure, StructureError};
use crate::surface::clip::influence;
use crate::surface::{
    Backend, Control, Mesh, Reservation, Spheres, SurfaceError, SurfaceLimits, SurfaceParams, Validation,
};

/// Maximum number of tiles.
const MAX_TILES: usize = 1_000_000;
/// Memory of the address of a tile, bytes.
const TILE_BYTES: u64 = 64;
/// Spheres between two checks of the cancellation flag.
const PER_CHECK: usize = 1 << 10;

/// Levels and tiles of a structure.
pub struct Tileset {
    job: Job,
    layout: Layout,
    levels: Vec<TilesetLevel>,
    /// Tiles that the surface can reach, and their ancestors.
    tiles: BTreeSet<TileAddress>,
    selected: Selected,
    colors: Option<MeshColors>,
    /// PDB id or data block name of the structure.
    name: Option<String>,
}

/// File of a tile.
#[derive(Debug, Clone)]
pub struct TileFile {
    /// GLB, compressed with meshopt.
    pub glb: Vec<u8>,
    /// Number of triangles, including skirts.
    pub triangles: u64,
}

/// Rejects parameters of a job that do not apply to tiles.
///
/// # Errors
/// Returns [`ParamError::BadValue`].
pub fn check(job: &Job) -> Result<(), ParamError> {
    let selection = &job.selection;
    let of_vertices = |color: &Coloring| matches!(color.scheme, Scheme::Vertex(_));
    let refused = [
        ("split", job.split != Split::None && job.split != Split::Model, "none"),
        ("model", job.split == Split::Model, "one model"),
        ("instances", selection.instances, "false"),
        ("context", selection.context != Context::Selection, "selection"),
        ("cavities", job.cavities.is_some(), "no value"),
        ("color", job.color.as_ref().is_some_and(of_vertices), "a scheme that colours atoms"),
        ("color_blend", job.color.is_some_and(|color| color.blend == ColorBlend::Smooth), "nearest"),
        ("pockets", job.pockets.is_some(), "false"),
        ("exact", job.exact, "false"),
        ("max_triangles", job.max_triangles().is_some(), "no value"),
        ("simplify", job.simplify.is_some(), "no value"),
        ("paper_b", job.params.paper.is_some(), "no value"),
        ("validation", job.validation != Validation::default(), "checksum"),
    ];
    match refused.into_iter().find(|(_, is_refused, _)| *is_refused) {
        Some((name, _, expected)) => {
            let expected = format!("{expected} for a tileset, whose tiles are computed independently");
            Err(ParamError::BadValue { name, value: "the value".to_owned(), expected })
        }
        None => Ok(()),
    }
}

impl Tileset {
    /// Prepares the levels of the structure that `read` returns. The grid spacing of `job` is that of the last level.
    ///
    /// # Errors
    /// Returns a [`JobError`] if reading or selecting fails, a colour scheme has no values, or the job is cancelled.
    pub fn new<S: Deref<Target = Structure>>(
        read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
        job: Job,
        limits: &ReadLimits,
        control: &Control<'_>,
        progress: &dyn ProgressSink,
    ) -> Result<Self, JobError> {
        let clock = StageClock::new(progress);
        let (structure, selected, spheres) = load(read, &job, limits, &clock, control)?;
        let color = |coloring| MeshColors::new(&structure, &selected.atoms, coloring, None, control);
        let colors = job.color.map(color).transpose()?;
        let name = structure.id.clone();
        drop(structure);
        let params = job.params_for(spheres.len());
        let bounds = spheres.bounds().ok_or(SurfaceError::NoSpheres)?;
        let layout = Layout::new(bounds, influence(&spheres, &params), params.resolution);
        let spheres = Arc::new(spheres);
        let (mut levels, mut tiles) = (Vec::new(), BTreeSet::new());
        for number in (0..layout.levels).rev() {
            let level = TilesetLevel::new(&spheres, &params, [layout.spacing(number), layout.side(number)], control)?;
            let finer = tiles.iter().take_while(|tile: &&TileAddress| tile.level == number + 1);
            let mut parents: BTreeSet<TileAddress> = finer.filter_map(|tile| tile.parent()).collect();
            tiles.append(&mut parents);
            let reach = influence(&level.spheres, &params);
            for i in 0..level.spheres.len() {
                if i.is_multiple_of(PER_CHECK) {
                    control.check()?;
                }
                let centre = level.spheres.centre(i);
                for tile in layout.touched(number, [centre.map(|c| c - reach), centre.map(|c| c + reach)]) {
                    if !tiles.insert(tile) {
                        continue;
                    }
                    control.memory.grow(TILE_BYTES).map_err(SurfaceError::from)?;
                    if tiles.len() > MAX_TILES {
                        let (limit, resolution) = (MAX_TILES as u64, params.resolution);
                        return Err(SurfaceError::TooManyTiles { limit, resolution }.into());
                    }
                }
            }
            levels.push(level);
        }
        levels.reverse();
        Ok(Self { job, layout, levels, tiles, selected, colors, name })
    }

    /// Returns the cube and the levels.
    #[must_use]
    pub fn bounds(&self) -> TilesetBounds {
        self.layout.bounds()
    }

    /// Returns the tiles that the surface can reach, and their ancestors.
    #[must_use]
    pub const fn tiles(&self) -> &BTreeSet<TileAddress> {
        &self.tiles
    }

    /// Returns the grid spacing of a level, Å.
    #[must_use]
    pub fn spacing(&self, level: u32) -> f64 {
        self.layout.spacing(level)
    }

    /// Meshes a tile and compresses it; `None` if the surface does not pass through it.
    ///
    /// # Errors
    /// Returns the errors of meshing and compression.
    pub fn tile(
        &self,
        address: TileAddress,
        backend: &dyn Backend,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Option<TileFile>, JobError> {
        // Releases all memory that is counted for the tile. The file is not counted.
        let control = &Control { memory: Arc::new(Reservation::new(&control.memory)), ..control.clone() };
        let mesh = self.mesh(address, backend, limits, control)?;
        mesh.map(|mesh| self.compressed(mesh, address, control)).transpose()
    }

    /// Meshes a tile; `None` if the surface does not pass through it. The mesh has a boundary at the faces of the tile.
    ///
    /// # Errors
    /// Returns the errors of meshing.
    pub fn mesh(
        &self,
        address: TileAddress,
        backend: &dyn Backend,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Option<Mesh>, JobError> {
        if !self.tiles.contains(&address) {
            return Ok(None);
        }
        let level = &self.levels[address.level as usize];
        let (spacing, bounds) = (self.layout.spacing(address.level), self.layout.tile(address));
        let params = SurfaceParams {
            resolution: spacing,
            atom_ids: self.job.needs_atoms(),
            quantize: None,
            ..self.job.params.clone()
        };
        let near = level.near(bounds, influence(&level.spheres, &params) + spacing);
        if near.is_empty() {
            return Ok(None);
        }
        let spheres: Spheres = level.spheres.subset(&near);
        let mut mesh = match backend.run(&spheres, &params, limits, control) {
            Err(SurfaceError::NoSurface { .. }) => return Ok(None),
            output => output?.mesh,
        };
        mesh.make_contiguous();
        for id in mesh.atom_ids.iter_mut().flat_map(|ids| ids.iter_mut()) {
            *id = level.row(near[*id as usize]);
        }
        mesh.clip(bounds, control)?;
        if mesh.triangles.is_empty() {
            return Ok(None);
        }
        if let Some(colors) = &self.colors {
            colors.apply(&mut mesh, spacing, None, control)?;
        }
        to_atom_indices(&mut mesh, &self.job, &self.selected, control)?;
        Ok(Some(mesh))
    }

    /// Quantizes and compresses the mesh of a tile.
    fn compressed(&self, mut mesh: Mesh, address: TileAddress, control: &Control<'_>) -> Result<TileFile, JobError> {
        let (half, spacing) = (0.5 * self.layout.side(address.level), self.layout.spacing(address.level));
        mesh.add_skirts(half, spacing);
        // The same step for all tiles of a level.
        let step = Step::covering(half + spacing);
        mesh.quantize(step);
        let storage = Storage { packing: Packing::Quantized(step), normals: self.job.normals, units: self.job.units };
        let grow = |bytes| {
            control.check()?;
            control.memory.grow(bytes).map_err(|error| JobError::from(SurfaceError::from(error)))
        };
        let pieces = Pieces::new(&mesh, storage, None, grow, |bytes| control.memory.shrink(bytes))?;
        let extras = Map::from_iter([("spacing".to_owned(), Value::from(spacing))]);
        let meta = Meta { name: self.name.clone(), extras };
        let mut glb = Vec::new();
        let file = CompressedGlb::new(&mesh, &pieces, &meta)?;
        file.write(&mut glb).map_err(|_unreachable| SurfaceError::Sink)?;
        Ok(TileFile { glb, triangles: mesh.n_triangles() as u64 })
    }
}
