//! Complete run of one job, from a structure file to spheres, mesh and report. Independent of HTTP, paths and queues.

pub mod algorithm_versions;
pub mod areas;
mod auto;
mod cavities;
mod clock;
mod collapse;
pub mod color;
mod components;
mod cut;
mod draw;
mod error;
mod estimate;
mod file;
mod fit;
mod instances;
pub mod integer;
mod job_backend;
mod left_out;
mod limits;
mod load;
mod map_file;
pub mod nearest;
pub mod params;
mod parts;
mod pockets;
mod progress;
mod report;
mod shapes;
mod simplify;
pub mod spacing;
pub mod tileset;
mod work;

use std::ops::Deref;

pub use areas::{AreaLevel, ExactReport, Interface, InterfaceReport, MeasuredSelection, SelectionMeasures};
pub use auto::AutoBackend;
pub use cavities::{Cavities, CavityReport, LiningResidue};
pub use clock::{ProgressSink, StageClock};
pub use collapse::{Deviation, SIMPLIFY_ERRORS, Simplification, Simplify};
pub use color::{AtomColors, ColorError, ColorReport, Coloring, MapReport};
pub use components::{ComponentReport, VoidReport};
pub use draw::draw;
pub use error::JobError;
pub use estimate::{Estimate, MeshEstimate, estimate};
pub use file::{File, Product};
pub use instances::{AssemblyReport, InstancesReport};
pub use left_out::{KindCount, LeftOutReport, ResidueCount};
pub use limits::JobLimits;
pub use map_file::MapFile;
pub use parts::PartReport;
pub use pockets::PocketReport;
pub use progress::Tracker;
pub use report::{PictureReport, Quantization, Report, file_arithmetic};
pub use shapes::TriangleReport;
pub use simplify::SimplificationReport;
pub use spacing::Spacing;
pub use work::{BYTES_PER_ATOM, estimate_atoms, estimate_work, suits_gpu};

use color::{MeshColors, MeshedSurface, Scheme};
use cut::Cut;
use estimate::MeshPlan;
use job_backend::{Division, of_job};
use load::{SPHERE_BYTES, load};
use molmesh_formats::tileset::TileAddress;
use molmesh_formats::{Compress, GlbSink, Normals, Packing, Step, Storage, Units};
use molmesh_picture::PictureParams;
use molmesh_structure::{Context, Selected, Selection, Split, Structure, StructureError};
use molmesh_surface::{
    Backend, Control, Measures, Mesh, MeshOutput, MeshSink, SinkFailed, Spheres, Stage, SurfaceError, SurfaceParams,
    TriangleQuality, Validation, lattice,
};
use report::Counts;
use tileset::{AssemblyTileset, Tileset};

/// Number of atom indices that are converted between two checks for cancellation.
const IDS_PER_CHECK: usize = 1 << 20;

/// Parameters of a job: selection, surface, and storage of the mesh.
#[derive(Debug, Clone, Default)]
pub struct Job {
    /// Selection of atoms.
    pub selection: Selection,
    /// Parameters of the surface. The resolution applies if `spacing` is [`Spacing::Given`].
    pub params: SurfaceParams,
    /// Division of the mesh into parts.
    pub split: Split,
    /// Search for cavities; `None` without it.
    pub cavities: Option<Cavities>,
    /// Radius of the large probe of a search for pockets, Å. Colours and parts that need pockets imply a search.
    pub pockets: Option<f64>,
    /// Simplification of the mesh; `None` to keep all triangles.
    pub simplify: Option<Simplify>,
    /// Quality of the triangles.
    pub quality: TriangleQuality,
    /// Tile to mesh instead of the whole structure.
    pub tile: Option<TileAddress>,
    /// Choice of the grid spacing.
    pub spacing: Spacing,
    /// Method that checks whether the mesh is watertight.
    pub validation: Validation,
    /// Encoding of vertices, in formats that support several.
    pub compress: Compress,
    /// Vertex normals, in formats where they are optional.
    pub normals: Normals,
    /// Units of the file's coordinates.
    pub units: Units,
    /// Colours of the vertices; `None` for a mesh without colours.
    pub color: Option<Coloring>,
    /// Map whose values colour the vertices, for [`Scheme::needs_map`] only.
    pub map: Option<MapFile>,
    /// Parameters of a picture of the mesh; `None` for a mesh file.
    pub picture: Option<PictureParams>,
    /// True if exact areas of the surface are requested.
    pub exact: bool,
    /// Sets of chains whose buried area is requested, with `exact` only.
    pub interface: Option<Interface>,
}

