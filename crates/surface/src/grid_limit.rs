//! Error for a grid of too many points.

use super::error::SurfaceError;
use super::lattice::BRICK_POINTS;
use super::limit::{Exceeded, Limit, slightly_coarser};
use super::params::SurfaceLimits;

/// Bricks extend a body: one of volume s³ reaches about (s/b + `EXTENSION`)³ bricks of edge b. The extension is 1 for a
/// ball, and up to 2 for fibres, sheets and shells. In counts of such bodies of 1 to 6,000 atoms, with limits from
/// 10,000 grid points on and the margin of [`slightly_coarser`], at most one repetition with a suggested spacing
/// exceeded the limit again. Atoms out of reach of each other extend more, and may need further repetitions.
const EXTENSION: f64 = 1.5;

/// Returns the error for `n_bodies` separate grids that have about `grid_points` grid points together. Its suggested
/// spacing is an estimate.
#[must_use]
pub fn exceeded(resolution: f64, grid_points: u64, n_bodies: usize, limits: &SurfaceLimits) -> SurfaceError {
    let limit = limits.max_grid_points;
    // Edge of a body in bricks.
    let edge = |points: u64| (points as f64 / (BRICK_POINTS * n_bodies) as f64).cbrt() - EXTENSION;
    let fitting = edge(limit);
    let factor = if fitting > 0.0 { (edge(grid_points) / fitting).max(1.0) } else { f64::INFINITY };
    let error =
        Exceeded { actual: Some(grid_points), resolution: Some(resolution), ..Exceeded::new(Limit::GridPoints, limit) };
    error.suggest(slightly_coarser(resolution * factor)).error()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lattice::to_u64;

    #[test]
    fn coarser_spacings_are_suggested_until_a_brick_is_too_large() {
        let suggested = |grid_points, n_bodies, max_grid_points| {
            let limits = SurfaceLimits { max_grid_points, ..SurfaceLimits::default() };
            exceeded(0.5, grid_points, n_bodies, &limits).exceeded(Limit::GridPoints)?.suggested_resolution
        };
        let points = |edge: f64| 512 * to_u64((edge + EXTENSION).powi(3));
        let half = suggested(points(100.0), 1, points(50.0)).unwrap();
        assert!((1.05..1.07).contains(&half), "{half}");
        assert_eq!(suggested(3 * points(100.0), 3, 3 * points(50.0)), Some(half));
        // No finer spacing is suggested.
        assert_eq!(suggested(1 << 20, 1, 1 << 30), Some(0.53));
        assert_eq!(suggested(1 << 20, 1, 1700), None);
    }
}
