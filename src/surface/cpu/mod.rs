//! The native CPU backend: the six stages over occupied bricks, parallel over tiles, SIMD inside.
//!
//! Order of work: `bin` assigns atoms to tiles. Then each tile, in parallel, finds its bricks' candidates, computes
//! `field` into a scratch that fits the core's cache, and `classify` keeps what the surface needs: crossing bits,
//! edge parameters, cases. The field is never stored beyond a tile. `scan` numbers the tiles, `interpolate` and
//! `emit` write vertices and triangles straight to their final place.
//!
//! The same input gives the same bytes whatever the thread count: no result depends on which thread ran what.

mod bin;
mod build;
mod classify;
mod emit;
mod field;
mod interpolate;
#[doc(hidden)]
pub mod probe;
mod sample;
mod scan;

// What the plan of a device's work shares with this backend: formulas, refusals and their numbers.
pub(super) use self::bin::{MAX_ATOMS, samples_at_least, too_large as grid_too_large, too_many_atoms};
pub(super) use self::field::Constants;
pub(super) use self::interpolate::SlopeConstants;
pub(super) use self::scan::too_large as mesh_too_large;

use rayon::prelude::*;

use self::bin::{Tiles, slot_brick};
use self::classify::Found;
use self::emit::Numbered;
use self::sample::{Pass, Tally};
use super::backend::{Backend, GridStats, Meshed};
use super::control::{Control, Stage};
use super::error::SurfaceError;
use super::lattice::{Lattice, to_f32, to_u32};
use super::params::{SurfaceLimits, SurfaceParams};
use super::simd;
use super::spheres::Spheres;

/// The native CPU backend.
#[derive(Debug)]
pub struct CpuBackend {
    /// Its own pool where a thread count was asked for; otherwise the process's.
    pool: Option<rayon::ThreadPool>,
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
    /// whose threads compete with it for the processors between the stages.
    ///
    /// # Errors
    /// The pool's, in words, where it exists already or its threads cannot be started.
    pub fn on_this_thread(threads: Option<usize>) -> Result<Self, String> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.unwrap_or(0)).use_current_thread();
        pool.build_global().map_err(|e| e.to_string())?;
        Ok(Self { pool: None })
    }

    /// Threads that a run uses.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.pool.as_ref().map_or_else(rayon::current_num_threads, rayon::ThreadPool::current_num_threads)
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
        match &self.pool {
            Some(pool) => pool.install(|| run(spheres, params, limits, control)),
            None => run(spheres, params, limits, control),
        }
    }
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
}

const NO_BRICK: u16 = u16::MAX;

fn run(
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<Meshed, SurfaceError> {
    let binned = control.span(Stage::Bin, || {
        if spheres.len() > bin::MAX_ATOMS {
            return Err(bin::too_many_atoms(spheres.len()));
        }
        let lattice = Lattice::new(spheres, params)?;
        let tiles = Tiles::new(&lattice, limits, control)?;
        bin::refuse_early(&lattice, &tiles, limits)?;
        Ok((lattice, tiles))
    });
    let (lattice, tiles) = binned?;
    control.check()?;
    let pass = Pass {
        lattice: &lattice,
        tiles: &tiles,
        constants: Constants::new(&lattice.profile, lattice.spacing),
        iso: to_f32(params.isovalue),
        limits,
        tally: Tally::default(),
        control,
    };
    let mut done: Vec<Tile> =
        (0..tiles.len()).into_par_iter().with_max_len(1).map(|t| pass.sample(t)).collect::<Result<_, _>>()?;
    control.check()?;
    let totals = control.span(Stage::Scan, || scan::scan(&mut done, lattice.spacing, limits))?;
    if totals.triangles == 0 {
        return Err(SurfaceError::NoSurface { isovalue: params.isovalue });
    }
    let mesh = build::build(&lattice, &tiles, &done, totals, params.atom_ids, control)?;
    let tally = pass.tally;
    let surface_bricks = done.iter().map(|tile| tile.found.bricks.len() as u64).sum();
    let grid = GridStats {
        bricks: tally.bricks.into_inner(),
        surface_bricks,
        samples: tally.samples.into_inner(),
        box_cells: lattice.box_cells,
        candidates: tally.candidates.into_inner(),
    };
    Ok(Meshed::new(mesh, grid))
}

impl Tile {
    /// The surface brick in `slot` with its first vertex's global id.
    fn numbered(&self, slot: usize) -> Numbered<'_> {
        let [x, y, z] = slot_brick(slot);
        let brick = self.found.bricks.get(usize::from(self.bricks[(z * 8 + y) * 8 + x]))?;
        // `scan` made sure that ids fit 32 bits.
        Some((brick, to_u32(self.first_vertex) + brick.vertex))
    }
}
