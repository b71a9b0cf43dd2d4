//! Occupied bricks of a lattice: counted for estimates, and listed for the plan of a device's job.
//!
//! A brick is occupied if an atom reaches one of its grid points or the gap up to the first grid points of its
//! neighbours, which contains cells of the brick. A run is a part of the atoms of one tile. For each run, a thread
//! counts the atoms that reach each brick in and around the tile, and converts the counts to masks. The masks of a
//! block of runs are then merged by tile, before the next block is counted. The result equals that of the CPU's stage
//! `bin`.

mod marks;

use std::collections::hash_map::Entry;
use std::f64::consts::PI;
use std::ops::Range;

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use self::marks::{CountedBricks, Marks, RUN, longest, mark_run, runs};
use super::control::Control;
use super::error::SurfaceError;
use super::lattice::{BRICK, Lattice, LatticeAtom, TILE, tile_of, tile_order, to_f32, to_u32, to_u64};
use super::limit::Limit;
use super::memory::{MemoryMeter as _, OutOfMemory, Reservation};
use super::params::SurfaceLimits;
use super::{candidates, checked_sort, grid_limit};

/// Number of tiles in reach of the runs of a block: their marks take at most 40 MB.
const BLOCK_TILES: f64 = 262_144.0;
/// Maximum number of runs of a block.
const BLOCK_RUNS: f64 = 4096.0;
/// Number of runs below which the limit of grid points does not lower the runs of a block.
const MIN_BLOCK_RUNS: f64 = 4.0;
/// Number of open tiles below which they are not searched for complete ones.
const MIN_OPEN: usize = 1 << 15;

/// Bricks of a tile as bits: word z, bit `8·y + x`.
pub type BrickBits = [u64; 8];

/// Occupied bricks of one tile.
#[derive(Debug, Clone, Copy)]
pub struct TileOccupancy {
    /// Tile coordinates.
    pub tile: [i32; 3],
    /// Occupied bricks.
    pub occupied: BrickBits,
    /// Bricks with a grid point in reach of an atom.
    pub reached: BrickBits,
    /// Pairs of an occupied brick and an atom that reaches it.
    pub candidates: u64,
    /// Pairs of a brick and an atom that reaches one of its grid points.
    pub pairs: u64,
}

/// Brick that holds consecutive atoms.
#[derive(Debug, Clone, Copy)]
pub struct AtomBrick {
    /// Tile coordinates.
    pub tile: [i32; 3],
    /// Index of the brick within its tile.
    pub local: u32,
    /// Number of atoms.
    pub n_atoms: u32,
}

/// Occupied bricks of a lattice.
#[derive(Debug)]
pub struct Occupancy {
    /// Tiles with occupied bricks, in tile order.
    pub tiles: Vec<TileOccupancy>,
    /// Reach of each atom, in spacings, with slack for rounding.
    pub reaches: Vec<f32>,
    /// Maximum of `reaches`.
    pub max_reach: f32,
    /// Bricks that hold atoms, in the order of the atoms. A brick with many atoms has several entries.
    pub atom_bricks: Vec<AtomBrick>,
    /// Memory of these lists.
    _memory: Reservation,
}

/// Work on a lattice.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WorkCounts {
    /// Bricks with a grid point in reach of an atom.
    pub reached: u64,
    /// Pairs of an occupied brick and an atom that reaches it.
    pub candidates: u64,
}