impl Job {
    /// Checks the size of the picture, and that there is a map if and only if the colours need one, before any other
    /// work.
    ///
    /// # Errors
    /// Returns [`JobError::Picture`] if the picture exceeds the limits, and [`JobError::Color`].
    pub fn check(&self, limits: &JobLimits) -> Result<(), JobError> {
        let scheme = self.color.map(|color| color.scheme);
        match (scheme.filter(|scheme| scheme.needs_map()), &self.map) {
            (Some(scheme), None) => return Err(ColorError::without_map(scheme).into()),
            (None, Some(_)) => return Err(ColorError::unused_map(scheme).into()),
            _ => {}
        }
        self.picture.map_or(Ok(()), |picture| picture.check(limits.picture)).map_err(JobError::Picture)
    }

    /// Returns true if the nearest atom of every vertex must be found, for its index or its colour.
    fn needs_atoms(&self) -> bool {
        self.params.atom_ids || self.color.is_some_and(|color| !matches!(color.scheme, Scheme::Vertex(_)))
    }

    /// Returns true if the mesh can be written while it is computed. Atom ids, colours, the exact validation, a limit
    /// on triangles, parts, cuts, instances, removed components, compression, simplification, improved triangles and
    /// pictures need the whole mesh in memory.
    fn can_stream(&self) -> bool {
        !self.params.atom_ids
            && self.color.is_none()
            && self.validation == Validation::Checksum
            && self.spacing.max_triangles().is_none()
            && self.compress != Compress::Meshopt
            && self.simplify.is_none()
            && self.quality == TriangleQuality::Standard
            && self.split == Split::None
            && self.selection.context == Context::Selection
            && !self.selection.instances
            && self.cavities.is_none_or(|cavities| cavities == Cavities::Keep)
            && self.picture.is_none()
    }

    /// Returns the limit on triangles, which applies to the choice of the grid spacing or to the simplification.
    fn max_triangles(&self) -> Option<u64> {
        self.simplify.and_then(|wanted| wanted.max_triangles).or_else(|| self.spacing.max_triangles())
    }

    /// Returns the bytes that colours and atom indices add to a vertex of a GLB.
    fn attribute_bytes(&self) -> u64 {
        4 * u64::from(self.params.atom_ids) + 8 * u64::from(self.color.is_some())
    }

    /// Returns the parameters for a number of atoms. With [`Spacing::MaxTriangles`], the resolution is not final.
    fn params_for(&self, atoms: usize) -> SurfaceParams {
        let resolution = match self.spacing {
            Spacing::Detail(level) => spacing::of_detail(level, atoms as f64),
            Spacing::Given | Spacing::MaxTriangles(_) => self.params.resolution,
        };
        SurfaceParams { resolution, atom_ids: self.needs_atoms(), ..self.params.clone() }
    }
}

/// Chosen backend and the reason for the choice, for reports and logs.
pub struct Choice<'a> {
    /// Backend.
    pub backend: &'a dyn Backend,
    /// Reason for the choice.
    pub reason: &'a str,
}

/// Runs a job: reads `bytes`, selects atoms, meshes them on the chosen backend and measures the mesh. Reports to
/// `progress`, not to the observer of `control`. The memory of the product stays added to the meter of `control`.
///
/// With a `sink`, the mesh is streamed into it as GLB unless the job needs the whole mesh in memory.
/// [`Product::streamed_bytes`] is set then.
///
/// # Errors
/// Returns a [`JobError`]; with [`SurfaceError::Sink`] if `sink` failed.
pub fn run(
    bytes: &[u8],
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    let read = |control: &Control<'_>| molmesh_structure::read_with(bytes, &limits.read, control).map(Box::new);
    run_with(read, job, limits, choice, control, progress, sink)
}

