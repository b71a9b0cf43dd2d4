//! The sampling lattice: spheres in units of the grid spacing, in one canonical order.
//!
//! Samples lie at multiples of the spacing, so the lattice does not depend on the tiling of a structure. A sphere's
//! centre is a lattice cell plus a fraction: the offset of a sample from a centre then depends on these two alone, bit
//! for bit, in every brick and tile, without 64-bit arithmetic.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::column::Column;
use super::error::SurfaceError;
use super::kernel::Profile;
use super::params::SurfaceParams;
use super::simd::dispatched;
use super::spheres::Spheres;

/// Samples along a brick's edge.
pub const BRICK: i32 = 8;
/// Samples in a brick.
pub const BRICK_SAMPLES: usize = 512;
/// Samples along a tile's edge: 8 bricks.
pub const TILE: i32 = 64;

/// Maximum number of atoms: candidate lists store indices of 31 bits.
const MAX_ATOMS: usize = (1 << 31) - 1;

/// Edge parameters are kept this far from both ends, in every backend: no triangle degenerates and no two vertices of
/// different edges coincide.
pub(super) const EDGE_MARGIN: f32 = 1.0 / 1024.0;

/// A sphere on the lattice. 32 bytes, the layout that the shaders share.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct LatticeAtom {
    /// The sample nearest to the centre.
    pub cell: [i32; 3],
    /// 1/ρ² in units of the spacing: u = d² × this.
    pub inv_length2: f32,
    /// The centre's offset from `cell`, in [−½, ½] spacings.
    pub frac: [f32; 3],
    /// Index of the sphere in the caller's input.
    pub source: u32,
}

impl LatticeAtom {
    /// The centre in spacings from the origin.
    #[must_use]
    pub fn position(&self, axis: usize) -> f64 {
        f64::from(self.cell[axis]) + f64::from(self.frac[axis])
    }
}

/// Spheres on a lattice, in canonical order: by tile, brick, cell and offset, independent of the input's order.
#[derive(Debug, Clone)]
pub struct Lattice {
    /// Spacing, Å.
    pub spacing: f64,
    /// The sample that mesh positions are relative to.
    pub centre: [i32; 3],
    /// The spheres.
    pub atoms: Column<LatticeAtom>,
    /// The kernel's constants.
    pub profile: Profile,
    /// u from which on a sphere's density is 0.
    pub support: f64,
    /// Cells of the box around all supports.
    pub box_cells: u64,
}

impl Lattice {
    /// Places `spheres` on the lattice of `params.resolution`.
    ///
    /// # Errors
    /// [`SurfaceError::NoSpheres`]; [`SurfaceError::BadParameter`] if scale and offset leave a radius of 0 or less, or
    /// there are more spheres than 31 bits can number.
    pub fn new(spheres: &Spheres, params: &SurfaceParams) -> Result<Self, SurfaceError> {
        let Some([lo, hi]) = spheres.bounds() else { return Err(SurfaceError::NoSpheres) };
        if spheres.len() > MAX_ATOMS {
            let expected = format!("at most {MAX_ATOMS} spheres");
            return Err(SurfaceError::BadParameter { name: "spheres", value: spheres.len().to_string(), expected });
        }
        let spacing = params.resolution;
        let profile = Profile::new(params);
        let (smallest, largest) = spheres.radius_range();
        params.check_radius(smallest)?;
        let largest = effective_radius(largest, params);
        let atoms = Placing { spheres, params, profile: &profile }.in_canonical_order([lo, hi]);
        let margin = 2.0 * profile.reach(profile.length(largest));
        let box_cells = (0..3).map(|k| ((hi[k] - lo[k] + margin) / spacing).ceil()).product::<f64>();
        Ok(Self {
            spacing,
            centre: std::array::from_fn(|k| to_i32((0.5 * (lo[k] + hi[k]) / spacing).round())),
            atoms,
            profile,
            support: profile.support(),
            // Saturates: a sparse assembly's box may hold more cells than any integer type.
            box_cells: to_u64(box_cells),
        })
    }

    /// Distance in spacings from which on an atom's density is 0.
    #[must_use]
    pub fn reach(&self, atom: &LatticeAtom) -> f64 {
        (self.support / f64::from(atom.inv_length2)).sqrt()
    }

    /// Origin of mesh positions, Å.
    #[must_use]
    pub fn centre(&self) -> [f64; 3] {
        self.centre.map(|c| f64::from(c) * self.spacing)
    }
}

/// Returns an upper bound of a vertex's distance from the mesh's centre along any axis, Å, from spheres and parameters
/// alone, before any density is computed. 0 without spheres.
#[must_use]
pub fn extent(spheres: &Spheres, params: &SurfaceParams) -> f64 {
    let Some([lo, hi]) = spheres.bounds() else { return 0.0 };
    let profile = Profile::new(params);
    let (_, largest) = spheres.radius_range();
    let reach = profile.reach(profile.length(effective_radius(largest, params)));
    let half = (0..3).map(|k| 0.5 * (hi[k] - lo[k])).fold(0.0, f64::max);
    // The centre is a sample, half a spacing from the middle at most; a vertex lies on an edge that begins within
    // reach. Half a spacing more is far above every rounding.
    half + reach + 2.0 * params.resolution
}

