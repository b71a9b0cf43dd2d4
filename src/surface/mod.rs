//! Meshing core: computes a closed triangle mesh from spheres and parameters.
//!
//! The core does not depend on files, clocks, async, serialization, GPUs or molecules. Lengths are ångström (Å), areas
//! Å², volumes Å³. Density grows inwards; a grid point is inside if its density is at least the isovalue; triangles
//! wind counter-clockwise seen from outside and normals point outwards.

pub mod backend;
pub(crate) mod candidates;
pub mod cases;
pub(crate) mod cavities;
pub(crate) mod checked_sort;
pub(crate) mod clip;
pub mod column;
pub mod control;
pub mod cpu;
pub(crate) mod curvature;
pub mod devices;
pub mod error;
pub(crate) mod grid_limit;
pub(crate) mod improve;
pub(crate) mod join;
pub mod kernel;
pub mod kind;
pub mod lattice;
pub mod measure;
pub mod memory;
pub mod mesh;
pub mod occupancy;
pub mod params;
pub(crate) mod pockets;
pub mod quantize;
pub mod reference;
mod simd;
pub(crate) mod simplify;
pub mod sink;
pub(crate) mod sphere_union;
pub mod spheres;
mod sums;
pub(crate) mod threads;
pub mod topology;
mod triangle;
mod triangle_grid;
mod union_find;

pub use backend::{Backend, BackendIdentity, GridStats, MeshOutput, StreamedMesh};
pub use cavities::Cavity;
pub use column::{Column, SharedBytes};
pub use control::{CancelToken, Control, Observer, Stage};
pub use cpu::CpuBackend;
pub use devices::{DeviceChoice, DeviceFacts, DeviceKind, DeviceName, DeviceStatus, FoundDevice};
pub use error::SurfaceError;
pub use improve::{TriangleQuality, TriangleShapes};
pub use measure::{Component, Measures, Validation};
pub use memory::{MemoryMeter, OutOfMemory, Reservation};
pub use mesh::{Mesh, PartRange, Placements, Quantized};
pub use params::{Kernel, PaperParams, Preset, SurfaceKind, SurfaceLimits, SurfaceOptions, SurfaceParams};
pub use pockets::{DEFAULT_POCKET_PROBE, POCKET_PROBES, Pocket, Pockets};
pub use quantize::Step;
pub use reference::ReferenceBackend;
pub use simd::arithmetic;
pub use simplify::{Deviation, SIMPLIFY_ERRORS, Simplification, Simplify};
pub use sink::{MeshPart, MeshSink, SinkFailed, Vertices};
pub use sphere_union::{AreaParts, ExactMeasures};
pub use spheres::Spheres;
