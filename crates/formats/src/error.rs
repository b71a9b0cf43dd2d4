//! Errors of writing a mesh. All are returned before the first byte is written.

use molmesh_surface::Exceeded;
use thiserror::Error;

/// Error of a mesh that is invalid or that the format cannot hold.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum FormatError {
    /// A column of the mesh and its positions differ in length.
    #[error("the mesh has {vertices} positions but {len} {column}")]
    ColumnLength {
        /// `normals`, `atom_ids` or `colors`.
        column: &'static str,
        /// Length of the column.
        len: u64,
        /// Number of positions.
        vertices: u64,
    },
    /// A triangle has the index of a vertex that does not exist.
    #[error("triangle {triangle} refers to vertex {index}, but the mesh has {vertices} vertices")]
    IndexOutOfRange {
        /// Number of the triangle, from 0.
        triangle: u64,
        /// Index of the vertex.
        index: u32,
        /// Number of vertices.
        vertices: u64,
    },
    /// The rows of a part are not next to those of the previous part, or its triangles refer to vertices of other
    /// parts.
    #[error(
        "part `{part}` is not a mesh of its own: its rows must follow those of the previous part, and its triangles \
         must refer to its own vertices only"
    )]
    BadPart {
        /// Name of the part.
        part: String,
    },
    /// A number is infinite or NaN.
    #[error("{column} {row} holds {value}; only finite numbers can be written")]
    NotFinite {
        /// `position`, `normal` or `centre`.
        column: &'static str,
        /// The row, from 0; for the centre the axis.
        row: u64,
        /// The number.
        value: f64,
    },
    /// A normal is longer than a unit vector.
    #[error("a normal has a component of {value}; normals have length 1")]
    NotUnit {
        /// The component.
        value: f32,
    },
    /// The format cannot hold a mesh of this size.
    #[error(transparent)]
    Limit(#[from] Box<Exceeded>),
    /// A coordinate has too many digits for a line of a text format.
    #[error("a coordinate of {value} cannot be written as text, the limit is ±{limit}")]
    CoordinateTooLarge {
        /// The coordinate, in the file's units.
        value: f64,
        /// The limit, in the file's units.
        limit: f64,
    },
    /// A position is out of the range of 16-bit multiples of the step.
    #[error("a vertex lies beyond {reach} Å from the mesh's centre, the largest coordinate with a step of {step} Å")]
    OutOfQuantizationRange {
        /// The largest coordinate that can be stored, Å.
        reach: f32,
        /// The step, Å.
        step: f32,
    },
    /// Only glTF and GLB hold quantized vertices.
    #[error("{format} cannot hold quantized vertices, glb and gltf can")]
    QuantizationNotSupported {
        /// The format's name.
        format: &'static str,
    },
    /// The mesh to compress has no quantized vertices.
    #[error("meshopt compression needs a mesh with quantized vertices")]
    NotQuantized,
    /// The encoder of the compression failed.
    #[error("the mesh cannot be compressed: {reason}")]
    Compression {
        /// Message of the encoder.
        reason: String,
    },
    /// Only glTF and GLB repeat a mesh.
    #[error("{format} cannot hold instances, glb and gltf can")]
    InstancesNotSupported {
        /// The format's name.
        format: &'static str,
    },
    /// Only glTF and GLB hold coordinates in units this large.
    #[error("{format} cannot hold coordinates in {units}, glb and gltf can")]
    UnitsNotSupported {
        /// The format's name.
        format: &'static str,
        /// The units' name.
        units: &'static str,
    },
    /// The format is a picture, which is rendered, not encoded.
    #[error("{format} is a picture format and cannot hold a mesh")]
    NotAMeshFormat {
        /// The format's name.
        format: &'static str,
    },
    /// The vertices are already quantized and cannot be stored with another step or as floats.
    #[error("the mesh's vertices are quantized in steps of {step} Å and cannot be stored differently")]
    AlreadyQuantized {
        /// The mesh's step, Å.
        step: f32,
    },
    /// The JSON part of a glTF cannot be serialized.
    #[error("the glTF document cannot be written as JSON: {reason}")]
    Json {
        /// Message of the serializer.
        reason: String,
    },
}