/// Runs a job as [`run`] does, on the structure that `read` returns.
///
/// # Errors
/// Returns the errors of [`run`].
pub fn run_with<S: Deref<Target = Structure>>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    job.check(limits)?;
    if job.tile.is_none() {
        return run_whole(read, job, limits, choice, control, progress, sink);
    }
    let clock = StageClock::new(progress);
    if job.selection.instances {
        let assembly = AssemblyTileset::new(read, job, &limits.read, control, &clock)?;
        return assembly.root(job, limits, choice, control, progress);
    }
    let tileset = Tileset::new(read, job, &limits.read, control, &clock)?;
    let colors = job.color.map(|coloring| tileset.colors(coloring, control)).transpose()?;
    tileset.product((job, colors.as_ref()), choice, &limits.surface, control, clock, progress)
}

/// Runs a job on the whole structure.
fn run_whole<S: Deref<Target = Structure>>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    let clock = StageClock::new(progress);
    let loaded = load(read, job, &limits.read, &clock, &Control { observer: &clock, ..control.clone() })?;
    run_loaded(loaded, job, limits, choice, control, clock, progress, sink)
}

/// Runs a job on selected spheres of a structure.
#[expect(clippy::too_many_arguments, reason = "those of `run_with`, and what was loaded")]
fn run_loaded<S: Deref<Target = Structure>>(
    (structure, selected, spheres): (S, Selected, Spheres),
    job: &Job,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
    clock: StageClock<'_>,
    progress: &dyn ProgressSink,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    let control = Control { observer: &clock, ..control.clone() };
    let read_map = |file: &MapFile| clock.time("read", || file.read(&limits.map, &control));
    let map = job.map.as_ref().map(read_map).transpose()?;
    let prepare = |coloring| MeshColors::new(&structure, &selected.atoms, coloring, map, &control);
    let colors = job.color.map(prepare).transpose()?;
    let measure = || areas::measure(&structure, &selected, &spheres, job, &limits.surface, &control);
    let exact = job.exact.then(|| clock.time("exact", measure)).transpose()?;
    let pockets = pockets::search(job, &spheres, &limits.surface, &clock, &control)?;
    let of_pockets = pockets.as_ref().filter(|_| job.split == Split::Pocket);
    let parts = pockets::parts(of_pockets, &structure, &selected, job.split, &limits.read, &control)?;
    let cut = Cut::of(&selected, parts.as_deref(), of_pockets, job.validation, &control)?;
    let division = Division::of(parts.as_deref(), cut.as_ref());
    let [backend, planner] =
        [job.quality, TriangleQuality::Standard].map(|quality| of_job(choice.backend, division, quality));
    let [choice, planner, whole] = [&*backend, &*planner, choice.backend].map(|backend| Choice { backend, ..*choice });
    let mut params = job.params_for(spheres.len());
    let sink = sink.filter(|_| job.can_stream());
    let (mut output, tries, storage) = if let Spacing::MaxTriangles(limit) = job.spacing {
        let fitted = fit::mesh(&spheres, job, limit, &limits.surface, &choice, &clock, &control)?;
        params.resolution = fitted.resolution;
        let storage = storage(job, &mut params, &spheres);
        (fitted.output, Some(fitted.tries), storage)
    } else {
        let storage = storage(job, &mut params, &spheres);
        if let Some(sink) = sink {
            sink.set_storage(storage);
        }
        let sink = sink.map(|sink| sink as &dyn MeshSink);
        let plan = MeshPlan::new(&spheres, division, &params, job, &limits.surface);
        let planner = plan.choice(&whole, &planner);
        let checked = if sink.is_none() { estimate::check_memory(&plan, job, planner, &control) } else { Ok(()) };
        let meshed = simplify::params_of_input(job, &params)?;
        let write = |()| {
            let written = clock.pass(|| backend.write(&spheres, &meshed, &limits.surface, &control, sink));
            written.map_err(|error| plan.run_error(error, planner, &control))
        };
        (checked.and_then(write)?, None, storage)
    };
    let search = |mode| {
        clock.time("cavities", || cavities::search(mode, &spheres, &params, &limits.surface, &mut output, &control))
    };
    let cavities = job.cavities.map(search).transpose()?;
    let simplification = simplify::apply(job, &params, &mut output, &clock, &control)?;
    let [n_vertices, n_triangles] = output.size();
    let MeshOutput { mut mesh, streamed, grid, measures, bounds, made_by } = output;
    let color = |colors: MeshColors| {
        let parts = division.and_then(Division::parts);
        let surface = MeshedSurface { spheres: &spheres, params: &params, limits: &limits.surface, parts };
        clock.time("color", || colors.apply(&mut mesh, &surface, pockets.as_ref(), &control))
    };
    let color = colors.map(color).transpose()?;
    to_atom_indices(&mut mesh, job, &selected, &control)?;
    instances::place(&mut mesh, &selected.units, &control)?;
    let measures = match measures {
        // The cut has validated the surface before it divided it.
        Some(measures) if cut.is_some() || measures.validation == job.validation => measures,
        found => clock.time(Stage::Measure.name(), || measures_of(&mut mesh, found, job.validation, &control))?,
    };
    let shapes = TriangleReport::of_job(job, &mesh, &clock);
    let (resolution, centre) = (params.resolution, mesh.centre);
    let counts = Counts { resolution, centre, tries, grid, n_vertices, n_triangles, cut: mesh.cut, made_by, storage };
    // The report takes the times of the clock, which observes nothing later.
    let control = Control { observer: &(), ..control };
    let mut report = Report::new(&structure, &selected, job, &choice, &counts, &measures, clock.finish());
    (report.color, report.exact, report.simplification, report.triangle_shapes) =
        (color, exact, simplification, shapes);
    report.set_cavities(cavities.as_ref(), &structure, &selected);
    report.set_pockets(pockets.as_ref(), &structure, &selected);
    report.models = parts.as_ref().filter(|_| job.split == Split::Model).map(|parts| parts.len() as u64);
    report.instances = InstancesReport::new(&selected.units, &mesh);
    report.parts = PartReport::all(parts.as_deref().unwrap_or_default(), &mesh);
    let mut product = Product { bounds, ..Product::new(mesh, storage, report) };
    product.compress(job, &control, progress)?;
    if let (Some(sink), Some(streamed)) = (sink, streamed) {
        let clock = StageClock::new(progress);
        let finish = || sink.finish(&product.meta(), centre, streamed.bounds);
        let bytes = clock.time("encode", finish).map_err(|SinkFailed| SurfaceError::Sink)?;
        product.streamed_bytes = Some(bytes);
        product.report.add_timings(clock);
    }
    Ok(product)
}

