//! Estimate of a job's size without its mesh: exact counts for the grid, estimates from the area for the mesh.
//!
//! A surface of area A with random orientation crosses 1.5 A/h² edges of a grid of spacing h, because the mean of
//! |nx| + |ny| + |nz| over all normals is 1.5. Each crossing is a vertex, and a closed mesh has about two triangles per
//! vertex. The area is that of a coarser mesh.

use std::ops::Deref;

use molmesh_formats::Compress;
use molmesh_structure::{Structure, StructureError};
use molmesh_surface::cpu::{LATTICE_BYTES, check_work, scan};
use molmesh_surface::lattice::Lattice;
use molmesh_surface::params::{MAX_RESOLUTION, bad};
use molmesh_surface::{
    Control, Limit, OutOfMemory, Reservation, SurfaceError, SurfaceParams, TriangleQuality, candidates, improve,
};

use super::collapse::{self, check_error};
use super::color::{AtomColors, Scheme};
use super::cut::Cut;
use super::fit::{self, COARSE_FACTOR, MIN_COARSE_SPACING};
use super::load::{LoadedStructure, load};
use super::meshing::Meshing;
use super::work::{self, WorkCounts};
use super::{Choice, JobError, JobLimits, Options, StageClock, WorkScope};
use super::{parts, pockets};

/// Estimated size of a job.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Atoms that would be meshed.
    pub atoms: u64,
    /// Atoms that would be meshed, each counted once even if an assembly copies it.
    pub distinct_atoms: u64,
    /// Atoms in the file, all models.
    pub atoms_in_file: u64,
    /// Grid spacing, Å. It is an estimate if the job would search for it, and otherwise exact.
    pub resolution: f64,
    /// Cells of a dense grid.
    pub box_cells: u64,
    /// Rows of grid points that the search for pockets would pass over; 0 without a search.
    pub pocket_rows: u64,
    /// Estimate of the grid and the mesh, or the error that the job would return.
    pub mesh: Result<MeshEstimate, SurfaceError>,
}

