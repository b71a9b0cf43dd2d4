//! glTF 2.0: the same document and the same buffer in two wrappings, GLB (binary) and `.gltf` (JSON with the
//! buffer as a data URI).
//!
//! Buffers are in Å relative to the mesh's centre; the root node's translation gives the structure file's own
//! coordinates back, so 32-bit floats keep their digits far from the origin.

mod buffer;
mod document;
mod glb;
mod json;
mod layout;
mod sink;

pub(super) use glb::GlbPlan;
pub(super) use json::GltfPlan;
pub use sink::{GlbSink, GlbSinkError, RandomAccess};
