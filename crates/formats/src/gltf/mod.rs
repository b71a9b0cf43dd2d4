//! glTF 2.0: the same document and buffer in two containers, GLB (binary) and `.gltf` (JSON with the buffer as a data
//! URI).
//!
//! Buffers are in Å relative to the mesh's centre. The root node's translation restores the structure file's
//! coordinates, so 32-bit floats keep their precision far from the origin.

mod buffer;
mod compressed;
mod document;
mod glb;
mod json;
mod layout;
mod numbering;
mod pieces;
mod sink;

pub use buffer::linear_of_srgb;
pub use compressed::CompressedGlb;
pub(super) use glb::GlbPlan;
pub(super) use json::GltfPlan;
pub use pieces::Pieces;
pub use sink::{GlbSink, GlbSinkError, RandomAccess};
