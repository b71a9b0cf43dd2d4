//! A mesh that leaves the backend part by part, and is never held as a whole.

use super::backend::{GridStats, Served};
use super::measure::Measures;
use super::quantize::Step;

/// Vertices as they lie in memory, in rows of equal number.
#[derive(Debug, Clone, Copy)]
pub enum Vertices<'a> {
    /// In single precision.
    Single {
        /// Positions relative to the mesh's centre, Å.
        positions: &'a [[f32; 3]],
        /// Unit normals.
        normals: &'a [[f32; 3]],
    },
    /// As small integers: see [`Quantized`](super::mesh::Quantized).
    Quantized {
        /// What an integer of a position is multiplied by, Å.
        step: Step,
        /// Positions relative to the mesh's centre, in steps.
        positions: &'a [[i16; 4]],
        /// Unit normals, in units of 1/127.
        normals: &'a [[i8; 4]],
    },
}

impl Vertices<'_> {
    /// Rows.
    #[must_use]
    pub const fn len(&self) -> usize {
        match self {
            Self::Single { positions, .. } => positions.len(),
            Self::Quantized { positions, .. } => positions.len(),
        }
    }

    /// Whether there are none.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A part of a mesh: rows of its columns, each in its final place.
#[derive(Debug, Clone, Copy)]
pub struct MeshPart<'a> {
    /// Row of the first vertex.
    pub first_vertex: usize,
    /// Its vertices; all parts of a mesh have the same kind.
    pub vertices: Vertices<'a>,
    /// Row of the first triangle.
    pub first_triangle: usize,
    /// Vertex indices, counted over the whole mesh.
    pub triangles: &'a [[u32; 3]],
}

/// The sink failed and knows why: whoever made it asks it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SinkFailed;

/// Takes a mesh part by part.
pub trait MeshSink: Sync {
    /// How much will come. Called once before the first part.
    ///
    /// # Errors
    /// [`SinkFailed`] ends the run.
    fn begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), SinkFailed>;

    /// A part. Called from several threads at once, in any order; parts cover every row. A row that comes a second time
    /// replaces the first.
    ///
    /// # Errors
    /// [`SinkFailed`] ends the run.
    fn part(&self, part: &MeshPart<'_>) -> Result<(), SinkFailed>;
}

/// What is known of a mesh that went into a sink.
#[derive(Debug, Clone)]
pub struct Poured {
    /// What to add to a position to get the structure file's own coordinates, Å.
    pub centre: [f64; 3],
    /// Vertices.
    pub n_vertices: usize,
    /// Triangles.
    pub n_triangles: usize,
    /// Lowest and highest relative position per axis, Å.
    pub bounds: [[f32; 3]; 2],
    /// Its grid.
    pub grid: GridStats,
    /// Its measures.
    pub measures: Measures,
    /// Who made it, as in [`Meshed`](super::backend::Meshed).
    pub served: Option<Served>,
}
