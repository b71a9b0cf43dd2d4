//! First pass over a tile, or a slab of it. Finds the candidates of its bricks, evaluates `field` in a scratch buffer,
//! and keeps the results of `classify`, refined for surfaces of spheres.

use std::cell::RefCell;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use super::bin::{Bricks, SIDE, SLOTS, Tiles, slot_brick, slot_origin};
use super::classify::{self, ClassifiedBricks, Inside, Neighbourhood};
use super::distance::DistanceField;
use super::field::{self, BrickField, GridPointRange};
use super::slabs::{PartialTiles, Slab};
use super::{Field, NO_BRICK, RunContext, Tile, scan};
use crate::control::Stage;
use crate::error::SurfaceError;
use crate::lattice::{BRICK_POINTS, Lattice};
use crate::memory::{MemoryMeter as _, Reservation};
use crate::sphere_union::BrickUnion;
use crate::{candidates, grid_limit};

/// Buffers that a thread reuses from tile to tile.
struct TileScratch {
    bricks: Bricks,
    /// Arcs of the boundary near the bricks, for surfaces of spheres.
    arcs: Bricks,
    spheres: BrickUnion,
    /// Two layers of bricks, with even and odd z: only two are needed at a time.
    layers: [Layer; 2],
    /// Index into its layer per slot, or `NO_BRICK`.
    slots: Vec<u16>,
}

/// Densities of a brick, aligned to cache lines, so that no vector crosses a boundary between two lines.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct AlignedField(BrickField);

/// Densities and inside bits of the bricks of a layer in reach of an atom.
#[derive(Default)]
struct Layer {
    fields: Vec<AlignedField>,
    inside: Vec<Inside>,
    /// The bricks with grid points inside: row y, bit x.
    rows: [u16; SIDE],
}

impl Default for TileScratch {
    fn default() -> Self {
        Self {
            bricks: Bricks::default(),
            arcs: Bricks::default(),
            spheres: BrickUnion::default(),
            layers: Default::default(),
            slots: vec![NO_BRICK; SLOTS],
        }
    }
}

/// Candidates of a brick between two checks of the cancellation flag: a fraction of a millisecond.
const CANDIDATES_PER_CHECK: usize = 4096;
/// Memory of a tile's table of bricks, bytes.
const TILE_BYTES: u64 = (size_of::<u16>() * BRICK_POINTS) as u64;

thread_local! {
    // Thread-local, because rayon would create a scratch for each part of the work. Allocating fresh memory takes
    // longer than filling it.
    static SCRATCH: RefCell<TileScratch> = RefCell::default();
}

impl Layer {
    /// Extends the layer to `n` bricks.
    fn grow(&mut self, n: usize) {
        if self.fields.len() < n {
            // Reserves the maximum once: growing would copy, and untouched memory costs nothing.
            self.fields.reserve_exact(SIDE * SIDE - self.fields.len());
            self.fields.resize(n, AlignedField([0.0; BRICK_POINTS]));
        }
    }
}

/// Counters over all tiles.
#[derive(Default)]
pub(super) struct PassCounters {
    pub(super) bricks: AtomicU64,
    pub(super) grid_points: AtomicU64,
    pub(super) candidates: AtomicU64,
    candidate_pairs: AtomicU64,
    mesh_bytes: AtomicU64,
    slabs_done: AtomicUsize,
}

impl PassCounters {
    /// Extrapolates a count of the finished slabs to all `n` slabs.
    fn all_slabs(&self, so_far: u64, n: usize) -> u64 {
        let done = self.slabs_done.load(Ordering::Relaxed) + 1;
        so_far / done as u64 * n as u64
    }
}

/// Shared inputs and counters of the first pass over all tiles.
pub(super) struct Pass<'a> {
    pub(super) lattice: &'a Lattice,
    pub(super) tiles: &'a Tiles,
    pub(super) slabs: &'a [Slab],
    pub(super) partial_tiles: PartialTiles,
    pub(super) field: &'a Field,
    pub(super) iso: f32,
    pub(super) context: RunContext<'a>,
    pub(super) counters: PassCounters,
}