/// Counts of a grid, and estimates of its mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshEstimate {
    /// Occupied bricks.
    pub bricks: u64,
    /// Grid points that would be evaluated.
    pub grid_points: u64,
    /// Pairs of an atom and a brick in its reach.
    pub pairs: u64,
    /// Area, Å².
    pub area: f64,
    /// Number of vertices.
    pub vertices: u64,
    /// Number of vertices of the surface before it is cut; equal to `vertices` without a cut.
    pub whole_vertices: u64,
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
    options: &Options,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<Estimate, JobError> {
    if let Some(tile) = options.tile {
        return Err(bad("tile", format!("`{}`", tile.path()), "no value in an estimate").into());
    }
    let clock = StageClock::new(&());
    let scope = WorkScope::new(&clock, control);
    let LoadedStructure { structure, selected, spheres } = load(read, options, &limits.read, &scope)?;
    if let Some(coloring) = options.color.as_ref().filter(|coloring| !matches!(coloring.scheme, Scheme::Vertex(_))) {
        AtomColors::new(&structure, &selected.atoms, coloring)?;
    }
    let parts = selected.parts(&structure, options.split, &limits.read, control)?;
    let cut = Cut::of(&selected, parts.as_deref(), None, options.validation, control)?;
    let job_backend = choice.backend.for_job();
    let meshing = Meshing {
        backend: job_backend.as_deref().unwrap_or(choice.backend),
        spheres: &spheres,
        parts: parts.as_deref().filter(|_| cut.is_none()),
        cut: cut.as_ref(),
        // Improved meshes would take far longer than the estimate needs.
        quality: TriangleQuality::Standard,
        limits: &limits.surface,
    };
    let max_triangles = options.spacing.max_triangles();
    let fitted = max_triangles.map(|limit| fit::expected(&meshing, options, limit, control)).transpose();
    let spacing = match &fitted {
        Ok(spacing) => *spacing,
        Err(error) => error.exceeded(Limit::Triangles).and_then(|exceeded| exceeded.resolution),
    };
    let params = options.mesh_params(&spheres, spacing);
    let plan = MeshPlan { meshing: &meshing, params: &params, compress: options.compress };
    let (lattices, memory) = plan.lattices(control)?;
    let box_cells = lattices.iter().fold(0, |all: u64, lattice| all.saturating_add(lattice.box_cells));
    let resolution = params.resolution;
    let simplifies = options.simplify.map_or(Ok(()), |wanted| check_error(wanted.error, params.resolution));
    let pocket_rows = pockets::rows(options, &spheres, &limits.surface, control);
    // In the order of the job, the search for pockets comes first.
    let checked = pocket_rows.clone().map(drop).and(simplifies).and(fitted.map(drop));
    let mesh = checked.and_then(|()| plan.mesh(&lattices, control));
    drop((lattices, memory));
    let mesh = mesh.and_then(|mesh| {
        let mesh = max_triangles.map_or(mesh, |limit| mesh.at_most(limit, &params));
        let with_attributes = |mesh: &MeshEstimate| mesh.bytes + options.attribute_bytes() * mesh.vertices;
        let held = with_attributes(&mesh).saturating_add(plan.compressed_bytes(mesh.vertices));
        control.memory.check(held.saturating_add(plan.bytes_before_cut(&mesh)))?;
        let mesh = options.max_triangles().map_or(mesh, |limit| mesh.at_most(limit, &params));
        Ok(MeshEstimate { bytes: with_attributes(&mesh), ..mesh })
    });
    let mesh = match mesh {
        Err(error) if ends_work(&error) => return Err(error.into()),
        mesh => mesh,
    };
    let (atoms, atoms_in_file) = (selected.atoms.len() as u64, structure.n_in_file());
    let distinct_atoms = selected.n_distinct as u64;
    let pocket_rows = pocket_rows.unwrap_or(0);
    Ok(Estimate { atoms, distinct_atoms, atoms_in_file, resolution, box_cells, pocket_rows, mesh })
}

impl Estimate {
    /// Returns the work of the job in atoms at 0.5 Å, if the job would be accepted.
    #[must_use]
    pub fn work(&self, options: &Options) -> Option<f64> {
        let Self { atoms_in_file: atoms, pocket_rows, .. } = *self;
        let MeshEstimate { grid_points, pairs, whole_vertices: vertices, .. } = *self.mesh.as_ref().ok()?;
        Some(work::counted_work(options, &WorkCounts { atoms, pairs, grid_points, vertices, pocket_rows }))
    }
}

impl MeshEstimate {
    /// Limits the numbers of triangles and vertices to those of at most `limit` triangles.
    fn at_most(self, limit: u64, params: &SurfaceParams) -> Self {
        let triangles = self.triangles.min(limit);
        let vertices = self.vertices.min(limit.div_ceil(2));
        Self { triangles, vertices, bytes: params.mesh_bytes(vertices, triangles), ..self }
    }
}

/// Rejects a job whose mesh alone needs more memory than the budget has, before the work begins. The size of the mesh
/// is estimated, by a coarser mesh, only if separate spheres would exceed the budget.
///
/// # Errors
/// Returns the errors of the mesh that can be foreseen, and those of the coarser mesh.
pub(super) fn check_memory(plan: &MeshPlan<'_>, options: &Options, control: &Control<'_>) -> Result<(), SurfaceError> {
    let (memory, params) = (&control.memory, plan.params);
    let processing = match (options.simplify, options.quality) {
        (Some(_), _) => collapse::TRIANGLE_BYTES,
        (None, TriangleQuality::High) => improve::TRIANGLE_BYTES,
        (None, TriangleQuality::Standard) => 0,
    };
    // A vertex has two triangles.
    let per_vertex = options.attribute_bytes() + 2 * processing;
    let attributes =
        |vertices: u64| vertices.saturating_mul(per_vertex).saturating_add(plan.compressed_bytes(vertices));
    let vertices = n_vertices(plan.meshing.spheres.area(params), params.resolution);
    let most = params.mesh_bytes(vertices, vertices.saturating_mul(2)).saturating_add(attributes(vertices));
    // A surface before its cut has at most the same size, besides its atom indices.
    let most = if plan.meshing.cut.is_some() {
        most.saturating_mul(2).saturating_add(ID_BYTES.saturating_mul(vertices))
    } else {
        most
    };
    if memory.check(most).is_ok() {
        return Ok(());
    }
    let mesh = plan.mesh(&plan.lattices(control)?.0, control)?;
    let bytes = mesh.bytes.saturating_add(attributes(mesh.vertices));
    Ok(memory.check(bytes.saturating_add(plan.bytes_before_cut(&mesh)))?)
}

