//! Which bricks exist: atoms mark those that they reach, run by run in parallel, and the marks are merged tile by tile.

use rayon::prelude::*;

use super::lattice::{BRICK, LatticeAtom, TILE, tile_of, tile_order, to_i32, to_u32};
use super::layout::NONE;
use super::simd::dispatched;

/// Atoms that one piece of parallel work marks the bricks of.
const RUN: usize = 2048;

/// Bricks of a tile as bits: word z, bit `8·y + x`.
pub(super) type Bits = [u64; 8];

/// What atoms mark in one tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Marked {
    pub(super) tile: [i32; 3],
    /// Bricks that exist.
    pub(super) closed: Bits,
    /// Those with a sample in reach.
    pub(super) reached: Bits,
    pub(super) candidates: u64,
    pub(super) pairs: u64,
}

/// Squared gaps along one axis between an atom and the bricks of a tile: to their samples, and to the closed box that also
/// holds the next brick's first sample. Infinite where the brick is out of reach by this axis alone.
struct Gaps {
    /// Bit per brick: within reach by this axis.
    near: u32,
    samples: [f32; 8],
    closed: [f32; 8],
}

impl Gaps {
    /// `local`: the atom's coordinate from the tile's first sample.
    #[inline(always)]
    fn new(local: f32, reach: f32) -> Self {
        let mut gaps = Self { near: 0, samples: [0.0; 8], closed: [0.0; 8] };
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
        gaps.near = at_most(&gaps.closed, 0.0, f32::MAX);
        gaps
    }
}

/// Bits of the entries that are at most `limit` together with `base`.
#[inline(always)]
fn at_most(entries: &[f32; 8], base: f32, limit: f32) -> u32 {
    let mut bits = 0;
    for (i, entry) in (0_u32..).zip(entries) {
        bits |= u32::from(base + entry <= limit) << i;
    }
    bits
}

impl Marked {
    /// Marks the bricks of the tile that `atom` reaches: the arithmetic of the CPU's stage `bin`, step by step.
    #[inline(always)]
    fn mark(&mut self, atom: &LatticeAtom, reach: f32) {
        let origin = self.tile.map(|t| t * TILE);
        let local = |k: usize| (atom.cell[k] - origin[k]) as f32 + atom.frac[k];
        let [x, y, z] = std::array::from_fn(|k| Gaps::new(local(k), reach));
        let reach2 = reach * reach;
        let (mut candidates, mut pairs) = (0, 0);
        let mut layers = z.near;
        while layers != 0 {
            let bz = (layers.trailing_zeros() & 7) as usize;
            layers &= layers - 1;
            let (mut near, mut hit) = (0_u64, 0_u64);
            let mut rows = y.near;
            while rows != 0 {
                let by = (rows.trailing_zeros() & 7) as usize;
                rows &= rows - 1;
                let row = at_most(&x.closed, y.closed[by] + z.closed[bz], reach2);
                near |= u64::from(row) << (8 * by);
                hit |= u64::from(row & at_most(&x.samples, y.samples[by] + z.samples[bz], reach2)) << (8 * by);
            }
            self.closed[bz] |= near;
            self.reached[bz] |= hit;
            candidates += near.count_ones();
            pairs += hit.count_ones();
        }
        self.candidates += u64::from(candidates);
        self.pairs += u64::from(pairs);
    }
}

/// The tiles that a run of atoms reaches, found by their distance from the atoms' own.
struct Around {
    home: [i32; 3],
    /// Tiles to either side.
    span: i32,
    /// Index into `marked` per tile around, or [`NONE`].
    at: Vec<u32>,
    marked: Vec<Marked>,
}

impl Around {
    fn new(home: [i32; 3], reach: f32) -> Self {
        // As far as `mark_run` looks, and what rounding adds there.
        let span = to_i32((f64::from(reach) + 12.0) / f64::from(TILE)) + 1;
        let side = 2 * span.unsigned_abs() as usize + 1;
        Self { home, span, at: vec![NONE; side * side * side], marked: Vec::new() }
    }

