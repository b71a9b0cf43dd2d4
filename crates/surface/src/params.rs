//! Parameters of a surface: the caller's options, and the validated form that the core uses.

use std::fmt;

use super::error::SurfaceError;
pub use super::kind::{Kernel, Preset, SurfaceKind};
pub use super::limit::MAX_RESOLUTION;
use super::mesh::Mesh;
use super::quantize::Step;

/// Finest grid spacing that is accepted, Å.
pub const MIN_RESOLUTION: f64 = 0.01;
/// Minimum radius after scale and offset, Å.
pub const MIN_RADIUS: f64 = 0.05;
/// Radius of support of the soft-object and inverse-square kernels, in radii.
pub const SUPPORT_RADII: f64 = 2.0;
/// Default probe radius, that of a water molecule, Å.
pub const DEFAULT_PROBE: f64 = 1.4;
/// Largest probe radius that is accepted, Å.
pub const MAX_PROBE: f64 = 10.0;

/// The raw parameters of Dias, Bora and Gomes (HPDC 2010): the same formula with the same constants for every
/// atom, radii unused. The threshold T is the isovalue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PaperParams {
    /// `b · exp(−a d²)`; `a` in Å⁻².
    Gaussian {
        /// Decay, Å⁻².
        a: f64,
        /// Height.
        b: f64,
    },
    /// `a · (1 − 4/9 s³ + 17/9 s² − 22/9 s)`, `s = d²/b²`.
    SoftObject {
        /// Height.
        a: f64,
        /// Radius of support, Å.
        b: f64,
    },
    /// `(c/d²)(1 − d²/b²)²`: the window is part of the definition, as the bare sum has no limit.
    InverseSquare {
        /// Strength, Å², in ]0, 1].
        c: f64,
        /// Radius of the window, Å.
        b: f64,
    },
}

/// Options of a surface; `None` selects the value of the preset or the default.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SurfaceOptions {
    /// Surface to triangulate; the Gaussian surface by default.
    pub surface: Option<SurfaceKind>,
    /// Radius of the probe, Å; 1.4 by default. Solvent-accessible and solvent-excluded surfaces only.
    pub probe: Option<f64>,
    /// Grid spacing, Å; 0.5 by default.
    pub resolution: Option<f64>,
    /// Level of the density that is the surface; 1 is the surface of an isolated atom at its radius.
    pub isovalue: Option<f64>,
    /// The Gaussian's `a` (Blinn's blobbiness without its sign); 1.25 by default. Gaussian only.
    pub smoothness: Option<f64>,
    /// Factor of the radii, applied first; 1 by default.
    pub radius_scale: Option<f64>,
    /// Offset added to the scaled radii, Å; 0 by default.
    pub radius_offset: Option<f64>,
    /// Cut-off of the Gaussian, as a fraction of its value at the radius; 0.01 by default. Gaussian only.
    pub cutoff_tolerance: Option<f64>,
    /// Values for the parameters that are not given.
    pub preset: Option<Preset>,
    /// The paper's `a` (Gaussian: decay in Å⁻²; soft object: height).
    pub paper_a: Option<f64>,
    /// The paper's `b` (Gaussian: height; soft object: support in Å; inverse square: window in Å).
    pub paper_b: Option<f64>,
    /// The paper's `c` (inverse square: strength in Å²).
    pub paper_c: Option<f64>,
    /// True if the atom whose sphere is nearest to each vertex is requested.
    pub atom_ids: bool,
}

/// Parameters of a run, validated.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceParams {
    /// Surface to triangulate.
    pub surface: SurfaceKind,
    /// Radius of the probe, Å.
    pub probe: f64,
    /// Grid spacing, Å.
    pub resolution: f64,
    /// Level of the density that is the surface.
    pub isovalue: f64,
    /// The Gaussian's `a`.
    pub smoothness: f64,
    /// Factor of the radii, applied first.
    pub radius_scale: f64,
    /// Offset added to the scaled radii, Å.
    pub radius_offset: f64,
    /// Cut-off of the Gaussian, as a fraction of its value at the radius.
    pub cutoff_tolerance: f64,
    /// The preset that filled in the values that were not given.
    pub preset: Preset,
    /// The paper's raw parameters, which replace radii and smoothness.
    pub paper: Option<PaperParams>,
    /// True if the atom whose sphere is nearest to each vertex is requested.
    pub atom_ids: bool,
    /// Step of [`Quantized`](super::mesh::Quantized) vertices, which covers the extent of the surface; `None` requests
    /// single precision. A backend without quantized vertices delivers single precision, which the caller may round.
    pub quantize: Option<Step>,
}

/// Limits of a run, checked before memory is allocated.
#[expect(clippy::struct_field_names, reason = "each is the highest value that is allowed")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SurfaceLimits {
    /// Grid points in occupied bricks.
    pub max_grid_points: u64,
    /// Bytes of vertices and triangles.
    pub max_mesh_bytes: u64,
    /// Candidate pairs: pairs of a sphere and a brick of the grid that its density can reach. Values above 2³¹ count as
    /// 2³¹.
    pub max_candidates: u64,
}

