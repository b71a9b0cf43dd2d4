//! Error for a grid of too many points.

use super::error::SurfaceError;
use super::lattice::{Lattice, slightly_coarser};
use super::params::SurfaceLimits;

/// Returns the error for a grid of about `grid_points` grid points. Its suggested spacing follows from the number of
/// grid points in constant time and assumes that the bricks of a coarser grid cover the same volume. They cover more,
/// so the pipeline replaces the suggestion by a spacing whose grid was counted.
pub(crate) fn exceeded(lattice: &Lattice, grid_points: u64, limits: &SurfaceLimits) -> SurfaceError {
    let (limit, resolution) = (limits.max_grid_points, lattice.spacing);
    let excess = grid_points as f64 / limit.max(1) as f64;
    SurfaceError::GridTooLarge {
        grid_points,
        limit,
        resolution,
        suggested_resolution: slightly_coarser(resolution * excess.cbrt()),
    }
}
