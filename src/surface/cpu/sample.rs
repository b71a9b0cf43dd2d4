//! The first pass over a tile: its bricks' candidates, the `field` in a scratch, and what `classify` keeps of it.

use std::cell::RefCell;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use super::bin::{self, Bricks, SIDE, SLOTS, Tiles, slot_brick, slot_origin};
use super::classify::{self, Around, Found, Inside};
use super::field::{self, Constants, Need, Samples};
use super::{NO_BRICK, Tile, scan};
use crate::surface::control::{Control, Stage};
use crate::surface::error::SurfaceError;
use crate::surface::lattice::{BRICK_SAMPLES, Lattice};
use crate::surface::params::{SurfaceLimits, SurfaceParams};

/// What one thread keeps from tile to tile.
struct Scratch {
    bricks: Bricks,
    fields: Vec<Samples>,
    inside: Vec<Inside>,
    /// Index into `fields` per slot, or `NO_BRICK`.
    slots: Vec<u16>,
    /// What `classify` appends to; a tile takes a copy of the right size with it.
    found: Found,
}

impl Default for Scratch {
    fn default() -> Self {
        Self {
            bricks: Bricks::default(),
            fields: Vec::new(),
            inside: Vec::new(),
            slots: vec![NO_BRICK; SLOTS],
            found: Found::default(),
        }
    }
}

thread_local! {
    // Rayon hands out work in pieces and would make a scratch for each; fresh memory costs more than filling it.
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Fields of a tile of a small structure: more would cost a small structure more than it saves a large one.
const WARM_FIELDS: usize = 192;

/// Makes the calling thread's scratch.
pub(super) fn warm() {
    SCRATCH.with_borrow_mut(|scratch| scratch.fields.resize(WARM_FIELDS, [0.0; BRICK_SAMPLES]));
}

/// Counters that the tiles add to.
#[derive(Default)]
pub(super) struct Tally {
    pub(super) bricks: AtomicU64,
    pub(super) samples: AtomicU64,
    pub(super) candidates: AtomicU64,
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

/// What the first pass over every tile shares.
pub(super) struct Pass<'a> {
    pub(super) lattice: &'a Lattice,
    pub(super) tiles: &'a Tiles,
    pub(super) constants: Constants,
    pub(super) iso: f32,
    pub(super) params: &'a SurfaceParams,
    pub(super) limits: &'a SurfaceLimits,
    pub(super) tally: Tally,
    pub(super) control: &'a Control<'a>,
}

impl Pass<'_> {
    /// `bin` within tile `t`, `field` and `classify`.
    ///
    /// # Errors
    /// [`SurfaceError::GridTooLarge`], [`SurfaceError::MeshTooLarge`] as soon as the tiles so far exceed a limit, and
    /// [`SurfaceError::Cancelled`].
    pub(super) fn sample(&self, t: usize) -> Result<Tile, SurfaceError> {
        self.control.check()?;
        let tile = SCRATCH.with_borrow_mut(|scratch| self.sample_into(t, scratch))?;
        let n = self.tally.tiles_done.fetch_add(1, Ordering::Relaxed) + 1;
        self.control.observer.progress(Stage::Field, n, self.tiles.len());
        Ok(tile)
    }

    fn sample_into(&self, t: usize, scratch: &mut Scratch) -> Result<Tile, SurfaceError> {
        let (coord, tally) = (self.tiles.coords[t], &self.tally);
        self.control.span(Stage::Bin, || bin::fill(&mut scratch.bricks, self.lattice, coord, self.tiles.atoms(t)));
        let occupied = count_occupied(&scratch.bricks, tally) * BRICK_SAMPLES as u64;
        let samples = tally.samples.fetch_add(occupied, Ordering::Relaxed) + occupied;
        if samples > self.limits.max_samples {
            return Err(bin::too_large(self.lattice, tally.all_tiles(samples, self.tiles.len()), self.limits));
        }
        self.control.span(Stage::Field, || scratch.evaluate(self, coord));
        let (found, bricks) = self.control.span(Stage::Classify, || scratch.classify(self.iso));
        let bytes = self.params.mesh_bytes(u64::from(found.vertices), u64::from(found.triangles));
        let so_far = tally.mesh_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        if so_far > self.limits.max_mesh_bytes {
            let all = tally.all_tiles(so_far, self.tiles.len());
            return Err(scan::too_large(all, self.lattice.spacing, self.limits.max_mesh_bytes));
        }
        Ok(Tile { coord, found, bricks, first_vertex: 0, first_triangle: 0, first_piece: 0 })
    }
}

impl Scratch {
    /// The densities of every brick of the tile, and of the layer beyond, that some atom reaches.
    fn evaluate(&mut self, pass: &Pass<'_>, tile: [i32; 3]) {
        let Self { bricks, fields, slots, .. } = self;
        fields.resize(bricks.reaching.iter().filter(|&&n| n > 0).count(), [0.0; BRICK_SAMPLES]);
        slots.fill(NO_BRICK);
        let occupied = slots.iter_mut().enumerate().filter(|(slot, _)| bricks.reaching[*slot] > 0);
        for ((n, field), (slot, index)) in (0..).zip(fields).zip(occupied) {
            *index = n;
            let [_, y, z] = slot_brick(slot);
            let layers = |k: usize, all: usize| if k == SIDE - 1 { 1 } else { all };
            let need = Need { y_pairs: layers(y, 4), z_layers: layers(z, 8) };
            let origin = slot_origin(tile, slot);
            field.fill(0.0);
            field::evaluate(&pass.constants, &pass.lattice.atoms, bricks.of(slot), origin, need, field);
        }
    }

    /// Classifies every brick of the tile that has, or borders on, samples in reach of an atom. Also tells where each
    /// local brick's record is, or `NO_BRICK`.
    fn classify(&mut self, iso: f32) -> (Found, Vec<u16>) {
        const NOWHERE: Inside = [0; 8];
        const NOTHING: Samples = [0.0; BRICK_SAMPLES];
        let Self { bricks, fields, inside, slots, found } = self;
        inside.clear();
        inside.extend(fields.iter().map(|field| classify::inside_bits(field, iso)));
        found.clear();
        let mut local = vec![NO_BRICK; BRICK_SAMPLES];
        for (at, entry) in local.iter_mut().enumerate() {
            let slot = (at / 64 * SIDE + at / 8 % 8) * SIDE + at % 8;
            let near: [usize; 8] = std::array::from_fn(|n| usize::from(slots[slot + NEIGHBOUR[n]]));
            let around = Around {
                inside: near.map(|i| inside.get(i).unwrap_or(&NOWHERE)),
                samples: near.map(|i| fields.get(i).unwrap_or(&NOTHING)),
            };
            if around.inside.iter().all(|bits| **bits == NOWHERE) {
                continue;
            }
            if let Some(record) = found.add(slot, &around, iso, bricks.of(slot)) {
                *entry = record;
            }
        }
        (found.take(), local)
    }
}

/// Distance in slots to the neighbour towards +x (bit 0), +y (bit 1), +z (bit 2).
const NEIGHBOUR: [usize; 8] =
    [0, 1, SIDE, SIDE + 1, SIDE * SIDE, SIDE * SIDE + 1, SIDE * SIDE + SIDE, SIDE * SIDE + SIDE + 1];

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
