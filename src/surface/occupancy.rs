//! Occupied bricks of a lattice: counted for estimates, and listed for the plan of a device's job.
//!
//! A brick is occupied if an atom reaches one of its samples or the gap up to the first samples of its neighbours:
//! cells lie there too. Atoms mark the bricks that they reach, in parallel runs, and the marks are merged by tile. The
//! result equals what the CPU's stage `bin` finds.

use std::collections::hash_map::Entry;

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::candidates;
use super::control::Control;
use super::cpu;
use super::error::SurfaceError;
use super::lattice::{BRICK, Lattice, LatticeAtom, TILE, tile_of, tile_order, to_f32, to_i32, to_u32};
use super::params::SurfaceLimits;
use super::simd::dispatched;

/// Maximum number of atoms of a run, which one thread marks.
const RUN: usize = 1024;
/// Number of tiles in reach of all runs above which a lower bound of the grid is checked before tiles are allocated.
const MAX_UNCHECKED_TILES: f64 = 1e6;
/// Marks a tile without an entry.
const NONE: u32 = u32::MAX;

/// Bricks of a tile as bits: word z, bit `8·y + x`.
pub type BrickBits = [u64; 8];

/// Occupied bricks of one tile.
#[derive(Debug, Clone, Copy)]
pub struct TileOccupancy {
    /// Tile coordinates.
    pub tile: [i32; 3],
    /// Occupied bricks.
    pub occupied: BrickBits,
    /// Bricks with a sample in reach of an atom.
    pub reached: BrickBits,
    /// Pairs of an occupied brick and an atom that reaches it.
    pub candidates: u64,
    /// Pairs of a brick and an atom that reaches one of its samples.
    pub pairs: u64,
}

/// Occupied bricks of a lattice.
#[derive(Debug, Clone)]
pub struct Occupancy {
    /// Tiles with occupied bricks, in tile order.
    pub tiles: Vec<TileOccupancy>,
    /// Reach of each atom, in spacings, with slack for rounding.
    pub reaches: Vec<f32>,
    /// Maximum of `reaches`.
    pub max_reach: f32,
    /// Index of the first atom of each tile that holds atoms.
    pub tile_starts: Vec<usize>,
}

impl Occupancy {
    /// Finds the occupied bricks of `lattice`.
    ///
    /// # Errors
    /// [`SurfaceError::GridTooLarge`] and [`SurfaceError::TooManyCandidates`] before memory is allocated beyond the
    /// limits, [`SurfaceError::Cancelled`].
    pub fn new(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let atoms = &lattice.atoms;
        let tile_starts = tile_starts(atoms);
        let runs = runs(&tile_starts, atoms.len());
        let reaches: Vec<f32> = atoms.par_iter().with_min_len(RUN).map(|atom| reach(lattice, atom)).collect();
        let max_reach = reaches.iter().copied().fold(0.0, f32::max);
        check_lower_bound(lattice, runs.len(), max_reach, limits)?;
        let mark = |&(start, end): &(usize, usize)| {
            control.check()?;
            Ok(mark_run(&atoms[start..end], &reaches[start..end], max_reach))
        };
        let marks: Vec<Vec<TileOccupancy>> = runs.par_iter().map(mark).collect::<Result<_, SurfaceError>>()?;
        let occupancy = Self { tiles: merge(&marks), reaches, max_reach, tile_starts };
        control.check()?;
        let n_reached = occupancy.n_reached();
        if n_reached.saturating_mul(512) > limits.max_samples {
            return Err(cpu::grid_too_large(lattice, n_reached * 512, limits));
        }
        let candidates = occupancy.n_candidates();
        if candidates > candidates::limit(limits) {
            return Err(candidates::exceeded(lattice, candidates, limits));
        }
        Ok(occupancy)
    }

    /// Number of bricks with a sample in reach of an atom.
    #[must_use]
    pub fn n_reached(&self) -> u64 {
        self.tiles.iter().map(|tile| count_ones(&tile.reached)).sum()
    }

    /// Number of pairs of an occupied brick and an atom that reaches it.
    #[must_use]
    pub fn n_candidates(&self) -> u64 {
        self.tiles.iter().map(|tile| tile.candidates).sum()
    }

    /// Number of pairs of a brick and an atom that reaches one of its samples.
    #[must_use]
    pub fn n_pairs(&self) -> u64 {
        self.tiles.iter().map(|tile| tile.pairs).sum()
    }
}

/// Number of bricks in `bits`.
#[must_use]
pub fn count_ones(bits: &BrickBits) -> u64 {
    bits.iter().map(|word| u64::from(word.count_ones())).sum()
}

/// Reach of an atom in spacings, a little more than its support: rounding must not lose a pair, and an additional pair
/// adds zero to the density.
fn reach(lattice: &Lattice, atom: &LatticeAtom) -> f32 {
    to_f32(lattice.reach(atom) * (1.0 + 1e-5)) + 1e-3
}

