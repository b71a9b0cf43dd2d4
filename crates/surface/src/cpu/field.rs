//! Stage `field`: the density at the 8 × 8 × 8 grid points of a brick.
//!
//! Each grid point's density is a sum over the brick's candidates in ascending order, and each term is a function of
//! the atom and the grid point alone. An atom out of reach adds an exact zero. A grid point therefore has the same bits
//! in every tile, and for every candidate list that contains all atoms in reach. Neighbouring bricks thus agree on
//! every sign.

use super::bin::NORMAL_ONLY;
use crate::kernel::{MIN_DISTANCE2, Profile};
use crate::lattice::{BRICK_POINTS, LatticeAtom, to_f32};
use crate::params::Kernel;
use crate::simd::{dispatched, exp2, fma};

/// Densities of a brick, x fastest: index `(z·8 + y)·8 + x`.
pub(super) type BrickField = [f32; BRICK_POINTS];

/// Lower bound of exponents: products of two stay normal numbers, as subnormal ones cost hundreds of cycles. Terms that
/// small lie beyond the cut-off for every valid smoothness.
const MIN_EXPONENT: f32 = -62.0;

/// Constants of a kernel in the form that the inner loops use. u is d²/ρ², as in [`crate::kernel`].
#[derive(Debug, Clone, Copy)]
pub struct Constants {
    pub(crate) kernel: Kernel,
    /// u from which on the density is 0.
    pub support: f32,
    /// Gaussian: the exponent of 2 is `share − rate·u` per axis; the three shares carry the amplitude.
    pub share: f32,
    /// Gaussian: the rate of this exponent.
    pub rate: f32,
    /// Gaussian: the C¹ cut-off's linear term is `tail_share + tail_rate·u` per axis.
    pub tail_share: f32,
    /// Gaussian: the rate of this term.
    pub tail_rate: f32,
    /// Gaussian: the linear term's value at the support.
    pub tail_end: f32,
    /// Factor of the density.
    pub amplitude: f32,
    /// Inverse square: lower bound of u, as a factor of 1/ρ².
    pub u_min: f32,
    /// Gaussian: the slope is `2^(slope_offset − rate·u) − slope_tail`. It omits the factor `slope_amplitude`, so
    /// numbers stay near 1.
    pub slope_offset: f32,
    /// Gaussian: the constant part of the slope.
    pub slope_tail: f32,
    /// Gaussian: the density without its amplitude is the slope minus `slope_decay` times the rest of u up to the
    /// support.
    pub(crate) slope_decay: f32,
    /// Factor of the slope, for all kernels: −dF/du is this times the slope.
    pub slope_amplitude: f32,
    /// Radius of an atom as a fraction of its ρ.
    pub(crate) radius_per_length: f32,
}

impl Constants {
    /// Returns the constants of `profile` on a lattice of `spacing` Å.
    #[must_use]
    pub fn new(profile: &Profile, spacing: f64) -> Self {
        let gaussian = profile.kernel == Kernel::Gaussian;
        let support = profile.support();
        let factor = if gaussian { profile.amplitude / profile.cutoff_norm() } else { profile.amplitude };
        let rate = profile.decay * std::f64::consts::LOG2_E;
        let slope_factor = match profile.kernel {
            Kernel::Gaussian => profile.decay,
            Kernel::SoftObject => 2.0 / 9.0,
            Kernel::InverseSquare => 1.0,
        };
        let tail_rate = factor * profile.tolerance * profile.decay;
        let tail_offset = -factor * profile.tolerance * (1.0 + profile.decay * support);
        Self {
            kernel: profile.kernel,
            support: to_f32(support),
            share: to_f32((factor.log2() + rate) / 3.0),
            rate: to_f32(rate),
            tail_share: to_f32(tail_offset / 3.0),
            tail_rate: to_f32(tail_rate),
            tail_end: to_f32(-factor * profile.tolerance),
            amplitude: to_f32(factor),
            u_min: to_f32(MIN_DISTANCE2 / (spacing * spacing)),
            slope_offset: to_f32(rate),
            slope_tail: to_f32(profile.tolerance),
            slope_decay: to_f32(profile.tolerance * profile.decay),
            slope_amplitude: to_f32(factor * slope_factor),
            radius_per_length: to_f32(profile.radius_per_length()),
        }
    }
}

