//! Simplification: fewer triangles, within an error.
//!
//! Cubes divide the triangles into pieces. Each piece is simplified on its own by meshoptimizer (quadric error metric,
//! Garland and Heckbert 1997), which keeps the boundary of the piece. A second pass with shifted cubes simplifies the
//! boundaries of the first. The vertices that remain are vertices of the original mesh, with their normals, colours and
//! atom indices.
//!
//! The simplifier may pinch a surface. So each piece is checked: it must remain a manifold with the same boundary, so
//! that a closed manifold mesh remains one. Otherwise the piece is simplified with a smaller error, or kept. Two pieces
//! may also get the same edge between two vertices of their boundaries; then one of them is kept.

mod deviation;
mod fans;
mod grid;

use std::ops::Range;

use meshopt::{SimplifyOptions, VertexDataAdapter};
use rayon::prelude::*;

pub use self::deviation::Deviation;
use self::deviation::{Distances, centroid};
use self::fans::topology;
use self::grid::{Corners, TriangleGrid};
use super::control::Control;
use super::error::SurfaceError;
use super::lattice::{to_i32, to_u32};
use super::measure::Component;
use super::mesh::{Mesh, PartRange, bounds_of};

/// Smallest and largest error, Å.
pub const SIMPLIFY_ERRORS: [f64; 2] = [0.001, 10.0];

/// Edge length of a cube, in grid spacings: some thousand triangles.
const SIDE: f64 = 24.0;
/// Errors of the simplifier that are tried, relative to the error. The simplifier averages squared distances, so that
/// the largest distance is about twice its error. Where an average hides a larger one, the next error is tried.
const TRIES: [f64; 3] = [0.5, 0.25, 0.125];
/// Memory of a triangle while the mesh is simplified, bytes: its cube and index, and copies in pieces.
const TRIANGLE_BYTES: u64 = 64;

/// Result of a simplification.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Simplification {
    /// Number of triangles before.
    pub triangles: u64,
    /// Distance between the surfaces.
    pub deviation: Deviation,
}

/// Edge length of the cubes, Å.
#[derive(Debug, Clone, Copy)]
struct CubeSide(f64);

impl CubeSide {
    /// Returns the edge length of a cell for searches: a few triangles of the original mesh.
    #[expect(clippy::cast_possible_truncation, reason = "a length of a few Å")]
    fn cell(self) -> f32 {
        (self.0 / SIDE * 2.0) as f32
    }

    /// Returns the lower end of a cube along an axis, Å.
    #[expect(clippy::cast_possible_truncation, reason = "positions have single precision")]
    fn position(self, cube: i32) -> f32 {
        (self.0 * f64::from(cube)) as f32
    }
}

/// Cube of a triangle: its part and its position, in edge lengths.
type Cube = (u32, [i32; 3]);

/// Cube and index of each triangle, sorted.
type Sorted = Vec<(Cube, u32)>;

/// Simplifies `mesh` with an error, Å. `spacing` is the grid spacing of the mesh, Å. Parts remain parts; the areas,
/// volumes and bounds of parts are those of the result.
///
/// # Errors
/// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
pub(crate) fn simplify(
    mesh: &mut Mesh,
    error: f64,
    spacing: f64,
    control: &Control<'_>,
) -> Result<Simplification, SurfaceError> {
    mesh.make_contiguous();
    let _memory = control.reserve(TRIANGLE_BYTES * mesh.n_triangles() as u64)?;
    let (before, parts) = (mesh.triangles.to_vec(), part_ranges(mesh));
    let side = CubeSide(SIDE * spacing);
    for shift in [0.0, 0.5] {
        let sorted = by_cube(mesh, &mesh.triangles, &part_ranges(mesh), side, shift, control)?;
        let pieces: Vec<&[(Cube, u32)]> = sorted.chunk_by(|a, b| a.0 == b.0).collect();
        let simplified = |piece: &&[(Cube, u32)]| {
            control.check()?;
            Ok(CubePiece::new(mesh, piece).simplified(error, side))
        };
        let mut results = pieces.par_iter().map(simplified).collect::<Result<Vec<_>, SurfaceError>>()?;
        keep_conflicting(&mut results);
        let mut n_of_parts = vec![0; mesh.parts.len().max(1)];
        let mut triangles = Vec::new();
        for (piece, result) in pieces.iter().zip(results) {
            let first = triangles.len();
            match result.triangles {
                Some(simplified) => triangles.extend(simplified),
                None => triangles.extend(piece.iter().map(|(_, i)| mesh.triangles[*i as usize])),
            }
            n_of_parts[piece[0].0.0 as usize] += triangles.len() - first;
        }
        mesh.triangles = triangles.into();
        let mut first = 0;
        for (part, n) in mesh.parts.iter_mut().zip(n_of_parts) {
            part.triangles = first..first + n;
            first += n;
        }
    }
    let deviation = Deviation::sampled(mesh, &before, &parts, side, control)?;
    let triangles = before.len() as u64;
    drop(before);
    compact(mesh);
    Ok(Simplification { triangles, deviation })
}

