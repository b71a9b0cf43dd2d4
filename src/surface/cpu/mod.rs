//! The native CPU backend: the six stages over occupied bricks, parallel over tiles, SIMD inside.
//!
//! Order of work: `bin` assigns atoms to tiles. Then each tile (or a slab of it), in parallel, finds its bricks'
//! candidates, computes `field` into a scratch that fits the core's cache, and `classify` keeps what the surface needs:
//! crossing bits, edge parameters, cases. The field is never stored beyond a tile. `scan` numbers the tiles, `interpolate` and
//! `emit` write vertices and triangles straight to their final place.
//!
//! The same input gives the same bytes whatever the thread count: no result depends on which thread ran what.

mod bin;
mod build;
mod classify;
mod edge;
mod emit;
pub(crate) mod field;
pub(crate) mod interpolate;
mod join;
mod near;
mod pour;
#[doc(hidden)]
pub mod probe;
mod reach;
mod sample;
pub(crate) mod scan;
mod sheets;
mod slabs;
mod table;
mod tally;
mod threads;

use std::num::NonZero;
use std::ops::Range;
use std::sync::Arc;

// Errors that the occupancy count shares with this backend.
pub(crate) use self::bin::{MAX_ATOMS, samples_at_least, too_large as grid_too_large, too_many_atoms};

use self::bin::{Tiles, slot_brick};
use self::classify::{Before, Found};
use self::field::Constants;
use self::near::Numbered;
use self::sample::Pass;
use self::scan::Totals;
use super::backend::{Backend, GridStats, Meshed};
use super::candidates;
use super::control::{Control, Stage};
use super::error::SurfaceError;
use super::lattice::{Lattice, to_f32, to_u32};
use super::params::{SurfaceLimits, SurfaceParams};
use super::quantize::Step;
use super::simd;
use super::sink::{MeshSink, Poured};
use super::spheres::Spheres;

/// The native CPU backend.
#[derive(Debug)]
pub struct CpuBackend {
    /// Its own pool where a thread count was asked for; otherwise the process's.
    pool: Option<rayon::ThreadPool>,
}

/// What a run is given beside its input.
#[derive(Clone, Copy)]
struct Means<'a> {
    params: &'a SurfaceParams,
    limits: &'a SurfaceLimits,
    control: &'a Control<'a>,
    /// Threads that have nothing else to do: one where several runs share the process's.
    free_threads: usize,
}

impl CpuBackend {
    /// A backend on `threads` threads, or on as many as there are processors.
    ///
    /// # Errors
    /// The pool's, in words, where the threads cannot be started.
    pub fn new(threads: Option<usize>) -> Result<Self, String> {
        let pool = threads.map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build()).transpose();
        Ok(Self { pool: pool.map_err(|e| e.to_string())? })
    }

    /// A backend for a process that meshes once and ends: the calling thread works too, instead of waiting for a pool
    /// whose threads compete with it for the processors between the stages. It has `threads`, or as many as there are
    /// processors but not more than are `enough`.
    ///
    /// # Errors
    /// The pool's, in words, where this thread is in one already or others cannot be started.
    pub fn on_this_thread(threads: Option<usize>, enough: usize) -> Result<Self, String> {
        // Counted before this thread is held in one place, which would count as one processor.
        let processors = || std::thread::available_parallelism().map_or(1, NonZero::get);
        let n = threads.unwrap_or_else(|| processors().min(enough));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).use_current_thread();
        let homes = threads::Homes::hold().map(Arc::new);
        let pool = match homes.clone() {
            Some(homes) => pool.start_handler(move |index| begin(&homes, index)).build(),
            None => pool.build(),
        };
        if let Some(homes) = homes {
            // The others begin on this processor and leave it at once; they are not waited for.
            std::thread::yield_now();
            homes.free();
        }
        let pool = pool.map_err(|e| e.to_string())?;
        // The other threads get their memory while this one reads the file, and are awake when there is work.
        for _ in 1..pool.current_num_threads() {
            pool.spawn(warm);
        }
        Ok(Self { pool: Some(pool) })
    }

    /// Threads that a run uses.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.pool.as_ref().map_or_else(rayon::current_num_threads, rayon::ThreadPool::current_num_threads)
    }

    /// Runs `work` on its threads. Says how many of them have nothing else to do.
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

    fn run(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Meshed, SurfaceError> {
        self.install(|free_threads| run(spheres, Means { params, limits, control, free_threads }))
    }

    fn pour(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: &dyn MeshSink,
    ) -> Result<Poured, SurfaceError> {
        self.install(|free_threads| pour(spheres, Means { params, limits, control, free_threads }, sink))
    }
}

/// What a thread of a pool does first.
fn begin(homes: &threads::Homes, index: usize) {
    homes.spread(index);
    // The processor is asked for its extensions once a process: in a virtual machine that takes longer than reading a small
    // structure does.
    let _known = simd::extension();
}

/// Makes what a thread keeps from tile to tile, and the tables that all share.
fn warm() {
    sample::warm();
    pour::warm();
    emit::warm();
}

/// A tile between the stages.
#[derive(Debug)]
struct Tile {
    coord: [i32; 3],
    found: Found,
    /// Index into `found.bricks` per local brick (8 × 8 × 8), or `NO_BRICK`.
    bricks: Vec<u16>,
    first_vertex: usize,
    first_triangle: usize,
    first_brick: usize,
    first_piece: usize,
}

const NO_BRICK: u16 = u16::MAX;

/// The stages up to `scan`: everything that must be known before the first row can be written.
struct Scanned {
    lattice: Lattice,
    tiles: Tiles,
    done: Vec<Tile>,
    totals: Totals,
    grid: GridStats,
    pieces: Vec<Piece>,
    /// How vertices are rounded, if they are.
    quantize: Option<Step>,
}

