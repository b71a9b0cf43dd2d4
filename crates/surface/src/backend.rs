//! The trait of meshing backends, and the result of a run.

use super::control::{Control, Stage};
use super::devices::DeviceStatus;
use super::error::SurfaceError;
use super::measure::{Measures, Validation};
use super::mesh::Mesh;
use super::params::{SurfaceLimits, SurfaceParams};
use super::simd;
use super::sink::{MeshPart, MeshSink, SinkFailed};
use super::spheres::Spheres;

/// Statistics of the grid of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GridStats {
    /// Bricks (8 × 8 × 8 cells) within the support of at least one sphere.
    pub bricks: u64,
    /// Bricks that the surface intersects.
    pub surface_bricks: u64,
    /// Grid points at which the density was evaluated, each counted once.
    pub grid_points: u64,
    /// Cells of the bounding box, as a dense grid would have them.
    pub box_cells: u64,
    /// Sphere–brick pairs; the field stage performs 512 evaluations for each.
    pub candidates: u64,
    /// Ordered pairs of overlapping spheres, counted for solvent-excluded surfaces only.
    pub overlaps: u64,
}

/// Result of a run.
#[derive(Debug, Clone)]
pub struct MeshOutput {
    /// The mesh. Its columns are empty if a sink took them.
    pub mesh: Mesh,
    /// Size and bounds of the mesh if a sink took it.
    pub streamed: Option<StreamedMesh>,
    /// Statistics of the grid.
    pub grid: GridStats,
    /// Measures of the vertices as delivered, validated by [`Validation::Checksum`]; `None` if the backend did not
    /// measure. Always present if a sink took the mesh.
    pub measures: Option<Measures>,
    /// Lowest and highest position of `mesh` relative to its centre, per axis, if the backend knows them, Å.
    pub bounds: Option<[[f32; 3]; 2]>,
    /// The backend that computed the mesh, if it is known only after the run.
    pub made_by: Option<BackendIdentity>,
}

/// Size and bounds of a mesh that was written to a sink.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamedMesh {
    /// Number of vertices.
    pub n_vertices: usize,
    /// Number of triangles.
    pub n_triangles: usize,
    /// Lowest and highest relative position per axis, Å.
    pub bounds: [[f32; 3]; 2],
}

impl MeshOutput {
    /// Result of a backend that keeps the mesh in memory and has not measured it.
    #[must_use]
    pub const fn new(mesh: Mesh, grid: GridStats) -> Self {
        Self { mesh, streamed: None, grid, measures: None, bounds: None, made_by: None }
    }

    /// Number of vertices and triangles, in memory or in a sink.
    #[must_use]
    pub fn size(&self) -> [usize; 2] {
        match &self.streamed {
            Some(streamed) => [streamed.n_vertices, streamed.n_triangles],
            None => [self.mesh.n_vertices(), self.mesh.n_triangles()],
        }
    }

    /// Returns the measures of a mesh in memory. Computes them if the backend has not.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub fn measure(&mut self, control: &Control<'_>) -> Result<&Measures, SurfaceError> {
        match &mut self.measures {
            Some(measures) => Ok(measures),
            none => {
                self.mesh.make_geometry_contiguous();
                let measure = || Measures::of(&self.mesh, Validation::Checksum, control);
                Ok(none.insert(control.span(Stage::Measure, measure)?))
            }
        }
    }

    /// Validates the measures of a mesh in memory. Computes them if the backend has not.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub fn validated(mut self, validation: Validation, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let measures = self.measure(control)?.clone();
        self.measures = Some(measures.validated(validation, &self.mesh.triangles, control)?);
        Ok(self)
    }

    /// Delivers a mesh in memory: rounds its vertices if `params` request quantized ones. If there is a `sink`,
    /// measures the mesh and passes it to the sink in a single part.
    ///
    /// # Errors
    /// [`SurfaceError::Sink`] and [`SurfaceError::Cancelled`].
    pub fn deliver(
        mut self,
        params: &SurfaceParams,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<Self, SurfaceError> {
        if let Some(step) = params.quantize
            && self.mesh.quantize(step)
        {
            // These are the measures before rounding.
            self.measures = None;
            self.bounds = self.bounds.map(|bounds| bounds.map(|row| step.decoded(step.position(row))));
        }
        let Some(sink) = sink else { return Ok(self) };
        self.mesh.make_contiguous();
        self.measure(control)?;
        let (mesh, failed) = (std::mem::take(&mut self.mesh), |SinkFailed| SurfaceError::Sink);
        let [n_vertices, n_triangles] = [mesh.n_vertices(), mesh.n_triangles()];
        sink.begin(n_vertices, n_triangles).map_err(failed)?;
        sink.part(&MeshPart::whole(&mesh)).map_err(failed)?;
        let bounds = self.bounds.unwrap_or_else(|| mesh.bounds());
        self.streamed = Some(StreamedMesh { n_vertices, n_triangles, bounds });
        self.mesh.centre = mesh.centre;
        Ok(self)
    }
}

