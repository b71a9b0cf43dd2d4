//! The native CPU backend: the six stages over occupied bricks, parallel over tiles, SIMD inside.
//!
//! Order of work: `bin` assigns atoms to tiles. Then each tile, in parallel, finds its bricks' candidates, computes
//! `field` into a scratch that fits the core's cache, and `classify` keeps what the surface needs: crossing bits,
//! edge parameters, cases. The field is never stored beyond a tile. `scan` numbers the tiles, `interpolate` and
//! `emit` write vertices and triangles straight to their final place.
//!
//! The same input gives the same bytes whatever the thread count: no result depends on which thread ran what.

mod bin;
mod classify;
mod emit;
mod field;
mod interpolate;
mod scan;

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use rayon::prelude::*;

use self::bin::{Bricks, SIDE, SLOTS, Tiles, slot_brick, slot_origin};
use self::classify::{Around, Found, Inside};
use self::emit::{IdTable, Numbered};
use self::field::{Constants, Need, Samples};
use self::interpolate::{Batch, SlopeConstants, Target};
use super::backend::{Backend, GridStats, Meshed};
use super::column::Column;
use super::control::{Control, Stage};
use super::error::SurfaceError;
use super::lattice::{BRICK_SAMPLES, Lattice, to_f32};
use super::mesh::Mesh;
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
    first_vertex: u64,
    first_triangle: u64,
}

const NO_BRICK: u16 = u16::MAX;

/// What one thread keeps from tile to tile.
struct Scratch {
    bricks: Bricks,
    fields: Vec<Samples>,
    inside: Vec<Inside>,
    /// Index into `fields` per slot, or `NO_BRICK`.
    slots: Vec<u16>,
}

impl Default for Scratch {
    fn default() -> Self {
        Self { bricks: Bricks::default(), fields: Vec::new(), inside: Vec::new(), slots: vec![NO_BRICK; SLOTS] }
    }
}

/// Counters that the tiles add to.
#[derive(Default)]
struct Tally {
    bricks: AtomicU64,
    samples: AtomicU64,
    candidates: AtomicU64,
    mesh_bytes: AtomicU64,
    tiles_done: AtomicUsize,
}

impl Tally {
    /// What all `n` tiles will have, going by what the finished ones have.
    fn all_tiles(&self, so_far: u64, n: usize) -> u64 {
        let done = self.tiles_done.load(Ordering::Relaxed) + 1;
        so_far / done as u64 * n as u64
    }
}

/// A spacing a little above `spacing`, rounded up to hundredths of an Å: a suggestion that fits.
fn roomier(spacing: f64) -> f64 {
    (spacing * 1.05 * 100.0).ceil() / 100.0
}

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
        Ok((lattice, tiles))
    });
    let (lattice, tiles) = binned?;
    control.check()?;
    let tally = Tally::default();
    let iso = to_f32(params.isovalue);
    let constants = Constants::new(&lattice.profile, lattice.spacing);
    let mut done: Vec<Tile> = (0..tiles.len())
        .into_par_iter()
        .map_init(Scratch::default, |scratch, t| {
            let tile = sample_tile(&lattice, &tiles, t, &constants, iso, scratch, limits, &tally, control)?;
            let n = tally.tiles_done.fetch_add(1, Ordering::Relaxed) + 1;
            control.observer.progress(Stage::Field, n, tiles.len());
            Ok(tile)
        })
        .collect::<Result<_, SurfaceError>>()?;
    control.check()?;
    let totals = control.span(Stage::Scan, || scan::scan(&mut done, lattice.spacing, limits))?;
    if totals.triangles == 0 {
        return Err(SurfaceError::NoSurface { isovalue: params.isovalue });
    }
    let mesh = build(&lattice, &tiles, &done, totals, params.atom_ids, control)?;
    let surface_bricks = done.iter().map(|tile| tile.found.bricks.len() as u64).sum();
    let grid = GridStats {
        bricks: tally.bricks.into_inner(),
        surface_bricks,
        samples: tally.samples.into_inner(),
        box_cells: lattice.box_cells,
        candidates: tally.candidates.into_inner(),
    };
    Ok(Meshed { mesh, grid })
}

