//! The lattice: spheres in units of the grid spacing, in one canonical order.
//!
//! Grid points lie at multiples of the spacing, so they do not depend on the structure. The centre of a sphere is
//! stored as the nearest grid point and a fraction. The offset of a grid point from a centre then has the same bits in
//! every brick and tile, without 64-bit arithmetic.

mod order;

use bytemuck::{Pod, Zeroable};

use self::order::Placing;
use super::column::Column;
use super::control::Control;
use super::error::SurfaceError;
use super::kernel::Shape;
use super::params::{SurfaceParams, bad};
use super::spheres::Spheres;

/// Grid points along a brick's edge.
pub const BRICK: i32 = 8;
/// Grid points in a brick.
pub const BRICK_POINTS: usize = 512;
/// Grid points along a tile's edge: 8 bricks.
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
    /// The grid point nearest to the centre.
    pub cell: [i32; 3],
    /// 1/ρ² in units of the spacing: u = d² × this.
    pub inv_length2: f32,
    /// The centre's offset from `cell`: in [−½, ½] spacings for an atom, in [0, 1] for the bounding sphere of an arc.
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

    /// Returns all three components of [`position`](Self::position).
    #[must_use]
    pub fn centre(&self) -> [f64; 3] {
        [0, 1, 2].map(|axis| self.position(axis))
    }
}

/// Spheres on a lattice, in canonical order: by tile, brick, cell and offset, independent of the input's order.
#[derive(Debug, Clone)]
pub struct Lattice {
    /// Spacing, Å.
    pub spacing: f64,
    /// The grid point that mesh positions are relative to.
    pub centre: [i32; 3],
    /// The spheres.
    pub atoms: Column<LatticeAtom>,
    /// Field of each sphere.
    pub shape: Shape,
    /// Value of u at which the effect of a sphere ends.
    pub support: f64,
    /// Cells of the box around all supports.
    pub box_cells: u64,
    /// Upper bound of the grid points in bricks that an atom reaches, from the box around all supports.
    pub box_points: u64,
}

