//! One job from end to end: structure bytes to spheres to mesh to report. No HTTP, no paths, no queue.

mod clock;
mod draw;
mod estimate;
mod file;
mod fit;
pub mod nearest;
pub mod params;
mod progress;
mod report;
pub mod spacing;
mod work;

use std::time::Instant;

use thiserror::Error;

pub use clock::{ProgressSink, StageClock};
pub use draw::draw;
pub use estimate::{Estimate, MeshEstimate, estimate};
pub use file::File;
pub use progress::Tracker;
pub use report::{
    ComponentReport, LeftOutReport, PictureReport, Quantization, Report, ResidueCount, VoidReport, maker,
};
pub use spacing::Spacing;
pub use work::work;

use crate::formats::{Compress, GlbSink, Meta, Normals, Packing, Step, Storage, Units};
use crate::picture::{PictureError, PictureLimits, PictureParams};
use crate::structure::{self, ReadLimits, Selected, Selection, Structure, StructureError};
use crate::surface::{
    Backend, CancelToken, Control, Measures, Mesh, Meshed, Proof, Spheres, Stage, SurfaceError, SurfaceLimits,
    SurfaceParams, lattice,
};
use report::Counts;

/// Everything that decides what a mesh looks like, and how its vertices are stored.
#[derive(Debug, Clone, Default)]
pub struct Job {
    /// Which atoms.
    pub selection: Selection,
    /// Which surface. Its resolution stands where `spacing` is [`Spacing::Given`].
    pub params: SurfaceParams,
    /// How the resolution is chosen.
    pub spacing: Spacing,
    /// How the mesh is proven closed and manifold.
    pub proof: Proof,
    /// How vertices are stored, in formats that have a choice.
    pub compress: Compress,
    /// Whether vertices have normals, in formats that have a choice.
    pub normals: Normals,
    /// The units of a file's coordinates.
    pub units: Units,
    /// What a picture of the mesh is to look like; none: the mesh itself is wanted.
    pub picture: Option<PictureParams>,
}

impl Job {
    /// Fails where its picture would be larger than allowed: before anything else is done for it.
    ///
    /// # Errors
    /// [`JobError::Picture`].
    pub fn check(&self, limits: &JobLimits) -> Result<(), JobError> {
        self.picture.map_or(Ok(()), |picture| picture.check(limits.picture)).map_err(JobError::Picture)
    }

    /// The parameters for so many atoms, where the resolution does not hang on the mesh.
    fn params_for(&self, atoms: usize) -> SurfaceParams {
        let resolution = match self.spacing {
            Spacing::Detail(level) => spacing::of_detail(level, atoms as f64),
            Spacing::Given | Spacing::MaxTriangles(_) => self.params.resolution,
        };
        SurfaceParams { resolution, ..self.params.clone() }
    }
}

/// Limits of one job.
#[derive(Debug, Clone, Copy, Default)]
pub struct JobLimits {
    /// Limits of reading.
    pub read: ReadLimits,
    /// Limits of meshing.
    pub surface: SurfaceLimits,
    /// Limits of drawing.
    pub picture: PictureLimits,
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
    /// How a file stores it.
    pub storage: Storage,
    /// What was measured.
    pub report: Report,
    /// The PNG, once it was drawn: then the mesh is gone.
    pub picture: Option<Vec<u8>>,
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
    /// Drawing failed.
    #[error(transparent)]
    Picture(PictureError),
}

impl From<PictureError> for JobError {
    fn from(error: PictureError) -> Self {
        match error {
            // Whoever stops a job asks for one kind of end.
            PictureError::Cancelled => Self::Surface(SurfaceError::Cancelled),
            PictureError::Device { why } => Self::Surface(SurfaceError::Device { why }),
            error => Self::Picture(error),
        }
    }
}

/// A job whose mesh went into a sink.
#[derive(Debug, Clone)]
pub struct Poured {
    /// What was measured.
    pub report: Report,
    /// What to add to a position to get the structure file's own coordinates, Å.
    pub centre: [f64; 3],
    /// Lowest and highest relative position per axis, Å.
    pub bounds: [[f32; 3]; 2],
}

