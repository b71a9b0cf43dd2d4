//! Tileset: levels of detail of a structure, divided into tiles that are meshed independently.
//!
//! Each level is meshed on a grid with half the spacing of the level before. A tile is computed from the atoms that
//! affect it, and its mesh is clipped to its box. Grid points do not depend on the tile, so adjacent tiles of a level
//! have the same vertices at their common face.

mod layout;
mod level;
mod source;
mod stored;
mod stream;
mod units;
mod write;

use std::collections::BTreeSet;
use std::fmt;
use std::ops::Deref;
use std::sync::Arc;

use molmesh_formats::tileset::{TileAddress, TilesetBounds};
use molmesh_structure::{ReadLimits, Selected, Structure, StructureError};
use molmesh_surface::clip::{influence, influence_of};
use molmesh_surface::params::bad;
use molmesh_surface::{
    Backend, Control, Exceeded, GridStats, Limit, Measures, Mesh, MeshOutput, Spheres, Stage, SurfaceError,
    SurfaceLimits, SurfaceParams,
};

use self::layout::Layout;
use self::level::{Buckets, TilesetLevel, bucket_side};
use self::source::{LevelSource, NearSpheres, Streamed};
pub use self::stream::{StreamSource, StructureStream, check_stream, needs_memory};
pub use self::units::AssemblyTileset;
pub use self::write::{LevelReport, TilesetReport, UnitReport, WriteError, unit_folder, write, write_stream};
use super::color::{ColorReport, Coloring, MeshColors, MeshedSurface};
use super::load::{LoadedStructure, load};
use super::report::Counts;
use super::{Choice, JobError, Options, Product, Report, StageClock, WorkScope};

/// Maximum number of tiles.
const MAX_TILES: usize = 1_000_000;
/// Memory of the address of a tile, bytes.
const TILE_BYTES: u64 = 64;
/// Spheres or tiles between two checks of the cancellation flag.
const PER_CHECK: usize = 1 << 14;

/// Levels and tiles of a structure.
pub struct Tileset<S> {
    structure: S,
    layout: Layout,
    levels: Vec<LevelSource>,
    /// Tiles that the surface can reach, and their ancestors.
    tiles: BTreeSet<TileAddress>,
    selected: Selected,
    /// Values of a structure that is not in memory.
    streamed: Option<Streamed>,
}

/// Colours of the atoms of a tileset.
pub struct TilesetColors(MeshColors);

impl fmt::Debug for TilesetColors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TilesetColors").finish_non_exhaustive()
    }
}

impl<S> fmt::Debug for Tileset<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tileset").field("layout", &self.layout).finish_non_exhaustive()
    }
}

/// Parameters that do not apply to tiles, which are computed independently.
#[rustfmt::skip]
pub const NOT_APPLICABLE: [&str; 17] = [
    "split", "context", "cavities", "pockets", "pocket_probe", "exact", "interface", "max_triangles",
    "simplify", "quality", "units", "paper_a", "paper_b", "paper_c", "validation", "color_blend", "color_offset",
];

impl<S: Deref<Target = Structure>> Tileset<S> {
    /// Prepares the levels of the structure that `read` returns. The grid spacing of `options` is that of the last
    /// level.
    ///
    /// # Errors
    /// Returns a [`JobError`] if reading or selecting fails, there are too many tiles, or the job is cancelled.
    pub fn new(
        read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
        options: &Options,
        limits: &ReadLimits,
        scope: &WorkScope<'_>,
    ) -> Result<Self, JobError> {
        let LoadedStructure { structure, selected, spheres } = load(read, options, limits, scope)?;
        scope.clock.time("index", || {
            let params = options.params_for(spheres.len());
            let layout = Layout::of(&spheres, &params)?;
            let (levels, tiles) = layout.index(&Arc::new(spheres), &params, &scope.control)?;
            Ok(Self { structure, layout, levels, tiles, selected, streamed: None })
        })
    }

    /// Prepares the colours of the atoms.
    ///
    /// # Errors
    /// Returns [`JobError::Color`] if the colour scheme has no values, and the errors of memory.
    pub fn colors(&self, coloring: Coloring, control: &Control<'_>) -> Result<TilesetColors, JobError> {
        if let Some((coloring, report)) = self.streamed.as_ref().and_then(|streamed| streamed.colors.clone()) {
            return Ok(TilesetColors(MeshColors::of_report(coloring, report)));
        }
        MeshColors::new(&self.structure, &self.selected.atoms, coloring, None, control).map(TilesetColors)
    }

