//! Distance between a mesh and its simplification, and triangles of the simplified mesh that intersect.

use std::ops::Range;

use molmesh_surface::lattice::to_f32;
use molmesh_surface::triangle::{Corners, Vector, bounds, centroid, floor};
use molmesh_surface::triangle_grid::TriangleGrid;
use molmesh_surface::vector::{joined_bounds, length, sub};
use molmesh_surface::{Control, SurfaceError};
use rayon::prelude::*;
use serde::Serialize;

use super::{Cube, CubeSide, Triangles, TrianglesByCube};

/// Maximum number of cubes in which the mean distance is measured.
const MAX_MEAN_CUBES: usize = 200;
/// Cubes between a triangle and the triangles that are nearest to it, at most.
const CUBES_APART: i32 = 2;

/// Size of the mesh before its simplification, and distance between the original and the simplified surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, utoipa::ToSchema)]
pub struct SimplificationReport {
    /// Number of triangles before the simplification.
    pub triangles_before: u64,
    /// Largest distance between the surfaces in Å, at samples: vertices of the original mesh, and points of the
    /// simplified one at most one grid spacing apart. No point is farther than one grid spacing from a sample, so the
    /// true maximum is at most one grid spacing larger.
    pub max_deviation: f64,
    /// Mean distance in Å at the samples in at most 200 cubes.
    pub mean_deviation: f64,
    /// Number of pairs of triangles of one part that intersect without a common edge. Simplification creates none
    /// within a piece of the mesh, but triangles of neighbouring pieces can intersect.
    pub intersections: u64,
}

impl SimplificationReport {
    /// Measures the distance between the triangles before and after a simplification. `max_distance` is the sum of the
    /// permitted errors of its passes, Å.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`] and [`SurfaceError::Memory`].
    pub(super) fn sampled(
        before: Triangles<'_>,
        after: Triangles<'_>,
        max_distance: f64,
        side: CubeSide,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let mut is_kept = vec![false; before.positions.len()];
        after.rows.iter().flatten().for_each(|v| is_kept[*v as usize] = true);
        let original = Surface::new(before, side, control)?;
        let simplified = Surface::new(after, side, control)?;
        let surfaces = [&original, &simplified].into_iter();
        let mut cubes: Vec<Cube> = surfaces.flat_map(|surface| &surface.pieces).map(|piece| piece.cube).collect();
        cubes.par_sort_unstable();
        cubes.dedup();
        let margin = to_f32(max_distance + side.spacing());
        let samples =
            Samples { original: &original, simplified: &simplified, is_kept: &is_kept, margin, side, control };
        let step = cubes.len().div_ceil(MAX_MEAN_CUBES).max(1);
        let mean_cubes: Vec<&Cube> = cubes.iter().step_by(step).collect();
        let distances = mean_cubes.into_par_iter().map(|cube| samples.distances(*cube));
        let distances = distances.collect::<Result<Vec<_>, SurfaceError>>()?;
        let sum: f64 = distances.iter().map(|cube| cube.sum).sum();
        let n: u64 = distances.iter().map(|cube| cube.n).sum();
        let largest_so_far = distances.iter().map(|cube| cube.maximum).fold(0.0, f32::max);
        let others = cubes.iter().enumerate().filter(|(n, _)| n % step != 0);
        let others: Vec<&Cube> = others.map(|(_, cube)| cube).collect();
        let maxima = others.into_par_iter().map(|cube| samples.maximum_above(*cube, largest_so_far));
        let maxima = maxima.collect::<Result<Vec<_>, SurfaceError>>()?;
        let max_deviation = f64::from(maxima.into_iter().fold(largest_so_far, f32::max));
        let intersections = |piece: &CubeRows| {
            control.check()?;
            Ok(simplified.intersections(piece, side))
        };
        let intersections = simplified.pieces.par_iter().map(intersections).sum::<Result<u64, SurfaceError>>()?;
        let mean_deviation = sum / n.max(1) as f64;
        Ok(Self { triangles_before: before.rows.len() as u64, max_deviation, mean_deviation, intersections })
    }
}

/// Distances at the samples of a cube.
#[derive(Default)]
struct Distances {
    /// Sum, Å.
    sum: f64,
    /// Largest, Å.
    maximum: f32,
    /// Number of samples, with the common vertices, whose distance is 0.
    n: u64,
}

