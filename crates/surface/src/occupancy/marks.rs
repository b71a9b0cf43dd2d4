//! Bricks that the atoms of a run reach. The atoms of a run lie in one tile, and one thread marks their bricks.

use std::ops::{Range, RangeInclusive};

use super::{AtomBrick, TileOccupancy};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::{BRICK, LatticeAtom, TILE, tile_of, to_i32};
use crate::memory::{OutOfMemory, Reservation};
use crate::simd::dispatched;

/// Maximum number of atoms of a run: their counts fit 16 bits.
pub(super) const RUN: usize = 4096;
/// Number of atoms that are tested at once.
const LANES: usize = 8;

/// Squared gaps along one axis between the atoms of a batch and one brick for each.
#[derive(Clone, Copy, Default)]
struct Gaps {
    /// Gaps to the grid points of the brick.
    points: [f32; LANES],
    /// Gaps to the closed box that also holds the next brick's first grid point; infinite beyond the reach.
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
    /// Loads at most [`LANES`] atoms of the tile with first grid point `origin`.
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
            let (points, closed) = (gap(local - (lo + 7.0)), gap(local - (lo + 8.0)));
            gaps.points[lane] = points * points;
            gaps.closed[lane] = if closed <= self.reach[lane] { closed * closed } else { f32::INFINITY };
        }
        gaps
    }
}

/// Marks of a run.
pub(super) struct Marks {
    pub(super) tiles: Vec<TileOccupancy>,
    /// Bricks that hold the atoms.
    pub(super) atom_bricks: Vec<AtomBrick>,
    memory: Reservation,
}

/// Bricks of a tile and around it, counted by the atoms of the tile that reach them.
pub(super) struct CountedBricks {
    /// Number of bricks before the tile, per axis.
    before: i32,
    /// Number of bricks per axis.
    side: i32,
    /// Number of bricks per axis that an atom may reach. It is the same for all atoms, because mispredicting the end of
    /// a range costs more than testing bricks out of reach.
    n: i32,
    /// Per brick, the number of atoms that reach it in the low 16 bits, and the number of atoms that reach one of its
    /// grid points in the high 16 bits. Empty before [`Self::allocate`].
    counts: Vec<u32>,
    /// Range of the counted bricks per axis: the first one, and the one after the last. It covers few of `counts` if
    /// there are few atoms.
    counted: [[i32; 2]; 3],
}

impl CountedBricks {
    /// Returns the bricks around a tile whose atoms reach at most `longest`, without counts.
    pub(super) fn new(longest: f32) -> Self {
        let bricks = |length: f32| to_i32(f64::from(length * (1.0 / BRICK as f32)).floor());
        // An atom lies at most half a spacing outside the grid points of its tile. The rest is slack for rounding.
        let (before, n) = (bricks(longest + 0.52) + 1, bricks(2.0 * longest + 0.1) + 2);
        let side = before + 7 + n;
        Self { before, side, n, counts: Vec::new(), counted: [[side, 0]; 3] }
    }

    /// Tiles that contain the bricks, per axis, relative to the tile of the atoms.
    pub(super) fn steps(&self) -> RangeInclusive<i32> {
        (-self.before >> 3)..=((self.side - self.before - 1) >> 3)
    }

    /// Tiles that contain counted bricks, and the tile of the atoms, per axis, relative to the tile of the atoms.
    fn counted_steps(&self, axis: usize) -> RangeInclusive<i32> {
        let [first, end] = self.counted[axis];
        ((first - self.before) >> 3).min(0)..=((end - self.before - 1) >> 3).max(0)
    }

    /// Allocates the counts.
    fn allocate(&mut self, memory: &Reservation) -> Result<(), OutOfMemory> {
        memory.reserve_rows(&mut self.counts, (self.side.unsigned_abs() as usize).pow(3))?;
        self.counts.resize(self.counts.capacity(), 0);
        Ok(())
    }

