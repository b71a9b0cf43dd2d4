//! Stage `bin`: assigns atoms to tiles, and within a tile to bricks.
//!
//! A tile is 8 × 8 × 8 bricks, the unit of parallel work. A tile also evaluates the grid points on the faces of one
//! layer of bricks beyond its upper faces (index 8). They belong to the next tile, which computes the same bits.

use std::ops::Range;

use rustc_hash::FxHashMap;

use crate::control::Control;
use crate::error::SurfaceError;
use crate::groups::Groups;
use crate::lattice::{BRICK, Lattice, LatticeAtom, TILE, tile_order, to_f32, to_i32, to_u32};
use crate::memory::{MemoryMeter as _, Reservation};
use crate::params::SurfaceLimits;
use crate::simd::dispatched;
use crate::{candidates, grid_limit, occupancy};

/// Bricks along a tile's edge with the layer beyond.
pub(super) const SIDE: usize = 9;
/// Bricks of a tile with the layer beyond.
pub(super) const SLOTS: usize = SIDE * SIDE * SIDE;
/// Marks a candidate that reaches no grid point of the brick, only the gap up to the first grid points of its
/// neighbours. Such a candidate affects normals, not the field.
pub(super) const NORMAL_ONLY: u32 = 1 << 31;
/// Pairs of an atom and a tile between two checks of the cancellation flag.
const PAIRS_PER_CHECK: u64 = 1 << 16;
/// Memory of a tile's coordinates and the end of its atoms, bytes.
const TILE_BYTES: u64 = 16;
/// Memory for sorting a tile, bytes: its coordinates, number and rank.
const SORTED_TILE_BYTES: u64 = 24;
/// Atoms whose candidate pairs are counted and checked against the limit together: 190,000 pairs at most.
const ATOMS_PER_CHECK: usize = 256;
/// Maximum capacity of a list that is kept between tiles; longer lists are freed.
const KEPT_CAPACITY: usize = 4096;

/// The tiles that some atom reaches, in canonical order, with their atoms.
#[derive(Debug)]
pub(super) struct Tiles {
    /// Tile coordinates, ordered by z, y, x.
    pub(super) coords: Vec<[i32; 3]>,
    /// Index of a tile by its coordinates.
    pub(super) index: FxHashMap<[i32; 3], u32>,
    /// Atom indices, ascending within a tile.
    atoms: Groups,
}

/// First and last tile per axis whose grid points, with the layer beyond, the atom reaches.
fn tile_range(atom: &LatticeAtom, reach: f64) -> [[i32; 2]; 3] {
    let side = f64::from(TILE);
    std::array::from_fn(|k| {
        let c = atom.position(k);
        [to_i32(((c - reach) / side - 1.0).ceil()), to_i32(((c + reach) / side).floor())]
    })
}

fn boxed(range: [[i32; 2]; 3]) -> impl Iterator<Item = [i32; 3]> {
    let [x, y, z] = range;
    (z[0]..=z[1]).flat_map(move |tz| (y[0]..=y[1]).flat_map(move |ty| (x[0]..=x[1]).map(move |tx| [tx, ty, tz])))
}

