//! Occupied bricks of a lattice: counted for estimates, and listed for the plan of a device's job.
//!
//! A brick is occupied if an atom reaches one of its samples or the gap up to the first samples of its neighbours:
//! cells lie there too. Runs of atoms of a tile count, in parallel, how many of them reach each brick around the tile.
//! The counts become masks, which are merged by tile. The result equals what the CPU's stage `bin` finds.

use std::collections::hash_map::Entry;
use std::ops::Range;

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::candidates;
use super::control::Control;
use super::cpu;
use super::error::SurfaceError;
use super::lattice::{BRICK, Lattice, LatticeAtom, TILE, tile_of, tile_order, to_f32, to_i32};
use super::params::SurfaceLimits;
use super::simd::dispatched;

/// Maximum number of atoms of a run, which one thread marks: counts of them fit 16 bits.
const RUN: usize = 4096;
/// Number of tiles in reach of all runs above which a lower bound of the grid is checked before tiles are allocated. A
/// tile takes 2 KiB while a run is marked, and 160 bytes from then on.
const MAX_UNCHECKED_TILES: f64 = 1e5;
/// Number of atoms that are tested at once.
const LANES: usize = 8;

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

/// Consecutive atoms of one brick.
#[derive(Debug, Clone, Copy)]
pub struct Home {
    /// Tile coordinates.
    pub tile: [i32; 3],
    /// Index of the brick within its tile.
    pub local: u32,
    /// Number of atoms.
    pub n_atoms: u32,
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
    /// Bricks that hold atoms, in the order of the atoms. A brick with many atoms has several entries.
    pub homes: Vec<Home>,
}