impl Default for SurfaceLimits {
    fn default() -> Self {
        Self { max_grid_points: 4 << 30, max_mesh_bytes: 8 << 30, max_candidates: 1 << 30 }
    }
}

impl Default for SurfaceParams {
    fn default() -> Self {
        match Self::new(&SurfaceOptions::default()) {
            Ok(params) => params,
            Err(_) => unreachable!("a test checks that the defaults are valid"),
        }
    }
}

/// Returns the error for a parameter with a bad value.
pub fn bad(name: &'static str, value: impl fmt::Display, expected: impl Into<String>) -> SurfaceError {
    SurfaceError::BadParameter { name, value: value.to_string(), expected: expected.into() }
}

/// Fails if there is a value.
fn reject(name: &'static str, value: Option<impl fmt::Display>, expected: &str) -> Result<(), SurfaceError> {
    value.map_or(Ok(()), |value| Err(bad(name, value, expected)))
}

fn quoted(preset: Preset) -> String {
    format!("`{preset}`")
}

/// Rejects values of the parameters that affect only densities.
fn reject_density_parameters(surface: SurfaceKind, options: &SurfaceOptions) -> Result<(), SurfaceError> {
    let why = format!("no value with surface {surface}: it shapes densities, and this surface has none");
    reject("preset", options.preset.filter(|&preset| preset != Preset::Default).map(quoted), &why)?;
    for (name, value, default) in [
        ("isovalue", options.isovalue, Some(1.0)),
        ("smoothness", options.smoothness, Some(1.25)),
        ("cutoff_tolerance", options.cutoff_tolerance, Some(0.01)),
        ("paper_a", options.paper_a, None),
        ("paper_b", options.paper_b, None),
        ("paper_c", options.paper_c, None),
    ] {
        reject(name, value.filter(|_| value != default), &why)?;
    }
    Ok(())
}

/// Returns `value` if it is within `[lo, hi]`.
fn within(name: &'static str, value: f64, lo: f64, hi: f64) -> Result<f64, SurfaceError> {
    if (lo..=hi).contains(&value) { Ok(value) } else { Err(bad(name, value, format!("a number from {lo} to {hi}"))) }
}

impl SurfaceParams {
    /// Fills in defaults and validates everything, once.
    ///
    /// # Errors
    /// [`SurfaceError::BadParameter`] names the first parameter that is out of range or does not go with the
    /// surface or with the paper's raw parameters.
    pub fn new(options: &SurfaceOptions) -> Result<Self, SurfaceError> {
        let surface = options.surface.unwrap_or_default();
        let preset = options.preset.unwrap_or_default();
        let paper = match surface.kernel() {
            Some(kernel) => paper_params(kernel, options)?,
            None => None,
        };
        match surface.kernel() {
            Some(Kernel::Gaussian) => {}
            Some(kernel) => {
                let why = format!("no preset with surface {kernel}: presets set the Gaussian's smoothness");
                reject("preset", options.preset.filter(|&p| p != Preset::Default).map(quoted), &why)?;
                let why = format!("no value with surface {kernel}: it shapes the gaussian kernel only");
                reject("smoothness", options.smoothness, &why)?;
                reject("cutoff_tolerance", options.cutoff_tolerance, &why)?;
            }
            None => reject_density_parameters(surface, options)?,
        }
        if !surface.has_probe() {
            let why = format!("no value with surface {surface}: only sas and ses have a probe");
            reject("probe", options.probe.filter(|&probe| probe != DEFAULT_PROBE), &why)?;
        }
        if paper.is_some() {
            let why = "no value together with paper_a, paper_b or paper_c: they replace radii and smoothness";
            reject("smoothness", options.smoothness, why)?;
            reject("radius_scale", options.radius_scale, why)?;
            reject("radius_offset", options.radius_offset, why)?;
        }
        let (smoothness, isovalue) = match preset {
            Preset::Default => (1.25, 1.0),
            Preset::SesLike => (0.75, 1.9),
            Preset::VdwLike => (5.0, 1.06),
            Preset::Molstar => (1.5, 1.0),
            Preset::Blinn => (2.5, 1.0),
            Preset::Quicksurf => (0.5, 0.824),
        };
        Ok(Self {
            surface,
            probe: within("probe", options.probe.unwrap_or(DEFAULT_PROBE), 0.0, MAX_PROBE)?,
            resolution: within("resolution", options.resolution.unwrap_or(0.5), MIN_RESOLUTION, MAX_RESOLUTION)?,
            isovalue: within("isovalue", options.isovalue.unwrap_or(isovalue), 1e-3, 1e6)?,
            smoothness: within("smoothness", options.smoothness.unwrap_or(smoothness), 0.1, 40.0)?,
            radius_scale: within("radius_scale", options.radius_scale.unwrap_or(1.0), 0.1, 10.0)?,
            radius_offset: within("radius_offset", options.radius_offset.unwrap_or(0.0), -5.0, 10.0)?,
            cutoff_tolerance: within("cutoff_tolerance", options.cutoff_tolerance.unwrap_or(0.01), 1e-6, 0.2)?,
            preset,
            paper,
            atom_ids: options.atom_ids,
            quantize: None,
        })
    }