/// Counts the bricks and pairs of `lattice` without listing them.
///
/// # Errors
/// Those of [`Occupancy::new`].
pub fn count(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<WorkCounts, SurfaceError> {
    let memory = Reservation::new(&control.memory);
    let reaches = Reaches::new(lattice, &memory)?;
    let mut found = FoundBricks::new(false, &memory);
    found.search(lattice, &reaches, limits, control)?;
    Ok(WorkCounts { reached: found.n_reached, candidates: found.n_candidates })
}

/// Rejects a run before any of it is computed if the atoms of all `lattices` together have too many pairs. Counts the
/// pairs exactly, but only if an upper bound exceeds the limit.
///
/// # Errors
/// [`SurfaceError::Limit`], and the other errors of counting.
pub fn check_pairs(lattices: &[&Lattice], limits: &SurfaceLimits, control: &Control<'_>) -> Result<(), SurfaceError> {
    let most: f64 = lattices.iter().map(|lattice| most_pairs(lattice)).sum();
    if most <= candidates::limit(limits) as f64 {
        return Ok(());
    }
    let mut left = candidates::limit(limits);
    for lattice in lattices {
        let rest = SurfaceLimits { max_candidates: left, ..*limits };
        let bytes = (size_of::<LatticeAtom>() * lattice.atoms.len()) as u64;
        let counted = if lattice.atoms.is_sorted_by_key(by_tile) {
            count(lattice, &rest, control)
        } else {
            // The arcs of a boundary are in the order of its spheres.
            let _copy = control.reserve(bytes)?;
            let mut sorted = Lattice::clone(lattice);
            checked_sort::sort(&mut sorted.atoms, |a, b| by_tile(a).cmp(&by_tile(b)), control)?;
            count(&sorted, &rest, control)
        };
        match counted {
            Ok(counts) => left -= counts.candidates.min(left),
            Err(error) => {
                let Some(candidates) = error.exceeded(Limit::Candidates).and_then(|exceeded| exceeded.actual) else {
                    return Err(error);
                };
                let so_far = candidates::limit(limits) - left + candidates;
                return Err(candidates::exceeded(lattices, so_far, limits));
            }
        }
    }
    Ok(())
}

/// Returns the sort key of the tile of an atom.
fn by_tile(atom: &LatticeAtom) -> [i32; 3] {
    tile_order(tile_of(atom.cell))
}

/// Upper bound of the candidate pairs of a lattice.
fn most_pairs(lattice: &Lattice) -> f64 {
    // A sphere touches at most 2·reach/brick + 2 bricks along each axis.
    let touched = |atom| 2.0 * lattice.reach(atom) / f64::from(BRICK) + 2.0;
    lattice.atoms.iter().map(|atom| touched(atom).powi(3)).sum()
}

impl Occupancy {
    /// Finds the occupied bricks of `lattice`.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`] before memory is allocated beyond the limits, [`SurfaceError::Cancelled`].
    pub fn new(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let memory = Reservation::new(&control.memory);
        let reaches = Reaches::new(lattice, &memory)?;
        let mut found = FoundBricks::new(true, &memory);
        found.search(lattice, &reaches, limits, control)?;
        let FoundBricks { tiles, atom_bricks, .. } = found;
        let Reaches { of_atoms, longest } = reaches;
        Ok(Self { tiles, reaches: of_atoms, max_reach: longest, atom_bricks, _memory: memory })
    }

    /// Number of bricks with a grid point in reach of an atom.
    #[must_use]
    pub fn n_reached(&self) -> u64 {
        self.tiles.iter().map(|tile| count_ones(&tile.reached)).sum()
    }

    /// Number of pairs of a brick and an atom that reaches one of its grid points.
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

/// Returns the reach of an atom in spacings, which is slightly more than its support. Rounding must not lose a pair,
/// and an additional pair adds zero to the density.
fn reach(lattice: &Lattice, atom: &LatticeAtom) -> f32 {
    to_f32(lattice.reach(atom) * (1.0 + 1e-5)) + 1e-3
}

/// Reaches of all atoms.
struct Reaches {
    of_atoms: Vec<f32>,
    longest: f32,
}

impl Reaches {
    fn new(lattice: &Lattice, memory: &Reservation) -> Result<Self, OutOfMemory> {
        memory.grow((size_of::<f32>() * lattice.atoms.len()) as u64)?;
        let of_atoms: Vec<f32> = lattice.atoms.par_iter().with_min_len(RUN).map(|atom| reach(lattice, atom)).collect();
        let longest = of_atoms.par_chunks(RUN).map(longest).reduce(|| 0.0, f32::max);
        Ok(Self { of_atoms, longest })
    }

    /// Returns a lower bound of the grid points in bricks that the largest sphere reaches.
    fn least_grid_points(&self) -> u64 {
        // A grid point lies within one spacing of every point, so the reached bricks cover a sphere whose radius is
        // smaller by one spacing.
        to_u64(4.0 / 3.0 * PI * (f64::from(self.longest) - 1.0).max(0.0).powi(3))
    }

    /// Number of runs of a block. It does not depend on the number of threads, and therefore errors do not either.
    fn runs_per_block(&self, limits: &SurfaceLimits) -> usize {
        // Upper bound of the tiles that a run reaches along each axis.
        let along = 2.0 * (f64::from(self.longest) + 2.0) / f64::from(TILE) + 3.0;
        // A search that exceeds a limit ends soon, even if each run takes long.
        let most = limits.max_grid_points as f64 / self.least_grid_points().max(1) as f64;
        let n = to_u64((BLOCK_TILES / along.powi(3)).min(most.max(MIN_BLOCK_RUNS)).clamp(1.0, BLOCK_RUNS));
        usize::try_from(n).unwrap_or(1)
    }
}

/// Bricks that the runs so far reach.
struct FoundBricks<'a> {
    /// True if tiles and bricks with atoms are listed, not only counted.
    lists: bool,
    /// Tiles that further runs may reach.
    open: Vec<TileOccupancy>,
    /// Index in `open` of each tile.
    index: FxHashMap<[i32; 3], u32>,
    /// Number of open tiles at which they are next searched for complete ones.
    max_open: usize,
    /// Complete tiles, in tile order.
    tiles: Vec<TileOccupancy>,
    atom_bricks: Vec<AtomBrick>,
    n_reached: u64,
    n_candidates: u64,
    memory: &'a Reservation,
}

impl<'a> FoundBricks<'a> {
    fn new(lists: bool, memory: &'a Reservation) -> Self {
        let (open, tiles, atom_bricks, index) = (Vec::new(), Vec::new(), Vec::new(), FxHashMap::default());
        Self { lists, open, index, max_open: MIN_OPEN, tiles, atom_bricks, n_reached: 0, n_candidates: 0, memory }
    }

    /// Finds the bricks of all atoms, unless they exceed a limit.
    fn search(
        &mut self,
        lattice: &Lattice,
        reaches: &Reaches,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<(), SurfaceError> {
        let atoms = &lattice.atoms[..];
        // Before any brick is allocated.
        let least = reaches.least_grid_points();
        if least > limits.max_grid_points {
            // The spheres lie in the box, where they may overlap.
            let all = least.saturating_mul(atoms.len() as u64).min(lattice.box_points).max(least);
            return Err(grid_limit::exceeded(lattice.spacing, all, 1, limits));
        }
        let n_runs = reaches.runs_per_block(limits);
        let mut runs = runs(atoms);
        let first_step = *CountedBricks::new(reaches.longest).steps().start();
        let mark = |run: &Range<usize>| mark_run(&atoms[run.clone()], &reaches.of_atoms[run.clone()], control);
        loop {
            let block: Vec<Range<usize>> = runs.by_ref().take(n_runs).collect();
            let Some(seen) = block.last().map(|run| run.end) else { break };
            let marks = block.par_iter().map(mark).collect::<Result<Vec<_>, SurfaceError>>()?;
            marks.into_iter().try_for_each(|marks| self.add(&marks))?;
            let grid_points = 512 * self.n_reached;
            if grid_points > limits.max_grid_points {
                let all = to_u64(grid_points as f64 * (atoms.len() as f64 / seen as f64));
                let all = all.min(lattice.box_points.max(grid_points));
                return Err(grid_limit::exceeded(lattice.spacing, all, 1, limits));
            }
            if self.n_candidates > candidates::limit(limits) {
                return Err(candidates::exceeded(&[lattice], self.n_candidates, limits));
            }
            // Atoms are in tile order.
            self.complete(atoms.get(seen).map(|next| tile_of(next.cell)[2] + first_step))?;
        }
        Ok(())
    }

    /// Adds the marks of a run.
    fn add(&mut self, marks: &Marks) -> Result<(), OutOfMemory> {
        self.memory.reserve_rows(&mut self.open, marks.tiles.len())?;
        self.memory.reserve_entries(&mut self.index, marks.tiles.len())?;
        for mark in &marks.tiles {
            self.n_candidates += mark.candidates;
            match self.index.entry(mark.tile) {
                Entry::Vacant(entry) => {
                    entry.insert(to_u32(self.open.len()));
                    self.n_reached += count_ones(&mark.reached);
                    self.open.push(*mark);
                }
                Entry::Occupied(entry) => {
                    let tile = &mut self.open[*entry.get() as usize];
                    let before = count_ones(&tile.reached);
                    tile.add(mark);
                    self.n_reached += count_ones(&tile.reached) - before;
                }
            }
        }
        if self.lists {
            self.memory.reserve_rows(&mut self.atom_bricks, marks.atom_bricks.len())?;
            self.atom_bricks.extend_from_slice(&marks.atom_bricks);
        }
        Ok(())
    }

    /// Moves complete tiles from the open ones to `tiles` if they are listed. Complete are the tiles below layer
    /// `from`, because no further run reaches them, and all tiles if there is no further run.
    fn complete(&mut self, from: Option<i32>) -> Result<(), OutOfMemory> {
        if from.is_some() && self.open.len() < self.max_open {
            return Ok(());
        }
        self.open.par_sort_unstable_by_key(|mark| tile_order(mark.tile));
        let n = from.map_or(self.open.len(), |from| self.open.partition_point(|mark| mark.tile[2] < from));
        if self.lists && self.tiles.is_empty() && n == self.open.len() {
            std::mem::swap(&mut self.tiles, &mut self.open);
        } else if self.lists {
            self.memory.reserve_rows(&mut self.tiles, n)?;
            self.tiles.extend(self.open.drain(..n));
        } else {
            self.open.drain(..n);
        }
        self.index.clear();
        self.index.extend(self.open.iter().map(|mark| mark.tile).zip(0..));
        self.max_open = MIN_OPEN.max(2 * self.open.len());
        Ok(())
    }
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    use proptest::prelude::*;

    use super::marks::local_brick;
    use super::*;
    use crate::lattice::to_i32;
    use crate::memory::MemoryMeter;
    use crate::{Spheres, SurfaceOptions, SurfaceParams};

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
            let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap(), &Control::default()).unwrap();
            assert_eq!(lattice.atoms[0].cell, [-1; 3]);
            let occupancy = Occupancy::new(&lattice, &SurfaceLimits::default(), &Control::default()).unwrap();
            assert_eq!(format!("{:?}", occupancy.tiles), format!("{:?}", brute_force(&lattice, &lattice.atoms)));
        }
    }

    /// Memory with a limit.
    #[derive(Debug)]
    struct Meter {
        limit: u64,
        held: AtomicU64,
        most: AtomicU64,
    }

    impl MemoryMeter for Meter {
        fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
            let held = self.held.fetch_add(bytes, Ordering::Relaxed) + bytes;
            if held > self.limit {
                self.shrink(bytes);
                return Err(OutOfMemory::Budget { needed: bytes, held: held - bytes, limit: self.limit });
            }
            self.most.fetch_max(held, Ordering::Relaxed);
            Ok(())
        }

        fn shrink(&self, bytes: u64) {
            self.held.fetch_sub(bytes, Ordering::Relaxed);
        }
    }

    fn meter(limit: u64) -> (Arc<Meter>, Control<'static>) {
        let meter = Arc::new(Meter { limit, held: AtomicU64::new(0), most: AtomicU64::new(0) });
        let memory: Arc<dyn MemoryMeter> = Arc::<Meter>::clone(&meter);
        (meter, Control { memory, ..Control::default() })
    }

    /// Lattice of 12,167 atoms, each at the corner of eight tiles that no other atom reaches.
    fn sparse() -> Lattice {
        let column = |step: i32| (0..23 * 23 * 23).map(|i| f64::from(256 * (i / step % 23))).collect();
        let spheres = Spheres::new(column(1), column(23), column(529), vec![1.7; 23 * 23 * 23]).unwrap();
        let options = SurfaceOptions { resolution: Some(1.0), ..SurfaceOptions::default() };
        Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap(), &Control::default()).unwrap()
    }

    #[test]
    fn sparse_atoms_are_marked_in_blocks_within_the_memory_of_the_meter() {
        let (lattice, limits) = (sparse(), SurfaceLimits::default());
        let (listing, control) = meter(u64::MAX);
        let occupancy = Occupancy::new(&lattice, &limits, &control).unwrap();
        assert_eq!(occupancy.tiles.len(), 8 * 23 * 23 * 23);
        assert_eq!(format!("{:?}", occupancy.tiles), format!("{:?}", brute_force(&lattice, &lattice.atoms)));
        let rows = (size_of_val(&*occupancy.tiles) + size_of_val(&*occupancy.atom_bricks)) as u64;
        assert!(listing.held.load(Ordering::Relaxed) >= rows);
        let n_reached = occupancy.n_reached();
        drop(occupancy);
        assert_eq!(listing.held.load(Ordering::Relaxed), 0);

        let (counting, control) = meter(u64::MAX);
        assert_eq!(count(&lattice, &limits, &control).unwrap().reached, n_reached);
        assert_eq!(counting.held.load(Ordering::Relaxed), 0);
        let most = |meter: &Meter| meter.most.load(Ordering::Relaxed);
        assert!(most(&counting) < most(&listing), "{} {}", most(&counting), most(&listing));
        let (_, control) = meter(most(&counting) / 2);
        assert!(matches!(count(&lattice, &limits, &control), Err(SurfaceError::Memory(_))));

        // The limit of grid points ends the search early, with an estimate for all atoms.
        let (stopped, control) = meter(u64::MAX);
        let few = SurfaceLimits { max_grid_points: 512 * n_reached / 10, ..limits };
        let error = count(&lattice, &few, &control).unwrap_err();
        let exceeded = error.exceeded(Limit::GridPoints).unwrap();
        let grid_points = exceeded.actual.unwrap();
        // The box around the atoms is much larger.
        assert!(lattice.box_points > 2 * grid_points);
        assert!(grid_points.abs_diff(512 * n_reached) < 26 * n_reached, "{grid_points} {n_reached}");
        assert!(exceeded.suggested_resolution.unwrap() > 1.0);
        assert!(most(&stopped) <= most(&counting));
    }

    #[test]
    fn pairs_of_a_lattice_in_any_order_are_counted() {
        let mut lattice = sparse();
        let n = count(&lattice, &SurfaceLimits::default(), &Control::default()).unwrap().candidates;
        lattice.atoms.reverse();
        lattice.atoms.swap(5, 9000);
        let check = |max_candidates| {
            let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
            check_pairs(&[&lattice], &limits, &Control::default())
        };
        // The upper bound exceeds both limits, so the pairs are counted.
        assert!(most_pairs(&lattice) > n as f64 && check(n).is_ok());
        assert!(check(n - 1).unwrap_err().exceeded(Limit::Candidates).is_some(), "the control");
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
            let rounded = |c: f64| if on_grid { (c / resolution).round() * resolution } else { c };
            let column = |k: usize| atoms.iter().map(|(centre, _)| rounded(centre[k])).collect();
            let mut radii: Vec<f32> = atoms.iter().map(|(_, radius)| *radius).collect();
            radii[0] = largest;
            let spheres = Spheres::new(column(0), column(1), column(2), radii).unwrap();
            let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
            let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap(), &Control::default()).unwrap();
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
            let bricks = |brick: &AtomBrick| vec![(brick.tile, brick.local); brick.n_atoms as usize];
            let held = occupancy.atom_bricks.iter().flat_map(bricks);
            prop_assert!(held.eq(lattice.atoms.iter().map(|atom| (tile_of(atom.cell), local_brick(atom)))));
        }
    }
}
