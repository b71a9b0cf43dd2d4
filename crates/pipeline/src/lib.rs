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
mod limits;
mod load;
mod map_file;
mod meshing;
pub mod nearest;
pub mod params;
mod parts;
mod pockets;
mod progress;
mod report;
mod shapes;
mod simplify;
pub mod spacing;
mod steps;
pub mod tileset;
mod work;

use std::ops::Deref;
use std::sync::Arc;

pub use areas::{AreaLevel, AreaRow, ExactReport, Interface, InterfaceReport, MeasuredSelection, SelectionMeasures};
pub use auto::AutoBackend;
pub use cavities::{Cavities, CavityReport, LiningResidue};
pub use clock::{ProgressSink, StageClock, WorkScope};
pub use collapse::{SIMPLIFY_ERRORS, SimplificationReport, Simplify};
pub use color::{AtomColors, ColorError, ColorReport, Coloring, MapReport};
pub use components::{ComponentReport, VoidReport};
pub use draw::draw;
pub use error::JobError;
pub use estimate::{Estimate, MeshEstimate, estimate};
pub use file::{File, Product};
pub use instances::{AssemblyReport, InstancesReport};
pub use limits::JobLimits;
pub use map_file::MapFile;
pub use molmesh_structure::{KindCount, LeftOut, ResidueCount};
pub use parts::PartReport;
pub use pockets::PocketReport;
pub use progress::Tracker;
pub use report::{PictureReport, Quantization, Report, file_arithmetic};
pub use shapes::TriangleReport;
pub use spacing::Spacing;
pub use work::{BYTES_PER_ATOM, estimate_atoms, estimate_work, suits_gpu};

use color::{MeshColors, Scheme};
use cut::Cut;
use estimate::MeshPlan;
use load::{LoadedStructure, SPHERE_BYTES, load};
use meshing::Meshing;
use molmesh_formats::tileset::TileAddress;
use molmesh_formats::{Compress, GlbSink, Normals, Packing, Step, Storage, Units};
use molmesh_picture::{PictureParams, SelectedRenderer};
use molmesh_structure::{AtomPart, Context, Selection, Split, Structure, StructureError};
use molmesh_surface::{
    Backend, BackendJob, Control, FoundDevice, MeshOutput, Pockets, SinkFailed, Spheres, SurfaceError, SurfaceParams,
    TriangleQuality, Validation, lattice,
};
use report::Counts;
use steps::Steps;
use tileset::{AssemblyTileset, Tileset};

/// Parameters of a job: selection, surface, and storage of the mesh.
#[derive(Debug, Clone, Default)]
pub struct Options {
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

impl Options {
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