/// Range of the required grid points of a brick: all, or only the first layer along y, z or both.
#[derive(Debug, Clone, Copy)]
pub(super) struct GridPointRange {
    /// Number of row pairs along y: 4, or 1 for the first layer.
    pub(super) y_pairs: usize,
    /// Number of layers along z: 8, or 1.
    pub(super) z_layers: usize,
}

/// Numbers along the three axes of a brick, a vector of sixteen each.
#[derive(Clone, Copy)]
struct Axes {
    /// Along x, twice: rows come in pairs.
    x: [f32; 16],
    /// Along y, then along z.
    yz: [f32; 16],
}

impl Axes {
    #[inline(always)]
    fn map(&self, f: impl Fn(f32) -> f32) -> Self {
        let (mut x, mut yz) = ([0.0; 16], [0.0; 16]);
        for i in 0..16 {
            x[i] = f(self.x[i]);
            yz[i] = f(self.yz[i]);
        }
        Self { x, yz }
    }

    /// Returns the number of layer `z`.
    #[inline(always)]
    fn z(&self, z: usize) -> f32 {
        self.yz[8 + (z & 7)]
    }

    /// Combines the numbers along x and y into the brick's 8 × 8 plane, as 4 pairs of rows.
    #[inline(always)]
    fn plane(&self, combine: impl Fn(f32, f32) -> f32) -> [[f32; 16]; 4] {
        let mut xy = [[0.0; 16]; 4];
        for (row, y) in xy.iter_mut().zip(self.yz.as_chunks::<2>().0) {
            for (i, (value, x)) in row.iter_mut().zip(self.x).enumerate() {
                *value = combine(x, y[i / 8]);
            }
        }
        xy
    }
}

/// One atom relative to a brick: the range of rows in reach, and u along each axis.
struct AtomInBrick {
    z: [usize; 2],
    /// Pairs of rows.
    y: [usize; 2],
    u: Axes,
}

#[inline(always)]
fn place_atom(atom: &LatticeAtom, origin: [i32; 3], support: f32, range: GridPointRange) -> AtomInBrick {
    let reach = (support / atom.inv_length2).sqrt() + 1e-3;
    let base: [f32; 3] = std::array::from_fn(|k| (origin[k] - atom.cell[k]) as f32);
    let rows = |k: usize, n: usize| {
        let c = atom.frac[k] - base[k];
        [to_row((c - reach).ceil(), n), to_row((c + reach).floor() + 1.0, n)]
    };
    let [y0, y1] = rows(1, 8);
    // Whole numbers are exact in f32 here, so this rounds once and depends on grid point and atom only.
    let away = |k: usize, i: usize| (base[k] + i as f32) - atom.frac[k];
    let mut d = Axes { x: [0.0; 16], yz: [0.0; 16] };
    for i in 0..8 {
        (d.x[i], d.x[8 + i], d.yz[i], d.yz[8 + i]) = (away(0, i), away(0, i), away(1, i), away(2, i));
    }
    let u = d.map(|d| d * d * atom.inv_length2);
    let y = [(y0 / 2).min(range.y_pairs), y1.div_ceil(2).min(range.y_pairs)];
    AtomInBrick { z: rows(2, range.z_layers), y, u }
}

/// Converts `v` to a row number from 0 to `n`.
#[inline(always)]
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the range before")]
fn to_row(v: f32, n: usize) -> usize {
    v.clamp(0.0, n as f32) as usize
}

