//! Native CPU backend: eight stages over occupied bricks, parallel over tiles, with SIMD.
//!
//! First pass (`first_pass.rs`): `bin` assigns atoms to tiles. For each tile, or a slab of it, a thread finds the
//! candidates of the bricks and evaluates `field` in a scratch buffer that fits the core's cache; `classify` keeps
//! crossing bits, edge parameters and cases. Densities are not kept. `scan` numbers the vertices and triangles of all
//! tiles. Second pass (`write.rs`): `interpolate` and `emit` write vertices and triangles to memory or to a sink;
//! `measure` sums over them.
//!
//! The same input gives the same bytes on any number of threads.

mod bin;
mod brick_atoms;
mod classify;
mod curvature;
pub mod distance;
mod edge;
mod emit;
pub mod field;
mod first_pass;
mod interpolate;
mod measure;
mod neighbours;
pub(super) mod points;
mod refine;
pub mod scan;
mod sheets;
mod slabs;
#[doc(hidden)]
pub mod stage_results;
mod table;
mod write;

use std::ops::Range;

use self::bin::{Tiles, slot_brick};
use self::classify::{ClassifiedBricks, CountsBefore};
use self::distance::DistanceField;
use self::field::Constants;
use self::first_pass::Pass;
pub(super) use self::interpolate::MAX_SHARE;
use self::neighbours::NumberedBrick;
use self::scan::Totals;
use super::backend::{Backend, BackendJob, GridStats, MeshOutput};
use super::control::{Control, Stage};
use super::error::SurfaceError;
use super::kernel::Shape;
use super::lattice::{Lattice, TILE, to_f32, to_u32};
use super::params::{SurfaceLimits, SurfaceParams};
use super::quantize::Step;
use super::spheres::Spheres;
use super::{candidates, occupancy, simd, threads};

/// Native CPU backend.
#[derive(Debug, Default)]
pub struct CpuBackend {
    /// Thread pool, if a number of threads was requested; otherwise the global pool is used.
    pool: Option<rayon::ThreadPool>,
}

/// Parameters and context of a run.
#[derive(Clone, Copy)]
struct RunContext<'a> {
    params: &'a SurfaceParams,
    limits: &'a SurfaceLimits,
    control: &'a Control<'a>,
    /// Threads reserved for this run: 1 if it shares the global pool.
    free_threads: usize,
}

impl CpuBackend {
    /// Backend with a pool of `threads` threads, or on the global pool.
    ///
    /// # Errors
    /// Message of the pool if the threads cannot be started.
    pub fn new(threads: Option<usize>) -> Result<Self, String> {
        let pool = threads.map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build()).transpose();
        Ok(Self { pool: pool.map_err(|e| e.to_string())? })
    }

    /// Number of threads that a run uses.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.pool.as_ref().map_or_else(rayon::current_num_threads, rayon::ThreadPool::current_num_threads)
    }

    /// Runs `work` on the backend's threads with the number of threads reserved for it.
    fn install<T: Send>(&self, work: impl FnOnce(usize) -> T + Send) -> T {
        match &self.pool {
            Some(pool) => pool.install(|| work(pool.current_num_threads())),
            None => work(1),
        }
    }
}

impl Backend for CpuBackend {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn describe(&self) -> String {
        let threads = self.threads();
        let plural = if threads == 1 { "" } else { "s" };
        format!("native CPU, {threads} thread{plural}, {}", simd::extension())
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        let BackendJob { spheres, params, limits, control, sink } = *job;
        self.install(|free_threads| {
            // Only the mesh outlives the run.
            let context = RunContext { params, limits, control: &control.metered(), free_threads };
            write::write(scan(spheres, context)?, context, control, sink)
        })
    }
}

/// Function whose level set is the surface.
enum Field {
    /// Sum of densities.
    Density(Constants),
    /// Distance to the boundary of a union of spheres.
    Distance(Box<DistanceField>),
}