    #[inline(always)]
    fn tile(&mut self, tile: [i32; 3]) -> &mut Marked {
        let side = 2 * self.span + 1;
        let [x, y, z] = std::array::from_fn(|k| tile[k] - self.home[k] + self.span);
        let at = &mut self.at[((z * side + y) * side + x).unsigned_abs() as usize];
        if *at == NONE {
            *at = to_u32(self.marked.len());
            self.marked.push(Marked { tile, closed: [0; 8], reached: [0; 8], candidates: 0, pairs: 0 });
        }
        &mut self.marked[*at as usize]
    }
}

dispatched! {
/// Marks the bricks of `atoms`, which live in one tile.
pub(super) fn mark_run(atoms: &[LatticeAtom], reaches: &[f32], longest: f32) -> Vec<Marked> {
    let Some(first) = atoms.first() else { return Vec::new() };
    let home = tile_of(first.cell);
    let mut around = Around::new(home, longest);
    for (atom, &reach) in atoms.iter().zip(reaches) {
        // The tiles that it can reach, one more at times; a tile without a marked brick is dropped later.
        let range: [[i32; 2]; 3] = std::array::from_fn(|k| {
            let local = (atom.cell[k] - home[k] * TILE) as f32;
            [tile_step(local - reach - 9.0), tile_step(local + reach + 1.0)]
        });
        for tz in range[2][0]..=range[2][1] {
            for ty in range[1][0]..=range[1][1] {
                for tx in range[0][0]..=range[0][1] {
                    around.tile([home[0] + tx, home[1] + ty, home[2] + tz]).mark(atom, reach);
                }
            }
        }
        // Where spheres are tiny, an atom may reach nothing of the brick that it lives in; its atoms are found there.
        let local = local_of(atom);
        around.tile(home).closed[local as usize >> 6] |= 1 << (local & 63);
    }
    around.marked
}
}

/// The tile, counted from an atom's own, that a coordinate from its first sample lies in.
#[inline(always)]
#[expect(clippy::cast_possible_truncation, reason = "coordinates are bounded by the spacing and by validated spheres")]
fn tile_step(local: f32) -> i32 {
    // Truncation is rounding down from 0 on, and no step is below the offset: reaches are bounded likewise.
    const OFFSET: i32 = 1 << 16;
    (local * (1.0 / TILE as f32) + OFFSET as f32) as i32 - OFFSET
}

/// The atoms of each tile, cut into runs.
pub(super) fn runs(atoms: &[LatticeAtom]) -> Vec<(usize, usize)> {
    let mut runs = Vec::new();
    let mut start = 0;
    while start < atoms.len() {
        let tile = tile_of(atoms[start].cell);
        let end = (start + RUN).min(atoms.len());
        let end = start + atoms[start..end].partition_point(|atom| tile_of(atom.cell) == tile);
        runs.push((start, end));
        start = end;
    }
    runs
}

/// Everything that was marked, one entry a tile, in the order of tiles.
pub(super) fn merge(marks: &[Vec<Marked>]) -> Vec<Marked> {
    let mut all: Vec<([i32; 3], &Marked)> = marks.iter().flatten().map(|m| (tile_order(m.tile), m)).collect();
    all.par_sort_unstable_by_key(|(order, _)| *order);
    let mut merged: Vec<Marked> = Vec::new();
    for (_, mark) in all {
        match merged.last_mut().filter(|last| last.tile == mark.tile) {
            Some(last) => {
                last.closed.iter_mut().zip(mark.closed).for_each(|(word, more)| *word |= more);
                last.reached.iter_mut().zip(mark.reached).for_each(|(word, more)| *word |= more);
                last.candidates += mark.candidates;
                last.pairs += mark.pairs;
            }
            // A tile is in an atom's range by a corner that no brick is near to.
            None if mark.closed == [0; 8] => {}
            None => merged.push(*mark),
        }
    }
    merged
}

/// An atom's brick within its tile.
pub(super) fn local_of(atom: &LatticeAtom) -> u32 {
    let [x, y, z] = atom.cell.map(|c| c.rem_euclid(TILE).unsigned_abs() / BRICK.unsigned_abs());
    z << 6 | y << 3 | x
}