impl Poured {
    /// What a mesh file says about this job.
    #[must_use]
    pub fn meta(&self) -> Meta {
        Meta { name: self.report.id.clone(), extras: self.report.extras() }
    }
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
    progress: &dyn ProgressSink,
) -> Result<Product, JobError> {
    job.check(limits)?;
    let clock = StageClock::new(progress);
    let (structure, selected, spheres) = read(bytes, job, limits, &clock)?;
    let control = Control { cancel: cancel.clone(), deadline: limits.deadline, observer: &clock };
    let mut params = job.params_for(spheres.len());
    let (mut meshed, tries, storage) = if let Spacing::MaxTriangles(most) = job.spacing {
        let fitted = fit::mesh(&spheres, job, most, &limits.surface, choice, &clock, &control)?;
        params.resolution = fitted.resolution;
        (fitted.meshed, Some(fitted.tries), storage(job, &mut params, &spheres))
    } else {
        let storage = storage(job, &mut params, &spheres);
        (clock.pass(|| choice.backend.run(&spheres, &params, &limits.surface, &control))?, None, storage)
    };
    // What a backend that does not round has measured is not what is handed on.
    if let Some(step) = params.quantize
        && meshed.mesh.quantize(step)
    {
        meshed.measures = None;
    }
    if let Some(ids) = &mut meshed.mesh.atom_ids {
        // The core speaks of spheres; people ask for atoms of the file.
        ids.iter_mut().for_each(|id| *id = selected.atoms[*id as usize]);
    }
    let measures = match meshed.measures.take().filter(|taken| taken.proof == job.proof) {
        Some(taken) => taken,
        None => clock.time(Stage::Measure.name(), || {
            // Triangles ask for positions anywhere; normals stay where several devices put them.
            meshed.mesh.settle_geometry();
            Measures::of(&meshed.mesh, job.proof, &control)
        })?,
    };
    let Meshed { mesh, grid, served, .. } = meshed;
    let (n_vertices, n_triangles) = (mesh.n_vertices(), mesh.n_triangles());
    let (resolution, centre) = (params.resolution, mesh.centre);
    let counts = Counts { resolution, centre, tries, grid, n_vertices, n_triangles, served, storage };
    let report = Report::new(&structure, &selected, job, choice, &counts, &measures, clock.finish());
    Ok(Product { mesh, storage, report, picture: None })
}

/// Whether [`pour`] can run a job: atoms by vertex and the exact proof need the whole mesh, and a bound on triangles meshes that
/// are not kept.
#[must_use]
pub fn can_pour(job: &Job) -> bool {
    !job.params.atom_ids && job.proof == Proof::Checksum && job.spacing.max_triangles().is_none()
}

/// Runs a job that [`can_pour`], handing the mesh on to `sink` part by part, packed as the job asks: the same mesh and report
/// as [`run`] gives, but the mesh is never held as a whole.
///
/// # Errors
/// Any [`JobError`]; [`SurfaceError::Sink`] if `sink` failed.
pub fn pour(
    bytes: &[u8],
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    cancel: &CancelToken,
    progress: &dyn ProgressSink,
    sink: &GlbSink<'_>,
) -> Result<Poured, JobError> {
    let clock = StageClock::new(progress);
    let (structure, selected, spheres) = read(bytes, job, limits, &clock)?;
    let control = Control { cancel: cancel.clone(), deadline: limits.deadline, observer: &clock };
    let mut params = job.params_for(spheres.len());
    let storage = storage(job, &mut params, &spheres);
    sink.store(storage);
    let poured = clock.pass(|| choice.backend.pour(&spheres, &params, &limits.surface, &control, sink))?;
    let counts = Counts {
        resolution: params.resolution,
        centre: poured.centre,
        tries: None,
        grid: poured.grid,
        n_vertices: poured.n_vertices,
        n_triangles: poured.n_triangles,
        served: poured.served,
        storage,
    };
    let report = Report::new(&structure, &selected, job, choice, &counts, &poured.measures, clock.finish());
    Ok(Poured { report, centre: poured.centre, bounds: poured.bounds })
}

/// How the mesh of `spheres` is stored; `params` ask the backend for vertices of that kind then. Depends on nothing that the
/// backend computes: a file can be written, and a device can fill it, before the mesh is known.
fn storage(job: &Job, params: &mut SurfaceParams, spheres: &Spheres) -> Storage {
    params.quantize = match job.compress {
        Compress::None => None,
        Compress::Quantize => Some(Step::covering(lattice::extent(spheres, params))),
    };
    let packing = params.quantize.map_or(Packing::Full, Packing::Quantized);
    Storage { packing, normals: job.normals, units: job.units }
}

/// Bytes to spheres.
fn read(
    bytes: &[u8],
    job: &Job,
    limits: &JobLimits,
    clock: &StageClock<'_>,
) -> Result<(Structure, Selected, Spheres), JobError> {
    let structure = clock.time("read", || structure::read(bytes, &limits.read))?;
    let (selected, spheres) = clock.time("select", || -> Result<_, JobError> {
        let selected = structure::select(&structure, &job.selection)?;
        let spheres = selected.spheres(&structure)?;
        Ok((selected, spheres))
    })?;
    Ok((structure, selected, spheres))
}
