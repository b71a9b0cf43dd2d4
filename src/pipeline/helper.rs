//! Helper of a job: computes partitions of its mesh, which another process joins.

use std::ops::Deref;

use super::report::Counts;
use super::{Choice, Job, JobError, JobLimits, Product, Report, StageClock, storage};
use crate::structure::{Selected, Structure};
use crate::surface::{Backend as _, Control, CpuBackend, GridStats, Measures, Mesh, Spheres};

/// Returns true if a job meshes one surface with a spacing that does not depend on the mesh, so that its mesh can be
/// divided into partitions.
#[cfg(feature = "server")]
pub(crate) fn is_divisible(job: &Job) -> bool {
    use crate::structure::{Context, Split};

    job.split == Split::None
        && job.selection.context == Context::Selection
        && !job.selection.instances
        && job.tile.is_none()
        && job.helper.is_none()
        && job.spacing.max_triangles().is_none()
        && job.map.is_none()
        && job.picture.is_none()
}

/// Computes partitions on the CPU until none is left. The mesh of the product is empty.
pub(super) fn run<S: Deref<Target = Structure>>(
    (structure, selected, spheres): (S, Selected, Spheres),
    job: &Job,
    limits: &JobLimits,
    reason: &str,
    control: &Control<'_>,
    clock: StageClock<'_>,
) -> Result<Product, JobError> {
    let backend = CpuBackend::default();
    let control = Control { observer: &clock, ..control.clone() };
    let mut params = job.params_for(spheres.len());
    let storage = storage(job, &mut params, &spheres);
    clock.pass(|| backend.help(&spheres, &params, &limits.surface, &control))?;
    let mesh = Mesh::default();
    let measures = Measures::of_part(&mesh, 0, &control)?;
    let counts = Counts {
        resolution: params.resolution,
        centre: mesh.centre,
        tries: None,
        grid: GridStats::default(),
        n_vertices: 0,
        n_triangles: 0,
        cut: true,
        made_by: Some(backend.identity()),
        storage,
    };
    let choice = Choice { backend: &backend, reason };
    // The report takes the times of the clock.
    drop(control);
    let report = Report::new(&structure, &selected, job, &choice, &counts, &measures, clock.finish());
    Ok(Product::new(mesh, storage, report))
}
