//! Why a mesh cannot be written. Every refusal comes before the first byte.

use std::io;

use thiserror::Error;

/// The mesh is broken, or the format cannot hold it.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum FormatError {
    /// A column of the mesh is not as long as its positions.
    #[error("the mesh has {vertices} positions but {len} {column}")]
    ColumnLength {
        /// `normals`, `atom_ids` or `colors`.
        column: &'static str,
        /// Its length.
        len: u64,
        /// Number of positions.
        vertices: u64,
    },
    /// A triangle names a vertex that does not exist.
    #[error("triangle {triangle} names vertex {index}, but the mesh has {vertices} vertices")]
    IndexOutOfRange {
        /// The triangle, from 0.
        triangle: u64,
        /// The vertex that it names.
        index: u32,
        /// Number of vertices.
        vertices: u64,
    },
    /// A number that is infinite or none.
    #[error("{column} {row} holds {value}; only finite numbers can be written")]
    NotFinite {
        /// `position`, `normal` or `centre`.
        column: &'static str,
        /// The row, from 0; for the centre the axis.
        row: u64,
        /// The number.
        value: f64,
    },
    /// A normal that is far too long.
    #[error("a normal has a component of {value}; normals have length 1")]
    NotUnit {
        /// The component.
        value: f32,
    },
    /// More vertices or triangles than the format can count.
    #[error("{format} counts {limit} {what} at most, the mesh has {count}")]
    TooMany {
        /// The format's name.
        format: &'static str,
        /// `vertices` or `triangles`.
        what: &'static str,
        /// How many there are.
        count: u64,
        /// How many the format can hold.
        limit: u64,
    },
    /// The length of a GLB is 32 bits wide.
    #[error("the GLB would take {bytes} bytes, the format's limit is {limit}; use a coarser resolution or PLY")]
    GlbTooLarge {
        /// Bytes that it would take.
        bytes: u64,
        /// Bytes that a GLB can hold.
        limit: u64,
    },
    /// glTF attributes are 16-bit integers or 32-bit floats: larger atom indices would be rounded.
    #[error("atom index {atom} cannot be held exactly by a glTF attribute, the limit is {limit}; use PLY")]
    AtomIndexTooLarge {
        /// The largest atom index of the mesh.
        atom: u32,
        /// The largest that is exact.
        limit: u32,
    },
    /// A coordinate with more digits before the point than OBJ lines have room for.
    #[error("a coordinate of {value} cannot be written to OBJ, the limit is ±{limit}")]
    CoordinateTooLarge {
        /// The coordinate, in the file's units.
        value: f64,
        /// The limit, in the file's units.
        limit: f64,
    },
    /// A position that no 16-bit multiple of the step is near.
    #[error("a vertex lies beyond {reach} Å from the mesh's centre, the largest coordinate with a step of {step} Å")]
    BeyondStep {
        /// The largest coordinate that can be stored, Å.
        reach: f32,
        /// The step, Å.
        step: f32,
    },
    /// Only glTF and GLB hold quantised vertices.
    #[error("{format} cannot hold quantised vertices, glb and gltf can")]
    NotQuantized {
        /// The format's name.
        format: &'static str,
    },
    /// Only glTF and GLB hold coordinates that small.
    #[error("{format} cannot hold coordinates in {units}, glb and gltf can")]
    NotInUnits {
        /// The format's name.
        format: &'static str,
        /// The units' name.
        units: &'static str,
    },
    /// Pictures are drawn, not written.
    #[error("{format} is a picture of a mesh, and holds none")]
    NotAMesh {
        /// The format's name.
        format: &'static str,
    },
    /// Vertices that were rounded before are not rounded again, nor are they made longer than they are.
    #[error("the mesh's vertices are quantised in steps of {step} Å, and can be stored in no other way")]
    OtherPacking {
        /// The mesh's step, Å.
        step: f32,
    },
    /// The JSON part of a glTF could not be made.
    #[error("the glTF document cannot be written as JSON: {reason}")]
    Json {
        /// The serialiser's words.
        reason: String,
    },
}

impl From<FormatError> for io::Error {
    fn from(error: FormatError) -> Self {
        Self::new(io::ErrorKind::InvalidInput, error)
    }
}
