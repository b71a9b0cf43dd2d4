//! The three kernels: density and slope of one atom as functions of `u = d²/ρ²`.
//!
//! This is the only implementation of the formulas on the CPU. `d` is the distance to the atom's centre and `ρ` the
//! atom's length scale: its radius for the Gaussian, the radius of its support for the two others. All kernels and
//! their slopes vanish at `u = support()`; an isolated atom's density at its radius is 1. Without a support, each grid
//! point would depend on every atom; an abrupt cut-off would leave steps in the surface.
//!
//! Sources: J. Blinn, ACM TOG 1(3), 1982 (Gaussian); G. Wyvill, C. `McPheeters`, B. Wyvill, The Visual Computer 2,
//! 1986 (soft object); S. Dias, K. Bora, A. Gomes, HPDC 2010 (all three as blending functions of molecules).

use super::params::{Kernel, PaperParams, SUPPORT_RADII, SurfaceParams};

/// Lower bound of squared distances for the inverse-square kernel, Å².
pub const MIN_DISTANCE2: f64 = 1e-4;

/// Kernel with its constants, shared by all atoms of a run. Each atom adds only its length scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// Kernel function.
    pub kernel: Kernel,
    /// ρ = `scale` × the atom's radius, unless `fixed` is set.
    scale: f64,
    /// One ρ for all atoms, Å (the paper's raw parameters).
    fixed: Option<f64>,
    /// Factor of the whole density.
    pub amplitude: f64,
    /// The Gaussian's `a`; unused otherwise.
    pub decay: f64,
    /// The Gaussian's cut-off tolerance ε; unused otherwise.
    pub tolerance: f64,
}

impl Profile {
    /// Returns the profile of `kernel` with validated parameters.
    #[must_use]
    pub fn new(kernel: Kernel, params: &SurfaceParams) -> Self {
        let plain = Self { kernel, scale: 1.0, fixed: None, amplitude: 1.0, decay: 0.0, tolerance: 0.0 };
        // (1 − 4/9 s)(1 − s)² is 1/2 and (1 − s)²/s is 9/4 where the support is twice the radius (s = 1/4).
        let s = SUPPORT_RADII.powi(-2);
        let soft_at_radius = (1.0 - 4.0 / 9.0 * s) * (1.0 - s).powi(2);
        let inverse_at_radius = (1.0 - s).powi(2) / s;
        match (kernel, params.paper) {
            (_, Some(PaperParams::Gaussian { a, b })) => {
                // b·exp(−a d²) is A·exp(−s(u − 1)) with u = a d²/s and A = b·exp(−s). If an isolated atom has a
                // surface, s is chosen such that A is the isovalue: the cut-off is then relative to the isovalue.
                let decay = if b > params.isovalue { (b / params.isovalue).ln() } else { 1.0 };
                let fixed = Some((decay / a).sqrt());
                Self { fixed, amplitude: b * (-decay).exp(), decay, tolerance: params.cutoff_tolerance, ..plain }
            }
            (_, Some(PaperParams::SoftObject { a, b })) => Self { fixed: Some(b), amplitude: a, ..plain },
            (_, Some(PaperParams::InverseSquare { c, b })) => Self { fixed: Some(b), amplitude: c / (b * b), ..plain },
            (Kernel::Gaussian, None) => Self { decay: params.smoothness, tolerance: params.cutoff_tolerance, ..plain },
            (Kernel::SoftObject, None) => Self { scale: SUPPORT_RADII, amplitude: 1.0 / soft_at_radius, ..plain },
            (Kernel::InverseSquare, None) => Self { scale: SUPPORT_RADII, amplitude: 1.0 / inverse_at_radius, ..plain },
        }
    }

    /// Returns the length scale ρ of an atom of `radius` (after scale and offset), Å.
    #[must_use]
    pub fn length(&self, radius: f64) -> f64 {
        self.fixed.unwrap_or(self.scale * radius)
    }