impl Field {
    fn new(lattice: &Lattice, context: RunContext<'_>) -> Result<Self, SurfaceError> {
        Ok(match &lattice.shape {
            Shape::Density(profile) => Self::Density(Constants::new(profile, lattice.spacing)),
            Shape::Sphere { .. } => Self::Distance(Box::new(DistanceField::new(lattice, context)?)),
        })
    }

    /// Returns the number of ordered pairs of overlapping spheres; 0 if they are not counted.
    fn overlaps(&self) -> u64 {
        match self {
            Self::Density(_) => 0,
            Self::Distance(field) => field.overlaps(),
        }
    }

    /// Returns the bounding spheres of the arcs of the boundary, if the surface needs one.
    fn bounds(&self) -> Option<&Lattice> {
        match self {
            Self::Density(_) => None,
            Self::Distance(field) => field.bounds(),
        }
    }

    /// Returns the value at the grid points on the surface.
    fn level(&self, params: &SurfaceParams) -> f32 {
        match self {
            Self::Density(_) => to_f32(params.isovalue),
            Self::Distance(_) => distance::SURFACE,
        }
    }
}

/// Returns the field of a run whose pairs do not exceed the limit.
fn checked_field(lattice: &Lattice, context: RunContext<'_>) -> Result<Field, SurfaceError> {
    let RunContext { limits, control, .. } = context;
    occupancy::check_pairs(&[lattice], limits, control)?;
    let field = Field::new(lattice, context)?;
    if let Some(bounds) = field.bounds() {
        occupancy::check_pairs(&[lattice, bounds], limits, control)?;
    }
    Ok(field)
}