/// Surface bricks of a tile whose part of the mesh is written by one thread in one go.
#[derive(Debug, Clone)]
struct Piece {
    tile: usize,
    bricks: Range<usize>,
}

/// Surface bricks of a piece: some 3,000 vertices with their triangles, a small part of the second-level cache.
const PIECE_BRICKS: usize = 32;

/// Cuts the tiles into pieces, in order.
fn pieces(done: &mut [Tile]) -> Vec<Piece> {
    let (mut pieces, mut bricks) = (Vec::new(), 0);
    for (t, tile) in done.iter_mut().enumerate() {
        let n = tile.found.bricks.len();
        (tile.first_piece, tile.first_brick) = (pieces.len(), bricks);
        bricks += n;
        let starts = (0..n).step_by(PIECE_BRICKS);
        pieces.extend(starts.map(|first| Piece { tile: t, bricks: first..n.min(first + PIECE_BRICKS) }));
    }
    pieces
}

fn scan(spheres: &Spheres, means: Means<'_>) -> Result<Scanned, SurfaceError> {
    let lattice = means.control.span(Stage::Bin, || {
        candidates::check(spheres, means.params, means.limits)?;
        if spheres.len() > bin::MAX_ATOMS {
            return Err(bin::too_many_atoms(spheres.len()));
        }
        Lattice::new(spheres, means.params)
    });
    scan_lattice(lattice?, means)
}

fn scan_lattice(lattice: Lattice, means: Means<'_>) -> Result<Scanned, SurfaceError> {
    let Means { params, limits, control, free_threads } = means;
    let tiles = control.span(Stage::Bin, || {
        let tiles = Tiles::new(&lattice, limits, control)?;
        bin::refuse_early(&lattice, &tiles, limits)?;
        Ok(tiles)
    });
    let tiles = tiles?;
    control.check()?;
    let slabs = slabs::cut(&tiles, free_threads);
    let pass = Pass {
        lattice: &lattice,
        tiles: &tiles,
        slabs: &slabs,
        unfinished: slabs::Unfinished::default(),
        constants: Constants::new(&lattice.profile, lattice.spacing),
        iso: to_f32(params.isovalue),
        params,
        limits,
        tally: sample::Tally::default(),
        control,
    };
    let sampled = threads::each(slabs.len(), |i| pass.sample(i))?;
    let tally = pass.tally;
    let mut done: Vec<(usize, Tile)> =
        slabs.iter().zip(sampled).filter_map(|(slab, tile)| Some((slab.tile, tile?))).collect();
    done.sort_unstable_by_key(|(t, _)| *t);
    let mut done: Vec<Tile> = done.into_iter().map(|(_, tile)| tile).collect();
    control.check()?;
    let totals = control.span(Stage::Scan, || scan::scan(&mut done, params, limits))?;
    if totals.triangles == 0 {
        return Err(SurfaceError::NoSurface { isovalue: params.isovalue });
    }
    let surface_bricks = done.iter().map(|tile| tile.found.bricks.len() as u64).sum();
    let grid = GridStats {
        bricks: tally.bricks.into_inner(),
        surface_bricks,
        samples: tally.samples.into_inner(),
        box_cells: lattice.box_cells,
        candidates: tally.candidates.into_inner(),
    };
    let pieces = pieces(&mut done);
    Ok(Scanned { lattice, tiles, done, totals, grid, pieces, quantize: params.quantize })
}

fn run(spheres: &Spheres, means: Means<'_>) -> Result<Meshed, SurfaceError> {
    let scanned = scan(spheres, means)?;
    let (mesh, measures) = build::build(&scanned, means.params.atom_ids, means.control)?;
    Ok(Meshed { measures, ..Meshed::new(mesh, scanned.grid) })
}

fn pour(spheres: &Spheres, means: Means<'_>, sink: &dyn MeshSink) -> Result<Poured, SurfaceError> {
    let scanned = scan(spheres, means)?;
    pour::pour(&scanned, means.control, sink)
}

impl Tile {
    /// What comes before the first brick of a piece of this tile, and before the first one after it.
    fn span(&self, piece: &Piece) -> [Before; 2] {
        [self.found.before(piece.bricks.start), self.found.before(piece.bricks.end)]
    }

    /// The surface brick in `slot`: its place among the tile's, and itself with its first vertex's global id.
    #[inline(always)]
    fn numbered(&self, slot: usize) -> Option<(usize, Numbered<'_>)> {
        let [x, y, z] = slot_brick(slot);
        let ix = usize::from(self.bricks[(z * 8 + y) * 8 + x]);
        let brick = self.found.bricks.get(ix)?;
        let end = self.found.bricks.get(ix + 1).map_or(self.found.vertices, |next| next.vertex);
        let own = brick.vertex as usize..end as usize;
        let (t, edges) = (&self.found.t[own.clone()], &self.found.edges[own]);
        // `scan` made sure that ids fit 32 bits; there are fewer bricks than vertices.
        let (id, first) = (to_u32(self.first_brick + ix), to_u32(self.first_vertex) + brick.vertex);
        Some((ix, Numbered { brick, id, first, t, edges }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_threads_than_are_enough_unless_they_are_asked_for() {
        // Each in a thread of its own, as a thread is in one pool.
        let threads = |asked, enough| {
            let made = std::thread::spawn(move || CpuBackend::on_this_thread(asked, enough).unwrap().threads());
            made.join().unwrap()
        };
        let processors = std::thread::available_parallelism().unwrap().get();
        assert_eq!(threads(None, usize::MAX), processors);
        assert_eq!(threads(None, 1), 1);
        assert_eq!(threads(Some(processors + 1), 1), processors + 1);
    }
}