impl Lattice {
    /// Places `spheres` on the lattice of `params.resolution`. The caller has reserved `LATTICE_BYTES` for each one.
    ///
    /// # Errors
    /// [`SurfaceError::NoSpheres`]; [`SurfaceError::BadParameter`] if scale and offset leave a radius of 0 or less, or
    /// there are more spheres than 31 bits can number; [`SurfaceError::Cancelled`]; [`SurfaceError::Memory`].
    pub fn new(spheres: &Spheres, params: &SurfaceParams, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let Some([lo, hi]) = spheres.bounds() else { return Err(SurfaceError::NoSpheres) };
        if spheres.len() > MAX_ATOMS {
            return Err(bad("spheres", spheres.len(), format!("at most {MAX_ATOMS} spheres")));
        }
        let spacing = params.resolution;
        let shape = Shape::new(params);
        let (smallest, largest) = spheres.radius_range();
        params.check_radius(smallest)?;
        let largest = effective_radius(largest, params);
        let atoms = Placing { spheres, params, shape: &shape, control }.in_canonical_order([lo, hi])?;
        let margin = 2.0 * shape.reach(shape.length(largest));
        let side = |k: usize| ((hi[k] - lo[k] + margin) / spacing).ceil();
        let box_cells = (0..3).map(side).product::<f64>();
        // The outermost bricks extend by at most their edge beyond the box, at both ends of each axis.
        let box_points = (0..3).map(|k| side(k) + f64::from(2 * BRICK)).product::<f64>();
        Ok(Self {
            spacing,
            centre: std::array::from_fn(|k| to_i32((0.5 * (lo[k] + hi[k]) / spacing).round())),
            atoms,
            shape,
            support: shape.support(),
            // Saturates: a sparse assembly's box may hold more cells than any integer type.
            box_cells: to_u64(box_cells),
            box_points: to_u64(box_points),
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

/// Returns an upper bound of a vertex's distance from the mesh's centre along any axis, Å; 0 without spheres. Computes
/// no density.
#[must_use]
pub fn extent(spheres: &Spheres, params: &SurfaceParams) -> f64 {
    let Some([lo, hi]) = spheres.bounds() else { return 0.0 };
    let shape = Shape::new(params);
    let (_, largest) = spheres.radius_range();
    let reach = shape.reach(shape.length(effective_radius(largest, params)));
    let half = (0..3).map(|k| 0.5 * (hi[k] - lo[k])).fold(0.0, f64::max);
    // The centre is a grid point, at most half a spacing from the middle. A vertex lies on an edge that begins within
    // reach. The further half spacing is much more than the rounding errors.
    half + reach + 2.0 * params.resolution
}

/// Radius of a sphere after scale and offset, Å.
pub(super) fn effective_radius(r: f32, params: &SurfaceParams) -> f64 {
    f64::from(r) * params.radius_scale + params.radius_offset
}

/// The tile that a grid point belongs to.
// Written without `map`, here and below: `map` may not be inlined, and these functions run for every atom.
#[inline(always)]
#[must_use]
pub fn tile_of([x, y, z]: [i32; 3]) -> [i32; 3] {
    [x.div_euclid(TILE), y.div_euclid(TILE), z.div_euclid(TILE)]
}

/// Returns the sort key of a tile. Tiles are ordered by z, then y, then x.
#[inline(always)]
#[must_use]
pub fn tile_order(tile: [i32; 3]) -> [i32; 3] {
    [tile[2], tile[1], tile[0]]
}

/// Converts `v` to f32, rounding.
#[expect(clippy::cast_possible_truncation, reason = "rounding to single precision is intended")]
#[must_use]
pub fn to_f32(v: f64) -> f32 {
    v as f32
}

/// Converts `v`, an integer value, to i32. Coordinates are at most 1e5 Å and the spacing at least 0.01 Å: 1e7 fits.
#[expect(clippy::cast_possible_truncation, reason = "validated spheres and spacings keep it within ±1e7")]
#[must_use]
pub fn to_i32(v: f64) -> i32 {
    debug_assert!(v.abs() < 1e9);
    v as i32
}

/// Converts an index to u32. Callers bound indices; if a bound were wrong, the saturated value would fail the next
/// look-up instead of aliasing another index.
#[must_use]
pub fn to_u32(n: usize) -> u32 {
    debug_assert!(u32::try_from(n).is_ok(), "{n} is no 32-bit index");
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// Converts `v` to u64, saturating at both ends.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
#[must_use]
pub fn to_u64(v: f64) -> u64 {
    v as u64
}

#[cfg(test)]
mod tests {
    use std::cmp::Ordering;

    use super::*;
    use crate::params::SurfaceOptions;

    /// Independent implementation of the canonical order.
    fn order(a: &LatticeAtom, b: &LatticeAtom) -> Ordering {
        let cell = |atom: &LatticeAtom| {
            let brick = atom.cell.map(|c| c.div_euclid(BRICK));
            let reversed = |[x, y, z]: [i32; 3]| [z, y, x];
            [reversed(tile_of(atom.cell)), reversed(brick), reversed(atom.cell)]
        };
        let rest = |atom: &LatticeAtom| [atom.frac[2], atom.frac[1], atom.frac[0], atom.inv_length2];
        let rest = rest(a).iter().zip(rest(b)).map(|(a, b)| a.total_cmp(&b)).find(|order| order.is_ne());
        cell(a).cmp(&cell(b)).then(rest.unwrap_or(Ordering::Equal)).then(a.source.cmp(&b.source))
    }

    #[test]
    fn atoms_are_in_canonical_order_in_any_box() {
        let at = |i: u32, k: f64, half: f64| half * (f64::from(i) * k).sin();
        // Many atoms per cell, few atoms per cell, tiles without atoms, and a box of too many tiles for their ranks.
        for (resolution, half) in [(20.0, 60.0), (4.0, 60.0), (0.5, 60.0), (0.1, 60.0), (0.05, 99_999.0)] {
            // Every seventh sphere lies where another one does, every third of these as large.
            let of = |i: u32| if i.is_multiple_of(7) { i / 2 } else { i };
            let column = |k: f64| (0..20_000).map(|i| at(of(i), k, half)).collect::<Vec<_>>();
            let radii = (0..20_000_u32).map(|i| if i.is_multiple_of(3) { 1.5 } else { 1.7 }).collect();
            let spheres = Spheres::new(column(0.37), column(1.13), column(2.71), radii).unwrap();
            let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
            let params = SurfaceParams::new(&options).unwrap();
            let on = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let [lattice, other] = [1, 3]
                .map(|threads| on(threads).install(|| Lattice::new(&spheres, &params, &Control::default()).unwrap()));
            assert_eq!(lattice.atoms, other.atoms, "the number of threads matters");
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