/// Radius of a sphere after scale and offset, Å.
pub(super) fn effective_radius(r: f32, params: &SurfaceParams) -> f64 {
    f64::from(r) * params.radius_scale + params.radius_offset
}

/// Spheres that are being placed on the lattice.
struct Placing<'a> {
    spheres: &'a Spheres,
    params: &'a SurfaceParams,
    profile: &'a Profile,
}

impl Placing<'_> {
    #[inline(always)]
    fn atom(&self, i: usize) -> LatticeAtom {
        let spacing = self.params.resolution;
        let length = self.profile.length(effective_radius(self.spheres.radius(i), self.params)) / spacing;
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

    /// Returns the sort key of atom `i`: tile, brick and cell.
    #[inline(always)]
    fn key(&self, rank: &TileRanks, i: usize) -> u64 {
        let cell = self.cell(self.spheres.centre(i));
        let local = cell.map(|c| c.rem_euclid(TILE).unsigned_abs());
        let brick = local.map(|c| c / BRICK.unsigned_abs());
        let cell_in_brick = local.map(|c| c % BRICK.unsigned_abs());
        let pack = |v: [u32; 3]| u64::from(v[0] | v[1] << 3 | v[2] << 6);
        rank.of(tile_of(cell)) << PLACE_BITS | pack(brick) << 9 | pack(cell_in_brick)
    }

    /// The atoms by tile, brick within the tile, cell within the brick; ties by offset, size, and the input's order
    /// last. `bounds`: lowest and highest coordinates.
    fn in_canonical_order(&self, bounds: [[f64; 3]; 2]) -> Column<LatticeAtom> {
        let n = self.spheres.len();
        // Rounding is monotone, so the outermost tiles are those of the outermost coordinates.
        let rank =
            TileRanks::new(bounds.map(|c| tile_of(self.cell(c))), n, |i| tile_of(self.cell(self.spheres.centre(i))));
        let mut atoms = Column::zeroed(n);
        let mut keys: Column<u128> = Column::zeroed(n);
        keys.par_chunks_mut(PART).enumerate().for_each(|(part, keys)| write_keys(self, &rank, part * PART, keys));
        keys.par_sort_unstable();
        atoms.par_chunks_mut(PART).zip(keys.par_chunks(PART)).for_each(|(atoms, keys)| place(self, keys, atoms));
        let same = |a: &LatticeAtom, b: &LatticeAtom| a.cell == b.cell;
        let order = |same: &mut [LatticeAtom]| {
            same.sort_unstable_by(|a, b| {
                let axis = |k: usize| a.frac[k].total_cmp(&b.frac[k]);
                let size = a.inv_length2.total_cmp(&b.inv_length2);
                axis(2).then(axis(1)).then(axis(0)).then(size).then(a.source.cmp(&b.source))
            });
        };
        atoms.par_chunk_by_mut(same).filter(|same| same.len() > 1).for_each(order);
        atoms
    }
}

/// Atoms per placement task.
const PART: usize = 4096;
/// Bits of an atom's brick and cell within its tile.
const PLACE_BITS: u32 = 18;

dispatched! {
/// Writes the sort keys of the atoms from `first` on: their places above their indices.
fn write_keys(placing: &Placing<'_>, rank: &TileRanks, first: usize, keys: &mut [u128]) {
    for (i, key) in (first..).zip(keys) {
        *key = u128::from(placing.key(rank, i)) << 64 | i as u128;
    }
}
}

dispatched! {
/// Writes the atoms whose sort keys are `keys`.
fn place(placing: &Placing<'_>, keys: &[u128], atoms: &mut [LatticeAtom]) {
    for (key, atom) in keys.iter().zip(atoms) {
        *atom = placing.atom(usize::try_from(key & u128::from(u64::MAX)).unwrap_or(usize::MAX));
    }
}
}

/// Numbers that order tiles, below 2⁴⁶.
enum TileRanks {
    /// Ranks within the box with these sides from the lowest tile on.
    Box { lo: [i32; 3], side: [u64; 3] },
    /// Ranks among the tiles with atoms, if the box has too many.
    Listed(Vec<[i32; 3]>),
}

impl TileRanks {
    /// For `n` atoms in the tiles `of_atom`, between the tiles `lo` and `hi`.
    fn new([lo, hi]: [[i32; 3]; 2], n: usize, of_atom: impl Fn(usize) -> [i32; 3] + Sync) -> Self {
        let side: [u64; 3] = std::array::from_fn(|k| u64::from(lo[k].abs_diff(hi[k])) + 1);
        // Each side is below 2²⁰, as coordinates are bounded.
        if side.iter().product::<u64>() < 1 << 46 {
            return Self::Box { lo, side };
        }
        let mut order: Vec<[i32; 3]> = (0..n).into_par_iter().map(|i| tile_order(of_atom(i))).collect();
        order.par_sort_unstable();
        order.dedup();
        Self::Listed(order)
    }