    /// Returns the radius of an atom as a fraction of its ρ. With the paper's raw parameters, all atoms have the same
    /// radius, so its value does not affect comparisons of atoms.
    #[must_use]
    pub fn radius_per_length(&self) -> f64 {
        self.scale.recip()
    }

    /// `u` from which on the density is 0.
    #[must_use]
    pub fn support(&self) -> f64 {
        match self.kernel {
            Kernel::Gaussian => 1.0 + (1.0 / self.tolerance).ln() / self.decay,
            Kernel::SoftObject | Kernel::InverseSquare => 1.0,
        }
    }

    /// Distance from an atom's centre from which on its density is 0, Å, for its length scale ρ.
    #[must_use]
    pub fn reach(&self, length: f64) -> f64 {
        length * self.support().sqrt()
    }

    /// Returns the divisor of the C¹ cut-off, so that g(1) = 1.
    #[must_use]
    pub fn cutoff_norm(&self) -> f64 {
        1.0 - self.tolerance * (1.0 + (1.0 / self.tolerance).ln())
    }

    /// Density at `u`. `u_min` is [`MIN_DISTANCE2`] over ρ² and matters to the inverse square only.
    #[must_use]
    pub fn value(&self, u: f64, u_min: f64) -> f64 {
        let support = self.support();
        if u >= support {
            return 0.0;
        }
        self.amplitude
            * match self.kernel {
                Kernel::Gaussian => {
                    let tail = self.tolerance * (1.0 + self.decay * (support - u));
                    ((-self.decay * (u - 1.0)).exp() - tail) / self.cutoff_norm()
                }
                Kernel::SoftObject => (1.0 - 4.0 / 9.0 * u) * (1.0 - u).powi(2),
                Kernel::InverseSquare => (1.0 - u).powi(2) / u.max(u_min),
            }
    }

    /// Slope dF/du at `u` (never positive). The gradient is `2 · slope · (x − c)/ρ²`.
    #[must_use]
    pub fn slope(&self, u: f64, u_min: f64) -> f64 {
        if u >= self.support() {
            return 0.0;
        }
        -self.amplitude
            * match self.kernel {
                Kernel::Gaussian => {
                    self.decay * ((-self.decay * (u - 1.0)).exp() - self.tolerance) / self.cutoff_norm()
                }
                Kernel::SoftObject => 2.0 / 9.0 * (1.0 - u) * (11.0 - 6.0 * u),
                Kernel::InverseSquare => (1.0 - u) * (1.0 + u) / (u.max(u_min)).powi(2),
            }
    }
}

/// Field of one atom: a density, or the distance to its sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// Density with this profile. The surface is an isosurface.
    Density(Profile),
    /// Sphere with an enlarged radius. The surface is a level set of the distance to a union of spheres.
    Sphere {
        /// Length by which the radius is enlarged, Å.
        enlarged: f64,
    },
}

impl Shape {
    /// Returns the shape of validated parameters.
    #[must_use]
    pub fn new(params: &SurfaceParams) -> Self {
        let enlarged = params.used_probe().unwrap_or(0.0);
        params.surface.kernel().map_or(Self::Sphere { enlarged }, |kernel| Self::Density(Profile::new(kernel, params)))
    }

    /// Returns the length scale ρ of an atom of `radius` (after scale and offset), Å. For a sphere it is the enlarged
    /// radius.
    #[must_use]
    pub fn length(&self, radius: f64) -> f64 {
        match self {
            Self::Density(profile) => profile.length(radius),
            Self::Sphere { enlarged } => radius + enlarged,
        }
    }

    /// Returns the value of `u` at which the effect of an atom ends.
    #[must_use]
    pub fn support(&self) -> f64 {
        match self {
            Self::Density(profile) => profile.support(),
            Self::Sphere { .. } => 1.0,
        }
    }

