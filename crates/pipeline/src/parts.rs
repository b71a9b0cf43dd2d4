//! Meshes of the parts of the atoms, made separately and joined. The joined mesh records the rows of each part.
//!
//! Grids are aligned with the origin, so the mesh of a part does not depend on the other parts.

use std::borrow::Cow;

use molmesh_structure::AtomPart;
use molmesh_surface::cpu::scan;
use molmesh_surface::lattice::{to_f32, to_u64};
use molmesh_surface::vector::{add, joined_bounds, sub};
use molmesh_surface::{
    BackendIdentity, Control, GridStats, Limit, Measures, Mesh, MeshOutput, PartRange, Spheres, Stage, SurfaceError,
    SurfaceLimits, SurfaceParams, candidates, grid_limit,
};
use rayon::prelude::*;
use serde::Serialize;

use super::SPHERE_BYTES;
use super::fit::WithoutProgress;

/// Rows per parallel task.
const ROWS: usize = 1 << 16;

/// Part of the mesh. It is closed on its own, unless `context=whole` divides one surface.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct PartReport {
    /// Name: chain (with the number of its copy in an assembly), entity, group of residues, or the chains of a unit
    /// (`instances`).
    pub name: String,
    /// Number of atoms.
    pub atoms: u64,
    /// Number of vertices.
    pub vertices: u64,
    /// Number of triangles; 0 if no grid point lies inside the surface of the part, or if no triangle is nearest to its
    /// atoms.
    pub triangles: u64,
    /// Surface area in Å².
    pub area: f64,
    /// Enclosed volume in Å³; null for a part of one surface (`context=whole`).
    #[schema(required)]
    pub volume: Option<f64>,
    /// Number of instances in the assembly; absent without `instances`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instances: Option<u64>,
}

impl PartReport {
    /// Returns the reports of all parts of `mesh`.
    pub(super) fn all(parts: &[AtomPart], mesh: &Mesh) -> Vec<Self> {
        let report = |(part, range): (&AtomPart, &PartRange)| {
            let [vertices, triangles] = [&range.vertices, &range.triangles].map(|rows| rows.len() as u64);
            let (name, atoms) = (part.name.clone(), part.rows.len() as u64);
            let instances = mesh.placements.is_some().then_some(range.placements.len() as u64);
            Self { name, atoms, vertices, triangles, area: range.area, volume: range.volume, instances }
        };
        parts.iter().zip(&mesh.parts).map(report).collect()
    }
}

/// Returns the spheres of each part, or all spheres if `parts` is `None`.
pub(super) fn spheres_of<'s>(
    spheres: &'s Spheres,
    parts: Option<&'s [AtomPart]>,
) -> impl Iterator<Item = Cow<'s, Spheres>> {
    let whole = parts.is_none().then_some(Cow::Borrowed(spheres));
    whole.into_iter().chain(parts.unwrap_or_default().iter().map(|part| Cow::Owned(spheres.subset(&part.rows))))
}