    #[inline(always)]
    fn of(&self, tile: [i32; 3]) -> u64 {
        match self {
            Self::Box { lo, side } => {
                let [x, y, z]: [u64; 3] = std::array::from_fn(|k| u64::from(tile[k].abs_diff(lo[k])));
                (z * side[1] + y) * side[0] + x
            }
            Self::Listed(order) => order.partition_point(|&t| t < tile_order(tile)) as u64,
        }
    }
}

/// The tile that a sample belongs to.
// Written out, here and below: `map` may not be inlined, and these run for every atom.
#[inline(always)]
#[must_use]
pub fn tile_of([x, y, z]: [i32; 3]) -> [i32; 3] {
    [x.div_euclid(TILE), y.div_euclid(TILE), z.div_euclid(TILE)]
}

/// Tiles are ordered by z, then y, then x.
#[inline(always)]
#[must_use]
pub fn tile_order(tile: [i32; 3]) -> [i32; 3] {
    [tile[2], tile[1], tile[0]]
}

/// Returns a spacing slightly above `spacing`, rounded up to hundredths of an Å, as a suggestion that fits.
pub(crate) fn slightly_coarser(spacing: f64) -> f64 {
    (spacing * 105.0).ceil() / 100.0
}

/// Converts `v` to f32, rounding.
#[expect(clippy::cast_possible_truncation, reason = "rounding to single precision is intended")]
pub(crate) fn to_f32(v: f64) -> f32 {
    v as f32
}

/// `v`, an integer value, as i32. Coordinates are at most 1e5 Å and the spacing at least 0.01 Å: 1e7 fits.
#[expect(clippy::cast_possible_truncation, reason = "validated spheres and spacings keep it within ±1e7")]
pub(crate) fn to_i32(v: f64) -> i32 {
    debug_assert!(v.abs() < 1e9);
    v as i32
}

/// Converts an index to u32. Callers bound indices; if a bound were wrong, the saturated value would fail the next
/// look-up instead of aliasing another index.
pub(crate) fn to_u32(n: usize) -> u32 {
    debug_assert!(u32::try_from(n).is_ok(), "{n} is no 32-bit index");
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// `v` as u64, saturating at both ends.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
pub(crate) fn to_u64(v: f64) -> u64 {
    v as u64
}

#[cfg(test)]
mod tests {
    use std::cmp::Ordering;

    use super::*;
    use crate::surface::params::SurfaceOptions;

    /// Independent implementation of the canonical order.
    fn order(a: &LatticeAtom, b: &LatticeAtom) -> Ordering {
        let place = |atom: &LatticeAtom| {
            let brick = atom.cell.map(|c| c.div_euclid(BRICK));
            let reversed = |[x, y, z]: [i32; 3]| [z, y, x];
            [reversed(tile_of(atom.cell)), reversed(brick), reversed(atom.cell)]
        };
        let rest = |atom: &LatticeAtom| [atom.frac[2], atom.frac[1], atom.frac[0], atom.inv_length2];
        let rest = rest(a).iter().zip(rest(b)).map(|(a, b)| a.total_cmp(&b)).find(|order| order.is_ne());
        place(a).cmp(&place(b)).then(rest.unwrap_or(Ordering::Equal)).then(a.source.cmp(&b.source))
    }

    #[test]
    fn atoms_are_in_canonical_order_in_any_box() {
        let at = |i: u32, k: f64, half: f64| half * (f64::from(i) * k).sin();
        // Many atoms a cell, few, tiles without atoms, and a box of too many tiles to be numbered by place.
        for (resolution, half) in [(20.0, 60.0), (4.0, 60.0), (0.5, 60.0), (0.1, 60.0), (0.05, 99_999.0)] {
            // Every seventh sphere lies where another one does, every third of these as large.
            let of = |i: u32| if i.is_multiple_of(7) { i / 2 } else { i };
            let column = |k: f64| (0..20_000).map(|i| at(of(i), k, half)).collect::<Vec<_>>();
            let radii = (0..20_000_u32).map(|i| if i.is_multiple_of(3) { 1.5 } else { 1.7 }).collect();
            let spheres = Spheres::new(column(0.37), column(1.13), column(2.71), radii).unwrap();
            let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
            let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap()).unwrap();
            let sorted = |atoms: &[LatticeAtom]| atoms.windows(2).all(|pair| order(&pair[0], &pair[1]).is_lt());
            assert!(sorted(&lattice.atoms), "{resolution}");
            let mut sources: Vec<u32> = lattice.atoms.iter().map(|atom| atom.source).collect();
            sources.sort_unstable();
            assert!(sources.into_iter().eq(0..20_000), "every sphere once");
            let mut wrong = lattice.atoms.clone();
            wrong.swap(777, 778);
            assert!(!sorted(&wrong), "the control");
        }
    }
}
