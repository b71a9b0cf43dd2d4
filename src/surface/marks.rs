//! Which bricks exist: atoms mark those that they reach, run by run in parallel, and the marks are merged tile by tile.

use indexmap::IndexMap;
use rayon::prelude::*;
use rustc_hash::FxBuildHasher;

use super::lattice::{BRICK, LatticeAtom, TILE, tile_of, tile_order, to_i32, to_u32};
use super::layout::NONE;

/// Atoms that one piece of parallel work marks the bricks of.
const RUN: usize = 1024;
/// From so many runs on, their marks are merged in parallel first.
const MANY_RUNS: usize = 256;

/// Bricks of a tile as bits: word z, bit `8·y + x`.
pub(super) type Bits = [u64; 8];

/// What atoms mark in one tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Marked {
    pub(super) tile: [i32; 3],
    /// Bricks within reach of at least one atom.
    pub(super) occupied: Bits,
    /// Those with a sample in reach.
    pub(super) reached: Bits,
    pub(super) candidates: u64,
    pub(super) pairs: u64,
}

/// Squared gaps along one axis between an atom and the bricks of a tile: to their samples, and to the closed box that also
/// holds the next brick's first sample. Infinite where the brick is out of reach by this axis alone.
struct Gaps {
    /// The first brick that may be within reach by this axis, and the one behind the last.
    range: [usize; 2],
    samples: [f32; 8],
    closed: [f32; 8],
}