/// Rejects a grid whose lower bound exceeds the limit before its tiles are allocated.
fn check_lower_bound(
    lattice: &Lattice,
    n_runs: usize,
    max_reach: f32,
    limits: &SurfaceLimits,
) -> Result<(), SurfaceError> {
    // Upper bound of the tiles that a run reaches along each axis: small unless spheres are huge compared with the
    // spacing.
    let along = 2.0 * (f64::from(max_reach) + 2.0) / f64::from(TILE) + 3.0;
    if along.powi(3) * n_runs as f64 <= MAX_UNCHECKED_TILES || along < 6.0 {
        return Ok(());
    }
    cpu::check_lower_bound(lattice, limits)
}

/// Squared gaps along one axis between an atom and the bricks of a tile.
struct Gaps {
    /// First brick that may be in reach along this axis, and one past the last.
    range: [usize; 2],
    /// Gaps to the brick's samples.
    samples: [f32; 8],
    /// Gaps to the closed box that also holds the next brick's first sample; infinite beyond the reach.
    closed: [f32; 8],
}

impl Gaps {
    /// Gaps of an atom at `local`, its coordinate relative to the tile's first sample.
    #[inline(always)]
    fn new(local: f32, reach: f32) -> Self {
        // The slack of 0.01 covers rounding, which must not lose a brick.
        let range = [local - reach - 0.01, local + reach + 8.01].map(|end| to_usize(end * 0.125).min(8));
        let mut gaps = Self { range, samples: [0.0; 8], closed: [0.0; 8] };
        for b in 0..8 {
            let lo = (b * 8) as f32;
            let gap = |hi: f32| {
                let (before, behind) = (lo - local, local - hi);
                let outside = if before > behind { before } else { behind };
                if outside > 0.0 { outside } else { 0.0 }
            };
            let (samples, closed) = (gap(lo + 7.0), gap(lo + 8.0));
            gaps.samples[b] = samples * samples;
            gaps.closed[b] = if closed <= reach { closed * closed } else { f32::INFINITY };
        }
        gaps
    }
}

/// Rounds `v` down; negative values become 0.
#[inline(always)]
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
fn to_usize(v: f32) -> usize {
    v as usize
}

impl TileOccupancy {
    /// Adds the marks of another run in the same tile.
    fn add(&mut self, other: &Self) {
        self.occupied.iter_mut().zip(other.occupied).for_each(|(word, more)| *word |= more);
        self.reached.iter_mut().zip(other.reached).for_each(|(word, more)| *word |= more);
        self.candidates += other.candidates;
        self.pairs += other.pairs;
    }

    /// Marks the bricks of the tile that an atom reaches, given its gaps along x, y and z. The arithmetic is that of
    /// the CPU's stage `bin`, operation by operation.
    #[inline(always)]
    fn mark(&mut self, [x, y, z]: [&Gaps; 3], reach: f32) {
        let reach2 = reach * reach;
        let (mut candidates, mut pairs) = (0, 0);
        for bz in z.range[0]..z.range[1] {
            // The rows of a layer are the lanes of a vector, and bit x of a lane is a brick.
            let [closed, samples]: [[f32; 8]; 2] = [(&y.closed, z.closed[bz]), (&y.samples, z.samples[bz])]
                .map(|(y, z)| std::array::from_fn(|by| y[by] + z));
            let mut rows = [[0_u32; 8]; 2];
            for bx in x.range[0]..x.range[1] {
                for by in 0..8 {
                    let near = closed[by] + x.closed[bx] <= reach2;
                    let hit = samples[by] + x.samples[bx] <= reach2;
                    rows[0][by] |= u32::from(near) << bx;
                    rows[1][by] |= u32::from(hit) << bx;
                }
            }
            let [near, hit] = rows.map(|rows| u64::from_le_bytes(rows.map(|row| row.to_le_bytes()[0])));
            let hit = hit & near;
            self.occupied[bz] |= near;
            self.reached[bz] |= hit;
            candidates += near.count_ones();
            pairs += hit.count_ones();
        }
        self.candidates += u64::from(candidates);
        self.pairs += u64::from(pairs);
    }
}

/// Tiles around the tile of a run of atoms, created when the first of their bricks is marked.
struct TileNeighbourhood {
    /// Tile of the run.
    centre: [i32; 3],
    /// Number of tiles on each side of the centre.
    span: i32,
    /// Index into `marked` of each tile in the neighbourhood, or [`NONE`].
    index: Vec<u32>,
    marked: Vec<TileOccupancy>,
}

impl TileNeighbourhood {
    fn new(centre: [i32; 3], reach: f32) -> Self {
        // Covers the range of `mark_run` including its slack.
        let span = to_i32((f64::from(reach) + 12.0) / f64::from(TILE)) + 1;
        let side = 2 * span.unsigned_abs() as usize + 1;
        Self { centre, span, index: vec![NONE; side * side * side], marked: Vec::new() }
    }

