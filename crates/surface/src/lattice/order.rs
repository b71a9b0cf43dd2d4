//! Canonical order of the spheres on a lattice: a sort by bucket, then within each bucket. Every loop looks at
//! cancellation.

use std::cmp::Ordering;
use std::ops::Range;

use rayon::prelude::*;

use super::{BRICK, LatticeAtom, TILE, effective_radius, tile_of, tile_order, to_f32, to_i32, to_u32};
use crate::checked_sort;
use crate::column::Column;
use crate::control::Control;
use crate::error::SurfaceError;
use crate::groups::{GroupCounts, Groups};
use crate::kernel::Shape;
use crate::memory::Reservation;
use crate::params::SurfaceParams;
use crate::simd::dispatched;
use crate::spheres::Spheres;

/// Spheres whose atoms on the lattice are computed.
pub(super) struct Placing<'a> {
    pub(super) spheres: &'a Spheres,
    pub(super) params: &'a SurfaceParams,
    pub(super) shape: &'a Shape,
    pub(super) control: &'a Control<'a>,
}

impl Placing<'_> {
    #[inline(always)]
    fn atom(&self, i: usize) -> LatticeAtom {
        let spacing = self.params.resolution;
        let length = self.shape.length(effective_radius(self.spheres.radius(i), self.params)) / spacing;
        let scaled = self.spheres.centre(i).map(|c| c / spacing);
        let cell = scaled.map(f64::round);
        LatticeAtom {
            cell: cell.map(to_i32),
            inv_length2: to_f32((length * length).recip()),
            frac: std::array::from_fn(|k| to_f32(scaled[k] - cell[k])),
            source: u32::try_from(i).unwrap_or(u32::MAX),
        }
    }

    #[inline(always)]
    fn cell(&self, c: [f64; 3]) -> [i32; 3] {
        c.map(|c| to_i32((c / self.params.resolution).round()))
    }

    /// Returns the atoms by tile, brick within the tile, and cell within the brick; ties by offset, by size, and last
    /// by the order of the input. `bounds` are the lowest and highest coordinates.
    pub(super) fn in_canonical_order(&self, bounds: [[f64; 3]; 2]) -> Result<Column<LatticeAtom>, SurfaceError> {
        let n = self.spheres.len();
        // Rounding is monotone, so the outermost tiles are those of the outermost coordinates.
        let tiles = bounds.map(|c| tile_of(self.cell(c)));
        let ranks = TileRanks::new(tiles, n, |i| tile_of(self.cell(self.spheres.centre(i))), self.control)?;
        let keys = SortKeys::new(ranks, n);
        // Independent of the number of threads. The tables of all parts together take at most a byte per atom.
        let part = PART.max(n / MAX_PARTS);
        let parts = (0..n.div_ceil(part))
            .into_par_iter()
            .map(|i| by_bucket(self, &keys, i * part..n.min((i + 1) * part)))
            .collect::<Result<Vec<Groups>, SurfaceError>>()?;
        let mut atoms = Column::zeroed(n);
        let mut rest = &mut atoms[..];
        let mut buckets = Vec::with_capacity(keys.n_buckets);
        for bucket in 0..keys.n_buckets {
            let (own, others) = rest.split_at_mut(parts.iter().map(|part| part.get(bucket).len()).sum());
            buckets.push(own);
            rest = others;
        }
        let write = |scratch: &mut Vec<_>, (bucket, atoms): (usize, &mut [LatticeAtom])| {
            write_bucket(self, &keys, &parts, bucket, scratch, atoms)
        };
        buckets.into_par_iter().enumerate().try_for_each_init(Vec::new, write)?;
        Ok(atoms)
    }
}

/// Minimum number of atoms that one task sorts by bucket.
const PART: usize = 1 << 13;
/// Maximum number of such tasks.
const MAX_PARTS: usize = 64;
/// Mean number of atoms of a bucket: they fit the L1 cache.
const BUCKET: usize = 512;
/// Minimum number of atoms of a bucket whose scratch memory is reserved. The scratch memory of smaller buckets takes
/// less than a megabyte per thread.
const LARGE_BUCKET: usize = 1 << 14;
/// Atoms between two checks of the cancellation flag: at most a few milliseconds.
const ATOMS_PER_CHECK: usize = 1 << 13;
/// Number of bits of an atom's brick and cell within its tile.
const CELL_BITS: u32 = 18;

/// Sort keys of atoms: tile, brick and cell. The highest bits of a key are the number of a bucket. Buckets are sorted
/// independently.
struct SortKeys {
    rank: TileRanks,
    n_buckets: usize,
    /// Number of bits below the number of the bucket: at most 32, because [`TileRanks`] are bounded.
    shift: u32,
}

impl SortKeys {
    /// Keys of `n` atoms.
    fn new(rank: TileRanks, n: usize) -> Self {
        let n_buckets = n.div_ceil(BUCKET).next_power_of_two();
        let bits = CELL_BITS + rank.count().next_power_of_two().trailing_zeros();
        Self { rank, n_buckets, shift: bits.saturating_sub(n_buckets.trailing_zeros()) }
    }

    /// Returns the key of an atom in `cell`.
    #[inline(always)]
    fn of(&self, cell: [i32; 3]) -> u64 {
        let local = cell.map(|c| c.rem_euclid(TILE).unsigned_abs());
        let brick = local.map(|c| c / BRICK.unsigned_abs());
        let cell_in_brick = local.map(|c| c % BRICK.unsigned_abs());
        let pack = |v: [u32; 3]| u64::from(v[0] | v[1] << 3 | v[2] << 6);
        self.rank.of(tile_of(cell)) << CELL_BITS | pack(brick) << 9 | pack(cell_in_brick)
    }
}

