//! Meshing core: computes a closed triangle mesh from spheres and parameters.
//!
//! The core does not depend on files, clocks, async, serialization, GPUs or molecules. Lengths are ångström (Å), areas
//! Å², volumes Å³. Density grows inwards; a grid point is inside if its density is at least the isovalue; triangles
//! wind counter-clockwise seen from outside and normals point outwards.
//!
//! The items that the crate re-exports are its interface. Other modules serve the crates of the workspace.

pub mod backend;
pub mod candidates;
pub mod cases;
pub mod cavities;
pub mod checked_sort;
pub mod clip;
mod column;
mod control;
pub mod cpu;
pub mod curvature;
pub mod devices;
mod error;
pub mod grid_limit;
pub mod groups;
pub mod improve;
pub mod join;
pub mod kernel;
mod kind;
pub mod lattice;
pub mod limit;
mod measure;
mod memory;
pub mod mesh;
pub mod occupancy;
pub mod params;
pub mod pockets;
pub mod quantize;
pub mod reference;
mod simd;
mod sink;
pub mod sphere_union;
pub mod spheres;
mod sums;
pub mod threads;
mod topology;
pub mod triangle;
pub mod triangle_grid;
pub mod union_find;
pub mod vector;

pub use backend::{Backend, BackendIdentity, BackendJob, GridStats, MeshOutput, StreamedMesh};
pub use cavities::Cavity;
pub use column::{Column, SharedBytes};
pub use control::{CancelOnDrop, CancelToken, Control, Observer, Stage};
pub use cpu::CpuBackend;
pub use devices::{DeviceChoice, DeviceFacts, DeviceKind, DeviceName, DeviceStatus, FoundDevice};
pub use error::SurfaceError;
pub use improve::{TriangleQuality, TriangleShapes};
pub use limit::{Exceeded, Limit};
pub use measure::{Component, Measures, Validation};
pub use memory::{MemoryMeter, OutOfMemory, Reservation};
pub use mesh::{Mesh, PartRange, Placements, Quantized};
pub use params::{Kernel, PaperParams, Preset, SurfaceKind, SurfaceLimits, SurfaceOptions, SurfaceParams};
pub use pockets::{DEFAULT_POCKET_PROBE, POCKET_PROBES, Pocket, Pockets};
pub use quantize::Step;
pub use reference::ReferenceBackend;
pub use simd::arithmetic;
pub use sink::{MeshPart, MeshSink, SinkFailed, Vertices};
pub use sphere_union::{AreaParts, ExactMeasures};
pub use spheres::Spheres;