    #[inline(always)]
    fn tile(&mut self, tile: [i32; 3]) -> &mut TileOccupancy {
        let side = 2 * self.span + 1;
        let [x, y, z] = std::array::from_fn(|k| tile[k] - self.centre[k] + self.span);
        let index = &mut self.index[((z * side + y) * side + x).unsigned_abs() as usize];
        if *index == NONE {
            *index = to_u32(self.marked.len());
            self.marked.push(TileOccupancy { tile, occupied: [0; 8], reached: [0; 8], candidates: 0, pairs: 0 });
        }
        &mut self.marked[*index as usize]
    }
}

// AVX-512 takes 1.7 times as long, because each comparison moves its mask bit by bit.
dispatched! {
without AVX-512:
/// Marks the bricks that `atoms`, all in one tile, reach.
fn mark_run(atoms: &[LatticeAtom], reaches: &[f32], max_reach: f32) -> Vec<TileOccupancy> {
    let Some(first) = atoms.first() else { return Vec::new() };
    let own = tile_of(first.cell);
    let mut around = TileNeighbourhood::new(own, max_reach);
    for (atom, &reach) in atoms.iter().zip(reaches) {
        // Tiles in reach, sometimes one too many; `merge` drops tiles without an occupied brick.
        let range: [[i32; 2]; 3] = std::array::from_fn(|k| {
            let local = (atom.cell[k] - own[k] * TILE) as f32;
            [tile_step(local - reach - 1.0), tile_step(local + reach + 1.0)]
        });
        let gaps =
            |k: usize, step: i32| Gaps::new((atom.cell[k] - (own[k] + step) * TILE) as f32 + atom.frac[k], reach);
        for tz in range[2][0]..=range[2][1] {
            let z = gaps(2, tz);
            for ty in range[1][0]..=range[1][1] {
                let y = gaps(1, ty);
                for tx in range[0][0]..=range[0][1] {
                    let x = gaps(0, tx);
                    around.tile([own[0] + tx, own[1] + ty, own[2] + tz]).mark([&x, &y, &z], reach);
                }
            }
        }
        // A tiny sphere may reach no sample of its own brick, but the plan lists atoms by brick.
        let local = local_brick(atom);
        around.tile(own).occupied[local as usize >> 6] |= 1 << (local & 63);
    }
    around.marked
}
}

/// Number of tiles between an atom's tile and the tile that holds `local`, a coordinate relative to the first.
#[inline(always)]
#[expect(clippy::cast_possible_truncation, reason = "coordinates are bounded by the spacing and by validated spheres")]
fn tile_step(local: f32) -> i32 {
    // Truncation rounds positive values down; the offset exceeds every reach in tiles.
    const OFFSET: i32 = 1 << 16;
    (local * (1.0 / TILE as f32) + OFFSET as f32) as i32 - OFFSET
}

/// Index of the first atom of each tile; atoms are sorted by tile.
fn tile_starts(atoms: &[LatticeAtom]) -> Vec<usize> {
    let tile = |i: usize| tile_of(atoms[i].cell);
    let mut starts = Vec::new();
    let mut at = 0;
    while at < atoms.len() {
        starts.push(at);
        at += atoms[at..].partition_point(|atom| tile_of(atom.cell) == tile(at));
    }
    starts
}

/// Cuts the atoms of each tile into runs of at most [`RUN`] atoms.
fn runs(tile_starts: &[usize], n_atoms: usize) -> Vec<(usize, usize)> {
    let ends = tile_starts.iter().skip(1).copied().chain([n_atoms]);
    let cut = |(&start, end): (&usize, usize)| (start..end).step_by(RUN).map(move |at| (at, (at + RUN).min(end)));
    tile_starts.iter().zip(ends).flat_map(cut).collect()
}

/// Merges the marks of all runs into one entry per tile, in tile order.
fn merge(marks: &[Vec<TileOccupancy>]) -> Vec<TileOccupancy> {
    let mut all: Vec<TileOccupancy> = Vec::new();
    let mut index: FxHashMap<[i32; 3], usize> = FxHashMap::default();
    for mark in marks.iter().flatten() {
        match index.entry(mark.tile) {
            Entry::Vacant(entry) => {
                entry.insert(all.len());
                all.push(*mark);
            }
            Entry::Occupied(entry) => all[*entry.get()].add(mark),
        }
    }
    all.retain(|mark| mark.occupied != [0; 8]);
    all.par_sort_unstable_by_key(|mark| tile_order(mark.tile));
    all
}

/// Index of an atom's brick within its tile.
#[inline(always)]
#[must_use]
pub fn local_brick(atom: &LatticeAtom) -> u32 {
    let [x, y, z] = atom.cell;
    let brick = |c: i32| c.rem_euclid(TILE).unsigned_abs() / BRICK.unsigned_abs();
    brick(z) << 6 | brick(y) << 3 | brick(x)
}
