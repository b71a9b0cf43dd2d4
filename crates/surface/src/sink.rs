//! Sinks: destinations that take a mesh part by part, so that it is never held as a whole.

use super::mesh::{Mesh, bounds_of};
use super::quantize::Step;

/// Rows of vertices, in one of two representations. All columns have the same length.
#[derive(Debug, Clone, Copy)]
pub enum Vertices<'a> {
    /// Single precision.
    Single {
        /// Positions relative to the mesh's centre, Å.
        positions: &'a [[f32; 3]],
        /// Unit normals.
        normals: &'a [[f32; 3]],
    },
    /// Small integers: see [`Quantized`](super::mesh::Quantized).
    Quantized {
        /// Length of a unit of the positions, Å.
        step: Step,
        /// Positions relative to the mesh's centre, in steps.
        positions: &'a [[i16; 4]],
        /// Unit normals, in units of 1/127.
        normals: &'a [[i8; 4]],
    },
}

impl Vertices<'_> {
    /// Number of rows.
    #[must_use]
    pub const fn len(&self) -> usize {
        match self {
            Self::Single { positions, .. } => positions.len(),
            Self::Quantized { positions, .. } => positions.len(),
        }
    }

    /// Returns the minimum and maximum of the positions, Å; `None` without rows.
    pub(super) fn bounds(&self) -> Option<[[f32; 3]; 2]> {
        match self {
            Self::Single { positions, .. } => bounds_of(positions),
            Self::Quantized { step, positions, .. } => Some(bounds_of(positions)?.map(|row| step.decoded(row))),
        }
    }

    /// Returns true if there are no rows.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Part of a mesh: consecutive rows of its columns.
#[derive(Debug, Clone, Copy)]
pub struct MeshPart<'a> {
    /// Row of the first vertex in the mesh.
    pub first_vertex: usize,
    /// The vertices; all parts of a mesh have the same representation.
    pub vertices: Vertices<'a>,
    /// Row of the first triangle in the mesh.
    pub first_triangle: usize,
    /// Vertex indices into the whole mesh.
    pub triangles: &'a [[u32; 3]],
}

impl<'a> MeshPart<'a> {
    /// Returns the whole of `mesh` as one part. Columns in several chunks are joined.
    #[must_use]
    pub fn whole(mesh: &'a Mesh) -> Self {
        Self { first_vertex: 0, vertices: mesh.vertices(), first_triangle: 0, triangles: &mesh.triangles }
    }
}

/// Error of a sink. The sink keeps the cause for its owner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SinkFailed;

/// Destination of a mesh that arrives in parts.
pub trait MeshSink: Sync {
    /// Announces the size of the mesh. Called once, before the first part.
    ///
    /// # Errors
    /// [`SinkFailed`], which ends the run.
    fn begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), SinkFailed>;

    /// Takes a part. Called from several threads at once and in any order; the parts cover every row. A row that
    /// arrives again replaces the earlier one.
    ///
    /// # Errors
    /// [`SinkFailed`], which ends the run.
    fn part(&self, part: &MeshPart<'_>) -> Result<(), SinkFailed>;
}