/// Returns the rows of the triangles of each part; none without parts.
fn part_ranges(mesh: &Mesh) -> Vec<Range<usize>> {
    mesh.parts.iter().map(|part| part.triangles.clone()).collect()
}

/// Returns `triangles` of vertices of `mesh` by cube. `shift` moves the cubes, in edge lengths.
fn by_cube(
    mesh: &Mesh,
    triangles: &[[u32; 3]],
    parts: &[Range<usize>],
    side: CubeSide,
    shift: f64,
    control: &Control<'_>,
) -> Result<Sorted, SurfaceError> {
    control.check()?;
    let cube = |(i, triangle): (usize, &[u32; 3])| {
        let corners = triangle.map(|v| mesh.position(v as usize));
        let cell = |k: usize| {
            let middle = corners.iter().map(|corner| f64::from(corner[k])).sum::<f64>() / 3.0;
            to_i32((middle / side.0 + shift).floor())
        };
        ((part_of(parts, i), std::array::from_fn(cell)), to_u32(i))
    };
    let mut sorted: Sorted = triangles.par_iter().enumerate().map(cube).collect();
    super::checked_sort::sort(&mut sorted, Ord::cmp, control)?;
    Ok(sorted)
}

/// Returns the part of a triangle; 0 without parts.
fn part_of(parts: &[Range<usize>], triangle: usize) -> u32 {
    to_u32(parts.partition_point(|rows| rows.end <= triangle).min(parts.len().saturating_sub(1)))
}

/// Result of the simplification of a piece. Vertices are those of the mesh.
#[derive(Default)]
struct CubeResult {
    /// Triangles; `None` if the piece is kept.
    triangles: Option<Vec<[u32; 3]>>,
    /// Edges within the piece that join vertices of its boundary, after and before the simplification.
    chords: Vec<[u32; 2]>,
    original_chords: Vec<[u32; 2]>,
}

/// Triangles of a cube with their vertices.
struct CubePiece {
    /// Numbers of the vertices in the mesh, ascending.
    vertices: Vec<u32>,
    positions: Vec<[f32; 3]>,
    /// Triangles of vertices of the piece.
    triangles: Vec<[u32; 3]>,
}

impl CubePiece {
    fn new(mesh: &Mesh, piece: &[(Cube, u32)]) -> Self {
        let triangles = piece.iter().map(|(_, i)| mesh.triangles[*i as usize]);
        let mut vertices: Vec<u32> = triangles.clone().flatten().collect();
        vertices.sort_unstable();
        vertices.dedup();
        let number = |v| to_u32(vertices.partition_point(|other| *other < v));
        let triangles = triangles.map(|triangle| triangle.map(number)).collect();
        let positions = vertices.iter().map(|v| mesh.position(*v as usize)).collect();
        Self { vertices, positions, triangles }
    }

    /// Simplifies the piece with the largest of some errors that keeps it a manifold with the same boundary, within
    /// `error` of itself.
    fn simplified(&self, error: f64, side: CubeSide) -> CubeResult {
        let Some(before) = topology(&self.triangles) else { return CubeResult::default() };
        let in_mesh = |edge: &[u32; 2]| edge.map(|v| self.vertices[v as usize]);
        let original_chords = before.chords.iter().map(in_mesh).collect();
        let original = TriangleGrid::new(self.triangles.iter().map(|t| self.corners(t)).collect(), side.cell());
        let found = TRIES.into_iter().find_map(|share| {
            let found = self.within(share * error)?;
            let after = topology(&found).filter(|after| after.fans == before.fans)?;
            let simplified = TriangleGrid::new(found.iter().map(|t| self.corners(t)).collect(), side.cell());
            let centroids = found.iter().map(|t| centroid(self.corners(t)));
            let distances = Distances::of(self.positions.iter().copied(), &simplified);
            let maximum = distances.with(Distances::of(centroids, &original)).maximum;
            (maximum <= error).then_some((found, after.chords))
        });
        let Some((found, chords)) = found else { return CubeResult { original_chords, ..CubeResult::default() } };
        CubeResult {
            triangles: Some(found.iter().map(|triangle| triangle.map(|v| self.vertices[v as usize])).collect()),
            chords: chords.iter().map(in_mesh).collect(),
            original_chords,
        }
    }