/// `bin` within the tile, `field` and `classify` for one tile.
#[expect(clippy::too_many_arguments, reason = "one call site; a struct of the same fields would only rename them")]
fn sample_tile(
    lattice: &Lattice,
    tiles: &Tiles,
    t: usize,
    constants: &Constants,
    iso: f32,
    scratch: &mut Scratch,
    limits: &SurfaceLimits,
    tally: &Tally,
    control: &Control<'_>,
) -> Result<Tile, SurfaceError> {
    control.check()?;
    let coord = tiles.coords[t];
    let Scratch { bricks, fields, inside, slots } = scratch;
    control.span(Stage::Bin, || bricks.fill(lattice, coord, tiles.atoms(t)));
    let occupied = count_occupied(bricks, tally);
    let samples = tally.samples.fetch_add(occupied * 512, Ordering::Relaxed) + occupied * 512;
    if samples > limits.max_samples {
        return Err(bin::too_large(lattice, tally.all_tiles(samples, tiles.len()), limits));
    }
    control.span(Stage::Field, || {
        slots.fill(NO_BRICK);
        let mut used = 0;
        for slot in 0..SLOTS {
            if bricks.reaching[slot] == 0 {
                continue;
            }
            if used == fields.len() {
                fields.push([0.0; BRICK_SAMPLES]);
            }
            slots[slot] = used as u16;
            let [_, y, z] = slot_brick(slot);
            let layers = |k: usize, all: usize| if k == SIDE - 1 { 1 } else { all };
            let need = Need { y_pairs: layers(y, 4), z_layers: layers(z, 8) };
            let field = &mut fields[used];
            field.fill(0.0);
            field::evaluate(constants, &lattice.atoms, bricks.of(slot), slot_origin(coord, slot), need, field);
            used += 1;
        }
        fields.truncate(used.max(64));
    });
    let (found, local) = control.span(Stage::Classify, || {
        inside.clear();
        inside.extend(fields.iter().map(|field| classify::inside_bits(field, iso)));
        classify_tile(bricks, fields, inside, slots, iso)
    });
    let bytes = Mesh::bytes_for(u64::from(found.vertices), u64::from(found.triangles));
    let so_far = tally.mesh_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
    if so_far > limits.max_mesh_bytes {
        return Err(scan::too_large(tally.all_tiles(so_far, tiles.len()), lattice.spacing, limits.max_mesh_bytes));
    }
    Ok(Tile { coord, found, bricks: local, first_vertex: 0, first_triangle: 0 })
}

/// Counts the tile's own bricks that some atom reaches.
fn count_occupied(bricks: &Bricks, tally: &Tally) -> u64 {
    let own = (0..SLOTS).filter(|&slot| slot_brick(slot).iter().all(|&b| b < SIDE - 1));
    let (mut occupied, mut pairs) = (0, 0);
    for slot in own {
        occupied += u64::from(bricks.reaching[slot] > 0);
        pairs += u64::from(bricks.reaching[slot]);
    }
    tally.bricks.fetch_add(occupied, Ordering::Relaxed);
    tally.candidates.fetch_add(pairs, Ordering::Relaxed);
    occupied
}

/// Classifies every brick of a tile that has, or borders on, samples in reach of an atom.
fn classify_tile(bricks: &Bricks, fields: &[Samples], inside: &[Inside], slots: &[u16], iso: f32) -> (Found, Vec<u16>) {
    const NOWHERE: Inside = [0; 8];
    const NOTHING: Samples = [0.0; BRICK_SAMPLES];
    let mut found = Found::default();
    let mut local = vec![NO_BRICK; BRICK_SAMPLES];
    for (at, entry) in local.iter_mut().enumerate() {
        let [x, y, z] = [at % 8, at / 8 % 8, at / 64];
        let slot = (z * SIDE + y) * SIDE + x;
        let near: [usize; 8] =
            std::array::from_fn(|n| usize::from(slots[slot + ((n >> 2 & 1) * SIDE + (n >> 1 & 1)) * SIDE + (n & 1)]));
        let around = Around {
            inside: near.map(|i| inside.get(i).unwrap_or(&NOWHERE)),
            samples: near.map(|i| fields.get(i).unwrap_or(&NOTHING)),
        };
        if around.inside.iter().all(|bits| **bits == NOWHERE) {
            continue;
        }
        let n = found.bricks.len();
        found.add(slot, &around, iso, bricks.of(slot));
        if found.bricks.len() > n {
            *entry = n as u16;
        }
    }
    (found, local)
}