    /// Returns true if nothing needs the whole mesh in memory. Every field is named, so that a new one is considered.
    fn can_stream(&self) -> bool {
        matches!(
            self,
            Self {
                selection: Selection { context: Context::Selection, instances: false, .. },
                params: SurfaceParams { atom_ids: false, .. },
                split: Split::None,
                cavities: None | Some(Cavities::Keep),
                simplify: None,
                quality: TriangleQuality::Standard,
                spacing: Spacing::Given | Spacing::Detail(_),
                validation: Validation::Checksum,
                compress: Compress::None | Compress::Quantize,
                color: None,
                picture: None,
                tile: _,
                pockets: _,
                normals: _,
                units: _,
                map: _,
                exact: _,
                interface: _,
            }
        )
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

    /// Returns the parameters of the mesh of `spheres`, with the encoding of its vertices. `fitted` is the grid spacing
    /// that a search found, Å.
    fn mesh_params(&self, spheres: &Spheres, fitted: Option<f64>) -> SurfaceParams {
        let mut params = self.params_for(spheres.len());
        params.resolution = fitted.unwrap_or(params.resolution);
        params.quantize = self.quantization(|| lattice::extent(spheres, &params));
        params
    }

    /// Returns the step of quantized vertices that are at most `extent`, Å, away from the centre of their mesh.
    fn quantization(&self, extent: impl FnOnce() -> f64) -> Option<Step> {
        (self.compress != Compress::None).then(|| Step::covering(extent()))
    }

    /// Returns the storage options of a mesh.
    fn storage(&self, quantize: Option<Step>) -> Storage {
        let packing = quantize.map_or(Packing::Full, Packing::Quantized);
        Storage { packing, normals: self.normals, units: self.units }
    }
}

/// Results of a job before its mesh exists.
struct PreparedJob {
    colors: Option<MeshColors>,
    exact: Option<ExactReport>,
    pockets: Option<Pockets>,
    parts: Option<Vec<AtomPart>>,
}

/// Mesh of a job, and its parameters.
struct JobMesh {
    output: MeshOutput,
    params: SurfaceParams,
    /// Number of meshes that a search for the grid spacing computed.
    tries: Option<u32>,
}

/// Chosen backend and the reason for the choice, for reports and logs.
pub struct Choice<'a> {
    /// Backend.
    pub backend: &'a dyn Backend,
    /// Reason for the choice.
    pub reason: &'a str,
}

/// Backend and renderer in use, with the reasons for their choice.
pub struct SelectedBackend {
    /// Backend.
    pub backend: Arc<dyn Backend>,
    /// Reason for its choice.
    pub reason: String,
    /// Renderer of pictures; the CPU if no pictures are needed.
    pub renderer: SelectedRenderer,
    /// All discovered devices, used or not.
    pub devices: Vec<FoundDevice>,
    /// Reason for not using a GPU, if none is used.
    pub no_gpu: Option<String>,
}

impl SelectedBackend {
    /// Returns the backend with the reason for its choice.
    #[must_use]
    pub fn choice(&self) -> Choice<'_> {
        Choice { backend: self.backend.as_ref(), reason: &self.reason }
    }
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
    options: &Options,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    let read = |control: &Control<'_>| molmesh_structure::read_with(bytes, &limits.read, control).map(Box::new);
    run_with(read, options, limits, choice, control, progress, sink)
}

/// Runs a job as [`run`] does, on the structure that `read` returns.
///
/// # Errors
/// Returns the errors of [`run`].
pub fn run_with<S: Deref<Target = Structure>>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    options: &Options,
    limits: &JobLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    options.check(limits)?;
    let clock = StageClock::new(progress);
    let scope = WorkScope::new(&clock, control);
    if options.tile.is_none() {
        let loaded = load(read, options, &limits.read, &scope)?;
        return run_loaded(loaded, options, limits, choice, &scope, sink);
    }
    if options.selection.instances {
        let assembly = AssemblyTileset::new(read, options, &limits.read, &scope)?;
        return assembly.root(options, limits, choice, &scope);
    }
    let tileset = Tileset::new(read, options, &limits.read, &scope)?;
    let colors = options.color.map(|coloring| tileset.colors(coloring, control)).transpose()?;
    tileset.product(options, colors.as_ref(), choice, &limits.surface, &scope)
}