    /// Returns the kernel of the surface for a backend that supports isosurfaces only.
    ///
    /// # Errors
    /// [`SurfaceError::BadParameter`] names `surface` if that is a surface of spheres.
    pub(crate) fn kernel_for(&self, backend: &str) -> Result<Kernel, SurfaceError> {
        let expected =
            || format!("one of {} from the {backend} backend; cpu and gpu make all", Kernel::NAMES.join(", "));
        self.surface.kernel().ok_or_else(|| bad("surface", format!("`{}`", self.surface), expected()))
    }

    /// Returns an upper estimate, in percent of the exact area, of the area that a mesh with this grid spacing, Å,
    /// lacks at its creases. It is fitted to 25 macromolecules with the default radii and probe (`docs/surface.md`);
    /// `None` for others, above 2 Å, and for surfaces without creases.
    #[must_use]
    pub fn area_deficit_percent(&self, spacing: f64) -> Option<f64> {
        let is_fitted = spacing <= 2.0 && self.radius_scale.total_cmp(&1.0).is_eq() && self.radius_offset == 0.0;
        let percent = |per_angstrom: f64| (10.0 * per_angstrom * spacing).round() / 10.0;
        match self.surface {
            SurfaceKind::Vdw if is_fitted => Some(percent(16.0)),
            SurfaceKind::Sas if is_fitted && self.probe == DEFAULT_PROBE => Some(percent(12.0)),
            _ => None,
        }
    }

    /// Returns the radius of the probe in Å; `None` for surfaces without one.
    #[must_use]
    pub fn used_probe(&self) -> Option<f64> {
        self.surface.has_probe().then_some(self.probe)
    }

    /// Returns the isovalue of an isosurface; `None` for a surface of spheres.
    #[must_use]
    pub fn level(&self) -> Option<f64> {
        self.surface.kernel().map(|_| self.isovalue)
    }

    /// Bytes of vertices and triangles of a mesh with these numbers of both, without nearest atoms.
    #[must_use]
    pub fn mesh_bytes(&self, n_vertices: u64, n_triangles: u64) -> u64 {
        Mesh::bytes_for(n_vertices, n_triangles, self.quantize.is_some())
    }

    /// Checks that scale and offset leave the smallest radius usable.
    ///
    /// # Errors
    /// [`SurfaceError::BadParameter`] names `radius_offset`.
    pub fn check_radius(&self, smallest: f32) -> Result<(), SurfaceError> {
        if f64::from(smallest) * self.radius_scale + self.radius_offset < MIN_RADIUS {
            let expected =
                format!("an offset that leaves every radius at {MIN_RADIUS} Å or more; the smallest is {smallest} Å");
            return Err(bad("radius_offset", self.radius_offset, expected));
        }
        Ok(())
    }
}

/// The paper's raw parameters, if any of them is given.
fn paper_params(kernel: Kernel, options: &SurfaceOptions) -> Result<Option<PaperParams>, SurfaceError> {
    let (a, b, c) = (options.paper_a, options.paper_b, options.paper_c);
    let all = [("paper_a", a), ("paper_b", b), ("paper_c", c)];
    let Some((given, given_value)) = all.into_iter().find_map(|(name, value)| Some((name, value?))) else {
        return Ok(None);
    };
    // An error names a parameter that was given, not the missing one.
    let need = |name: &'static str, value: Option<f64>, lo: f64, hi: f64| {
        let missing = || format!("`{name}` beside it: the paper's {kernel} kernel needs both");
        value.map_or_else(|| Err(bad(given, given_value, missing())), |value| within(name, value, lo, hi))
    };
    let absent = format!("no value: the paper's {kernel} kernel has no such parameter");
    Ok(Some(match kernel {
        Kernel::Gaussian => {
            reject("paper_c", c, &absent)?;
            PaperParams::Gaussian { a: need("paper_a", a, 1e-3, 100.0)?, b: need("paper_b", b, 1e-2, 1e6)? }
        }
        Kernel::SoftObject => {
            reject("paper_c", c, &absent)?;
            PaperParams::SoftObject { a: need("paper_a", a, 1e-2, 1e6)?, b: need("paper_b", b, 0.1, 50.0)? }
        }
        Kernel::InverseSquare => {
            reject("paper_a", a, &absent)?;
            PaperParams::InverseSquare { c: need("paper_c", c, 1e-6, 1.0)?, b: need("paper_b", b, 0.1, 50.0)? }
        }
    }))
}