    /// Index of a brick by its coordinates.
    #[inline(always)]
    fn index(&self, coords: [i32; 3]) -> usize {
        let [x, y, z] = coords.map(|c| c.unsigned_abs() as usize);
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
        for (counted, first) in self.counted.iter_mut().zip(&batch.first) {
            for (first, reach) in first.iter().zip(&batch.reach) {
                let start = first + self.before;
                if *reach >= 0.0 {
                    *counted = [counted[0].min(start), counted[1].max(start + self.n)];
                }
            }
        }
        for (z, iz) in gaps[2].iter().zip(0..) {
            for (y, iy) in gaps[1].iter().zip(0..) {
                for (row, x) in row.iter_mut().zip(&gaps[0]) {
                    // Computed in a local array, because the compiler must assume that `row` and the gaps overlap.
                    let mut reached = [0; LANES];
                    for (lane, reached) in reached.iter_mut().enumerate() {
                        let reach2 = batch.reach[lane] * batch.reach[lane];
                        let near = (y.closed[lane] + z.closed[lane]) + x.closed[lane] <= reach2;
                        let hit = (y.points[lane] + z.points[lane]) + x.points[lane] <= reach2;
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
        let range = |k: usize| starts[k].max(self.counted[k][0])..self.counted[k][1].min(starts[k] + 8);
        let [x, y, z] = [0, 1, 2].map(range);
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
/// Marks the bricks that `atoms`, all in one tile, reach.
pub(super) fn mark_run(atoms: &[LatticeAtom], reaches: &[f32], control: &Control<'_>) -> Result<Marks, SurfaceError> {
    let mut marks = Marks { tiles: Vec::new(), atom_bricks: Vec::new(), memory: Reservation::new(&control.memory) };
    let Some(first) = atoms.first() else { return Ok(marks) };
    let own = tile_of(first.cell);
    let (mut bricks, scratch) = (CountedBricks::new(longest(reaches)), Reservation::new(&control.memory));
    bricks.allocate(&scratch)?;
    let (mut gaps, mut row) = ([const { Vec::new() }; 3], Vec::new());
    for (atoms, reaches) in atoms.chunks(LANES).zip(reaches.chunks(LANES)) {
        control.check()?;
        bricks.add(&Batch::new(atoms, reaches, own.map(|t| t * TILE)), &mut gaps, &mut row);
    }
    for atom in atoms {
        let local = local_brick(atom);
        match marks.atom_bricks.last_mut() {
            Some(brick) if brick.local == local => brick.n_atoms += 1,
            _ => {
                marks.memory.reserve_rows(&mut marks.atom_bricks, 1)?;
                marks.atom_bricks.push(AtomBrick { tile: own, local, n_atoms: 1 });
            }
        }
    }
    for z in bricks.counted_steps(2) {
        for y in bricks.counted_steps(1) {
            for x in bricks.counted_steps(0) {
                let mut tile = bricks.occupancy([own[0] + x, own[1] + y, own[2] + z], [x, y, z]);
                if tile.tile == own {
                    // A tiny sphere may reach no grid point of its own brick, but the plan lists atoms by brick.
                    for brick in &marks.atom_bricks {
                        tile.occupied[brick.local as usize >> 6] |= 1 << (brick.local & 63);
                    }
                }
                if tile.occupied != [0; 8] {
                    marks.memory.reserve_rows(&mut marks.tiles, 1)?;
                    marks.tiles.push(tile);
                }
            }
        }
    }
    Ok(marks)
}
}

/// Rounds `v` down; a whole number may become one less. A cast would be slower, because it checks for values out of
/// range.
#[inline(always)]
fn floor(v: f32) -> i32 {
    // Adding 1.5·2²³ leaves the rounded integer in the low bits of the sum.
    const MAGIC: f32 = 12_582_912.0;
    (v - 0.5 + MAGIC).to_bits().cast_signed() - MAGIC.to_bits().cast_signed()
}

/// Cuts the atoms, which are sorted by tile, into runs of at most [`RUN`] atoms of one tile.
pub(super) fn runs(atoms: &[LatticeAtom]) -> impl Iterator<Item = Range<usize>> {
    let mut at = 0;
    std::iter::from_fn(move || {
        let start = at;
        let tile = tile_of(atoms.get(start)?.cell);
        let rest = &atoms[start..atoms.len().min(start + RUN)];
        at = start + rest.partition_point(|atom| tile_of(atom.cell) == tile);
        Some(start..at)
    })
}

/// Index of an atom's brick within its tile.
#[inline(always)]
pub(super) fn local_brick(atom: &LatticeAtom) -> u32 {
    let [x, y, z] = atom.cell;
    let brick = |c: i32| c.rem_euclid(TILE).unsigned_abs() / BRICK.unsigned_abs();
    brick(z) << 6 | brick(y) << 3 | brick(x)
}

/// Returns the maximum of `reaches`.
pub(super) fn longest(reaches: &[f32]) -> f32 {
    reaches.iter().copied().fold(0.0, f32::max)
}