/// Runs a job on selected spheres of a structure.
fn run_loaded<S: Deref<Target = Structure>>(
    loaded: LoadedStructure<S>,
    options: &Options,
    limits: &JobLimits,
    choice: &Choice<'_>,
    scope: &WorkScope<'_>,
    sink: Option<&GlbSink<'_>>,
) -> Result<Product, JobError> {
    let PreparedJob { colors, exact, pockets, parts } = prepare(&loaded, options, limits, scope)?;
    let LoadedStructure { structure, selected, spheres } = loaded;
    let of_pockets = pockets.as_ref().filter(|_| options.split == Split::Pocket);
    let cut = Cut::of(&selected, parts.as_deref(), of_pockets, options.validation, &scope.control)?;
    let job_backend = choice.backend.for_job();
    let choice = Choice { backend: job_backend.as_deref().unwrap_or(choice.backend), ..*choice };
    let meshing = Meshing {
        backend: choice.backend,
        spheres: &spheres,
        parts: parts.as_deref().filter(|_| cut.is_none()),
        cut: cut.as_ref(),
        quality: options.quality,
        limits: &limits.surface,
    };
    let sink = sink.filter(|_| options.can_stream());
    let mut job_mesh = mesh(&meshing, options, scope, sink)?;
    let steps = Steps { options, selected: &selected, pockets: pockets.as_ref(), meshing: &meshing };
    let results = steps.apply(&mut job_mesh, colors, scope)?;
    let JobMesh { output, params, tries } = job_mesh;
    let [n_vertices, n_triangles] = output.size();
    let MeshOutput { mesh, streamed, grid, bounds, made_by, .. } = output;
    let (resolution, centre, storage) = (params.resolution, mesh.centre, options.storage(params.quantize));
    let counts = Counts { resolution, centre, tries, grid, n_vertices, n_triangles, cut: mesh.cut, made_by, storage };
    let times = scope.clock.finish();
    let mut report = Report::new(&structure, &selected, options, &choice, &counts, &results.measures, times);
    (report.color, report.exact, report.simplification, report.triangle_shapes) =
        (results.color, exact, results.simplification, results.shapes);
    report.set_cavities(results.cavities.as_ref(), &structure, &selected);
    report.set_pockets(pockets.as_ref(), &structure, &selected);
    report.models = parts.as_ref().filter(|_| options.split == Split::Model).map(|parts| parts.len() as u64);
    report.instances = InstancesReport::new(&selected.units, &mesh);
    report.parts = PartReport::all(parts.as_deref().unwrap_or_default(), &mesh);
    let mut product = Product { bounds, ..Product::new(mesh, storage, report) };
    product.compress(options, scope)?;
    if let (Some(sink), Some(streamed)) = (sink, streamed) {
        let finish = || sink.finish(&product.meta(), centre, streamed.bounds);
        let bytes = scope.clock.time("encode", finish).map_err(|SinkFailed| SurfaceError::Sink)?;
        product.streamed_bytes = Some(bytes);
        product.report.add_timings(scope.clock);
    }
    Ok(product)
}

/// Does the work that needs no mesh.
fn prepare<S: Deref<Target = Structure>>(
    LoadedStructure { structure, selected, spheres }: &LoadedStructure<S>,
    options: &Options,
    limits: &JobLimits,
    scope: &WorkScope<'_>,
) -> Result<PreparedJob, JobError> {
    let WorkScope { clock, control } = scope;
    let read_map = |file: &MapFile| clock.time("read", || file.read(&limits.map, control));
    let map = options.map.as_ref().map(read_map).transpose()?;
    let colors = |coloring| MeshColors::new(structure, &selected.atoms, coloring, map, control);
    let colors = options.color.map(colors).transpose()?;
    let measure = || areas::measure(structure, selected, spheres, options, &limits.surface, control);
    let exact = options.exact.then(|| clock.time("exact", measure)).transpose()?;
    let pockets = pockets::search(options, spheres, &limits.surface, scope)?;
    let of_pockets = pockets.as_ref().filter(|_| options.split == Split::Pocket);
    let parts = pockets::parts(of_pockets, structure, selected, options.split, &limits.read, control)?;
    Ok(PreparedJob { colors, exact, pockets, parts })
}

/// Meshes the spheres of `meshing`, in memory or into `sink`.
fn mesh(
    meshing: &Meshing<'_>,
    options: &Options,
    scope: &WorkScope<'_>,
    sink: Option<&GlbSink<'_>>,
) -> Result<JobMesh, SurfaceError> {
    if let Spacing::MaxTriangles(limit) = options.spacing {
        return fit::mesh(meshing, options, limit, scope);
    }
    let WorkScope { clock, control } = scope;
    let params = options.mesh_params(meshing.spheres, None);
    let plan = MeshPlan { meshing, params: &params, compress: options.compress };
    let written = if let Some(sink) = sink {
        sink.set_storage(options.storage(params.quantize));
        let Meshing { backend, spheres, limits, .. } = *meshing;
        let job = BackendJob { spheres, params: &params, limits, control, sink: Some(sink) };
        clock.pass(|| backend.write(&job))
    } else {
        let before_simplifying = simplify::params_of_input(options, &params)?;
        estimate::check_memory(&plan, options, control)?;
        clock.pass(|| meshing.mesh(&before_simplifying, control))
    };
    Ok(JobMesh { output: written.map_err(|error| plan.run_error(error, control))?, params, tries: None })
}
