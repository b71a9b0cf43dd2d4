//! The sampling lattice: spheres in units of the grid spacing, in one canonical order.
//!
//! Samples lie at multiples of the spacing, so the lattice is the same wherever a structure is cut into tiles.
//! A sphere's centre is a lattice cell plus a fraction: the distance from a sample to a centre is then a function
//! of the two alone, bit for bit, whichever brick or tile evaluates it, without 64-bit arithmetic.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::error::SurfaceError;
use super::kernel::Profile;
use super::params::SurfaceParams;
use super::spheres::Spheres;

/// Samples along a brick's edge.
pub const BRICK: i32 = 8;
/// Samples in a brick.
pub const BRICK_SAMPLES: usize = 512;
/// Samples along a tile's edge: 8 bricks.
pub const TILE: i32 = 64;

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

/// Spheres on a lattice, in canonical order: by tile, brick, cell and offset, whatever the input's order was.
#[derive(Debug, Clone)]
pub struct Lattice {
    /// Spacing, Å.
    pub spacing: f64,
    /// The sample that mesh positions are relative to.
    pub centre: [i32; 3],
    /// The spheres.
    pub atoms: Vec<LatticeAtom>,
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
    /// [`SurfaceError::NoSpheres`]; [`SurfaceError::BadParameter`] if scale and offset leave a radius of 0 or less.
    pub fn new(spheres: &Spheres, params: &SurfaceParams) -> Result<Self, SurfaceError> {
        let Some([lo, hi]) = spheres.bounds() else { return Err(SurfaceError::NoSpheres) };
        let spacing = params.resolution;
        let profile = Profile::new(params);
        let radii = || spheres.radii().par_iter().with_min_len(1 << 16).copied();
        let smallest = radii().reduce(|| f32::MAX, f32::min);
        let effective = |r: f32| f64::from(r) * params.radius_scale + params.radius_offset;
        params.check_radius(smallest)?;
        let mut atoms: Vec<LatticeAtom> = (0..spheres.len())
            .into_par_iter()
            .with_min_len(4096)
            .map(|i| {
                let length = profile.length(effective(spheres.radius(i))) / spacing;
                let scaled = spheres.centre(i).map(|c| c / spacing);
                let cell = scaled.map(f64::round);
                LatticeAtom {
                    cell: cell.map(to_i32),
                    inv_length2: to_f32((length * length).recip()),
                    frac: std::array::from_fn(|k| to_f32(scaled[k] - cell[k])),
                    source: u32::try_from(i).unwrap_or(u32::MAX),
                }
            })
            .collect();
        sort_canonically(&mut atoms);
        let reach = radii().reduce(|| 0.0, f32::max);
        let margin = 2.0 * profile.reach(profile.length(effective(reach)));
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

    /// What mesh positions are relative to, Å.
    #[must_use]
    pub fn centre(&self) -> [f64; 3] {
        self.centre.map(|c| f64::from(c) * self.spacing)
    }
}

/// How far from the mesh's centre a vertex can lie along any axis, Å, by spheres and parameters alone: known before any
/// density is. 0 without spheres.
#[must_use]
pub fn extent(spheres: &Spheres, params: &SurfaceParams) -> f64 {
    let Some([lo, hi]) = spheres.bounds() else { return 0.0 };
    let profile = Profile::new(params);
    let largest = f64::from(spheres.radii().iter().copied().fold(0.0, f32::max));
    let reach = profile.reach(profile.length(largest * params.radius_scale + params.radius_offset));
    let half = (0..3).map(|k| 0.5 * (hi[k] - lo[k])).fold(0.0, f64::max);
    // The centre is a sample, half a spacing from the middle at most; a vertex lies on an edge that begins within reach.
    // Half a spacing more is far above every rounding.
    half + reach + 2.0 * params.resolution
}

/// Sorts by tile, brick within the tile, cell within the brick; ties by offset, size, and the input's order last.
fn sort_canonically(atoms: &mut Vec<LatticeAtom>) {
    let rank = tile_ranks(atoms);
    let key = |atom: &LatticeAtom| {
        let local = atom.cell.map(|c| c.rem_euclid(TILE).unsigned_abs());
        let brick = local.map(|c| c / BRICK.unsigned_abs());
        let cell = local.map(|c| c % BRICK.unsigned_abs());
        let pack = |v: [u32; 3]| u64::from(v[0] | v[1] << 3 | v[2] << 6);
        rank(tile_of(atom.cell)) << 18 | pack(brick) << 9 | pack(cell)
    };
    let mut keyed: Vec<(u64, u32)> =
        atoms.par_iter().enumerate().with_min_len(4096).map(|(i, atom)| (key(atom), to_u32(i))).collect();
    let tie = |a: &LatticeAtom, b: &LatticeAtom| {
        let axis = |k: usize| a.frac[k].total_cmp(&b.frac[k]);
        axis(2).then(axis(1)).then(axis(0)).then(a.inv_length2.total_cmp(&b.inv_length2)).then(a.source.cmp(&b.source))
    };
    let order =
        |a: &(u64, u32), b: &(u64, u32)| a.0.cmp(&b.0).then_with(|| tie(&atoms[a.1 as usize], &atoms[b.1 as usize]));
    keyed.par_sort_unstable_by(order);
    *atoms = keyed.par_iter().with_min_len(4096).map(|&(_, i)| atoms[i as usize]).collect();
}

/// Numbers that order the tiles of `atoms`, below 2⁴⁶: places in the box around them, or ranks where the box is too large.
fn tile_ranks(atoms: &[LatticeAtom]) -> Box<dyn Fn([i32; 3]) -> u64 + Sync> {
    let tiles = || atoms.par_iter().with_min_len(4096).map(|atom| tile_of(atom.cell));
    let fold = |f: fn(i32, i32) -> i32| move |a: [i32; 3], b: [i32; 3]| std::array::from_fn(|k| f(a[k], b[k]));
    let lo: [i32; 3] = tiles().reduce(|| [i32::MAX; 3], fold(i32::min));
    let hi = tiles().reduce(|| [i32::MIN; 3], fold(i32::max));
    let side: [u64; 3] = std::array::from_fn(|k| u64::from(lo[k].abs_diff(hi[k])) + 1);
    // Each side is below 2²⁰, as coordinates are bounded.
    if side.iter().product::<u64>() < 1 << 46 {
        return Box::new(move |tile| {
            let [x, y, z]: [u64; 3] = std::array::from_fn(|k| u64::from(tile[k].abs_diff(lo[k])));
            (z * side[1] + y) * side[0] + x
        });
    }
    let mut order: Vec<[i32; 3]> = atoms.iter().map(|atom| tile_of(atom.cell)).collect();
    order.par_sort_unstable_by_key(|&tile| tile_order(tile));
    order.dedup();
    Box::new(move |tile| order.partition_point(|&t| tile_order(t) < tile_order(tile)) as u64)
}

/// The tile that a sample belongs to.
#[must_use]
pub fn tile_of(cell: [i32; 3]) -> [i32; 3] {
    cell.map(|c| c.div_euclid(TILE))
}

/// Tiles are ordered by z, then y, then x.
#[must_use]
pub fn tile_order(tile: [i32; 3]) -> [i32; 3] {
    [tile[2], tile[1], tile[0]]
}

/// A spacing a little above `spacing`, rounded up to hundredths of an Å: a suggestion that fits.
pub(super) fn roomier(spacing: f64) -> f64 {
    (spacing * 105.0).ceil() / 100.0
}

/// `v` as f32; the loss of digits is meant.
#[expect(clippy::cast_possible_truncation, reason = "rounding to single precision is the point")]
pub(super) fn to_f32(v: f64) -> f32 {
    v as f32
}

/// `v`, an integer value, as i32. Coordinates are at most 1e5 Å and the spacing at least 0.01 Å: 1e7 fits.
#[expect(clippy::cast_possible_truncation, reason = "validated spheres and spacings keep it within ±1e7")]
pub(super) fn to_i32(v: f64) -> i32 {
    debug_assert!(v.abs() < 1e9);
    v as i32
}

/// An index as u32. Indices within tiles, of atoms and of vertices are bounded where they arise; were a bound ever
/// wrong, the saturated value fails the next look-up instead of aliasing another index.
pub(super) fn to_u32(n: usize) -> u32 {
    debug_assert!(u32::try_from(n).is_ok(), "{n} is no 32-bit index");
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// `v` as u64, saturating at both ends.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
pub(super) fn to_u64(v: f64) -> u64 {
    v as u64
}