/// Rejects a run as it would be rejected before its field is evaluated.
///
/// # Errors
/// Those of the limits on grid points, pairs and overlaps.
pub fn check_work(
    lattice: &Lattice,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<occupancy::WorkCounts, SurfaceError> {
    let counts = occupancy::count(lattice, limits, control)?;
    if matches!(lattice.shape, Shape::Sphere { .. }) {
        checked_field(lattice, RunContext { params, limits, control: &control.metered(), free_threads: 1 })?;
    }
    Ok(counts)
}

/// Results of the stages for a tile.
#[derive(Debug)]
struct Tile {
    coord: [i32; 3],
    found: ClassifiedBricks,
    /// Index into `found.bricks` per local brick (8 × 8 × 8), or `NO_BRICK`.
    bricks: Vec<u16>,
    first_vertex: usize,
    first_triangle: usize,
    first_piece: usize,
}

const NO_BRICK: u16 = u16::MAX;

/// Result of the stages up to `scan`, on which the second pass depends.
struct Scanned {
    lattice: Lattice,
    field: Field,
    /// Value of the field on the surface.
    level: f32,
    tiles: Tiles,
    done: Vec<Tile>,
    totals: Totals,
    grid: GridStats,
    pieces: Vec<Piece>,
    /// Step of quantized vertices.
    quantize: Option<Step>,
}

/// Run of surface bricks of a tile. One thread writes its rows.
#[derive(Debug, Clone)]
struct Piece {
    tile: usize,
    bricks: Range<usize>,
}

/// Surface bricks per piece: about 3,000 vertices with their triangles, a small part of the L2 cache.
const PIECE_BRICKS: usize = 32;

/// Splits the tiles into pieces, in order.
fn pieces(done: &mut [Tile]) -> Vec<Piece> {
    let mut pieces = Vec::new();
    for (t, tile) in done.iter_mut().enumerate() {
        let n = tile.found.bricks.len();
        tile.first_piece = pieces.len();
        let starts = (0..n).step_by(PIECE_BRICKS);
        pieces.extend(starts.map(|first| Piece { tile: t, bricks: first..n.min(first + PIECE_BRICKS) }));
    }
    pieces
}

/// Memory of placing an atom on the lattice, bytes: the atom, its bucket and its index, and the tables of buckets.
pub const LATTICE_BYTES: u64 = 41;

/// Memory of a slab and its result besides the lists that it owns, bytes: while the results are collected and sorted.
const RESULT_BYTES: u64 = (size_of::<slabs::Slab>() + 3 * size_of::<(usize, Tile)>()) as u64;

fn scan(spheres: &Spheres, context: RunContext<'_>) -> Result<Scanned, SurfaceError> {
    let lattice = context.control.span(Stage::Bin, || {
        candidates::check(spheres, context.params, context.limits)?;
        context.control.memory.grow(LATTICE_BYTES * spheres.len() as u64)?;
        Lattice::new(spheres, context.params, context.control)
    });
    scan_lattice(lattice?, context)
}

fn scan_lattice(lattice: Lattice, context: RunContext<'_>) -> Result<Scanned, SurfaceError> {
    let RunContext { params, limits, control, free_threads } = context;
    let tiles = control.span(Stage::Bin, || -> Result<_, SurfaceError> {
        let tiles = Tiles::new(&lattice, limits, control)?;
        if tiles.len() as f64 * f64::from(TILE).powi(3) > limits.max_grid_points as f64 {
            // Rejects a grid that exceeds the limit before any of it is computed.
            occupancy::count(&lattice, limits, control)?;
        }
        Ok(tiles)
    });
    let tiles = tiles?;
    control.check()?;
    let field = control.span(Stage::Bin, || checked_field(&lattice, context))?;
    control.check()?;
    let level = field.level(params);
    let slabs = slabs::cut(&tiles, free_threads);
    control.memory.grow(RESULT_BYTES * slabs.len() as u64)?;
    let pass = Pass {
        lattice: &lattice,
        tiles: &tiles,
        slabs: &slabs,
        partial_tiles: slabs::PartialTiles::default(),
        field: &field,
        iso: level,
        context,
        counters: first_pass::PassCounters::default(),
    };
    let evaluated = threads::each(slabs.len(), |i| pass.evaluate(i))?;
    let counters = pass.counters;
    let mut done: Vec<(usize, Tile)> =
        slabs.iter().zip(evaluated).filter_map(|(slab, tile)| Some((slab.tile, tile?))).collect();
    done.sort_unstable_by_key(|(t, _)| *t);
    let mut done: Vec<Tile> = done.into_iter().map(|(_, tile)| tile).collect();
    control.check()?;
    let totals = control.span(Stage::Scan, || scan::scan(&mut done, params, limits))?;
    if totals.triangles == 0 {
        return Err(SurfaceError::NoSurface { isovalue: params.level() });
    }
    let surface_bricks = done.iter().map(|tile| tile.found.bricks.len() as u64).sum();
    let grid = GridStats {
        bricks: counters.bricks.into_inner(),
        surface_bricks,
        grid_points: counters.grid_points.into_inner(),
        box_cells: lattice.box_cells,
        candidates: counters.candidates.into_inner(),
        overlaps: field.overlaps(),
    };
    let pieces = pieces(&mut done);
    Ok(Scanned { lattice, field, level, tiles, done, totals, grid, pieces, quantize: params.quantize })
}

impl Scanned {
    /// Returns the lattice and frees everything else.
    fn into_lattice(self) -> Lattice {
        self.lattice
    }
}

impl Tile {
    /// Counts before the first brick of a piece of this tile, and before the first brick after it.
    fn span(&self, piece: &Piece) -> [CountsBefore; 2] {
        [self.found.before(piece.bricks.start), self.found.before(piece.bricks.end)]
    }

    /// The surface brick in `slot`: its index in the tile, and the brick with the global id of its first vertex.
    #[inline(always)]
    fn numbered(&self, slot: usize) -> Option<(usize, NumberedBrick<'_>)> {
        let [x, y, z] = slot_brick(slot);
        let ix = usize::from(self.bricks[(z * 8 + y) * 8 + x]);
        let brick = self.found.bricks.get(ix)?;
        let end = self.found.bricks.get(ix + 1).map_or(self.found.vertices, |next| next.vertex);
        let own = brick.vertex as usize..end as usize;
        let (t, edges) = (&self.found.t[own.clone()], &self.found.edges[own]);
        // `scan` checked that ids fit 32 bits.
        let first = to_u32(self.first_vertex) + brick.vertex;
        Some((ix, NumberedBrick { brick, first, t, edges }))
    }
}
