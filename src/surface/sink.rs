//! A mesh that leaves the backend part by part, and is never held as a whole.

use super::backend::{GridStats, Served};
use super::measure::Measures;

/// A part of a mesh: rows of its columns, each in its final place.
#[derive(Debug, Clone, Copy)]
pub struct MeshPart<'a> {
    /// Row of the first vertex.
    pub first_vertex: usize,
    /// Positions relative to the mesh's centre, Å.
    pub positions: &'a [[f32; 3]],
    /// Unit normals, one per position.
    pub normals: &'a [[f32; 3]],
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