/// Identity of the backend that computed a mesh.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BackendIdentity {
    /// Its name, as in [`Backend::name`].
    pub backend: &'static str,
    /// Its arithmetic, as in [`Backend::arithmetic`].
    pub arithmetic: String,
    /// The hardware that it ran on, for display.
    pub device: String,
    /// The reason why this backend replaced the requested one; `None` if it did not.
    pub fallback_reason: Option<String>,
}

impl BackendIdentity {
    /// Creates the identity of a backend or renderer that did not replace another one.
    #[must_use]
    pub fn new(backend: &'static str, arithmetic: String, device: String) -> Self {
        Self { backend, arithmetic, device, fallback_reason: None }
    }

    /// Adds the reason for a fallback, if there is one, to the reason for the choice of a backend.
    #[must_use]
    pub fn reason(&self, choice: &str) -> String {
        let fallback = self.fallback_reason.iter().map(|why| format!("; but {why}"));
        std::iter::once(choice.to_owned()).chain(fallback).collect()
    }
}

/// Spheres to mesh, and the receiver of the mesh.
#[derive(Clone, Copy)]
pub struct BackendJob<'a> {
    /// Spheres.
    pub spheres: &'a Spheres,
    /// Parameters of the surface.
    pub params: &'a SurfaceParams,
    /// Limits of the run.
    pub limits: &'a SurfaceLimits,
    /// Cancellation, progress and memory.
    pub control: &'a Control<'a>,
    /// Receiver; `None` to return the mesh.
    pub sink: Option<&'a dyn MeshSink>,
}

/// A meshing backend. The same input gives the same bytes on any number of threads.
pub trait Backend: Send + Sync {
    /// Short stable name: `cpu`, `reference`, `gpu`.
    fn name(&self) -> &'static str;

    /// Name of the arithmetic: equal names give equal bytes for equal input. With several devices, the name of the
    /// first device that accepts jobs. Part of the content keys of results.
    fn arithmetic(&self) -> String {
        format!("{} {}", self.name(), simd::arithmetic())
    }

    /// Arithmetics of all backends and devices that may run a job. A stored result with any of them answers a request.
    fn arithmetics(&self) -> Vec<String> {
        vec![self.arithmetic()]
    }

    /// Description of the hardware for display: threads and vector extension, or the adapter's name.
    fn describe(&self) -> String;

    /// Returns the identity of this backend for the report of a mesh.
    fn identity(&self) -> BackendIdentity {
        BackendIdentity::new(self.name(), self.arithmetic(), self.describe())
    }

    /// Meshes the spheres of `job`, in memory or into its sink. Both get the same rows.
    ///
    /// # Errors
    /// Any [`SurfaceError`]; limits are checked before memory is allocated. [`SurfaceError::Sink`] if the sink fails.
    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError>;

    /// Meshes `spheres` in memory.
    ///
    /// # Errors
    /// As [`Self::write`].
    fn run(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<MeshOutput, SurfaceError> {
        self.write(&BackendJob { spheres, params, limits, control, sink: None })
    }

    /// Returns a backend for one job, whose meshes must come from the same backend: after a fallback, it stays with the
    /// fallback. `None` if this backend has no fallback.
    fn for_job(&self) -> Option<Box<dyn Backend + '_>> {
        None
    }

    /// Returns the backend for jobs that do not suit a GPU; `None` if this backend takes them as well.
    fn cpu(&self) -> Option<&dyn Backend> {
        None
    }

    /// Computes a first, tiny mesh on all threads and devices: starts threads, loads code and detects failures.
    ///
    /// # Errors
    /// As [`Self::write`].
    fn warm_up(&self) -> Result<(), SurfaceError> {
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        self.run(&one_atom()?, &params, &limits, &Control::default()).map(|_mesh| ())
    }

    /// Returns true if jobs can be run: a device or a fallback is available.
    fn is_available(&self) -> bool {
        let devices = self.devices();
        devices.is_empty() || devices.iter().any(|device| device.down.is_none())
    }

    /// Status of the devices; empty for backends that use the processor alone.
    fn devices(&self) -> Vec<DeviceStatus> {
        Vec::new()
    }
}

/// The smallest structure that has a surface: one carbon atom.
///
/// # Errors
/// Never in practice: the sphere is valid.
pub fn one_atom() -> Result<Spheres, SurfaceError> {
    Spheres::new(vec![0.0], vec![0.0], vec![0.0], vec![1.7])
}