    fn corners(&self, triangle: &[u32; 3]) -> Corners {
        triangle.map(|v| self.positions[v as usize])
    }

    /// Returns the triangles of the piece after a simplification with this error, Å; `None` if it changes nothing.
    fn within(&self, error: f64) -> Option<Vec<[u32; 3]>> {
        let options = SimplifyOptions::LockBorder | SimplifyOptions::ErrorAbsolute;
        let stride = size_of::<[f32; 3]>();
        let vertices = VertexDataAdapter::new(bytemuck::cast_slice(&self.positions), stride, 0).ok()?;
        #[expect(clippy::cast_possible_truncation, reason = "single precision is enough for an error")]
        let found = meshopt::simplify(self.triangles.as_flattened(), &vertices, 0, error as f32, options, None);
        (found.len() < 3 * self.triangles.len()).then(|| found.as_chunks::<3>().0.to_vec())
    }
}

/// Keeps pieces as they are so that no two pieces have the same chord.
fn keep_conflicting(results: &mut [CubeResult]) {
    loop {
        let mut chords: Vec<([u32; 2], usize)> = Vec::new();
        for (n, result) in results.iter().enumerate() {
            let own = if result.triangles.is_some() { &result.chords } else { &result.original_chords };
            chords.extend(own.iter().map(|chord| (*chord, n)));
        }
        chords.par_sort_unstable();
        let mut kept = Vec::new();
        for group in chords.chunk_by(|a, b| a.0 == b.0).filter(|group| group.len() > 1) {
            let simplified = group.iter().map(|(_, n)| *n).filter(|n| results[*n].triangles.is_some());
            // One piece may keep its chord if it is new in all of them.
            let n_free = usize::from(group.iter().all(|(_, n)| results[*n].triangles.is_some()));
            kept.extend(simplified.skip(n_free));
        }
        if kept.is_empty() {
            return;
        }
        for n in kept {
            results[n].triangles = None;
        }
    }
}

/// Removes unused vertices, and measures the parts.
fn compact(mesh: &mut Mesh) {
    let mut used = vec![false; mesh.n_vertices()];
    mesh.triangles.iter().flatten().for_each(|v| used[*v as usize] = true);
    let rows: Vec<u32> = (0..).zip(&used).filter(|(_, used)| **used).map(|(row, _)| row).collect();
    let number = |v: u32| to_u32(rows.partition_point(|row| *row < v));
    mesh.triangles.par_chunks_mut(1 << 14).flatten_iter().for_each(|triangle| *triangle = triangle.map(number));
    for part in &mut mesh.parts {
        let ends = [part.vertices.start, part.vertices.end].map(to_u32).map(number);
        part.vertices = ends[0] as usize..ends[1] as usize;
    }
    mesh.take_vertices(&rows);
    let measured = mesh.parts.iter().map(|part| measure(mesh, part)).collect();
    mesh.parts = measured;
}

/// Returns a part with the measures of its triangles.
fn measure(mesh: &Mesh, part: &PartRange) -> PartRange {
    let mut sum = Component::default();
    for triangle in &mesh.triangles[part.triangles.clone()] {
        sum.add(triangle.map(|v| mesh.position(v as usize).map(f64::from)));
    }
    let rows =
        |Range { start, end }: Range<usize>| -> Vec<[f32; 3]> { (start..end).map(|v| mesh.position(v)).collect() };
    PartRange {
        area: sum.area,
        volume: part.volume.map(|_| sum.volume),
        bounds: bounds_of(&rows(part.vertices.clone())).unwrap_or_default(),
        ..part.clone()
    }
}

#[cfg(test)]
mod tests;