impl Pass<'_> {
    /// Runs `bin`, `field`, `classify` and, for surfaces of spheres, `refine` for the `i`th slab. Returns its tile once
    /// all slabs of the tile are finished.
    ///
    /// # Errors
    /// Returns [`SurfaceError::Limit`] as soon as the slabs so far exceed a limit, and [`SurfaceError::Cancelled`].
    pub(super) fn evaluate(&self, i: usize) -> Result<Option<Tile>, SurfaceError> {
        self.context.control.check()?;
        let slab = &self.slabs[i];
        let tile = SCRATCH.with_borrow_mut(|scratch| {
            let tile = self.evaluate_into(slab, scratch);
            scratch.bricks.free_long_lists();
            scratch.arcs.free_long_lists();
            tile
        })?;
        let tile = self.context.control.span(Stage::Classify, || self.partial_tiles.add(slab, tile));
        let n = self.counters.slabs_done.fetch_add(1, Ordering::Relaxed) + 1;
        self.context.control.observer.progress(Stage::Field, n, self.slabs.len());
        Ok(tile)
    }

    /// Counts `n` more candidate pairs, and their memory in the tile's lists.
    fn count(&self, n: u64, memory: &Reservation) -> Result<(), SurfaceError> {
        self.context.control.check()?;
        memory.grow(size_of::<u32>() as u64 * n)?;
        let all = self.counters.candidate_pairs.fetch_add(n, Ordering::Relaxed) + n;
        if all > candidates::limit(self.context.limits) {
            return Err(candidates::exceeded(&[self.lattice], all, self.context.limits));
        }
        Ok(())
    }

    fn evaluate_into(&self, slab: &Slab, scratch: &mut TileScratch) -> Result<Tile, SurfaceError> {
        let memory = Reservation::new(&self.context.control.memory);
        let (coord, counters, layers) = (self.tiles.coords[slab.tile], &self.counters, &slab.layers);
        let atoms = self.tiles.atoms(slab.tile);
        self.context
            .control
            .span(Stage::Bin, || scratch.bricks.fill(self.lattice, coord, layers, atoms, |n| self.count(n, &memory)))?;
        match self.field {
            Field::Density(_) => scratch.arcs.clear(),
            Field::Distance(field) => {
                let count = |n| self.count(n, &memory);
                self.context.control.span(Stage::Bin, || field.fill_arcs(&mut scratch.arcs, coord, layers, count))?;
            }
        }
        let reached = count_occupied(&scratch.bricks, layers, counters);
        let occupied = reached as u64 * BRICK_POINTS as u64;
        let grid_points = counters.grid_points.fetch_add(occupied, Ordering::Relaxed) + occupied;
        if grid_points > self.context.limits.max_grid_points {
            let all = counters.all_slabs(grid_points, self.slabs.len());
            return Err(grid_limit::exceeded(self.lattice.spacing, all, 1, self.context.limits));
        }
        memory.grow(TILE_BYTES + ClassifiedBricks::max_bytes(reached))?;
        let mut bricks = vec![NO_BRICK; BRICK_POINTS];
        let mut found = ClassifiedBricks::with_capacity(reached);
        for z in layers.start..=layers.end {
            self.context.control.span(Stage::Field, || scratch.evaluate(self, coord, layers, z))?;
            if z > layers.start {
                self.context.control.span(Stage::Classify, || scratch.classify(self, z - 1, &mut found, &mut bricks));
                if let Field::Distance(field) = self.field {
                    self.context
                        .control
                        .span(Stage::Refine, || scratch.refine(self, field, coord, z - 1, &mut found))?;
                }
            }
        }
        self.context.control.span(Stage::Classify, || found.shrink_to_fit());
        self.context.control.memory.grow(TILE_BYTES + found.bytes())?;
        drop(memory);
        let bytes = self.context.params.mesh_bytes(u64::from(found.vertices), u64::from(found.triangles));
        let so_far = counters.mesh_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        if so_far > self.context.limits.max_mesh_bytes {
            let all = counters.all_slabs(so_far, self.slabs.len());
            return Err(scan::too_large(all, self.lattice.spacing, self.context.limits.max_mesh_bytes));
        }
        Ok(Tile { coord, found, bricks, first_vertex: 0, first_triangle: 0, first_piece: 0 })
    }
}

impl TileScratch {
    /// Evaluates the densities of every brick of layer z in reach of an atom; z is at most the layer beyond the slab's
    /// `own`, of which only the first grid points are needed.
    ///
    /// # Errors
    /// Returns [`SurfaceError::Cancelled`].
    fn evaluate(&mut self, pass: &Pass<'_>, tile: [i32; 3], own: &Range<usize>, z: usize) -> Result<(), SurfaceError> {
        let Self { bricks, arcs, spheres, layers, slots } = self;
        let layer = &mut layers[z % 2];
        let mut n = 0;
        for (slot, index) in slots.iter_mut().enumerate().skip(z * SIDE * SIDE).take(SIDE * SIDE) {
            *index = NO_BRICK;
            if bricks.reaching[slot] == 0 {
                continue;
            }
            layer.grow(n + 1);
            let AlignedField(field) = &mut layer.fields[n];
            let [_, y, _] = slot_brick(slot);
            let rows = |beyond: bool, all: usize| if beyond { 1 } else { all };
            let range = GridPointRange { y_pairs: rows(y == SIDE - 1, 4), z_layers: rows(z == own.end, 8) };
            field.fill(0.0);
            let (atoms, origin) = (&pass.lattice.atoms, slot_origin(tile, slot));
            match pass.field {
                Field::Density(constants) => {
                    for candidates in bricks.of(slot).chunks(CANDIDATES_PER_CHECK) {
                        pass.context.control.check()?;
                        field::evaluate(constants, atoms, candidates, origin, range, field);
                    }
                }
                Field::Distance(distance) => {
                    pass.context.control.check()?;
                    distance.load(spheres, atoms, bricks.of(slot), arcs.of(slot), origin);
                    distance.evaluate(spheres, range, field);
                }
            }
            // A layer has 81 bricks.
            *index = u16::try_from(n).unwrap_or(NO_BRICK);
            n += 1;
        }
        layer.inside.clear();
        layer.inside.extend(layer.fields[..n].iter().map(|AlignedField(field)| classify::inside_bits(field, pass.iso)));
        for (row, slots) in layer.rows.iter_mut().zip(slots[z * SIDE * SIDE..].chunks(SIDE)) {
            let inside = |slot: &u16| layer.inside.get(usize::from(*slot)).is_some_and(|bits| *bits != NONE_INSIDE);
            *row = slots.iter().rev().fold(0, |row, slot| row << 1 | u16::from(inside(slot)));
        }
        Ok(())
    }