impl Tiles {
    /// Assigns atoms to tiles.
    ///
    /// # Errors
    /// Returns [`SurfaceError::Limit`] before memory is allocated beyond the limits, and [`SurfaceError::Cancelled`].
    pub(super) fn new(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<Self, SurfaceError> {
        // Only the result stays added.
        let (lasting, scratch) = (Reservation::new(&control.memory), Reservation::new(&control.memory));
        let mut index: FxHashMap<[i32; 3], u32> = FxHashMap::default();
        let (mut pairs, mut unchecked) = (0_u64, 0_u64);
        // Two facts bound the allocations below. Every tile in reach holds at least one occupied brick. A tile in reach
        // of an atom holds at least one of its candidate pairs, unless the atom reaches only a corner of the tile.
        let max_tiles = limits.max_grid_points / 512 + 1;
        let max_pairs = candidates::limit(limits).max(8 * lattice.atoms.len() as u64).min(u64::from(u32::MAX));
        // Tiles in the order of their first atoms, and every pair of an atom and such a tile.
        let mut hits: Vec<(u32, u32)> = Vec::new();
        scratch.reserve_rows(&mut hits, 2 * lattice.atoms.len())?;
        // The last tile of each parity: neighbouring atoms look up the same eight tiles repeatedly.
        let mut recent = [([i32::MAX; 3], 0_u32); 8];
        for (i, atom) in (0_u32..).zip(&lattice.atoms) {
            let range = tile_range(atom, lattice.reach(atom));
            let n: u64 = range.iter().map(|[lo, hi]| u64::from(lo.abs_diff(*hi)) + 1).product();
            pairs += n;
            unchecked += n;
            if unchecked > PAIRS_PER_CHECK {
                control.check()?;
                unchecked = 0;
            }
            if n > max_tiles || index.len() as u64 > max_tiles {
                // A tile has up to 512 bricks, which are counted up to the limit, in the memory of these lists.
                drop((index, hits, lasting, scratch));
                let counted = occupancy::count(lattice, limits, control).err();
                let exceeded = || grid_limit::exceeded(lattice.spacing, limits.max_grid_points + 1, 1, limits);
                return Err(counted.unwrap_or_else(exceeded));
            }
            if pairs > max_pairs {
                return Err(candidates::exceeded(&[lattice], pairs, limits));
            }
            // Both limits have 32 bits.
            scratch.reserve_rows(&mut hits, usize::try_from(n).unwrap_or(usize::MAX))?;
            for tile in boxed(range) {
                let parity = tile.iter().fold(0, |p, c| p << 1 | usize::from(c & 1 == 1));
                let (cached, id) = &mut recent[parity];
                if *cached != tile {
                    let next = to_u32(index.len());
                    lasting.reserve_entries(&mut index, 1)?;
                    (*cached, *id) = (tile, *index.entry(tile).or_insert(next));
                }
                hits.push((*id, i));
            }
        }
        lasting.grow(TILE_BYTES * (index.len() + 1) as u64 + (size_of::<u32>() * hits.len()) as u64)?;
        scratch.grow(SORTED_TILE_BYTES * (index.len() + 1) as u64)?;
        let mut met: Vec<([i32; 3], u32)> = index.iter().map(|(tile, id)| (*tile, *id)).collect();
        met.sort_unstable_by_key(|(tile, _)| tile_order(*tile));
        let mut rank = vec![0_usize; met.len()];
        for (order, (tile, id)) in met.iter().enumerate() {
            rank[*id as usize] = order;
            index.insert(*tile, to_u32(order));
        }
        // Atoms are ascending within a tile, as that is the order of the hits.
        let atoms = Groups::new(met.len(), hits.iter().map(|(id, atom)| (rank[*id as usize], *atom)));
        let coords = met.iter().map(|(tile, _)| *tile).collect();
        lasting.keep();
        Ok(Self { coords, index, atoms })
    }

    /// Number of tiles.
    pub(super) fn len(&self) -> usize {
        self.coords.len()
    }

    /// The atoms that reach tile `t`, ascending.
    pub(super) fn atoms(&self, t: usize) -> &[u32] {
        self.atoms.get(t)
    }
}

/// Bricks of a tile and their candidate atoms. Reused from tile to tile.
#[derive(Debug)]
pub(super) struct Bricks {
    /// Candidates per slot: atom indices, ascending, some marked [`NORMAL_ONLY`].
    lists: Vec<Vec<u32>>,
    /// Per slot the number of candidates that reach a grid point.
    pub(super) reaching: Vec<u32>,
}

impl Default for Bricks {
    fn default() -> Self {
        Self { lists: vec![Vec::new(); SLOTS], reaching: vec![0; SLOTS] }
    }
}

/// Squared distances along one axis from an atom to the grid points of each of the 9 brick layers, and to the closed
/// box that also holds the next brick's first grid point. The layer beyond the tile has its first grid point only.
struct AxisReach {
    first: usize,
    last: usize,
    points: [f32; SIDE],
    closed: [f32; SIDE],
}

impl AxisReach {
    #[inline(always)]
    fn new(local: f32, reach: f32) -> Self {
        let mut axis = Self { first: SIDE, last: 0, points: [0.0; SIDE], closed: [0.0; SIDE] };
        for b in 0..SIDE {
            let lo = (b * 8) as f32;
            let beyond = b == SIDE - 1;
            let gap = |hi: f32| (lo - local).max(local - hi).max(0.0);
            let (points, closed) = if beyond { (gap(lo), gap(lo)) } else { (gap(lo + 7.0), gap(lo + 8.0)) };
            (axis.points[b], axis.closed[b]) = (points * points, closed * closed);
            if closed <= reach {
                (axis.first, axis.last) = (axis.first.min(b), b + 1);
            }
        }
        axis
    }
}

impl Bricks {
    /// The candidates of a slot.
    pub(super) fn of(&self, slot: usize) -> &[u32] {
        &self.lists[slot]
    }