/// Joins the meshes that `mesh` returns for the spheres of each part and the limits that remain for it. Returns `None`
/// if a fallback meshed some of them.
pub(super) fn join(
    parts: &[AtomPart],
    mesh: impl Fn(&Spheres, &SurfaceLimits, &Control<'_>) -> Result<MeshOutput, SurfaceError>,
    run: &Run<'_>,
    control: &Control<'_>,
) -> Result<Option<MeshOutput>, SurfaceError> {
    let spheres = run.spheres;
    let mut joined = Joined::new(centre(spheres, run.single));
    let observer = control.observer;
    let quiet = WithoutProgress(observer);
    let control = Control { observer: &quiet, ..control.clone() };
    let mut n_atoms = 0;
    for part in parts {
        control.check()?;
        n_atoms += part.rows.len();
        let meshed = {
            let _spheres = control.reserve(SPHERE_BYTES * part.rows.len() as u64)?;
            let own = spheres.subset(&part.rows);
            mesh(&own, &joined.left_of(run), &control)
        };
        match meshed {
            Ok(output) if !joined.made_by(output.made_by.as_ref()) => return Ok(None),
            Ok(output) => joined.push(part, output, run, &control)?,
            Err(SurfaceError::NoSurface { .. }) => joined.skip(part),
            Err(error) => return Err(joined.error(error, run, parts.len(), n_atoms as f64 / spheres.len() as f64)),
        }
        let [n_vertices, n_triangles] = [joined.mesh.n_vertices(), joined.mesh.n_triangles()];
        scan::check_size(run.single, run.limits, n_vertices as u64, n_triangles as u64)?;
        for stage in [Stage::Field, Stage::Emit] {
            observer.progress(stage, n_atoms, spheres.len());
        }
    }
    joined.finish(run.single).map(Some)
}

/// Returns the error of `n_parts` parts whose grids are too large together. The first of them, with `fraction` of the
/// atoms, have about `grid_points` grid points.
pub(super) fn grid_too_large(
    grid_points: u64,
    fraction: f64,
    n_parts: usize,
    resolution: f64,
    limits: &SurfaceLimits,
) -> SurfaceError {
    // The number of grid points of a part that fails is an estimate.
    let all = to_u64(grid_points as f64 / fraction).max(limits.max_grid_points.saturating_add(1));
    grid_limit::exceeded(resolution, all, n_parts, limits)
}

/// Spheres, parameters and limits of all parts.
pub(super) struct Run<'a> {
    pub(super) spheres: &'a Spheres,
    pub(super) params: &'a SurfaceParams,
    /// The parameters without quantizing: all parts are quantized relative to the centre of the joined mesh.
    pub(super) single: &'a SurfaceParams,
    pub(super) limits: &'a SurfaceLimits,
}

/// Returns the centre of the joined mesh: the grid point nearest to the middle of the bounding box of all spheres.
fn centre(spheres: &Spheres, params: &SurfaceParams) -> [f64; 3] {
    let [low, high] = spheres.bounds().unwrap_or_default();
    let h = params.resolution;
    std::array::from_fn(|k| (0.5 * (low[k] + high[k]) / h).round() * h)
}

/// Joined mesh of the parts so far.
struct Joined {
    mesh: Mesh,
    grid: GridStats,
    /// Measures of the parts.
    measures: Vec<Measures>,
    made_by: Option<BackendIdentity>,
}

impl Joined {
    fn new(centre: [f64; 3]) -> Self {
        let mesh = Mesh { centre, ..Mesh::default() };
        Self { mesh, grid: GridStats::default(), measures: Vec::new(), made_by: None }
    }

    /// Records the backend of a part. Returns false if it differs from that of the previous parts.
    fn made_by(&mut self, identity: Option<&BackendIdentity>) -> bool {
        let name = |identity: Option<&BackendIdentity>| identity.map(|identity| identity.backend);
        self.made_by = self.made_by.take().or_else(|| identity.cloned());
        name(self.made_by.as_ref()) == name(identity)
    }

    /// Adds the mesh of a part.
    fn push(
        &mut self,
        part: &AtomPart,
        mut output: MeshOutput,
        run: &Run<'_>,
        control: &Control<'_>,
    ) -> Result<(), SurfaceError> {
        let own = &mut output.mesh;
        let shift = sub(own.centre, self.mesh.centre);
        own.centre = self.mesh.centre;
        let moved = |p: [f32; 3]| add(p.map(f64::from), shift).map(to_f32);
        own.positions.par_chunks_mut(ROWS).flatten_iter().for_each(|position| *position = moved(*position));
        // Moving and rounding keep the order of coordinates.
        output.bounds = output.bounds.map(|bounds| bounds.map(moved));
        let components = output.measures.iter_mut().flat_map(|measures| &mut measures.components);
        components.for_each(|component| component.shift(shift));
        let [first, n] = [self.mesh.n_vertices(), own.n_vertices()];
        let rounded = run.params.quantize.map_or(0, |_step| run.params.mesh_bytes(n as u64, 0));
        let _rounding = control.reserve(rounded)?;
        output = output.deliver(run.params, control, None)?;
        let measures = output.measure(control)?.clone();
        let MeshOutput { mesh: mut own, grid, bounds, .. } = output;
        let bounds = bounds.unwrap_or_else(|| own.bounds());
        // `check_size` has ensured that the indices so far fit 32 bits; the caller checks those of this part next.
        let offset = u32::try_from(first).unwrap_or(u32::MAX);
        let shifted = |v: u32| v.wrapping_add(offset);
        own.triangles.par_chunks_mut(ROWS).flatten_iter().for_each(|triangle| *triangle = triangle.map(shifted));
        if let Some(ids) = &mut own.atom_ids {
            // Converts indices among the spheres of the part to indices among all spheres.
            ids.par_chunks_mut(ROWS).flatten_iter().for_each(|id| *id = part.rows[*id as usize]);
        }
        let triangles = self.mesh.n_triangles();
        self.mesh.parts.push(PartRange {
            name: part.name.clone(),
            vertices: first..first + n,
            triangles: triangles..triangles + own.n_triangles(),
            area: measures.area,
            volume: Some(measures.volume),
            bounds,
            placements: 0..0,
        });
        self.mesh.append(own);
        self.measures.push(measures);
        let all = &mut self.grid;
        all.bricks += grid.bricks;
        all.surface_bricks += grid.surface_bricks;
        all.grid_points += grid.grid_points;
        all.box_cells = all.box_cells.saturating_add(grid.box_cells);
        all.candidates += grid.candidates;
        all.overlaps += grid.overlaps;
        Ok(())
    }