/// Samples of two surfaces.
struct Samples<'a> {
    original: &'a Surface<'a>,
    simplified: &'a Surface<'a>,
    /// True for the vertices that the simplified surface has.
    is_kept: &'a [bool],
    /// Largest distance between a sample and the triangles that are nearest to it, Å.
    margin: f32,
    side: CubeSide,
    control: &'a Control<'a>,
}

impl Samples<'_> {
    /// Passes each sample in a cube to `each`, with the grid of the other surface and the number of a near triangle.
    /// Returns the number of common vertices, which are left out.
    fn for_each(&self, cube: Cube, mut each: impl FnMut(Vector, &TriangleGrid, &mut u32)) -> Result<u64, SurfaceError> {
        self.control.check()?;
        let positions = self.original.triangles.positions;
        let mut n_common = 0;
        if let Some(piece) = self.original.piece(cube) {
            let grid = self.simplified.grid(piece, self.margin, self.side);
            let mut vertices: Vec<u32> = self.original.rows(piece).flatten().collect();
            vertices.sort_unstable();
            vertices.dedup();
            n_common = vertices.extract_if(.., |v| self.is_kept[*v as usize]).count() as u64;
            let mut near = 0;
            for v in vertices {
                each(positions[v as usize], &grid, &mut near);
            }
        }
        if let Some(piece) = self.simplified.piece(cube) {
            let grid = self.original.grid(piece, self.margin, self.side);
            let mut near = 0;
            for row in self.simplified.rows(piece) {
                let corners = row.map(|v| positions[v as usize]);
                samples(row, corners, to_f32(self.side.spacing())).for_each(|point| each(point, &grid, &mut near));
            }
        }
        Ok(n_common)
    }

    /// Returns the distances in a cube.
    fn distances(&self, cube: Cube) -> Result<Distances, SurfaceError> {
        let mut distances = Distances::default();
        let n_common = self.for_each(cube, |point, grid, near| {
            let distance = grid.distance(point, near);
            distances.sum += f64::from(distance);
            distances.maximum = distances.maximum.max(distance);
            distances.n += 1;
        })?;
        distances.n += n_common;
        Ok(distances)
    }

    /// Returns the largest distance in a cube if it exceeds `largest_so_far`, and that otherwise, Å: most samples are
    /// nearer, which is found faster than their distance.
    fn maximum_above(&self, cube: Cube, largest_so_far: f32) -> Result<f32, SurfaceError> {
        let mut maximum = largest_so_far;
        self.for_each(cube, |point, grid, near| {
            if !grid.is_within(point, maximum, near) {
                maximum = grid.distance(point, near);
            }
        })?;
        Ok(maximum)
    }
}

/// Returns points of the triangle `row` that are at most `step`, Å, apart, without its corners. Of two triangles with a
/// common edge, one has the samples on that edge.
pub(super) fn samples(row: [u32; 3], corners: Corners, step: f32) -> impl Iterator<Item = Vector> {
    let [a, b, c] = corners;
    let longest = [[a, b], [b, c], [c, a]].map(|[p, q]| length(sub(q, p))).into_iter().fold(0.0, f32::max);
    let parts = floor(longest / step).saturating_add(1);
    let point = move |i: i32, j: i32| -> Vector {
        let [u, v] = [i, j].map(|part| part as f32 / parts as f32);
        std::array::from_fn(|k| a[k] + u * (b[k] - a[k]) + v * (c[k] - a[k]))
    };
    let inner = move |(i, j): &(i32, i32)| {
        let n_zero = [*i, *j, parts - i - j].iter().filter(|part| **part == 0).count();
        // Each edge has both directions in the mesh, of which one counts.
        let counts = match (*i, *j) {
            (0, _) => row[2] < row[0],
            (_, 0) => row[0] < row[1],
            _ => row[1] < row[2],
        };
        n_zero == 0 || n_zero == 1 && counts
    };
    let lattice = (0..=parts).flat_map(move |i| (0..=parts - i).map(move |j| (i, j)));
    // A small triangle has no point inside but its centroid.
    let alone = (parts < 3).then(|| centroid(corners));
    lattice.filter(inner).map(move |(i, j)| point(i, j)).chain(alone)
}

/// Triangles of a surface, by cube.
struct Surface<'a> {
    triangles: Triangles<'a>,
    by_cube: TrianglesByCube,
    /// Pieces, sorted by cube.
    pieces: Vec<CubeRows>,
}