    /// Finds the candidates of every brick in `layers` of a tile, and in the layer beyond. Calls `count` with the
    /// number of candidate pairs of the layers' own bricks, in portions; an error of `count` ends the search.
    ///
    /// # Errors
    /// Returns the errors of `count`.
    pub(super) fn fill(
        &mut self,
        lattice: &Lattice,
        tile: [i32; 3],
        layers: &Range<usize>,
        atoms: &[u32],
        mut count: impl FnMut(u64) -> Result<(), SurfaceError>,
    ) -> Result<(), SurfaceError> {
        self.clear();
        atoms.chunks(ATOMS_PER_CHECK).try_for_each(|atoms| count(find(self, lattice, tile, layers, atoms)))
    }

    /// Removes all candidates.
    pub(super) fn clear(&mut self) {
        self.lists.iter_mut().for_each(Vec::clear);
        self.reaching.iter_mut().for_each(|n| *n = 0);
    }

    /// Frees lists that are much longer than those of a typical structure.
    pub(super) fn free_long_lists(&mut self) {
        self.lists.iter_mut().filter(|list| list.capacity() > KEPT_CAPACITY).for_each(|list| *list = Vec::new());
    }
}

dispatched! {
/// Appends the candidates among `atoms`, which come after all earlier ones in canonical order. Returns the number of
/// candidate pairs of the layers' own bricks.
fn find(bricks: &mut Bricks, lattice: &Lattice, tile: [i32; 3], layers: &Range<usize>, atoms: &[u32]) -> u64 {
    let origin = tile.map(|t| t * TILE);
    let mut own = 0;
    for &ix in atoms {
        let atom = &lattice.atoms[ix as usize];
        // Slightly more than the support: rounding must not lose a pair, and an additional pair adds zero.
        let reach = to_f32(lattice.reach(atom) * (1.0 + 1e-5)) + 1e-3;
        let local = |k: usize| (atom.cell[k] - origin[k]) as f32 + atom.frac[k];
        let [x, y, z] = std::array::from_fn(|k| AxisReach::new(local(k), reach));
        let reach2 = reach * reach;
        for bz in z.first.max(layers.start)..z.last.min(layers.end + 1) {
            for by in y.first..y.last {
                let closed = y.closed[by] + z.closed[bz];
                let points = y.points[by] + z.points[bz];
                let row = (bz * SIDE + by) * SIDE;
                for bx in x.first..x.last {
                    if closed + x.closed[bx] > reach2 {
                        continue;
                    }
                    // A brick in the next layer adds no vertices here; only its grid points matter.
                    let beyond = bz == layers.end || by == SIDE - 1 || bx == SIDE - 1;
                    own += u64::from(!beyond);
                    let reaches = points + x.points[bx] <= reach2;
                    if !reaches && beyond {
                        continue;
                    }
                    let slot = row + bx;
                    bricks.reaching[slot] += u32::from(reaches);
                    bricks.lists[slot].push(if reaches { ix } else { ix | NORMAL_ONLY });
                }
            }
        }
    }
    own
}
}

/// A slot's brick index within the tile, 0 to 8 per axis.
#[inline(always)]
pub(super) fn slot_brick(slot: usize) -> [usize; 3] {
    [slot % SIDE, slot / SIDE % SIDE, slot / (SIDE * SIDE)]
}

/// First grid point of a slot's brick.
pub(super) fn slot_origin(tile: [i32; 3], slot: usize) -> [i32; 3] {
    let brick = slot_brick(slot);
    std::array::from_fn(|k| tile[k] * TILE + i32::try_from(brick[k]).unwrap_or_default() * BRICK)
}