/// Adds densities of the Gaussian kernel. `FULL` means that all pairs of rows are required, not only the first.
#[inline(always)]
fn gaussian<const FMA: bool, const FULL: bool>(
    c: &Constants,
    atoms: &[LatticeAtom],
    candidates: &[u32],
    origin: [i32; 3],
    range: GridPointRange,
    out: &mut BrickField,
) {
    for &candidate in candidates {
        if candidate & NORMAL_ONLY != 0 {
            continue;
        }
        let atom = &atoms[candidate as usize];
        let placed = place_atom(atom, origin, c.support, range);
        let e = placed.u.map(|u| {
            let exponent = fma::<FMA>(-c.rate, u, c.share);
            // A plain comparison: `f32::max` handles NaN and prevents vectorization.
            exp2::<FMA>(if exponent > MIN_EXPONENT { exponent } else { MIN_EXPONENT })
        });
        let w = placed.u.map(|u| fma::<FMA>(c.tail_rate, u, c.tail_share));
        let (exy, wxy) = (e.plane(|x, y| x * y), w.plane(|x, y| x + y));
        for z in placed.z[0]..placed.z[1] {
            let (ez, wz) = (e.z(z), w.z(z));
            // Processes all rows of the layer: mispredicting the end of the rows in reach costs more than adding zeros.
            for pair in 0..if FULL { 4 } else { 1 } {
                let (exy, wxy) = (&exy[pair & 3], &wxy[pair & 3]);
                let at = (z * 4 + pair) * 16;
                let Some(row) = out.get_mut(at..at + 16) else { continue };
                for i in 0..16 {
                    let tail = wxy[i] + wz;
                    let value = fma::<FMA>(exy[i], ez, tail);
                    row[i] += if tail < c.tail_end { value } else { 0.0 };
                }
            }
        }
    }
}

/// Adds densities of the soft-object or, if `INVERSE`, of the inverse-square kernel.
#[inline(always)]
fn compact<const FMA: bool, const INVERSE: bool>(
    c: &Constants,
    atoms: &[LatticeAtom],
    candidates: &[u32],
    origin: [i32; 3],
    range: GridPointRange,
    out: &mut BrickField,
) {
    for &candidate in candidates {
        if candidate & NORMAL_ONLY != 0 {
            continue;
        }
        let atom = &atoms[candidate as usize];
        let placed = place_atom(atom, origin, c.support, range);
        let u_min = c.u_min * atom.inv_length2;
        let uxy = placed.u.plane(|x, y| x + y);
        for z in placed.z[0]..placed.z[1] {
            let uz = placed.u.z(z);
            for pair in placed.y[0]..placed.y[1] {
                let uxy = &uxy[pair & 3];
                let at = (z * 4 + pair) * 16;
                let Some(row) = out.get_mut(at..at + 16) else { continue };
                for i in 0..16 {
                    let u = uxy[i] + uz;
                    let t = if u < 1.0 { 1.0 - u } else { 0.0 };
                    let t2 = t * t * c.amplitude;
                    row[i] += if INVERSE {
                        t2 / if u > u_min { u } else { u_min }
                    } else {
                        t2 * fma::<FMA>(u, -4.0 / 9.0, 1.0)
                    };
                }
            }
        }
    }
}

dispatched! {
/// Adds the densities of `candidates` to `out`, for the brick whose first grid point is `origin`. Skips candidates that
/// have the flag [`NORMAL_ONLY`].
pub(super) fn evaluate(
    c: &Constants,
    atoms: &[LatticeAtom],
    candidates: &[u32],
    origin: [i32; 3],
    range: GridPointRange,
    out: &mut BrickField,
) {

    if multiversion::target::target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64")) {
        match c.kernel {
            Kernel::Gaussian if range.y_pairs == 4 => gaussian::<true, true>(c, atoms, candidates, origin, range, out),
            Kernel::Gaussian => gaussian::<true, false>(c, atoms, candidates, origin, range, out),
            Kernel::SoftObject => compact::<true, false>(c, atoms, candidates, origin, range, out),
            Kernel::InverseSquare => compact::<true, true>(c, atoms, candidates, origin, range, out),
        }
    } else {
        match c.kernel {
            Kernel::Gaussian if range.y_pairs == 4 => gaussian::<false, true>(c, atoms, candidates, origin, range, out),
            Kernel::Gaussian => gaussian::<false, false>(c, atoms, candidates, origin, range, out),
            Kernel::SoftObject => compact::<false, false>(c, atoms, candidates, origin, range, out),
            Kernel::InverseSquare => compact::<false, true>(c, atoms, candidates, origin, range, out),
        }
    }
}
}