/// Measures and validates a mesh, or only validates it if its measures are `found`.
fn measures_of(
    mesh: &mut Mesh,
    found: Option<Measures>,
    validation: Validation,
    control: &Control<'_>,
) -> Result<Measures, SurfaceError> {
    mesh.make_geometry_contiguous();
    match found {
        Some(measures) => measures.validated(validation, &mesh.triangles, control),
        None => Measures::of(mesh, validation, control),
    }
}

/// Converts indices of spheres to indices of atoms in the file, or drops them if the job does not ask for them.
fn to_atom_indices(mesh: &mut Mesh, job: &Job, selected: &Selected, control: &Control<'_>) -> Result<(), JobError> {
    if !job.params.atom_ids {
        mesh.atom_ids = None;
    }
    for (n, id) in mesh.atom_ids.iter_mut().flat_map(|ids| ids.iter_mut()).enumerate() {
        if n.is_multiple_of(IDS_PER_CHECK) {
            control.check()?;
        }
        *id = selected.atoms[*id as usize];
    }
    Ok(())
}

/// Returns the storage options of the mesh of `spheres`, and sets the vertex encoding in `params`.
fn storage(job: &Job, params: &mut SurfaceParams, spheres: &Spheres) -> Storage {
    params.quantize = match job.compress {
        Compress::None => None,
        Compress::Quantize | Compress::Meshopt => Some(Step::covering(lattice::extent(spheres, params))),
    };
    let packing = params.quantize.map_or(Packing::Full, Packing::Quantized);
    Storage { packing, normals: job.normals, units: job.units }
}