/// Memory of the atom index of a vertex, bytes.
const ID_BYTES: u64 = 4;

/// Returns true if `error` ends the estimate as well, not only the mesh.
const fn ends_work(error: &SurfaceError) -> bool {
    matches!(
        error,
        SurfaceError::Cancelled
            | SurfaceError::Deadline
            | SurfaceError::Memory(OutOfMemory::Budget { .. } | OutOfMemory::Share { .. } | OutOfMemory::System { .. })
    )
}

/// Returns the number of vertices of a mesh of `area` Å².
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate")]
fn n_vertices(area: f64, spacing: f64) -> u64 {
    (1.5 * area / (spacing * spacing)).round() as u64
}

/// Mesh that is planned.
pub(super) struct MeshPlan<'a> {
    pub(super) meshing: &'a Meshing<'a>,
    pub(super) params: &'a SurfaceParams,
    /// Storage of the mesh in its file.
    pub(super) compress: Compress,
}

impl MeshPlan<'_> {
    /// Returns the memory of a compressed mesh, which is held besides the mesh, bytes.
    fn compressed_bytes(&self, vertices: u64) -> u64 {
        vertices.saturating_mul(self.compress.compressed_vertex_bytes())
    }

    /// Returns the memory of the surface before it is cut, with its atom indices, bytes; 0 without a cut.
    fn bytes_before_cut(&self, mesh: &MeshEstimate) -> u64 {
        let n = mesh.whole_vertices;
        let bytes = self.params.mesh_bytes(n, n.saturating_mul(2)).saturating_add(ID_BYTES.saturating_mul(n));
        if self.meshing.cut.is_some() { bytes } else { 0 }
    }

    /// Places the spheres of each part on its lattice. Returns the memory of the lattices as well.
    fn lattices(&self, control: &Control<'_>) -> Result<(Vec<Lattice>, Reservation), SurfaceError> {
        // All lattices, and the spheres of one part at a time.
        let Meshing { spheres, parts, .. } = *self.meshing;
        let memory = control.reserve((LATTICE_BYTES + super::SPHERE_BYTES) * spheres.len() as u64)?;
        let lattices = parts::spheres_of(spheres, parts).map(|own| Lattice::new(&own, self.params, control));
        Ok((lattices.collect::<Result<_, _>>()?, memory))
    }

    /// Estimates the mesh.
    fn mesh(&self, lattices: &[Lattice], control: &Control<'_>) -> Result<MeshEstimate, SurfaceError> {
        let Self { meshing: Meshing { spheres, limits, .. }, params, .. } = *self;
        let (mut bricks, mut pairs, mut n_atoms, h) = (0, 0, 0, params.resolution);
        candidates::check(spheres, params, limits)?;
        let too_large = |grid_points: u64, n_atoms: usize| {
            let fraction = n_atoms as f64 / spheres.len() as f64;
            parts::grid_too_large(grid_points, fraction, lattices.len(), h, limits)
        };
        for lattice in lattices {
            n_atoms += lattice.atoms.len();
            let counts = check_work(lattice, params, limits, control).map_err(|error| {
                match error.exceeded(Limit::GridPoints).and_then(|exceeded| exceeded.actual) {
                    Some(grid_points) => too_large(grid_points.saturating_add(512 * bricks), n_atoms),
                    None => error,
                }
            })?;
            bricks += counts.reached;
            pairs += counts.candidates;
        }
        if pairs > candidates::limit(limits) {
            return Err(candidates::too_many(pairs, spheres, params, limits));
        }
        let grid_points = 512 * bricks;
        if grid_points > limits.max_grid_points {
            // Each part fits the limit, but not all parts together.
            return Err(too_large(grid_points, n_atoms));
        }
        let [whole_area, area] = self.areas(COARSE_FACTOR * h, control)?;
        let [whole_vertices, vertices] = [whole_area, area].map(|area| n_vertices(area, h));
        let triangles = vertices.saturating_mul(2);
        let bytes = params.mesh_bytes(vertices, triangles);
        // Limits count parts before quantizing, and a surface before its cut.
        let counted = if lattices.len() > 1 { &self.unquantized() } else { params };
        let in_memory = counted.mesh_bytes(whole_vertices, whole_vertices.saturating_mul(2));
        if in_memory > limits.max_mesh_bytes {
            return Err(scan::too_large(in_memory, h, limits.max_mesh_bytes));
        }
        Ok(MeshEstimate { bricks, grid_points, pairs, area, vertices, whole_vertices, triangles, bytes })
    }

    /// Returns the error of a run that failed with `error`. A run ends soon after its mesh exceeds a limit, when it has
    /// found little of the surface. An estimate of the whole mesh suggests a better spacing.
    pub(super) fn run_error(&self, error: SurfaceError, control: &Control<'_>) -> SurfaceError {
        if error.exceeded(Limit::MeshBytes).is_none() {
            return error;
        }
        match self.lattices(control).and_then(|(lattices, _memory)| self.mesh(&lattices, control)) {
            Err(planned) if ends_work(&planned) || planned.exceeded(Limit::MeshBytes).is_some() => planned,
            _ => error,
        }
    }

    fn unquantized(&self) -> SurfaceParams {
        SurfaceParams { atom_ids: false, quantize: None, ..self.params.clone() }
    }

    /// Returns the areas of a coarser mesh before and after the cut, Å². They are equal without a cut.
    fn areas(&self, coarse: f64, control: &Control<'_>) -> Result<[f64; 2], SurfaceError> {
        let cut = self.meshing.cut;
        let uncut = Meshing { cut: None, quality: TriangleQuality::Standard, ..*self.meshing };
        let single = SurfaceParams { atom_ids: cut.is_some(), ..self.unquantized() };
        let resolution = coarse.clamp(MIN_COARSE_SPACING, MAX_RESOLUTION).max(single.resolution);
        let coarse = SurfaceParams { resolution, ..single.clone() };
        let control = control.metered();
        let areas = |params: &SurfaceParams| {
            let mut output = uncut.mesh(params, &control)?;
            let whole = output.measure(&control)?.area;
            let Some(cut) = cut else { return Ok([whole; 2]) };
            output.mesh.make_contiguous();
            match cut.area(&output.mesh) {
                0.0 => Err(SurfaceError::NoPatch),
                area => Ok([whole, area]),
            }
        };
        match areas(&coarse) {
            // A coarse grid can miss single small spheres: use the job's grid then.
            Err(SurfaceError::NoSurface { .. } | SurfaceError::NoPatch) => areas(&single),
            areas => areas,
        }
    }
}