    /// Replaces the structure by an equal one.
    pub fn with_structure<T>(self, structure: impl FnOnce(S) -> T) -> Tileset<T> {
        let Self { structure: own, layout, levels, tiles, selected, streamed } = self;
        Tileset { structure: structure(own), layout, levels, tiles, selected, streamed }
    }

    /// Returns true if the atoms are in a file and not in the structure.
    pub const fn is_streamed(&self) -> bool {
        self.streamed.is_some()
    }

    /// Returns the structure.
    pub const fn structure(&self) -> &S {
        &self.structure
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

    /// Meshes the tile of `options`, or the root without one, adds skirts and encodes it. The mesh is empty if the
    /// surface does not pass through the tile. The memory of the product stays added to the meter of `scope`. Its
    /// report includes the times of its clock. `options` differs from that of [`Self::new`] in tile, colours and
    /// encoding at most; `colors` are those of [`Self::colors`].
    ///
    /// # Errors
    /// Returns the errors of meshing and compression, and [`SurfaceError::BadParameter`] for a tile outside the cube.
    pub fn product(
        &self,
        options: &Options,
        colors: Option<&TilesetColors>,
        choice: &Choice<'_>,
        limits: &SurfaceLimits,
        scope: &WorkScope<'_>,
    ) -> Result<Product, JobError> {
        let WorkScope { clock, control } = scope;
        let (output, color) = self.output(options, colors, choice.backend, limits, scope)?;
        let MeshOutput { mut mesh, grid, made_by, .. } = output;
        let address = options.tile.unwrap_or(TileAddress::ROOT);
        let (half, resolution) = (0.5 * self.layout.side(address.level), self.layout.spacing(address.level));
        let boundary = clock.time("clip", || mesh.boundary(half, resolution));
        // Without the skirts.
        let measure = || Measures::of_part(&mesh, boundary.len(), control);
        let measures = clock.time(Stage::Measure.name(), measure)?;
        clock.time("clip", || mesh.add_skirts(&boundary, half, resolution));
        // The same step for all tiles of a level.
        let quantize = options.quantization(|| half);
        if let Some(step) = quantize {
            mesh.quantize(step);
        }
        let storage = options.storage(quantize);
        let (n_vertices, n_triangles, centre) = (mesh.n_vertices(), mesh.n_triangles(), mesh.centre);
        let counts =
            Counts { resolution, centre, tries: None, grid, n_vertices, n_triangles, cut: true, made_by, storage };
        let times = clock.finish();
        let mut report = Report::new(&self.structure, &self.selected, options, choice, &counts, &measures, times);
        report.color = color;
        if let Some(Streamed { n_atoms, atoms_in_file, radii, .. }) = &self.streamed {
            (report.atoms, report.atoms_in_file, report.radii) = (*n_atoms, *atoms_in_file, radii);
        }
        let mut product = Product::new(mesh, storage, report);
        product.compress(options, scope)?;
        Ok(product)
    }

    /// Meshes the tile of `options`, as [`Self::product`] does, without skirts and encoding; `None` if the surface does
    /// not pass through it. The mesh has a boundary at the faces of the tile.
    ///
    /// # Errors
    /// Returns the errors of meshing.
    pub fn mesh(
        &self,
        options: &Options,
        colors: Option<&TilesetColors>,
        backend: &dyn Backend,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Option<Mesh>, JobError> {
        let clock = StageClock::new(&());
        let (output, _) = self.output(options, colors, backend, limits, &WorkScope::new(&clock, control))?;
        Ok(Some(output.mesh).filter(|mesh| mesh.n_triangles() > 0))
    }

    /// Meshes a tile and colours it.
    fn output(
        &self,
        options: &Options,
        colors: Option<&TilesetColors>,
        backend: &dyn Backend,
        limits: &SurfaceLimits,
        WorkScope { clock, control }: &WorkScope<'_>,
    ) -> Result<(MeshOutput, Option<ColorReport>), JobError> {
        let (address, levels) = (options.tile.unwrap_or(TileAddress::ROOT), self.layout.levels);
        if !address.is_valid(levels) {
            let expected = format!("a tile of the tileset, whose levels are 0 to {}", levels - 1);
            return Err(bad("tile", format!("`{}`", address.path()), expected).into());
        }
        let level = &self.levels[address.level as usize];
        let (spacing, bounds) = (self.layout.spacing(address.level), self.layout.tile(address));
        let params = SurfaceParams {
            resolution: spacing,
            atom_ids: options.needs_atoms(),
            quantize: None,
            ..options.params.clone()
        };
        let empty = || Ok((MeshOutput::new(Mesh::default(), GridStats::default()), None));
        if !self.tiles.contains(&address) {
            return empty();
        }
        let margin = influence_of(level.largest(), &params) + spacing;
        let NearSpheres { spheres, atoms, colors } = level.near(&self.selected, bounds, margin, colors, control)?;
        if spheres.is_empty() {
            return empty();
        }
        let mut output = match clock.pass(|| backend.run(&spheres, &params, limits, control)) {
            Err(SurfaceError::NoSurface { .. }) => return empty(),
            output => output?,
        };
        let mesh = &mut output.mesh;
        clock.time("clip", || {
            mesh.make_contiguous();
            mesh.clip(bounds, control)
        })?;
        if mesh.triangles.is_empty() {
            return empty();
        }
        let surface = MeshedSurface { spheres: &spheres, params: &params, limits, parts: None };
        let color = |colors: MeshColors| clock.time("color", || colors.apply(mesh, &surface, None, control));
        let color = colors.map(color).transpose()?;
        if !options.params.atom_ids {
            mesh.atom_ids = None;
        }
        for id in mesh.atom_ids.iter_mut().flat_map(|ids| ids.iter_mut()) {
            *id = atoms[*id as usize];
        }
        Ok((output, color))
    }

    /// Returns the number of meshed atoms.
    fn n_atoms(&self) -> u64 {
        self.streamed.as_ref().map_or(self.selected.atoms.len() as u64, |streamed| streamed.n_atoms)
    }
}

impl Layout {
    /// Returns the layout of the surface of `spheres`.
    fn of(spheres: &Spheres, params: &SurfaceParams) -> Result<Self, SurfaceError> {
        params.check_radius(spheres.radius_range().0)?;
        let bounds = spheres.bounds().ok_or(SurfaceError::NoSpheres)?;
        Ok(Self::new(bounds, influence(spheres, params), params.resolution))
    }

    /// Returns the levels, coarsest first, and the tiles that the surface of `spheres` can reach, with their ancestors.
    fn index(
        &self,
        spheres: &Arc<Spheres>,
        params: &SurfaceParams,
        control: &Control<'_>,
    ) -> Result<(Vec<LevelSource>, BTreeSet<TileAddress>), JobError> {
        let (mut levels, mut tiles) = (Vec::new(), BTreeSet::new());
        let side = bucket_side(self.side(self.levels - 1));
        let buckets = Arc::new(Buckets::new(spheres, side, control)?);
        for number in (0..self.levels).rev() {
            let lengths = [self.spacing(number), self.side(number)];
            let level = TilesetLevel::new(spheres, &buckets, params, lengths, control)?;
            Self::add_parents(number, &mut tiles);
            let reach = influence(&level.spheres, params);
            let centres = (0..level.spheres.len()).map(|i| level.spheres.centre(i));
            self.add_tiles(number, centres, reach, params, &mut tiles, control)?;
            levels.push(LevelSource::Memory(level));
        }
        levels.reverse();
        Ok((levels, tiles))
    }

    /// Adds the parents of the tiles of the next level.
    fn add_parents(number: u32, tiles: &mut BTreeSet<TileAddress>) {
        let finer = tiles.iter().take_while(|tile: &&TileAddress| tile.level == number + 1);
        let mut parents: BTreeSet<TileAddress> = finer.filter_map(|tile| tile.parent()).collect();
        tiles.append(&mut parents);
    }

    /// Adds the tiles of a level that a sphere of radius `reach`, Å, around one of the centres touches.
    fn add_tiles(
        &self,
        number: u32,
        centres: impl Iterator<Item = [f64; 3]>,
        reach: f64,
        params: &SurfaceParams,
        tiles: &mut BTreeSet<TileAddress>,
        control: &Control<'_>,
    ) -> Result<(), JobError> {
        let ranges = centres.map(|c| self.touched(number, [c.map(|c| c - reach), c.map(|c| c + reach)]));
        // Successive atoms mostly touch the same tiles.
        let mut last = None;
        let new = ranges.filter(|range| last.replace(*range) != Some(*range));
        for (n, tile) in new.flat_map(|range| Self::between(number, range)).enumerate() {
            control.check_every(n, PER_CHECK)?;
            if !tiles.insert(tile) {
                continue;
            }
            control.memory.grow(TILE_BYTES).map_err(SurfaceError::from)?;
            if tiles.len() > MAX_TILES {
                let error = Exceeded::new(Limit::Tiles, MAX_TILES as u64);
                let error = Exceeded { resolution: Some(params.resolution), ..error };
                return Err(error.error::<SurfaceError>().into());
            }
        }
        Ok(())
    }
}