/// `interpolate` and `emit`: every tile writes its own part of the mesh.
fn build(
    lattice: &Lattice,
    tiles: &Tiles,
    done: &[Tile],
    totals: scan::Totals,
    atom_ids: bool,
    control: &Control<'_>,
) -> Result<Mesh, SurfaceError> {
    let mut mesh = Mesh {
        centre: lattice.centre(),
        positions: Column::zeroed(totals.vertices),
        normals: Column::zeroed(totals.vertices),
        triangles: Column::zeroed(totals.triangles),
        atom_ids: atom_ids.then(|| Column::zeroed(totals.vertices)),
        colors: None,
        parts: done.iter().map(|tile| (tile.first_vertex as usize, tile.first_triangle as usize)).collect(),
    };
    let mut work = Vec::with_capacity(done.len());
    let (mut positions, mut normals) = (&mut mesh.positions[..], &mut mesh.normals[..]);
    let (mut triangles, mut ids) = (&mut mesh.triangles[..], mesh.atom_ids.as_deref_mut());
    for tile in done {
        let (n, m) = (tile.found.vertices as usize, tile.found.triangles as usize);
        let part = TilePart {
            tile,
            positions: take(&mut positions, n),
            normals: take(&mut normals, n),
            triangles: take(&mut triangles, m),
            atom_ids: ids.as_mut().map(|ids| take(ids, n)),
        };
        work.push(part);
    }
    let slope = SlopeConstants::new(&lattice.profile, lattice.spacing);
    let finished = AtomicUsize::new(0);
    let flat: usize = work
        .into_par_iter()
        .map_init(
            || (Batch::default(), IdTable::default()),
            |(batch, table), mut part| {
                control.check()?;
                let flat = control.span(Stage::Interpolate, || part.interpolate(lattice, &slope, batch));
                control.span(Stage::Emit, || part.emit(tiles, done, table));
                let n = finished.fetch_add(1, Ordering::Relaxed) + 1;
                control.observer.progress(Stage::Emit, n, done.len());
                Ok(flat)
            },
        )
        .sum::<Result<usize, SurfaceError>>()?;
    if flat > 0 {
        control.span(Stage::Interpolate, || mesh.fill_flat_normals());
    }
    Ok(mesh)
}

/// Splits the first `n` rows off.
fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(rest).split_at_mut(n);
    *rest = tail;
    head
}

/// A tile with its part of the mesh.
struct TilePart<'a> {
    tile: &'a Tile,
    positions: &'a mut [[f32; 3]],
    normals: &'a mut [[f32; 3]],
    triangles: &'a mut [[u32; 3]],
    atom_ids: Option<&'a mut [u32]>,
}

impl TilePart<'_> {
    /// Vertices of the tile's bricks. Returns how many have no gradient.
    fn interpolate(&mut self, lattice: &Lattice, slope: &SlopeConstants, batch: &mut Batch) -> usize {
        let found = &self.tile.found;
        let mut flat = 0;
        for (i, brick) in found.bricks.iter().enumerate() {
            let end = found.bricks.get(i + 1).map_or(found.vertices, |next| next.vertex);
            let rows = brick.vertex as usize..end as usize;
            if rows.is_empty() {
                continue;
            }
            let candidates = &found.candidates[brick.candidates[0] as usize..brick.candidates[1] as usize];
            let target = Target {
                positions: &mut self.positions[rows.clone()],
                normals: &mut self.normals[rows.clone()],
                atom_ids: self.atom_ids.as_deref_mut().map(|ids| &mut ids[rows.clone()]),
            };
            flat += interpolate::interpolate(
                lattice,
                slope,
                self.tile.coord,
                brick,
                candidates,
                &found.t[rows],
                batch,
                target,
            );
        }
        flat
    }

    /// Triangles of the tile's bricks.
    fn emit(&mut self, tiles: &Tiles, done: &[Tile], table: &mut IdTable) {
        // The tile itself and its neighbours towards +x, +y, +z.
        let near: [Option<&Tile>; 8] = std::array::from_fn(|n| {
            let coord = std::array::from_fn(|k| self.tile.coord[k] + (n >> k & 1) as i32);
            tiles.index.get(&coord).map(|&t| &done[t as usize])
        });
        let found = &self.tile.found;
        for (i, brick) in found.bricks.iter().enumerate() {
            let around: [Numbered<'_>; 8] = std::array::from_fn(|n| {
                let (slot, beyond) = emit::neighbour_slot(usize::from(brick.slot), n);
                near[beyond[0] | beyond[1] << 1 | beyond[2] << 2].and_then(|tile| tile.numbered(slot))
            });
            let end =
                found.bricks.get(i + 1).map_or((found.triangles, found.cases.len()), |n| (n.triangle, n.case as usize));
            let cases = &found.cases[brick.case as usize..end.1];
            emit::emit(table, &around, cases, &mut self.triangles[brick.triangle as usize..end.0 as usize]);
        }
    }
}

impl Tile {
    /// The surface brick in `slot` with its first vertex's global id.
    fn numbered(&self, slot: usize) -> Numbered<'_> {
        let [x, y, z] = slot_brick(slot);
        let brick = self.found.bricks.get(usize::from(self.bricks[(z * 8 + y) * 8 + x]))?;
        // `scan` made sure that ids fit 32 bits.
        Some((brick, (self.first_vertex as u32).wrapping_add(brick.vertex)))
    }
}
