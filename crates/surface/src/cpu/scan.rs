//! Stage `scan`: exclusive scan over tiles for the first vertex and triangle of each.

use super::Tile;
use crate::error::SurfaceError;
use crate::limit::{Exceeded, Limit};
use crate::params::{SurfaceLimits, SurfaceParams};

/// Totals of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Totals {
    /// Vertices.
    pub(super) vertices: usize,
    /// Triangles.
    pub(super) triangles: usize,
}

/// Sets the first vertex and triangle of every tile.
///
/// # Errors
/// Returns [`SurfaceError::Limit`] if the mesh exceeds the limit, or 32-bit indices.
pub(super) fn scan(tiles: &mut [Tile], params: &SurfaceParams, limits: &SurfaceLimits) -> Result<Totals, SurfaceError> {
    let (mut vertices, mut triangles) = (0, 0);
    for tile in &mut *tiles {
        (tile.first_vertex, tile.first_triangle) = (vertices, triangles);
        vertices += tile.found.vertices as usize;
        triangles += tile.found.triangles as usize;
    }
    check_size(params, limits, vertices as u64, triangles as u64)?;
    Ok(Totals { vertices, triangles })
}

/// Rejects a mesh that exceeds the limit or whose vertices 32-bit indices cannot number.
///
/// # Errors
/// Returns [`SurfaceError::Limit`].
pub fn check_size(
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    n_vertices: u64,
    n_triangles: u64,
) -> Result<(), SurfaceError> {
    let bytes = params.mesh_bytes(n_vertices, n_triangles);
    // The highest value of an index is the primitive restart of graphics interfaces.
    let cap = params.mesh_bytes(u64::from(u32::MAX), 0);
    let error = Exceeded { actual: Some(bytes), ..Exceeded::capped(Limit::MeshBytes, limits.max_mesh_bytes, cap) };
    if bytes <= error.max { Ok(()) } else { Err(error.suggest_for_area(params.resolution).error()) }
}

/// Returns the error for a mesh of `bytes` bytes.
#[must_use]
pub fn too_large(bytes: u64, spacing: f64, limit: u64) -> SurfaceError {
    Exceeded { actual: Some(bytes), ..Exceeded::new(Limit::MeshBytes, limit) }.suggest_for_area(spacing).error()
}
