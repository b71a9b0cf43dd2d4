//! One job from end to end: structure bytes to spheres to mesh to report. No HTTP, no paths, no queue.

mod clock;
pub mod nearest;
pub mod params;
mod report;

use std::time::Instant;

use thiserror::Error;

pub use clock::{ProgressSink, StageClock};
pub use report::Report;

use crate::formats::Meta;
use crate::structure::{self, ReadLimits, Selection, StructureError};
use crate::surface::{
    Backend, CancelToken, Control, Measures, Mesh, Proof, Stage, SurfaceError, SurfaceLimits, SurfaceParams,
};

/// Everything that decides what a mesh looks like.
#[derive(Debug, Clone, Default)]
pub struct Job {
    /// Which atoms.
    pub selection: Selection,
    /// Which surface.
    pub params: SurfaceParams,
    /// How the mesh is proven closed and manifold.
    pub proof: Proof,
}

/// Limits of one job.
#[derive(Debug, Clone, Copy, Default)]
pub struct JobLimits {
    /// Limits of reading.
    pub read: ReadLimits,
    /// Limits of meshing.
    pub surface: SurfaceLimits,
    /// When the mesh must be there; none: whenever.
    pub deadline: Option<Instant>,
}

/// A backend and the reason why it was taken, for reports and logs.
pub struct Choice<'a> {
    /// The backend.
    pub backend: &'a dyn Backend,
    /// Why it was taken, in words.
    pub reason: &'a str,
}

/// A finished job.
#[derive(Debug, Clone)]
pub struct Product {
    /// The mesh.
    pub mesh: Mesh,
    /// What was measured.
    pub report: Report,
}

impl Product {
    /// What a mesh file says about this product.
    #[must_use]
    pub fn meta(&self) -> Meta {
        Meta { name: self.report.id.clone(), extras: self.report.extras() }
    }
}

/// Why a job failed.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum JobError {
    /// Reading or selecting failed.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// Meshing failed.
    #[error(transparent)]
    Surface(#[from] SurfaceError),
}

/// Runs a job: reads `bytes`, selects atoms, meshes them on the chosen backend and measures the mesh.
///
/// # Errors
/// Any [`JobError`].
pub fn run(
    bytes: &[u8],
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    cancel: &CancelToken,
    sink: &dyn ProgressSink,
) -> Result<Product, JobError> {
    let clock = StageClock::new(sink);
    let structure = clock.time("read", || structure::read(bytes, &limits.read))?;
    let (selected, spheres) = clock.time("select", || -> Result<_, JobError> {
        let selected = structure::select(&structure, &job.selection)?;
        let spheres = selected.spheres(&structure)?;
        Ok((selected, spheres))
    })?;
    let control = Control { cancel: cancel.clone(), deadline: limits.deadline, observer: &clock };
    let mut meshed = clock.pass(|| choice.backend.run(&spheres, &job.params, &limits.surface, &control))?;
    if let Some(ids) = &mut meshed.mesh.atom_ids {
        // The core speaks of spheres; people ask for atoms of the file.
        ids.iter_mut().for_each(|id| *id = selected.atoms[*id as usize]);
    }
    let measures = clock.time(Stage::Measure.name(), || Measures::of(&meshed.mesh, job.proof, &control))?;
    let report = Report::new(&structure, &selected, job, choice, &meshed, &measures, clock.finish());
    Ok(Product { mesh: meshed.mesh, report })
}
