//! Stage `scan`: exclusive scan over tiles for the first vertex and triangle of each.

use super::Tile;
use crate::error::SurfaceError;
use crate::lattice::slightly_coarser;
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
/// Returns [`SurfaceError::MeshTooLarge`] if the mesh exceeds the limit, or 32-bit indices.
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
/// Returns [`SurfaceError::MeshTooLarge`].
pub fn check_size(
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    n_vertices: u64,
    n_triangles: u64,
) -> Result<(), SurfaceError> {
    let bytes = params.mesh_bytes(n_vertices, n_triangles);
    // The highest value of an index is the primitive restart of graphics interfaces.
    let limit = limits.max_mesh_bytes.min(params.mesh_bytes(u64::from(u32::MAX), 0));
    if bytes <= limit { Ok(()) } else { Err(too_large(bytes, params.resolution, limit)) }
}

/// Returns the error for a mesh of `bytes` bytes. The number of bytes grows with the inverse square of the spacing, as
/// the area stays the same.
#[must_use]
pub fn too_large(bytes: u64, spacing: f64, limit: u64) -> SurfaceError {
    let excess = (bytes as f64 / limit.max(1) as f64).max(1.0);
    SurfaceError::MeshTooLarge { bytes, limit, suggested_resolution: slightly_coarser(spacing * excess.sqrt()) }
}
