//! Mean curvature of the level sets of a density.
//!
//! Let G = −∇F up to a factor, and M the derivative of G. The outward normal is G/|G|, and half its divergence is the
//! mean curvature: `(tr M / |G| − GᵀMG / |G|³) / 2`. An atom adds s/ρ² to the diagonal of M, and takes 2 t dᵢdⱼ/ρ⁴ from
//! it, where d is the vector from the atom, s the slope of its density over u = d²/ρ², and t the rate at which the
//! slope falls.

use std::f32::consts::LN_2;

use super::brick_atoms::BrickAtoms;
use super::field::Constants;
use crate::params::Kernel;
use crate::simd::{LANES, dispatched, exp2, extent, fma};
use crate::sphere_union::Lanes;

dispatched! {
/// Returns the mean curvature of the level sets through points that are close together, per spacing: positive where the
/// level set is convex seen from outside. Not finite where the gradient vanishes.
pub(super) fn mean_curvatures(c: &Constants, around: &mut BrickAtoms, p: &Lanes) -> [f32; LANES] {
    if multiversion::target::target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64")) {
        // One copy of the loop per kernel.
        let with_kernel = |kernel| Constants { kernel, ..*c };
        match c.kernel {
            Kernel::Gaussian => sum::<true>(&with_kernel(Kernel::Gaussian), around, p),
            Kernel::SoftObject => sum::<true>(&with_kernel(Kernel::SoftObject), around, p),
            Kernel::InverseSquare => sum::<true>(&with_kernel(Kernel::InverseSquare), around, p),
        }
    } else {
        sum::<false>(c, around, p)
    }
}
}

#[inline(always)]
fn sum<const FMA: bool>(c: &Constants, around: &mut BrickAtoms, p: &Lanes) -> [f32; LANES] {
    let [px, py, pz] = p;
    let zero = [0.0_f32; LANES];
    // G; the sum of s/ρ²; the sums of 2 t dᵢdⱼ/ρ⁴ for xx, yy, zz, xy, xz, yz.
    let ([mut gx, mut gy, mut gz], mut diagonal, mut q) = ([zero; 3], zero, [zero; 6]);
    for &[x, y, z, inv] in around.reach(c.support, [extent(px), extent(py), extent(pz)]) {
        let u_min = c.u_min * inv;
        for i in 0..LANES {
            let (dx, dy, dz) = (px[i] - x, py[i] - y, pz[i] - z);
            let u = fma::<FMA>(dx, dx, fma::<FMA>(dy, dy, dz * dz)) * inv;
            let (slope, fall) = match c.kernel {
                Kernel::Gaussian => {
                    let exponent = fma::<FMA>(-c.rate, u, c.slope_offset);
                    let term = exp2::<FMA>(if exponent > -100.0 { exponent } else { -100.0 });
                    (term - c.slope_tail, c.rate * LN_2 * term)
                }
                Kernel::SoftObject => ((1.0 - u) * fma::<FMA>(u, -6.0, 11.0), fma::<FMA>(u, -12.0, 17.0)),
                Kernel::InverseSquare => {
                    let u = if u > u_min { u } else { u_min };
                    let square = (u * u).recip();
                    (square - 1.0, 2.0 * square / u)
                }
            };
            let (slope, fall) = if u < c.support { (slope * inv, 2.0 * fall * inv * inv) } else { (0.0, 0.0) };
            gx[i] = fma::<FMA>(slope, dx, gx[i]);
            gy[i] = fma::<FMA>(slope, dy, gy[i]);
            gz[i] = fma::<FMA>(slope, dz, gz[i]);
            diagonal[i] += slope;
            let (fx, fy, fz) = (fall * dx, fall * dy, fall * dz);
            q[0][i] = fma::<FMA>(fx, dx, q[0][i]);
            q[1][i] = fma::<FMA>(fy, dy, q[1][i]);
            q[2][i] = fma::<FMA>(fz, dz, q[2][i]);
            q[3][i] = fma::<FMA>(fx, dy, q[3][i]);
            q[4][i] = fma::<FMA>(fx, dz, q[4][i]);
            q[5][i] = fma::<FMA>(fy, dz, q[5][i]);
        }
    }
    let mut found = zero;
    for i in 0..LANES {
        let (x, y, z) = (gx[i], gy[i], gz[i]);
        let g2 = x * x + y * y + z * z;
        let off_diagonal = x * y * q[3][i] + x * z * q[4][i] + y * z * q[5][i];
        let along = (x * x * q[0][i] + y * y * q[1][i] + z * z * q[2][i] + 2.0 * off_diagonal) / g2;
        found[i] = 0.5 * (2.0 * diagonal[i] - q[0][i] - q[1][i] - q[2][i] + along) / g2.sqrt();
    }
    found
}
