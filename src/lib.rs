//! Watertight molecular-surface meshes from PDB, mmCIF, BinaryCIF, PQR and XYZ files.
//!
//! [`mesh()`] converts the bytes of a structure file to a triangle mesh:
//!
//! ```
//! let bytes = std::fs::read("samples/4pti.pdb")?;
//! let mesh = molmesh::mesh(&bytes, &molmesh::Options::default())?;
//! println!("{} vertices, {} triangles", mesh.n_vertices(), mesh.n_triangles());
//! # assert!(mesh.n_triangles() > 10_000);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`Options`] selects atoms and the surface; [`formats::Encoder`] writes the mesh as GLB, glTF, PLY, STL or OBJ, and
//! [`pipeline::run`] also returns a report with area, volume and components. The folder `examples` has programs for
//! these tasks: `select.rs`, `mesh.rs` and `report.rs`.
//!
//! [`surface`] is the meshing core, which converts spheres to a mesh. [`structure`] reads files, [`formats`] encodes
//! meshes, [`picture`] renders them, and [`pipeline`] runs one job from bytes to report. The feature `gpu` adds the GPU
//! backend. All lengths are ångström. `ARCHITECTURE.md` describes the folders.

pub mod access;
pub mod archive;
mod client_shares;
pub mod config;
#[doc(hidden)]
pub mod fuzzing;
pub mod http;
mod jobs;
pub mod memory_budget;
pub mod readers;
mod single_flight;
pub mod store;
pub mod telemetry;
mod tls;

pub use molmesh_formats as formats;
#[cfg(feature = "gpu")]
pub use molmesh_gpu as gpu;
pub use molmesh_picture as picture;
pub use molmesh_pipeline as pipeline;
pub use molmesh_structure as structure;
pub use molmesh_surface as surface;
use molmesh_sync as sync;
pub use pipeline::{JobError as Error, Options};
pub use surface::Mesh;

/// Meshes a structure file on the CPU.
///
/// `bytes` is a PDB, mmCIF, BinaryCIF, PQR or XYZ file, plain or compressed with gzip or zstd. Positions of the mesh
/// are in Å and relative to [`Mesh::centre`].
///
/// # Errors
/// Returns an [`Error`] if the file cannot be read, the selection is empty, a limit is exceeded, or the density never
/// reaches the isovalue.
pub fn mesh(bytes: &[u8], options: &Options) -> Result<Mesh, Error> {
    let choice = pipeline::Choice { backend: &surface::CpuBackend::default(), reason: "library" };
    let (limits, control) = (pipeline::JobLimits::default(), surface::Control::default());
    // A compressed mesh has no columns.
    let quantized = Options { compress: formats::Compress::Quantize, ..options.clone() };
    let options = if options.compress == formats::Compress::Meshopt { &quantized } else { options };
    let mut product = pipeline::run(bytes, options, &limits, &choice, &control, &(), None)?;
    product.mesh.make_contiguous();
    Ok(product.mesh)
}