    /// Returns the distance at which the effect of an atom with length scale ρ ends, Å.
    #[must_use]
    pub fn reach(&self, length: f64) -> f64 {
        length * self.support().sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::{SurfaceKind, SurfaceOptions};

    fn profiles() -> Vec<(Profile, f64)> {
        let raw = |kernel, a, b, c, iso| SurfaceOptions {
            surface: Some(SurfaceKind::from(kernel)),
            paper_a: a,
            paper_b: b,
            paper_c: c,
            isovalue: Some(iso),
            ..SurfaceOptions::default()
        };
        let plain = |kernel| SurfaceOptions { surface: Some(SurfaceKind::from(kernel)), ..SurfaceOptions::default() };
        [
            plain(Kernel::Gaussian),
            SurfaceOptions { smoothness: Some(5.0), cutoff_tolerance: Some(1e-3), ..plain(Kernel::Gaussian) },
            plain(Kernel::SoftObject),
            plain(Kernel::InverseSquare),
            raw(Kernel::Gaussian, Some(0.4), Some(3.0), None, 1.0),
            raw(Kernel::Gaussian, Some(0.4), Some(0.5), None, 1.0),
            raw(Kernel::SoftObject, Some(2.0), Some(3.0), None, 1.0),
            raw(Kernel::InverseSquare, None, Some(5.0), Some(0.8), 0.2),
        ]
        .map(|o| SurfaceParams::new(&o).unwrap())
        .map(|p| (Profile::new(p.surface.kernel().unwrap(), &p), p.isovalue))
        .to_vec()
    }

    #[test]
    fn an_isolated_atom_has_density_one_at_its_radius() {
        for (profile, _) in &profiles()[..4] {
            let u = (1.7 / profile.length(1.7)).powi(2);
            assert!((profile.value(u, 0.0) - 1.0).abs() < 1e-12, "{profile:?}");
        }
    }

    #[test]
    fn value_and_slope_vanish_at_the_support_and_slope_is_the_derivative() {
        for (profile, _) in profiles() {
            let end = profile.support();
            assert!(profile.value(end * (1.0 - 1e-9), 0.0).abs() < 1e-9, "{profile:?}");
            assert!(profile.slope(end * (1.0 - 1e-9), 0.0).abs() < 1e-6, "{profile:?}");
            for i in 1..100 {
                let (u, e) = (end * f64::from(i) / 100.0, 1e-6);
                let numeric = (profile.value(u + e, 0.0) - profile.value(u - e, 0.0)) / (2.0 * e);
                let slope = profile.slope(u, 0.0);
                assert!(
                    (numeric - slope).abs() <= 1e-5 * slope.abs().max(1e-2),
                    "{profile:?} u {u}: {numeric} {slope}"
                );
                assert!(slope <= 0.0 && profile.value(u, 0.0) >= 0.0, "{profile:?} u {u}");
            }
        }
    }

    #[test]
    fn raw_parameters_give_the_papers_formulas() {
        let all = profiles();
        let value = |i: usize, d: f64| {
            let (profile, _) = &all[i];
            profile.value((d / profile.length(9.0)).powi(2), 0.0)
        };
        for d in [0.3_f64, 0.8, 1.2] {
            // The C¹ cut-off at ε = 0.01 moves the raw Gaussian by less than 6 % inside.
            let gaussian = 3.0 * (-0.4 * d * d).exp();
            assert!((value(4, d) / gaussian - 1.0).abs() < 0.06, "{d}: {} {gaussian}", value(4, d));
            let s = d * d / 9.0;
            let soft = 2.0 * (1.0 - 4.0 / 9.0 * s.powi(3) + 17.0 / 9.0 * s * s - 22.0 / 9.0 * s);
            assert!((value(6, d) - soft).abs() < 1e-12);
            let inverse = 0.8 / (d * d) * (1.0 - d * d / 25.0).powi(2);
            assert!((value(7, d) - inverse).abs() < 1e-12);
        }
    }
}