impl Occupancy {
    /// Finds the occupied bricks of `lattice`.
    ///
    /// # Errors
    /// [`SurfaceError::GridTooLarge`] and [`SurfaceError::TooManyCandidates`] before memory is allocated beyond the
    /// limits, [`SurfaceError::Cancelled`].
    pub fn new(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let atoms = &lattice.atoms;
        let runs = runs(atoms);
        let reaches: Vec<f32> = atoms.par_iter().with_min_len(RUN).map(|atom| reach(lattice, atom)).collect();
        let max_reach = reaches.par_chunks(RUN).map(longest).reduce(|| 0.0, f32::max);
        check_lower_bound(lattice, runs.len(), max_reach, limits)?;
        let mark = |run: &Range<usize>| {
            control.check()?;
            Ok(mark_run(&atoms[run.clone()], &reaches[run.clone()]))
        };
        let marks = runs.par_iter().map(mark).collect::<Result<Vec<_>, SurfaceError>>()?;
        let (marks, homes): (Vec<_>, Vec<_>) = marks.into_iter().unzip();
        let occupancy = Self { tiles: merge(&marks), reaches, max_reach, homes: homes.concat() };
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

/// Returns the maximum of `reaches`.
fn longest(reaches: &[f32]) -> f32 {
    reaches.iter().copied().fold(0.0, f32::max)
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

impl TileOccupancy {
    /// Adds the marks of another run in the same tile.
    fn add(&mut self, other: &Self) {
        self.occupied.iter_mut().zip(other.occupied).for_each(|(word, more)| *word |= more);
        self.reached.iter_mut().zip(other.reached).for_each(|(word, more)| *word |= more);
        self.candidates += other.candidates;
        self.pairs += other.pairs;
    }
}

/// Squared gaps along one axis between the atoms of a batch and one brick for each.
#[derive(Clone, Copy, Default)]
struct Gaps {
    /// Gaps to the samples of the brick.
    samples: [f32; LANES],
    /// Gaps to the closed box that also holds the next brick's first sample; infinite beyond the reach.
    closed: [f32; LANES],
}

/// Atoms of a tile, one per lane of a vector.
struct Batch {
    /// Cells relative to the tile.
    cells: [[i32; LANES]; 3],
    fracs: [[f32; LANES]; 3],
    /// Reach of each atom; negative in unused lanes.
    reach: [f32; LANES],
    /// First brick per axis that may be in reach, relative to the tile.
    first: [[i32; LANES]; 3],
}

impl Batch {
    /// Loads at most [`LANES`] atoms of the tile with first sample `origin`.
    #[inline(always)]
    fn new(atoms: &[LatticeAtom], reaches: &[f32], origin: [i32; 3]) -> Self {
        let (cells, fracs) = ([[0; LANES]; 3], [[0.0; LANES]; 3]);
        let mut batch = Self { cells, fracs, reach: [-1.0; LANES], first: [[0; LANES]; 3] };
        for (lane, (atom, &reach)) in atoms.iter().zip(reaches).enumerate().take(LANES) {
            for (k, origin) in origin.into_iter().enumerate() {
                batch.cells[k][lane] = atom.cell[k] - origin;
                batch.fracs[k][lane] = atom.frac[k];
            }
            batch.reach[lane] = reach;
        }
        for k in 0..3 {
            for lane in 0..LANES {
                let local = batch.cells[k][lane] as f32 + batch.fracs[k][lane];
                // The slack of 0.01 covers rounding, which must not lose a brick.
                batch.first[k][lane] = floor((local - batch.reach[lane] - 0.01) * (1.0 / BRICK as f32));
            }
        }
        batch
    }

    /// Returns the gaps along axis `k` to the `i`th brick from the first on. The arithmetic is that of the CPU's stage
    /// `bin`, operation by operation: coordinates are relative to the tile of the brick.
    #[inline(always)]
    fn gaps(&self, k: usize, i: i32) -> Gaps {
        let mut gaps = Gaps::default();
        for lane in 0..LANES {
            let brick = self.first[k][lane] + i;
            let local = (self.cells[k][lane] - (brick >> 3) * TILE) as f32 + self.fracs[k][lane];
            let lo = ((brick & 7) * BRICK) as f32;
            let before = lo - local;
            let before = if before > 0.0 { before } else { 0.0 };
            let gap = |behind: f32| if before > behind { before } else { behind };
            let (samples, closed) = (gap(local - (lo + 7.0)), gap(local - (lo + 8.0)));
            gaps.samples[lane] = samples * samples;
            gaps.closed[lane] = if closed <= self.reach[lane] { closed * closed } else { f32::INFINITY };
        }
        gaps
    }
}

/// Bricks of a tile and around it, counted by the atoms of the tile that reach them.
struct CountedBricks {
    /// Number of bricks before the tile, per axis.
    before: i32,
    /// Number of bricks per axis.
    side: i32,
    /// Number of bricks per axis that an atom may reach. It is the same for all atoms, because mispredicting the end of
    /// a range costs more than testing bricks out of reach.
    n: i32,
    /// Per brick the number of atoms that reach it, and that of those that reach a sample, shifted by 16.
    counts: Vec<u32>,
}

impl CountedBricks {
    /// Bricks around a tile whose atoms reach at most `longest`.
    fn new(longest: f32) -> Self {
        let bricks = |length: f32| to_i32(f64::from(length * (1.0 / BRICK as f32)).floor());
        // An atom lies at most half a spacing outside the samples of its tile. The rest is slack for rounding.
        let (before, n) = (bricks(longest + 0.52) + 1, bricks(2.0 * longest + 0.1) + 2);
        let side = before + 7 + n;
        Self { before, side, n, counts: vec![0; (side.unsigned_abs() as usize).pow(3)] }
    }

    /// Index of a brick by its place.
    #[inline(always)]
    fn index(&self, place: [i32; 3]) -> usize {
        let [x, y, z] = place.map(|c| c.unsigned_abs() as usize);
        let side = self.side.unsigned_abs() as usize;
        (z * side + y) * side + x
    }

    /// Counts the bricks that a batch reaches. `gaps` and `row` are scratch.
    #[inline(always)]
    fn add(&mut self, batch: &Batch, gaps: &mut [Vec<Gaps>; 3], row: &mut Vec<[u32; LANES]>) {
        for (k, gaps) in gaps.iter_mut().enumerate() {
            gaps.clear();
            gaps.extend((0..self.n).map(|i| batch.gaps(k, i)));
        }
        row.resize(gaps[0].len(), [0; LANES]);
        let starts: [usize; LANES] =
            std::array::from_fn(|lane| self.index(batch.first.map(|first| first[lane] + self.before)));
        for (z, iz) in gaps[2].iter().zip(0..) {
            for (y, iy) in gaps[1].iter().zip(0..) {
                for (row, x) in row.iter_mut().zip(&gaps[0]) {
                    // In a local array, as the compiler cannot know that `row` is none of the gaps.
                    let mut reached = [0; LANES];
                    for (lane, reached) in reached.iter_mut().enumerate() {
                        let reach2 = batch.reach[lane] * batch.reach[lane];
                        let near = (y.closed[lane] + z.closed[lane]) + x.closed[lane] <= reach2;
                        let hit = (y.samples[lane] + z.samples[lane]) + x.samples[lane] <= reach2;
                        *reached = u32::from(near) + (u32::from(near & hit) << 16);
                    }
                    *row = reached;
                }
                let offset = self.index([0, iy, iz]);
                for (lane, start) in starts.iter().enumerate() {
                    let counts = &mut self.counts[start + offset..][..row.len()];
                    counts.iter_mut().zip(row.iter()).for_each(|(count, row)| *count += row[lane]);
                }
            }
        }
    }

    /// Returns the occupied bricks of `tile`, which is `step` tiles away from that of the atoms.
    #[inline(always)]
    fn occupancy(&self, tile: [i32; 3], step: [i32; 3]) -> TileOccupancy {
        let mut occupancy = TileOccupancy { tile, occupied: [0; 8], reached: [0; 8], candidates: 0, pairs: 0 };
        let starts = step.map(|step| 8 * step + self.before);
        let [x, y, z] = starts.map(|start| start.max(0)..self.side.min(start + 8));
        for z in z {
            let layer = (z - starts[2]).unsigned_abs() as usize & 7;
            for y in y.clone() {
                for x in x.clone() {
                    let (count, bit) = (self.counts[self.index([x, y, z])], 8 * (y - starts[1]) + x - starts[0]);
                    occupancy.occupied[layer] |= u64::from(count > 0) << bit;
                    occupancy.reached[layer] |= u64::from(count >> 16 > 0) << bit;
                    occupancy.candidates += u64::from(count & 0xffff);
                    occupancy.pairs += u64::from(count >> 16);
                }
            }
        }
        occupancy
    }
}

dispatched! {
without AVX-512:
/// Marks the bricks that `atoms`, all in one tile, reach. Returns them with the bricks that hold the atoms.
fn mark_run(atoms: &[LatticeAtom], reaches: &[f32]) -> (Vec<TileOccupancy>, Vec<Home>) {
    let Some(first) = atoms.first() else { return (Vec::new(), Vec::new()) };
    let own = tile_of(first.cell);
    let mut bricks = CountedBricks::new(longest(reaches));
    let (mut gaps, mut row) = ([const { Vec::new() }; 3], Vec::new());
    for (atoms, reaches) in atoms.chunks(LANES).zip(reaches.chunks(LANES)) {
        bricks.add(&Batch::new(atoms, reaches, own.map(|t| t * TILE)), &mut gaps, &mut row);
    }
    let mut homes: Vec<Home> = Vec::new();
    for atom in atoms {
        let local = local_brick(atom);
        match homes.last_mut() {
            Some(home) if home.local == local => home.n_atoms += 1,
            _ => homes.push(Home { tile: own, local, n_atoms: 1 }),
        }
    }
    let steps = (-bricks.before >> 3)..=((bricks.side - bricks.before - 1) >> 3);
    let mut tiles = Vec::new();
    for z in steps.clone() {
        for y in steps.clone() {
            for x in steps.clone() {
                let mut tile = bricks.occupancy([own[0] + x, own[1] + y, own[2] + z], [x, y, z]);
                if tile.tile == own {
                    // A tiny sphere may reach no sample of its own brick, but the plan lists atoms by brick.
                    for home in &homes {
                        tile.occupied[home.local as usize >> 6] |= 1 << (home.local & 63);
                    }
                }
                if tile.occupied != [0; 8] {
                    tiles.push(tile);
                }
            }
        }
    }
    (tiles, homes)
}
}

/// Rounds `v` down; a whole number may become one less. Casts would check for values out of range.
#[inline(always)]
fn floor(v: f32) -> i32 {
    // Adding 1.5·2²³ leaves the rounded integer in the low bits of the sum.
    const MAGIC: f32 = 12_582_912.0;
    (v - 0.5 + MAGIC).to_bits().cast_signed() - MAGIC.to_bits().cast_signed()
}

/// Cuts the atoms, which are sorted by tile, into runs of at most [`RUN`] atoms of one tile.
fn runs(atoms: &[LatticeAtom]) -> Vec<Range<usize>> {
    let mut runs = Vec::new();
    let mut at = 0;
    while let Some(first) = atoms.get(at) {
        let tile = tile_of(first.cell);
        let rest = &atoms[at..atoms.len().min(at + RUN)];
        let end = at + rest.partition_point(|atom| tile_of(atom.cell) == tile);
        runs.push(at..end);
        at = end;
    }
    runs
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
    all.par_sort_unstable_by_key(|mark| tile_order(mark.tile));
    all
}

/// Index of an atom's brick within its tile.
#[inline(always)]
fn local_brick(atom: &LatticeAtom) -> u32 {
    let [x, y, z] = atom.cell;
    let brick = |c: i32| c.rem_euclid(TILE).unsigned_abs() / BRICK.unsigned_abs();
    brick(z) << 6 | brick(y) << 3 | brick(x)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::surface::{Spheres, SurfaceOptions, SurfaceParams};

    /// Occupied bricks of `atoms`, tested one by one with the arithmetic of stage `bin`.
    fn brute_force(lattice: &Lattice, atoms: &[LatticeAtom]) -> Vec<TileOccupancy> {
        let mut tiles: FxHashMap<[i32; 3], TileOccupancy> = FxHashMap::default();
        for atom in atoms {
            let (own, reach) = (atom.cell.map(|c| c.div_euclid(BRICK)), reach(lattice, atom));
            let n = to_i32(f64::from(reach / 8.0).floor()) + 2;
            let around = |k: usize| own[k] - n..=own[k] + n;
            for [x, y, z] in around(2).flat_map(|z| around(1).flat_map(move |y| around(0).map(move |x| [x, y, z]))) {
                let brick = [x, y, z];
                let gaps = |side: f32| {
                    [0, 1, 2].map(|k| {
                        let local = (atom.cell[k] - (brick[k] >> 3) * TILE) as f32 + atom.frac[k];
                        let lo = ((brick[k] & 7) * BRICK) as f32;
                        (lo - local).max(local - (lo + side)).max(0.0)
                    })
                };
                let within = |[x, y, z]: [f32; 3]| (y * y + z * z) + x * x <= reach * reach;
                let near = gaps(8.0).iter().all(|gap| *gap <= reach) && within(gaps(8.0));
                let hit = near && within(gaps(7.0));
                // The brick of an atom is occupied even if the atom does not reach it.
                if near || brick == own {
                    let tile = brick.map(|b| b >> 3);
                    let empty = TileOccupancy { tile, occupied: [0; 8], reached: [0; 8], candidates: 0, pairs: 0 };
                    let found = tiles.entry(tile).or_insert(empty);
                    let (layer, bit) = ((z & 7).unsigned_abs() as usize, 8 * (y & 7) + (x & 7));
                    found.occupied[layer] |= 1 << bit;
                    found.reached[layer] |= u64::from(hit) << bit;
                    found.candidates += u64::from(near);
                    found.pairs += u64::from(hit);
                }
            }
        }
        let mut tiles: Vec<TileOccupancy> = tiles.into_values().collect();
        tiles.sort_unstable_by_key(|tile| tile_order(tile.tile));
        tiles
    }

    #[test]
    fn a_lone_atom_at_the_end_of_a_tile_marks_its_bricks() {
        for resolution in [1.0, 0.5, 0.23] {
            let column = || vec![-0.52 * resolution];
            let spheres = Spheres::new(column(), column(), column(), vec![1.7]).unwrap();
            let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
            let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap()).unwrap();
            assert_eq!(lattice.atoms[0].cell, [-1; 3]);
            let occupancy = Occupancy::new(&lattice, &SurfaceLimits::default(), &Control::default()).unwrap();
            assert_eq!(format!("{:?}", occupancy.tiles), format!("{:?}", brute_force(&lattice, &lattice.atoms)));
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]
        #[test]
        fn bricks_and_pairs_equal_brute_force_on_any_number_of_threads(
            atoms in prop::collection::vec((prop::array::uniform3(-5.0_f64..5.0), 1.0_f32..1.5), 1..40),
            // From reaches of a part of a brick to reaches of several tiles, and atoms at grid points.
            resolution in prop::sample::select(vec![4.0, 1.0, 0.7, 0.5, 0.23, 0.15, 0.06]),
            (largest, on_grid) in (1.0_f32..2.5, any::<bool>()),
        ) {
            let place = |c: f64| if on_grid { (c / resolution).round() * resolution } else { c };
            let column = |k: usize| atoms.iter().map(|(centre, _)| place(centre[k])).collect();
            let mut radii: Vec<f32> = atoms.iter().map(|(_, radius)| *radius).collect();
            radii[0] = largest;
            let spheres = Spheres::new(column(0), column(1), column(2), radii).unwrap();
            let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
            let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap()).unwrap();
            let found = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| Occupancy::new(&lattice, &SurfaceLimits::default(), &Control::default())).unwrap()
            };
            let occupancy = found(1);
            prop_assert_eq!(format!("{:?}", occupancy), format!("{:?}", found(3)));
            let tiles = format!("{:?}", occupancy.tiles);
            prop_assert_eq!(&tiles, &format!("{:?}", brute_force(&lattice, &lattice.atoms)));
            prop_assert_ne!(&tiles, &format!("{:?}", brute_force(&lattice, &lattice.atoms[1..])), "the control");

            let max_reach = occupancy.reaches.iter().copied().fold(0.0, f32::max);
            prop_assert_eq!(occupancy.max_reach.to_bits(), max_reach.to_bits());
            let bricks = |home: &Home| vec![(home.tile, home.local); home.n_atoms as usize];
            let held = occupancy.homes.iter().flat_map(bricks);
            prop_assert!(held.eq(lattice.atoms.iter().map(|atom| (tile_of(atom.cell), local_brick(atom)))));
        }
    }
}