impl Gaps {
    /// `local`: the atom's coordinate from the tile's first sample.
    #[inline(always)]
    fn new(local: f32, reach: f32) -> Self {
        // A hundredth more than within reach: rounding must not lose a brick.
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

/// `v` rounded down, 0 where it is negative.
#[inline(always)]
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
fn to_usize(v: f32) -> usize {
    v as usize
}

impl Marked {
    /// Adds what others mark in the same tile.
    fn add(&mut self, other: &Self) {
        self.occupied.iter_mut().zip(other.occupied).for_each(|(word, more)| *word |= more);
        self.reached.iter_mut().zip(other.reached).for_each(|(word, more)| *word |= more);
        self.candidates += other.candidates;
        self.pairs += other.pairs;
    }

    /// Marks the bricks of the tile that an atom reaches, by its gaps along x, y and z: the arithmetic of the CPU's stage
    /// `bin`, step by step.
    #[inline(always)]
    fn mark(&mut self, [x, y, z]: [&Gaps; 3], reach: f32) {
        let reach2 = reach * reach;
        let (mut candidates, mut pairs) = (0, 0);
        for bz in z.range[0]..z.range[1] {
            // The rows of a layer are the lanes of a vector; bit x of each is a brick.
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
            self.marked.push(Marked { tile, occupied: [0; 8], reached: [0; 8], candidates: 0, pairs: 0 });
        }
        &mut self.marked[*at as usize]
    }
}

// Eight lanes: with AVX-512 the comparisons' masks go through mask registers one bit at a time, in 1.7 times the time.
/// Marks the bricks of `atoms`, which live in one tile.
#[multiversion::multiversion(targets("x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt"))]
pub(super) fn mark_run(atoms: &[LatticeAtom], reaches: &[f32], longest: f32) -> Vec<Marked> {
    let Some(first) = atoms.first() else { return Vec::new() };
    let home = tile_of(first.cell);
    let mut around = Around::new(home, longest);
    for (atom, &reach) in atoms.iter().zip(reaches) {
        // The tiles that it can reach, one more at times; a tile without a marked brick is dropped later.
        let range: [[i32; 2]; 3] = std::array::from_fn(|k| {
            let local = (atom.cell[k] - home[k] * TILE) as f32;
            [tile_step(local - reach - 1.0), tile_step(local + reach + 1.0)]
        });
        let gaps =
            |k: usize, step: i32| Gaps::new((atom.cell[k] - (home[k] + step) * TILE) as f32 + atom.frac[k], reach);
        for tz in range[2][0]..=range[2][1] {
            let z = gaps(2, tz);
            for ty in range[1][0]..=range[1][1] {
                let y = gaps(1, ty);
                for tx in range[0][0]..=range[0][1] {
                    let x = gaps(0, tx);
                    around.tile([home[0] + tx, home[1] + ty, home[2] + tz]).mark([&x, &y, &z], reach);
                }
            }
        }
        // Where spheres are tiny, an atom may reach nothing of the brick that it lives in; its atoms are found there.
        let local = local_of(atom);
        around.tile(home).occupied[local as usize >> 6] |= 1 << (local & 63);
    }
    around.marked
}

/// The tile, counted from an atom's own, that a coordinate from its first sample lies in.
#[inline(always)]
#[expect(clippy::cast_possible_truncation, reason = "coordinates are bounded by the spacing and by validated spheres")]
fn tile_step(local: f32) -> i32 {
    // Truncation is rounding down from 0 on, and no step is below the offset: reaches are bounded likewise.
    const OFFSET: i32 = 1 << 16;
    (local * (1.0 / TILE as f32) + OFFSET as f32) as i32 - OFFSET
}

/// Index of the first atom of each tile.
pub(super) fn starts(atoms: &[LatticeAtom]) -> Vec<usize> {
    let tile = |i: usize| tile_of(atoms[i].cell);
    let in_piece = |piece: usize| {
        let end = (piece + RUN).min(atoms.len());
        let next = move |&at: &usize| Some(at + atoms[at..end].partition_point(|atom| tile_of(atom.cell) == tile(at)));
        std::iter::successors(Some(piece), next).take_while(move |&at| at < end)
    };
    // A piece begins within a tile, as a rule.
    let begins = |&at: &usize| at == 0 || tile(at - 1) != tile(at);
    let pieces: Vec<usize> = (0..atoms.len()).step_by(RUN).collect();
    pieces.into_par_iter().flat_map_iter(|piece| in_piece(piece).filter(begins)).collect()
}

/// The atoms of each tile, which `starts` tells, cut into runs.
pub(super) fn runs(starts: &[usize], n_atoms: usize) -> Vec<(usize, usize)> {
    let ends = starts.iter().skip(1).copied().chain([n_atoms]);
    let cut = |(&start, end): (&usize, usize)| (start..end).step_by(RUN).map(move |at| (at, (at + RUN).min(end)));
    starts.iter().zip(ends).flat_map(cut).collect()
}

/// Everything that was marked, one entry a tile, in the order of tiles.
pub(super) fn merge(marks: &[Vec<Marked>]) -> Vec<Marked> {
    let mut all: Vec<Marked> = if marks.len() < MANY_RUNS {
        merged(marks)
    } else {
        // Runs that follow each other share most of their tiles.
        let parts: Vec<Vec<Marked>> = marks.par_chunks(MANY_RUNS / 4).map(merged).collect();
        merged(&parts)
    };
    // A tile may be in an atom's range by a corner that no brick is near to.
    all.retain(|mark| mark.occupied != [0; 8]);
    all.par_sort_unstable_by_key(|mark| tile_order(mark.tile));
    all
}

/// Adds up the marks of each tile. The order of the tiles is unspecified.
fn merged(marks: &[Vec<Marked>]) -> Vec<Marked> {
    let mut all: IndexMap<[i32; 3], Marked, FxBuildHasher> = IndexMap::default();
    for mark in marks.iter().flatten() {
        all.entry(mark.tile).and_modify(|sum| sum.add(mark)).or_insert(*mark);
    }
    all.into_values().collect()
}

/// An atom's brick within its tile.
#[inline(always)]
pub(super) fn local_of(atom: &LatticeAtom) -> u32 {
    let [x, y, z] = atom.cell;
    let brick = |c: i32| c.rem_euclid(TILE).unsigned_abs() / BRICK.unsigned_abs();
    brick(z) << 6 | brick(y) << 3 | brick(x)
}