dispatched! {
/// Sorts the indices of `spheres` by bucket.
fn by_bucket(placing: &Placing<'_>, keys: &SortKeys, spheres: Range<usize>) -> Result<Groups, SurfaceError> {
    let mut counts = GroupCounts::new(keys.n_buckets);
    let bucket = |i| u32::try_from(keys.of(placing.cell(placing.spheres.centre(i))) >> keys.shift).unwrap_or(u32::MAX);
    let mut buckets: Vec<u32> = Vec::with_capacity(spheres.len());
    for first in spheres.clone().step_by(ATOMS_PER_CHECK) {
        placing.control.check()?;
        for i in first..spheres.end.min(first + ATOMS_PER_CHECK) {
            let bucket = bucket(i);
            counts.add(bucket as usize);
            buckets.push(bucket);
        }
    }
    let mut groups = counts.groups();
    let mut pairs = buckets.iter().zip(to_u32(spheres.start)..);
    for _ in (0..buckets.len()).step_by(ATOMS_PER_CHECK) {
        placing.control.check()?;
        pairs.by_ref().take(ATOMS_PER_CHECK).for_each(|(bucket, i)| groups.push(*bucket as usize, i));
    }
    Ok(groups)
}
}

dispatched! {
/// Writes the atoms of a bucket in canonical order.
fn write_bucket(
    placing: &Placing<'_>,
    keys: &SortKeys,
    parts: &[Groups],
    bucket: usize,
    scratch: &mut Vec<LatticeAtom>,
    atoms: &mut [LatticeAtom],
) -> Result<(), SurfaceError> {
    let control = placing.control;
    control.check()?;
    // All atoms may lie in one bucket.
    let bytes = (size_of::<LatticeAtom>() + size_of::<u64>()) * atoms.len();
    let large = if atoms.len() < LARGE_BUCKET { 0 } else { bytes };
    let _memory = control.reserve(large as u64)?;
    scratch.clear();
    scratch.reserve(atoms.len());
    for part in parts {
        for indices in part.get(bucket).chunks(ATOMS_PER_CHECK) {
            control.check()?;
            scratch.extend(indices.iter().map(|&i| placing.atom(i as usize)));
        }
    }
    let mask = (1 << keys.shift) - 1;
    // Keys are equal above the mask. Spheres with equal keys keep their order.
    let mut order: Vec<u64> =
        scratch.iter().zip(0_u64..).map(|(atom, i)| (keys.of(atom.cell) & mask) << 32 | i).collect();
    checked_sort::sort(&mut order, Ord::cmp, control)?;
    for (atom, key) in atoms.iter_mut().zip(&order) {
        *atom = scratch[usize::try_from(key & u64::from(u32::MAX)).unwrap_or(usize::MAX)];
    }
    drop(order);
    if large > 0 {
        *scratch = Vec::new();
    }
    let same = |a: &LatticeAtom, b: &LatticeAtom| a.cell == b.cell;
    for same in atoms.chunk_by_mut(same).filter(|same| same.len() > 1) {
        checked_sort::sort(same, by_offset, control)?;
    }
    Ok(())
}
}

/// Order of the atoms of a cell.
fn by_offset(a: &LatticeAtom, b: &LatticeAtom) -> Ordering {
    let axis = |k: usize| a.frac[k].total_cmp(&b.frac[k]);
    let size = a.inv_length2.total_cmp(&b.inv_length2);
    axis(2).then(axis(1)).then(axis(0)).then(size).then(a.source.cmp(&b.source))
}

/// Ranks that order tiles. Their number is at most 4,096 plus 16 per atom.
enum TileRanks {
    /// Ranks within the box with these sides from the lowest tile on.
    Box { lo: [i32; 3], side: [u64; 3] },
    /// Ranks among the tiles with atoms, if the box has too many.
    Listed {
        /// Sort keys of the tiles.
        order: Vec<[i32; 3]>,
        /// Memory of `order`.
        _memory: Reservation,
    },
}

impl TileRanks {
    /// Ranks the tiles of `n` atoms, given by `of_atom`. They lie between the tiles `lo` and `hi`.
    fn new(
        [lo, hi]: [[i32; 3]; 2],
        n: usize,
        of_atom: impl Fn(usize) -> [i32; 3] + Sync,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let side: [u64; 3] = std::array::from_fn(|k| u64::from(lo[k].abs_diff(hi[k])) + 1);
        // Each side is below 2²⁰, as coordinates are bounded.
        if side.iter().product::<u64>() <= 16 * n as u64 + 4096 {
            return Ok(Self::Box { lo, side });
        }
        let memory = control.reserve((size_of::<[i32; 3]>() * n) as u64)?;
        let mut order: Vec<[i32; 3]> = (0..n).into_par_iter().map(|i| tile_order(of_atom(i))).collect();
        checked_sort::sort(&mut order, Ord::cmp, control)?;
        order.dedup();
        Ok(Self::Listed { order, _memory: memory })
    }

    /// Number of ranks.
    fn count(&self) -> u64 {
        match self {
            Self::Box { side, .. } => side.iter().product(),
            Self::Listed { order, .. } => order.len() as u64,
        }
    }

    #[inline(always)]
    fn of(&self, tile: [i32; 3]) -> u64 {
        match self {
            Self::Box { lo, side } => {
                let [x, y, z]: [u64; 3] = std::array::from_fn(|k| u64::from(tile[k].abs_diff(lo[k])));
                (z * side[1] + y) * side[0] + x
            }
            Self::Listed { order, .. } => order.partition_point(|&t| t < tile_order(tile)) as u64,
        }
    }
}