    /// Classifies every brick of layer z that has, or borders on, grid points inside; requires the layer above to be
    /// the last one evaluated. Writes the index of each local brick's record to `local`.
    fn classify(&self, pass: &Pass<'_>, z: usize, found: &mut ClassifiedBricks, local: &mut [u16]) {
        for y in 0..SIDE - 1 {
            let rows = self.layers.iter().fold(0, |rows, layer| rows | layer.rows[y] | layer.rows[y + 1]);
            let mut left = (rows | rows >> 1) & ((1 << (SIDE - 1)) - 1);
            while left != 0 {
                let x = left.trailing_zeros() as usize;
                left &= left - 1;
                let slot = (z * SIDE + y) * SIDE + x;
                let around = neighbourhood(&self.layers, &self.slots, slot);
                if let Some(record) = found.add(slot, &around, pass.iso, self.bricks.of(slot)) {
                    local[(z * 8 + y) * 8 + x] = record;
                }
            }
        }
    }

    /// Moves the vertices of layer z, which was classified last, to the surface.
    ///
    /// # Errors
    /// Returns [`SurfaceError::Cancelled`].
    fn refine(
        &mut self,
        pass: &Pass<'_>,
        field: &DistanceField,
        tile: [i32; 3],
        z: usize,
        found: &mut ClassifiedBricks,
    ) -> Result<(), SurfaceError> {
        let Self { bricks, arcs, spheres, layers, slots } = self;
        let first = found.bricks.partition_point(|brick| usize::from(brick.slot) < z * SIDE * SIDE);
        for ix in first..found.bricks.len() {
            pass.context.control.check()?;
            let slot = usize::from(found.bricks[ix].slot);
            let vertices = found.before(ix).vertices..found.before(ix + 1).vertices;
            field.load(spheres, &pass.lattice.atoms, bricks.of(slot), arcs.of(slot), slot_origin(tile, slot));
            field.refine(spheres, &neighbourhood(layers, slots, slot).fields, vertices, found);
        }
        Ok(())
    }
}

/// Returns the inside bits and the fields of the brick in a slot and of its neighbours.
fn neighbourhood<'a>(layers: &'a [Layer; 2], slots: &[u16], slot: usize) -> Neighbourhood<'a> {
    const NOTHING: &BrickField = &[0.0; BRICK_POINTS];
    let z = slot / (SIDE * SIDE);
    let near: [(usize, &Layer); 8] =
        std::array::from_fn(|n| (usize::from(slots[slot + NEIGHBOUR[n]]), &layers[(z + (n >> 2)) % 2]));
    Neighbourhood {
        inside: near.map(|(i, layer)| layer.inside.get(i).unwrap_or(&NONE_INSIDE)),
        fields: near.map(|(i, layer)| layer.fields.get(i).map_or(NOTHING, |AlignedField(field)| field)),
    }
}

/// Inside bits of a brick without grid points inside.
const NONE_INSIDE: Inside = [0; 8];

/// Distance in slots to the neighbour towards +x (bit 0), +y (bit 1), +z (bit 2).
const NEIGHBOUR: [usize; 8] =
    [0, 1, SIDE, SIDE + 1, SIDE * SIDE, SIDE * SIDE + 1, SIDE * SIDE + SIDE, SIDE * SIDE + SIDE + 1];

/// Counts the slab's own bricks in reach of an atom.
fn count_occupied(bricks: &Bricks, layers: &Range<usize>, counters: &PassCounters) -> usize {
    let slots = layers.start * SIDE * SIDE..layers.end * SIDE * SIDE;
    let own = slots.filter(|&slot| slot_brick(slot)[..2].iter().all(|&b| b < SIDE - 1));
    let (mut occupied, mut pairs) = (0, 0);
    for slot in own {
        occupied += usize::from(bricks.reaching[slot] > 0);
        pairs += u64::from(bricks.reaching[slot]);
    }
    counters.bricks.fetch_add(occupied as u64, Ordering::Relaxed);
    counters.candidates.fetch_add(pairs, Ordering::Relaxed);
    occupied
}