    /// Adds a part without a surface.
    fn skip(&mut self, part: &AtomPart) {
        let [vertices, triangles] = [self.mesh.n_vertices(), self.mesh.n_triangles()];
        let name = part.name.clone();
        let (vertices, triangles) = (vertices..vertices, triangles..triangles);
        self.mesh.parts.push(PartRange { name, vertices, triangles, ..PartRange::default() });
    }

    /// Returns the remaining limits for the next part.
    fn left_of(&self, Run { single, limits, .. }: &Run<'_>) -> SurfaceLimits {
        SurfaceLimits {
            max_grid_points: limits.max_grid_points.saturating_sub(self.grid.grid_points),
            max_mesh_bytes: limits.max_mesh_bytes.saturating_sub(self.bytes(single)),
            // One limit applies to both counts.
            max_candidates: limits.max_candidates.saturating_sub(self.grid.candidates.max(self.grid.overlaps)),
        }
    }

    /// Converts the error of one of `n_parts` parts to an error of all parts. `fraction` of the atoms are in this part
    /// and the previous ones.
    fn error(&self, error: SurfaceError, run: &Run<'_>, n_parts: usize, fraction: f64) -> SurfaceError {
        let (limits, resolution) = (run.limits, run.single.resolution);
        let SurfaceError::Limit(exceeded) = &error else { return error };
        // The part exceeds a fixed limit on its own.
        if exceeded.is_fixed {
            return error;
        }
        let in_part = exceeded.actual.unwrap_or_default();
        match exceeded.limit {
            Limit::GridPoints => {
                let so_far = self.grid.grid_points.saturating_add(in_part);
                grid_too_large(so_far, fraction, n_parts, resolution, limits)
            }
            Limit::Candidates => candidates::too_many(self.grid.candidates + in_part, run.spheres, run.single, limits),
            Limit::Overlaps => candidates::too_many_overlaps(self.grid.overlaps + in_part, limits),
            Limit::MeshBytes => {
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "casts saturate")]
                let all = (self.bytes(run.single).saturating_add(in_part) as f64 / fraction) as u64;
                scan::too_large(all, resolution, limits.max_mesh_bytes)
            }
            _ => error,
        }
    }

    /// Returns the size of the mesh so far, as it counts for limits, bytes.
    fn bytes(&self, params: &SurfaceParams) -> u64 {
        params.mesh_bytes(self.mesh.n_vertices() as u64, self.mesh.n_triangles() as u64)
    }

    /// Returns the mesh of all parts.
    fn finish(self, params: &SurfaceParams) -> Result<MeshOutput, SurfaceError> {
        if self.mesh.n_triangles() == 0 {
            return Err(SurfaceError::NoSurface { isovalue: params.level() });
        }
        let measures = Measures::joined(self.measures);
        let parts = self.mesh.parts.iter().filter(|part| !part.vertices.is_empty());
        let bounds = parts.map(|part| part.bounds).reduce(joined_bounds);
        Ok(MeshOutput { measures, bounds, made_by: self.made_by, ..MeshOutput::new(self.mesh, self.grid) })
    }
}
