//! Distance between a mesh and its simplification, at samples on both.

use rayon::prelude::*;

use super::grid::TriangleGrid;
use super::{Cube, CubeSide, Triangles, TrianglesByCube};
use crate::surface::control::Control;
use crate::surface::error::SurfaceError;
use crate::surface::triangle::Corners;

/// Maximum number of cubes with samples.
const CUBES: usize = 1000;
/// Maximum number of samples per cube on each surface.
const SAMPLES: usize = 256;

/// Distance between two surfaces, at samples on both: vertices of the original, and centroids of triangles of the
/// simplified mesh.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Deviation {
    /// Largest distance, Å.
    pub maximum: f64,
    /// Mean distance, Å.
    pub mean: f64,
}

/// Sum, maximum and number of distances.
#[derive(Clone, Copy, Default)]
pub(super) struct Distances {
    sum: f64,
    pub(super) maximum: f64,
    n: u64,
}

impl Distances {
    /// Returns the distances of points from the triangles of `grid`.
    pub(super) fn of(points: impl Iterator<Item = [f32; 3]>, grid: &TriangleGrid) -> Self {
        points
            .map(|point| f64::from(grid.distance(point)))
            .fold(Self::default(), |all, distance| all.with(Self { sum: distance, maximum: distance, n: 1 }))
    }

    /// Returns the statistics of both sets of distances together.
    pub(super) fn with(self, other: Self) -> Self {
        Self { sum: self.sum + other.sum, maximum: self.maximum.max(other.maximum), n: self.n + other.n }
    }
}

impl Deviation {
    /// Measures the distance between the triangles before and after a simplification with this error, Å.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub(super) fn sampled(
        before: Triangles<'_>,
        after: Triangles<'_>,
        error: f64,
        side: CubeSide,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        // Both passes may move the surface by the error.
        #[expect(clippy::cast_possible_truncation, reason = "positions have single precision")]
        let margin = 2.0 * (error as f32 + side.cell());
        let surface = |triangles: Triangles<'_>| triangles.by_cube(side, 0.0, control);
        let original = Surface { triangles: before, by_cube: surface(before)?, margin };
        let simplified = Surface { triangles: after, by_cube: surface(after)?, margin };
        let surfaces = [&original, &simplified].into_iter();
        let pieces = surfaces.flat_map(|surface| surface.by_cube.chunk_by(|a, b| a.0 == b.0));
        let mut cubes: Vec<Cube> = pieces.map(|piece| piece[0].0).collect();
        cubes.par_sort_unstable();
        cubes.dedup();
        let of_cube = |cube: &Cube| {
            control.check()?;
            let vertices = samples(original.of(*cube)).map(|corners| corners[0]);
            let centroids = samples(simplified.of(*cube)).map(centroid);
            let [from, to] = [&simplified, &original].map(|surface| surface.around(*cube, side));
            Ok(Distances::of(vertices, &from).with(Distances::of(centroids, &to)))
        };
        let sampled: Vec<Cube> = cubes.iter().copied().step_by(cubes.len().div_ceil(CUBES).max(1)).collect();
        let of_cubes = sampled.par_iter().map(of_cube).collect::<Result<Vec<_>, SurfaceError>>()?;
        let Distances { sum, maximum, n } = of_cubes.into_iter().fold(Distances::default(), Distances::with);
        Ok(Self { maximum, mean: sum / n.max(1) as f64 })
    }
}

/// Returns every n-th triangle, at most [`SAMPLES`].
fn samples(triangles: impl ExactSizeIterator<Item = Corners>) -> impl Iterator<Item = Corners> {
    let step = triangles.len().div_ceil(SAMPLES).max(1);
    triangles.step_by(step)
}

/// Returns the centroid of a triangle.
pub(super) fn centroid([a, b, c]: Corners) -> [f32; 3] {
    std::array::from_fn(|k| (a[k] + b[k] + c[k]) / 3.0)
}

/// Triangles of a surface, with an index by cube.
struct Surface<'a> {
    triangles: Triangles<'a>,
    by_cube: TrianglesByCube,
    /// Distance from a cube within which the triangles are searched that are nearest to its samples, Å.
    margin: f32,
}

impl Surface<'_> {
    /// Returns the triangles of a cube.
    fn of(&self, cube: Cube) -> impl ExactSizeIterator<Item = Corners> {
        let [start, end] = [
            self.by_cube.partition_point(|(other, _)| *other < cube),
            self.by_cube.partition_point(|(other, _)| *other <= cube),
        ];
        self.by_cube[start..end].iter().map(|(_, i)| self.triangles.corners(*i as usize))
    }

    /// Returns the triangles in and near a cube; all triangles of the surface if none is near.
    fn around(&self, (part, [x, y, z]): Cube, side: CubeSide) -> TriangleGrid {
        let steps = || -1..=1;
        let cubes = steps().flat_map(|dx| steps().flat_map(move |dy| steps().map(move |dz| [x + dx, y + dy, z + dz])));
        let margin = self.margin;
        let [low, high] = [0, 1].map(|end| [x, y, z].map(|c| side.position(c + end)));
        let is_near = |corners: &Corners| {
            (0..3).all(|k| {
                corners.iter().any(|p| p[k] >= low[k] - margin) && corners.iter().any(|p| p[k] <= high[k] + margin)
            })
        };
        let mut near: Vec<Corners> = cubes.flat_map(|cube| self.of((part, cube))).filter(is_near).collect();
        if near.is_empty() {
            near = (0..self.triangles.rows.len()).map(|i| self.triangles.corners(i)).collect();
        }
        TriangleGrid::new(near, side.cell())
    }
}
