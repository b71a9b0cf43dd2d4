//! Estimate of a job's size without its mesh: exact counts for the grid, estimates from the area for the mesh.
//!
//! A surface of area A with random orientation crosses 1.5 A/h² edges of a grid of spacing h, as the mean of
//! |nx| + |ny| + |nz| over all normals is 1.5. Each crossing is a vertex, and a closed mesh has about two triangles per
//! vertex. A coarser mesh gives the area.

use std::ops::Deref;

use super::color::AtomColors;
use super::fit::{self, COARSE_FACTOR, MIN_COARSE_SPACING};
use super::parts::{self, PartsBackend};
use super::{Choice, Job, JobError, JobLimits, Spacing, StageClock};
use crate::structure::{AtomPart, Structure, StructureError};
use crate::surface::cpu::{LATTICE_BYTES, scan};
use crate::surface::lattice::{Lattice, slightly_coarser};
use crate::surface::occupancy::Occupancy;
use crate::surface::params::MAX_RESOLUTION;
use crate::surface::{Backend, Control, Mesh, Spheres, SurfaceError, SurfaceLimits, SurfaceParams};

/// Estimated size of a job.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Atoms that would be meshed.
    pub atoms: u64,
    /// Atoms that would be meshed, each counted once even if an assembly copies it.
    pub distinct_atoms: u64,
    /// Atoms in the file, all models.
    pub atoms_in_file: u64,
    /// Grid spacing, Å. It is an estimate if the job would search for it, else exact.
    pub resolution: f64,
    /// Cells of a dense grid.
    pub box_cells: u64,
    /// Estimate of the grid and the mesh, or the error that the job would return.
    pub mesh: Result<MeshEstimate, SurfaceError>,
}

/// Counts of a grid, and estimates of its mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshEstimate {
    /// Occupied bricks.
    pub bricks: u64,
    /// Grid points that would be evaluated.
    pub samples: u64,
    /// Area, Å².
    pub area: f64,
    /// Number of vertices.
    pub vertices: u64,
    /// Number of triangles.
    pub triangles: u64,
    /// Bytes of the binary part of a GLB. Without colours and atom indices, the mesh in memory has the same size.
    pub bytes: u64,
}

/// Estimates a job on the structure that `read` returns.
///
/// # Errors
/// Returns a [`JobError`] if reading or selecting fails, or the job is cancelled.
pub fn estimate<S: Deref<Target = Structure>>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<Estimate, JobError> {
    let clock = StageClock::new(&());
    let (structure, selected, spheres) = super::load(read, job, &limits.read, &clock, control)?;
    if let Some(coloring) = &job.color {
        AtomColors::new(&structure, &selected.atoms, coloring)?;
    }
    let parts = selected.parts(&structure, job.split, &limits.read, control)?;
    let divided = parts.as_deref().map(|parts| PartsBackend::new(choice.backend, parts));
    let backend = divided.as_ref().map_or(choice.backend, |divided| divided as &dyn Backend);
    let choice = &Choice { backend, reason: choice.reason };
    let mut params = job.params_for(spheres.len());
    let mut refused = None;
    if let Spacing::MaxTriangles(limit) = job.spacing {
        match fit::expected(&spheres, job, limit, &limits.surface, choice, control) {
            Ok(resolution) => params.resolution = resolution,
            Err(error) => {
                if let SurfaceError::TooManyTriangles { resolution, .. } = error {
                    params.resolution = resolution;
                }
                refused = Some(error);
            }
        }
    }
    let _storage = super::storage(job, &mut params, &spheres);
    // All lattices, and the spheres of one part at a time.
    let copies = (LATTICE_BYTES + super::SPHERE_BYTES) * spheres.len() as u64;
    control.memory.grow(copies).map_err(SurfaceError::from)?;
    let lattices = parts::spheres_of(&spheres, parts.as_deref()).map(|own| Lattice::new(&own, &params));
    let lattices: Vec<Lattice> = lattices.collect::<Result<_, SurfaceError>>()?;
    let box_cells = lattices.iter().fold(0, |all: u64, lattice| all.saturating_add(lattice.box_cells));
    let resolution = params.resolution;
    let mesh = refused.map_or_else(|| of_mesh(&lattices, &spheres, &params, &limits.surface, choice, control), Err);
    let explain = |error| with_finest_fit(error, &spheres, parts.as_deref(), &params, &limits.surface, control);
    let mesh = mesh.map_err(explain);
    let mesh = match (mesh, job.spacing) {
        (Err(error @ (SurfaceError::Cancelled | SurfaceError::Deadline)), _) => return Err(error.into()),
        (Ok(mesh), Spacing::MaxTriangles(limit)) => Ok(mesh.at_most(limit, &params)),
        (mesh, _) => mesh,
    };
    let mesh = mesh.map(|mesh| MeshEstimate { bytes: mesh.bytes + job.attribute_bytes() * mesh.vertices, ..mesh });
    let (atoms, atoms_in_file) = (selected.atoms.len() as u64, structure.len() as u64);
    let distinct_atoms = selected.n_distinct as u64;
    Ok(Estimate { atoms, distinct_atoms, atoms_in_file, resolution, box_cells, mesh })
}

