//! What a backend is: something that turns spheres into a mesh.

use super::control::{Control, Stage};
use super::devices::DeviceStatus;
use super::error::SurfaceError;
use super::measure::{Measures, Proof};
use super::mesh::Mesh;
use super::params::{SurfaceLimits, SurfaceParams};
use super::simd;
use super::sink::{MeshPart, MeshSink, Poured, SinkFailed};
use super::spheres::Spheres;

/// What the grid of a run looked like.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GridStats {
    /// Bricks (8 × 8 × 8 cells) that some sphere's support reaches.
    pub bricks: u64,
    /// Bricks that the surface passes through.
    pub surface_bricks: u64,
    /// Samples at which the density was evaluated, each counted once.
    pub samples: u64,
    /// Cells of the box around the structure, had the grid been dense.
    pub box_cells: u64,
    /// Sphere–brick pairs: the work of the field stage is 512 evaluations for each.
    pub candidates: u64,
}

/// A finished run.
#[derive(Debug, Clone)]
pub struct Meshed {
    /// The mesh.
    pub mesh: Mesh,
    /// Its grid.
    pub grid: GridStats,
    /// Its measures with [`Proof::Checksum`](super::measure::Proof::Checksum), if the backend took them on the way and
    /// the mesh is closed. They are those of the vertices as the mesh has them: what [`Measures::of`] finds is the same up
    /// to the rounding of single precision.
    pub measures: Option<Measures>,
    /// Who made it, where that is known only afterwards: one of several devices, or a stand-in for them.
    pub served: Option<Served>,
}

impl Meshed {
    /// The run of a backend that is one thing, always serves by itself, and did not measure.
    #[must_use]
    pub const fn new(mesh: Mesh, grid: GridStats) -> Self {
        Self { mesh, grid, measures: None, served: None }
    }
}

/// Who made a mesh.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Served {
    /// The name of the backend that did, as [`Backend::name`] gives it.
    pub backend: &'static str,
    /// Its arithmetic, as [`Backend::arithmetic`] gives it.
    pub arithmetic: String,
    /// What it ran on, for people.
    pub device: String,
    /// Why this one stood in for the backend that was asked; none where none had to.
    pub instead: Option<String>,
}

/// Turns spheres into a mesh. The same input gives the same bytes, whatever the thread count.
pub trait Backend: Send + Sync {
    /// Short stable name: `cpu`, `reference`, `gpu`.
    fn name(&self) -> &'static str;

    /// Name of the arithmetic: equal names give equal bytes for equal input. Of several devices, that of the first one
    /// that takes jobs. Part of the keys of results.
    fn arithmetic(&self) -> String {
        format!("{} {}", self.name(), simd::arithmetic())
    }

    /// What it runs on, for people: threads and vector extension, or the adapter's name.
    fn describe(&self) -> String;

    /// Meshes `spheres`.
    ///
    /// # Errors
    /// Any [`SurfaceError`]; limits are checked before memory is allocated for them.
    fn run(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Meshed, SurfaceError>;

    /// Meshes `spheres` into `sink`: the same rows as [`Self::run`] returns, measured with
    /// [`Proof::Checksum`]. A backend that need not hold the whole mesh for that does not.
    ///
    /// # Errors
    /// As [`Self::run`], and [`SurfaceError::Sink`].
    fn pour(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: &dyn MeshSink,
    ) -> Result<Poured, SurfaceError> {
        let Meshed { mut mesh, grid, measures, served } = self.run(spheres, params, limits, control)?;
        // It is handed on in one part.
        mesh.settle();
        let measures = match measures {
            Some(measures) => measures,
            None => control.span(Stage::Measure, || Measures::of(&mesh, Proof::Checksum, control))?,
        };
        pour_whole(&mesh, sink)?;
        let (n_vertices, n_triangles) = (mesh.n_vertices(), mesh.n_triangles());
        Ok(Poured { centre: mesh.centre, n_vertices, n_triangles, bounds: mesh.bounds(), grid, measures, served })
    }

    /// Makes a first, tiny mesh on everything that it runs on: threads are started, code is paged in, and what cannot
    /// work is found out.
    ///
    /// # Errors
    /// Those of [`Backend::run`].
    fn warm(&self) -> Result<(), SurfaceError> {
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        self.run(&one_atom()?, &params, &limits, &Control::default()).map(|_mesh| ())
    }

    /// Whether it can run jobs at all: a device is up, or something stands in for them.
    fn able(&self) -> bool {
        let devices = self.devices();
        devices.is_empty() || devices.iter().any(|device| device.down.is_none())
    }

    /// How the devices behind it are doing; empty where there are none but the processor.
    fn devices(&self) -> Vec<DeviceStatus> {
        Vec::new()
    }
}

/// Hands a finished mesh on as one part.
fn pour_whole(mesh: &Mesh, sink: &dyn MeshSink) -> Result<(), SurfaceError> {
    let failed = |SinkFailed| SurfaceError::Sink;
    sink.begin(mesh.n_vertices(), mesh.n_triangles()).map_err(failed)?;
    let (vertices, triangles) = (mesh.vertices(), &mesh.triangles[..]);
    sink.part(&MeshPart { first_vertex: 0, vertices, first_triangle: 0, triangles }).map_err(failed)
}

/// The smallest structure that has a surface: one carbon.
///
/// # Errors
/// None that could be met: the sphere is a good one.
pub fn one_atom() -> Result<Spheres, SurfaceError> {
    Spheres::new(vec![0.0], vec![0.0], vec![0.0], vec![1.7])
}