/// Triangles whose centroids lie in a cube.
struct CubeRows {
    cube: Cube,
    /// Range in the sorted triangles.
    rows: Range<usize>,
    /// Bounding box, Å.
    bounds: [Vector; 2],
}

impl<'a> Surface<'a> {
    fn new(triangles: Triangles<'a>, side: CubeSide, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let by_cube = triangles.by_cube(side, 0.0, control)?;
        let groups: Vec<&[(Cube, u32)]> = by_cube.chunk_by(|a, b| a.0 == b.0).collect();
        let box_of = |group: &&[(Cube, u32)]| {
            let boxes = group.iter().map(|(_, i)| bounds(triangles.corners(*i as usize)));
            boxes.reduce(joined_bounds).unwrap_or_default()
        };
        let boxes: Vec<[Vector; 2]> = groups.par_iter().map(box_of).collect();
        let mut start = 0;
        let piece = |(group, bounds): (&&[(Cube, u32)], [Vector; 2])| {
            let rows = start..start + group.len();
            start = rows.end;
            CubeRows { cube: group[0].0, rows, bounds }
        };
        let pieces = groups.iter().zip(boxes).map(piece).collect();
        Ok(Self { triangles, by_cube, pieces })
    }

    /// Returns the piece of a cube.
    fn piece(&self, cube: Cube) -> Option<&CubeRows> {
        self.pieces.binary_search_by(|piece| piece.cube.cmp(&cube)).ok().map(|i| &self.pieces[i])
    }

    /// Returns the triangles of a piece.
    fn rows(&self, piece: &CubeRows) -> impl Iterator<Item = [u32; 3]> {
        self.by_cube[piece.rows.clone()].iter().map(|(_, i)| self.triangles.rows[*i as usize])
    }

    /// Returns a grid of the triangles within `margin`, Å, of a piece of the other surface.
    fn grid(&self, piece: &CubeRows, margin: f32, side: CubeSide) -> TriangleGrid {
        TriangleGrid::new(self.corners(&self.near(piece, margin)), side.cell())
    }

    /// Returns the corners of triangles.
    fn corners(&self, triangles: &[u32]) -> Vec<Corners> {
        triangles.iter().map(|i| self.triangles.corners(*i as usize)).collect()
    }

    /// Returns the indices of the triangles within `margin`, Å, of a piece of this or another surface. Simplification
    /// removes no component of a piece, so there is always one.
    fn near(&self, piece: &CubeRows, margin: f32) -> Vec<u32> {
        let [low, high] = [piece.bounds[0].map(|c| c - margin), piece.bounds[1].map(|c| c + margin)];
        let overlaps = |[from, to]: [Vector; 2]| (0..3).all(|k| from[k] <= high[k] && to[k] >= low[k]);
        let (part, [x, y, z]) = piece.cube;
        let steps = || -CUBES_APART..=CUBES_APART;
        let cubes = steps().flat_map(|dx| steps().flat_map(move |dy| steps().map(move |dz| [x + dx, y + dy, z + dz])));
        let pieces = cubes.filter_map(|cube| self.piece((part, cube))).filter(|piece| overlaps(piece.bounds));
        let triangles = pieces.flat_map(|piece| &self.by_cube[piece.rows.clone()]).map(|(_, i)| *i);
        triangles.filter(|i| overlaps(bounds(self.triangles.corners(*i as usize)))).collect()
    }

    /// Returns the number of pairs of triangles of a part that intersect, of which the first lies in a piece.
    fn intersections(&self, piece: &CubeRows, side: CubeSide) -> u64 {
        let near = self.near(piece, 0.0);
        let rows: Vec<[u32; 3]> = near.iter().map(|i| self.triangles.rows[*i as usize]).collect();
        // The triangles of a piece are sorted.
        let own = &self.by_cube[piece.rows.clone()];
        let is_own: Vec<bool> = near.iter().map(|i| own.binary_search_by_key(i, |(_, own)| *own).is_ok()).collect();
        let grid = TriangleGrid::new(self.corners(&near), side.cell());
        let pairs = grid.intersections(&rows, &is_own);
        let first_is_own = |pair: &&[usize; 2]| is_own[if near[pair[0]] < near[pair[1]] { pair[0] } else { pair[1] }];
        pairs.iter().filter(first_is_own).count() as u64
    }
}