#[cfg(test)]
mod tests {
    use molmesh_structure::{ReadLimits, read_with};
    use molmesh_surface::{CpuBackend, Exceeded, Spheres, SurfaceLimits};

    use super::*;
    use crate::{params, run};

    const SAMPLE: &[u8] = include_bytes!("../../../samples/4pti.pdb");

    fn read(control: &Control<'_>) -> Result<Box<Structure>, StructureError> {
        read_with(SAMPLE, &ReadLimits::default(), control).map(Box::new)
    }

    #[test]
    fn grid_counts_are_exact_and_mesh_counts_are_close() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        for resolution in ["0.3", "0.5", "1", "2"] {
            let options = params::parse([("resolution", resolution)]).unwrap().options;
            let (limits, control) = (JobLimits::default(), Control::default());
            let estimate = estimate(read, &options, &limits, &choice, &control).unwrap();
            let report = run(SAMPLE, &options, &limits, &choice, &control, &(), None).unwrap().report;
            let mesh = estimate.mesh.unwrap();
            assert_eq!((mesh.grid_points, estimate.atoms), (report.grid_points, report.atoms));
            let ratio = mesh.triangles as f64 / report.triangles as f64;
            assert!((0.8..1.25).contains(&ratio), "{resolution}: {ratio}");
        }
    }

    #[test]
    fn searches_for_pockets_are_limited_and_cost_their_rows() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let of = |pairs: &[(&str, &str)], surface: SurfaceLimits| {
            let (options, limits) = (params::parse(pairs.iter().copied()).unwrap().options, JobLimits::default());
            let (limits, control) = (JobLimits { surface, ..limits }, Control::default());
            let done = run(SAMPLE, &options, &limits, &choice, &control, &(), None).map(drop);
            let estimate = estimate(read, &options, &limits, &choice, &control).unwrap();
            match (done, &estimate.mesh) {
                (Ok(()), Ok(_)) => Ok((estimate.pocket_rows, estimate.work(&options).unwrap())),
                (Err(JobError::Surface(error)), Err(refused)) if error == *refused => Err(error),
                (done, mesh) => panic!("{done:?} and {mesh:?}"),
            }
        };
        let coarse = ("resolution", "3");
        let search = |probe, surface| of(&[("pockets", "true"), ("pocket_probe", probe), coarse], surface);
        let (no_rows, without) = of(&[coarse], SurfaceLimits::default()).unwrap();
        assert_eq!(no_rows, 0);
        let mut rows = 0;
        for probe in ["4", "20"] {
            let (counted, with) = search(probe, SurfaceLimits::default()).unwrap();
            assert!(counted > rows && ((with - without) / (0.005 * counted as f64) - 1.0).abs() < 1e-9, "{counted}");
            rows = counted;
        }
        // Five rows count as a pair. The mesh has fewer pairs.
        let most = |max_candidates| search("20", SurfaceLimits { max_candidates, ..SurfaceLimits::default() });
        let least = rows.div_ceil(5);
        assert!(most(least).is_ok());
        let error = Exceeded { actual: Some(rows), ..Exceeded::new(Limit::PocketRows, 5 * (least - 1)) };
        assert_eq!(most(least - 1), Err(error.error()));
        let small = SurfaceLimits { max_grid_points: 50_000, ..SurfaceLimits::default() };
        assert!(search("4", small).unwrap_err().exceeded(Limit::PocketPoints).is_some());
    }

    #[test]
    fn sizes_of_huge_spheres_do_not_overflow() {
        let (backend, limits) = (CpuBackend::new(None).unwrap(), SurfaceLimits::default());
        let spheres = Spheres::new(vec![0.0], vec![0.0], vec![0.0], vec![1e9]).unwrap();
        let params = SurfaceParams { resolution: 0.05, ..SurfaceParams::default() };
        let quality = TriangleQuality::Standard;
        let meshing =
            Meshing { backend: &backend, spheres: &spheres, parts: None, cut: None, quality, limits: &limits };
        let plan = MeshPlan { meshing: &meshing, params: &params, compress: Compress::None };
        assert_eq!(n_vertices(spheres.area(&params), params.resolution), u64::MAX);
        assert_eq!(params.mesh_bytes(u64::MAX, u64::MAX), u64::MAX);
        // Without a limit, any size is accepted.
        check_memory(&plan, &Options::default(), &Control::default()).unwrap();
    }

    #[test]
    fn quantized_vertices_need_half_the_bytes() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let of = |compress: &str| {
            let options = params::parse([("compress", compress)]).unwrap().options;
            estimate(read, &options, &JobLimits::default(), &choice, &Control::default()).unwrap().mesh.unwrap()
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
            let options = params::parse(pairs.iter().copied()).unwrap().options;
            let (limits, control) = (JobLimits::default(), Control::default());
            let estimate = estimate(read, &options, &limits, &choice, &control).unwrap().mesh.unwrap();
            let product = run(SAMPLE, &options, &limits, &choice, &control, &(), None).unwrap();
            let bytes = product.file(molmesh_formats::Format::Glb).unwrap().bytes().unwrap();
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
    fn repetitions_with_suggested_spacings_are_accepted() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let refused = |surface: &str, resolution: f64, limits: SurfaceLimits| {
            let text = resolution.to_string();
            let options = params::parse([("surface", surface), ("resolution", text.as_str())]).unwrap().options;
            let (limits, control) = (JobLimits { surface: limits, ..JobLimits::default() }, Control::default());
            let error = match run(SAMPLE, &options, &limits, &choice, &control, &(), None).err()? {
                JobError::Surface(error) => error,
                error => panic!("{error}"),
            };
            Some((error, estimate(read, &options, &limits, &choice, &control).unwrap().mesh.err()))
        };
        let suggestion = |error: &SurfaceError| match error {
            SurfaceError::Limit(exceeded) => exceeded.suggested_resolution,
            _ => None,
        };
        let any = SurfaceLimits::default();
        for (surface, resolution, limits) in [
            ("gaussian", 0.05, SurfaceLimits { max_grid_points: 20_000_000, ..any }),
            ("gaussian", 0.02, SurfaceLimits { max_grid_points: 1_000_000, ..any }),
            ("gaussian", 0.3, SurfaceLimits { max_grid_points: 200_000, ..any }),
            ("gaussian", 0.9, SurfaceLimits { max_grid_points: 40_000, ..any }),
            ("gaussian", 0.4, SurfaceLimits { max_candidates: 10_000, ..any }),
            // The pairs of arcs are counted once those of the atoms fit.
            ("ses", 0.05, SurfaceLimits { max_candidates: 200_000, ..any }),
            // The run ends early, with few triangles.
            ("gaussian", 0.1, SurfaceLimits { max_mesh_bytes: 300_000, ..any }),
            (
                "gaussian",
                0.4,
                SurfaceLimits { max_grid_points: 100_000, max_candidates: 10_000, max_mesh_bytes: 100_000 },
            ),
        ] {
            let (mut spacing, mut count) = (resolution, 0);
            while let Some((error, planned)) = refused(surface, spacing, limits) {
                let suggested = suggestion(&error).unwrap_or_else(|| panic!("{error}"));
                if count == 0 {
                    let planned = planned.as_ref().and_then(suggestion);
                    assert_eq!(planned, Some(suggested), "{error}");
                }
                count += 1;
                assert!(suggested > spacing && count <= 3, "refusal {count}: {error}");
                spacing = suggested;
            }
            assert!(count > 0, "{resolution} {limits:?}");
            // Control: half of the spacing does not fit.
            assert!(refused(surface, 0.5 * spacing, limits).is_some(), "{spacing} {limits:?}");
        }
        let (error, _) = refused("gaussian", 1.0, SurfaceLimits { max_grid_points: 511, ..any }).unwrap();
        assert_eq!(suggestion(&error), None, "a grid has one brick");
    }

    #[test]
    fn rejections_suggest_a_resolution_that_fits() {
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let small = SurfaceLimits { max_mesh_bytes: 100_000, ..SurfaceLimits::default() };
        let limits = JobLimits { surface: small, ..JobLimits::default() };
        let refused = estimate(read, &Options::default(), &limits, &choice, &Control::default()).unwrap();
        let error = refused.mesh.unwrap_err();
        let text = error.exceeded(Limit::MeshBytes).unwrap().suggested_resolution.unwrap().to_string();
        let options = params::parse([("resolution", text.as_str())]).unwrap().options;
        assert!(estimate(read, &options, &limits, &choice, &Control::default()).unwrap().mesh.is_ok());
    }
}