impl MeshEstimate {
    /// Limits the numbers of triangles and vertices to those of at most `limit` triangles.
    fn at_most(self, limit: u64, params: &SurfaceParams) -> Self {
        let triangles = self.triangles.min(limit);
        let vertices = self.vertices.min(limit.div_ceil(2));
        Self { triangles, vertices, bytes: params.mesh_bytes(vertices, triangles), ..self }
    }
}

fn of_mesh(
    lattices: &[Lattice],
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<MeshEstimate, SurfaceError> {
    let (mut bricks, h) = (0, params.resolution);
    for lattice in lattices {
        bricks += Occupancy::new(lattice, limits, control)?.n_reached();
    }
    let (samples, limit) = (512 * bricks, limits.max_samples);
    if samples > limit {
        // Each part fits the limit, but not all parts together.
        let suggested_resolution = slightly_coarser(h * (samples as f64 / limit as f64).cbrt());
        return Err(SurfaceError::GridTooLarge { samples, limit, resolution: h, suggested_resolution });
    }
    let single = SurfaceParams { atom_ids: false, quantize: None, ..params.clone() };
    let coarse = SurfaceParams { resolution: (COARSE_FACTOR * h).max(MIN_COARSE_SPACING).max(h), ..single.clone() };
    let mesh = match choice.backend.run(spheres, &coarse, limits, control) {
        // A coarse grid can miss single small spheres: use the job's grid then.
        Err(SurfaceError::NoSurface { .. }) => choice.backend.run(spheres, &single, limits, control)?.mesh,
        meshed => meshed?.mesh,
    };
    let area = area(&mesh);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate")]
    let vertices = (1.5 * area / (h * h)).round() as u64;
    let triangles = 2 * vertices;
    let bytes = params.mesh_bytes(vertices, triangles);
    // Parts are quantized after joining, so each vertex first takes its full size.
    let in_memory = if lattices.len() > 1 { single.mesh_bytes(vertices, triangles) } else { bytes };
    let estimate = MeshEstimate { bricks, samples, area, vertices, triangles, bytes };
    if in_memory > limits.max_mesh_bytes {
        return Err(scan::too_large(in_memory, h, limits.max_mesh_bytes));
    }
    Ok(estimate)
}

/// Maximum number of grids that [`with_finest_fit`] plans.
const MAX_PLANS: u32 = 6;
/// Factor by which the spacing grows if it does not fit all parts.
const COARSER: f64 = 1.5;

/// Replaces the suggested spacing of [`SurfaceError::GridTooLarge`], which is an upper bound, with the finest hundredth
/// of an Å whose planned grid fits.
pub(super) fn with_finest_fit(
    error: SurfaceError,
    spheres: &Spheres,
    parts: Option<&[AtomPart]>,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> SurfaceError {
    let SurfaceError::GridTooLarge { samples, limit, resolution, suggested_resolution: bound } = error else {
        return error;
    };
    let samples_at = |spacing: f64| {
        let params = SurfaceParams { resolution: spacing, ..params.clone() };
        let counted = parts::spheres_of(spheres, parts).map(|own| {
            let lattice = Lattice::new(&own, &params)?;
            Ok(512 * Occupancy::new(&lattice, limits, control)?.n_reached())
        });
        counted.sum::<Result<u64, SurfaceError>>()
    };
    let (mut fits, mut next) = (None, bound);
    for _ in 0..MAX_PLANS {
        match samples_at(next) {
            Ok(needed) if needed <= limit => {
                fits = Some(next);
                // The bricks of a finer grid cover less volume, so the grid at this spacing fits as well.
                let finer = (next * (needed as f64 / limit as f64).cbrt() * 100.0).ceil() / 100.0;
                if finer >= next {
                    break;
                }
                next = finer;
            }
            Err(error @ (SurfaceError::Cancelled | SurfaceError::Deadline)) => return error,
            // The bound comes from one part and may be too fine for all parts.
            _too_large if parts.is_some() && fits.is_none() && next < MAX_RESOLUTION => {
                next = (COARSER * next).min(MAX_RESOLUTION);
            }
            _too_large => break,
        }
    }
    // The bound ends at the coarsest spacing, which need not fit.
    let unknown = parts.is_some() || bound >= MAX_RESOLUTION;
    let suggested_resolution = fits.unwrap_or(if unknown { f64::INFINITY } else { bound });
    SurfaceError::GridTooLarge { samples, limit, resolution, suggested_resolution }
}

/// Returns the area of a mesh, Å².
fn area(mesh: &Mesh) -> f64 {
    let corner = |i: u32| glam::Vec3::from(mesh.positions[i as usize]);
    let doubled = |t: &[u32; 3]| {
        let [a, b, c] = t.map(corner);
        f64::from((b - a).cross(c - a).length())
    };
    0.5 * mesh.triangles.iter().map(doubled).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{params, run};
    use crate::structure::{ReadLimits, read_with};
    use crate::surface::CpuBackend;

    const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");

    fn read(control: &Control<'_>) -> Result<Box<Structure>, StructureError> {
        read_with(SAMPLE, &ReadLimits::default(), control).map(Box::new)
    }

    #[test]
    fn grid_counts_are_exact_and_mesh_counts_are_close() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        for resolution in ["0.3", "0.5", "1", "2"] {
            let job = params::parse([("resolution", resolution)]).unwrap().job;
            let (limits, control) = (JobLimits::default(), Control::default());
            let estimate = estimate(read, &job, &limits, &choice, &control).unwrap();
            let report = run(SAMPLE, &job, &limits, &choice, &control, &(), None).unwrap().report;
            let mesh = estimate.mesh.unwrap();
            assert_eq!((mesh.samples, estimate.atoms), (report.samples, report.atoms));
            let ratio = mesh.triangles as f64 / report.triangles as f64;
            assert!((0.8..1.25).contains(&ratio), "{resolution}: {ratio}");
        }
    }

    #[test]
    fn quantized_vertices_need_half_the_bytes() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let of = |compress: &str| {
            let job = params::parse([("compress", compress)]).unwrap().job;
            estimate(read, &job, &JobLimits::default(), &choice, &Control::default()).unwrap().mesh.unwrap()
        };
        let (single, rounded) = (of("none"), of("quantize"));
        assert_eq!((single.vertices, single.triangles), (rounded.vertices, rounded.triangles));
        assert_eq!(single.bytes - rounded.bytes, 12 * single.vertices);
    }

    #[test]
    fn colours_and_atom_indices_add_their_bytes() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let of = |pairs: &[(&str, &str)]| {
            let job = params::parse(pairs.iter().copied()).unwrap().job;
            let (limits, control) = (JobLimits::default(), Control::default());
            let estimate = estimate(read, &job, &limits, &choice, &control).unwrap().mesh.unwrap();
            let product = run(SAMPLE, &job, &limits, &choice, &control, &(), None).unwrap();
            let bytes = product.file(crate::formats::Format::Glb).unwrap().bytes().unwrap();
            // The number of vertices is an estimate. At this spacing, indices have 32 bits, as in memory.
            let ratio = bytes as f64 / estimate.bytes as f64;
            assert!((0.8..1.25).contains(&ratio), "{pairs:?}: {ratio}");
            estimate
        };
        let plain = of(&[("resolution", "0.2")]);
        let colored = of(&[("resolution", "0.2"), ("color", "chain")]);
        let both = of(&[("resolution", "0.2"), ("color", "chain"), ("atom_ids", "true")]);
        assert_eq!(colored.bytes - plain.bytes, 8 * plain.vertices);
        assert_eq!(both.bytes - colored.bytes, 4 * plain.vertices);
    }

    #[test]
    fn the_finest_spacing_that_fits_is_suggested() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let suggested = |resolution: f64, max_samples: u64| {
            let text = resolution.to_string();
            let job = params::parse([("resolution", text.as_str())]).unwrap().job;
            let surface = SurfaceLimits { max_samples, ..SurfaceLimits::default() };
            let limits = JobLimits { surface, ..JobLimits::default() };
            let refused = run(SAMPLE, &job, &limits, &choice, &Control::default(), &(), None).map(drop);
            let planned = estimate(read, &job, &limits, &choice, &Control::default()).unwrap().mesh.map(drop);
            let spacing = |error: SurfaceError| match error {
                SurfaceError::GridTooLarge { suggested_resolution, .. } => suggested_resolution,
                error => panic!("{error}"),
            };
            let planned = planned.map_err(spacing);
            let refused = refused.map_err(|error| match error {
                JobError::Surface(error) => spacing(error),
                error => panic!("{error}"),
            });
            assert_eq!(refused, planned);
            refused
        };
        for (resolution, limit) in [(0.05, 20_000_000), (0.02, 1_000_000), (0.3, 200_000), (0.9, 40_000)] {
            let fits = suggested(resolution, limit).unwrap_err();
            assert!(fits > resolution && suggested(fits, limit).is_ok(), "{limit}: {fits}");
            // Control: a slightly finer grid does not fit.
            assert!(suggested(0.97 * fits - 0.01, limit).is_err(), "{limit}: {fits}");
        }
        assert!(suggested(1.0, 511).unwrap_err().is_infinite(), "a grid has one brick");
    }

    #[test]
    fn rejections_suggest_a_resolution_that_fits() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let small = SurfaceLimits { max_mesh_bytes: 100_000, ..SurfaceLimits::default() };
        let limits = JobLimits { surface: small, ..JobLimits::default() };
        let refused = estimate(read, &Job::default(), &limits, &choice, &Control::default()).unwrap();
        let Err(SurfaceError::MeshTooLarge { suggested_resolution, .. }) = refused.mesh else { panic!("{refused:?}") };
        let text = suggested_resolution.to_string();
        let job = params::parse([("resolution", text.as_str())]).unwrap().job;
        assert!(estimate(read, &job, &limits, &choice, &Control::default()).unwrap().mesh.is_ok());
    }
}
