//! Simplification of a mesh: fewer triangles, near the original surface.
//!
//! Space is divided into cubes, and the triangles whose centroids lie in one cube form a piece. meshoptimizer
//! simplifies each piece on its own (quadric error metric, Garland and Heckbert 1997) and does not change the boundary
//! of the piece. A second pass with shifted cubes simplifies the triangles at the boundaries of the first pass. The
//! vertices that remain are vertices of the original mesh, with their normals, colours and atom indices.
//!
//! meshoptimizer can join two sheets of a surface at a vertex or an edge, which would not be a manifold. So each result
//! is checked: it must be a manifold with the same boundary as the piece. Then a closed manifold mesh remains one. A
//! piece that fails is simplified with a smaller error; if all errors fail, it stays unchanged. Two pieces can also
//! both create the same edge between two vertices of their boundaries. Then only one of them is simplified.

mod deviation;
mod fans;
mod grid;

use std::ops::Range;

use meshopt::{SimplifyOptions, VertexDataAdapter};
use rayon::prelude::*;
use rustc_hash::FxHashSet;

pub use self::deviation::Deviation;
use self::deviation::{Distances, centroid};
use self::fans::{BoundaryFans, topology};
use self::grid::TriangleGrid;
use super::control::Control;
use super::error::SurfaceError;
use super::lattice::{to_i32, to_u32};
use super::measure::Component;
use super::mesh::{Mesh, PartRange, bounds_of};
use super::params::bad;
use super::triangle::Corners;
use super::union_find::UnionFind;

/// Smallest and largest value of the parameter `simplify`, Å.
pub const SIMPLIFY_ERRORS: [f64; 2] = [0.001, 10.0];

/// Shifts of the cubes in each pass, in edge lengths. The passes after [`MIN_PASSES`] run only while the mesh has too
/// many triangles.
const SHIFTS: [f64; 4] = [0.0, 0.5, 0.25, 0.75];
/// Number of passes without a limit on triangles.
const MIN_PASSES: usize = 2;

/// Edge length of a cube, in grid spacings. A piece then has some thousand triangles.
const SIDE: f64 = 24.0;
/// Errors that are passed to meshoptimizer one after another, relative to the permitted error. Its error is an average
/// of squared distances, so the largest distance is about twice as large, and in places larger. Then the next is tried.
const TRIES: [f64; 3] = [0.5, 0.25, 0.125];
/// Largest error, in grid spacings: with larger ones, most results fail the checks.
const MAX_SPACINGS: f64 = 2.0;
/// Memory per triangle while the mesh is simplified, bytes: its cube and index, and copies of its corners.
pub(crate) const TRIANGLE_BYTES: u64 = 112;

/// Value of the parameter `simplify`, with the limit on triangles that it must reach.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Simplify {
    /// Permitted error of each pass, Å.
    pub error: f64,
    /// Number of triangles at which the simplification ends; `None` to remove as many as the error permits.
    pub max_triangles: Option<u64>,
}

/// Result of a simplification.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Simplification {
    /// Number of triangles before the simplification.
    pub triangles: u64,
    /// Distance between the original and the simplified surface.
    pub deviation: Deviation,
}

/// Edge length of the cubes, Å.
#[derive(Debug, Clone, Copy)]
struct CubeSide(f64);

impl CubeSide {
    /// Returns the edge length of a cell of a [`TriangleGrid`], Å: two grid spacings, so that a cell has few triangles.
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

/// Cube of a triangle: the part of the triangle, and the position of the cube, in edge lengths.
type Cube = (u32, [i32; 3]);

/// Cube and index of each triangle, sorted.
type TrianglesByCube = Vec<(Cube, u32)>;

/// Checks an error for a grid spacing, both in Å.
///
/// # Errors
/// [`SurfaceError::BadParameter`] for an error of more than 2 grid spacings.
pub(crate) fn check_error(error: f64, spacing: f64) -> Result<(), SurfaceError> {
    let most = MAX_SPACINGS * spacing;
    if error <= most {
        return Ok(());
    }
    let expected = format!("at most {MAX_SPACINGS} grid spacings: {most:.3} Å with this grid");
    Err(bad("simplify", format!("`{error}`"), &expected))
}

/// Simplifies `mesh`. Each pass may move the surface by up to the error of `wanted`, measured at vertices and
/// centroids. `spacing` is the grid spacing of the mesh, Å. Each part is simplified on its own, and its area, volume
/// and bounds are measured again.
///
/// # Errors
/// Returns the errors of [`check_error`], [`SurfaceError::TooManyTriangles`] if the error is too small for the limit on
/// triangles, [`SurfaceError::Memory`] and [`SurfaceError::Cancelled`].
pub(crate) fn simplify(
    mesh: &mut Mesh,
    wanted: Simplify,
    spacing: f64,
    control: &Control<'_>,
) -> Result<Simplification, SurfaceError> {
    let Simplify { error, max_triangles } = wanted;
    check_error(error, spacing)?;
    mesh.make_contiguous();
    let memory = control.reserve(TRIANGLE_BYTES * mesh.n_triangles() as u64)?;
    let positions: Vec<[f32; 3]> = (0..mesh.n_vertices()).into_par_iter().map(|v| mesh.position(v)).collect();
    let (rows, parts) = (mesh.triangles.to_vec(), part_ranges(mesh));
    let before = Triangles { positions: &positions, rows: &rows, parts: &parts };
    let side = CubeSide(SIDE * spacing);
    for (pass, shift) in SHIFTS.into_iter().enumerate() {
        let excess = max_triangles.map_or(f64::INFINITY, |limit| mesh.n_triangles() as f64 / limit as f64);
        if excess <= 1.0 || pass >= MIN_PASSES && max_triangles.is_none() {
            break;
        }
        // The boundaries of the pieces stay fine in the first pass, so both passes share the reduction.
        let share = if pass == 0 { excess.sqrt().recip() } else { excess.recip() };
        let parts = part_ranges(mesh);
        let triangles = Triangles { positions: &positions, rows: &mesh.triangles, parts: &parts };
        let sorted = triangles.by_cube(side, shift, control)?;
        let pieces: Vec<&[(Cube, u32)]> = sorted.chunk_by(|a, b| a.0 == b.0).collect();
        let simplified = |piece: &&[(Cube, u32)]| {
            control.check()?;
            Ok(CubePiece::new(&triangles, piece).simplified(error, share, side))
        };
        let mut results = pieces.par_iter().map(simplified).collect::<Result<Vec<_>, SurfaceError>>()?;
        revert_conflicts(&mut results);
        let mut n_of_parts = vec![0; mesh.parts.len().max(1)];
        let mut rows = Vec::new();
        for (piece, result) in pieces.iter().zip(results) {
            control.check()?;
            let first = rows.len();
            match result.triangles {
                Some(simplified) => rows.extend(simplified),
                None => rows.extend(piece.iter().map(|(_, i)| triangles.rows[*i as usize])),
            }
            n_of_parts[piece[0].0.0 as usize] += rows.len() - first;
        }
        mesh.triangles = rows.into();
        let mut first = 0;
        for (part, n) in mesh.parts.iter_mut().zip(n_of_parts) {
            part.triangles = first..first + n;
            first += n;
        }
    }
    if let Some(limit) = max_triangles.filter(|limit| mesh.n_triangles() as u64 > *limit) {
        let triangles = mesh.n_triangles() as u64;
        return Err(SurfaceError::TooManyTriangles { triangles, limit, resolution: spacing, simplify: Some(error) });
    }
    let parts = part_ranges(mesh);
    let after = Triangles { positions: &positions, rows: &mesh.triangles, parts: &parts };
    let deviation = Deviation::sampled(before, after, error, side, control)?;
    let triangles = rows.len() as u64;
    drop((rows, positions, memory));
    compact(mesh, control)?;
    Ok(Simplification { triangles, deviation })
}

/// Returns the range of triangles of each part; empty for a mesh without parts.
fn part_ranges(mesh: &Mesh) -> Vec<Range<usize>> {
    mesh.parts.iter().map(|part| part.triangles.clone()).collect()
}

/// Triangles of a mesh.
#[derive(Debug, Clone, Copy)]
struct Triangles<'a> {
    /// Positions of the vertices, Å.
    positions: &'a [[f32; 3]],
    rows: &'a [[u32; 3]],
    /// Range of the triangles of each part; empty without parts.
    parts: &'a [Range<usize>],
}

impl Triangles<'_> {
    /// Returns the corners of triangle `i`, Å.
    fn corners(&self, i: usize) -> Corners {
        self.rows[i].map(|v| self.positions[v as usize])
    }

    /// Sorts the triangles by cube. `shift` moves the cubes, in edge lengths.
    fn by_cube(&self, side: CubeSide, shift: f64, control: &Control<'_>) -> Result<TrianglesByCube, SurfaceError> {
        control.check()?;
        let cube = |i: usize| {
            let middle = centroid(self.corners(i));
            let along = |k: usize| to_i32((f64::from(middle[k]) / side.0 + shift).floor());
            ((part_of(self.parts, i), std::array::from_fn(along)), to_u32(i))
        };
        let mut sorted: TrianglesByCube = (0..self.rows.len()).into_par_iter().map(cube).collect();
        super::checked_sort::sort(&mut sorted, Ord::cmp, control)?;
        Ok(sorted)
    }
}

/// Returns the part of a triangle; 0 without parts.
fn part_of(parts: &[Range<usize>], triangle: usize) -> u32 {
    to_u32(parts.partition_point(|rows| rows.end <= triangle).min(parts.len().saturating_sub(1)))
}

/// Result of the simplification of a piece, with the vertex numbers of the mesh.
#[derive(Default)]
struct CubeResult {
    /// Simplified triangles; `None` if the piece stays unchanged.
    triangles: Option<Vec<[u32; 3]>>,
    /// Chords after the simplification: inner edges of the piece that join two vertices of its boundary.
    chords: Vec<[u32; 2]>,
    /// Chords before the simplification.
    original_chords: Vec<[u32; 2]>,
}

/// Piece: the triangles of a cube, with their vertices.
struct CubePiece {
    /// Numbers of the vertices in the mesh, ascending.
    vertices: Vec<u32>,
    /// Positions of these vertices, Å.
    positions: Vec<[f32; 3]>,
    /// Triangles, as indices of `vertices`.
    triangles: Vec<[u32; 3]>,
}

impl CubePiece {
    fn new(of: &Triangles<'_>, piece: &[(Cube, u32)]) -> Self {
        let triangles = piece.iter().map(|(_, i)| of.rows[*i as usize]);
        let mut vertices: Vec<u32> = triangles.clone().flatten().collect();
        vertices.sort_unstable();
        vertices.dedup();
        let number = |v| to_u32(vertices.partition_point(|other| *other < v));
        let triangles = triangles.map(|triangle| triangle.map(number)).collect();
        let positions = vertices.iter().map(|v| of.positions[*v as usize]).collect();
        Self { vertices, positions, triangles }
    }

    /// Simplifies the piece to a `share` of its triangles, with the first error of [`TRIES`] that passes all checks:
    /// the result is a manifold with the same boundary, and vertices of the piece and centroids of the result are at
    /// most `error`, Å, away from the other.
    fn simplified(&self, error: f64, share: f64, side: CubeSide) -> CubeResult {
        let Some(before) = topology(&self.triangles) else { return CubeResult::default() };
        let in_mesh = |edge: &[u32; 2]| edge.map(|v| self.vertices[v as usize]);
        let original_chords = before.chords.iter().map(in_mesh).collect();
        let components = ClosedComponents::new(self, &before.fans);
        let original = TriangleGrid::new(self.triangles.iter().map(|t| self.corners(t)).collect(), side.cell());
        let found = TRIES.into_iter().find_map(|part| {
            let found = self.within(part * error, share)?;
            let after = topology(&found).filter(|after| after.fans == before.fans && after.euler == before.euler)?;
            if !components.remain_in(self, &found) {
                return None;
            }
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

    /// Returns the signed volume of each of `n` components, Å³.
    fn volumes(&self, triangles: &[[u32; 3]], of_vertex: &[u32], n: u32) -> Vec<f64> {
        let mut sums = vec![Component::default(); n as usize];
        for triangle in triangles {
            let sum = &mut sums[of_vertex[triangle[0] as usize] as usize];
            sum.add(self.corners(triangle).map(|corner| corner.map(f64::from)));
        }
        sums.into_iter().map(|sum| sum.volume).collect()
    }

    fn corners(&self, triangle: &[u32; 3]) -> Corners {
        triangle.map(|v| self.positions[v as usize])
    }

    /// Returns the triangles of the piece after meshoptimizer has simplified it with this error, Å, or to a `share` of
    /// its triangles; `None` if it removes none.
    fn within(&self, error: f64, share: f64) -> Option<Vec<[u32; 3]>> {
        let options = SimplifyOptions::LockBorder | SimplifyOptions::ErrorAbsolute;
        let stride = size_of::<[f32; 3]>();
        let vertices = VertexDataAdapter::new(bytemuck::cast_slice(&self.positions), stride, 0).ok()?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a small number")]
        let target = 3 * (share * self.triangles.len() as f64) as usize;
        #[expect(clippy::cast_possible_truncation, reason = "single precision is enough for an error")]
        let found = meshopt::simplify(self.triangles.as_flattened(), &vertices, target, error as f32, options, None);
        (found.len() < 3 * self.triangles.len()).then(|| found.as_chunks::<3>().0.to_vec())
    }
}

/// Closed components of a piece.
struct ClosedComponents {
    /// Component of each vertex of the piece.
    of_vertex: Vec<u32>,
    /// Signed volume of each component, Å³; `None` for those with a boundary.
    volumes: Vec<Option<f64>>,
}

impl ClosedComponents {
    fn new(piece: &CubePiece, fans: &BoundaryFans) -> Self {
        let mut sets = UnionFind::new(piece.vertices.len());
        for [a, b, c] in &piece.triangles {
            sets.union(*a, *b);
            sets.union(*a, *c);
        }
        let mut of_vertex = Vec::new();
        let n = sets.number_sets(&mut of_vertex);
        let open: FxHashSet<u32> = fans.keys().map(|[v, _]| of_vertex[*v as usize]).collect();
        let volumes = (0..).zip(piece.volumes(&piece.triangles, &of_vertex, n));
        let volumes = volumes.map(|(component, volume)| (!open.contains(&component)).then_some(volume)).collect();
        Self { of_vertex, volumes }
    }

    /// Returns true if the simplified triangles leave each closed component at least half of its volume.
    fn remain_in(&self, piece: &CubePiece, simplified: &[[u32; 3]]) -> bool {
        let after = piece.volumes(simplified, &self.of_vertex, to_u32(self.volumes.len()));
        let remains = |(before, after): (&Option<f64>, f64)| before.is_none_or(|before| after / before >= 0.5);
        self.volumes.iter().zip(after).all(remains)
    }
}

/// Returns simplified pieces to their original triangles until no two pieces have the same chord: their common edge
/// would have four triangles.
fn revert_conflicts(results: &mut [CubeResult]) {
    loop {
        let mut chords: Vec<([u32; 2], usize)> = Vec::new();
        for (n, result) in results.iter().enumerate() {
            let own = if result.triangles.is_some() { &result.chords } else { &result.original_chords };
            chords.extend(own.iter().map(|chord| (*chord, n)));
        }
        chords.par_sort_unstable();
        let mut reverted = Vec::new();
        for group in chords.chunk_by(|a, b| a.0 == b.0).filter(|group| group.len() > 1) {
            let simplified = group.iter().map(|(_, n)| *n).filter(|n| results[*n].triangles.is_some());
            // If the chord is new in all these pieces, the first of them stays simplified.
            let n_free = usize::from(group.iter().all(|(_, n)| results[*n].triangles.is_some()));
            reverted.extend(simplified.skip(n_free));
        }
        if reverted.is_empty() {
            return;
        }
        for n in reverted {
            results[n].triangles = None;
        }
    }
}

/// Removes unused vertices, and updates the ranges and measures of the parts.
fn compact(mesh: &mut Mesh, control: &Control<'_>) -> Result<(), SurfaceError> {
    let rows = mesh.drop_unused_vertices(control)?;
    for part in &mut mesh.parts {
        let [start, end] = [part.vertices.start, part.vertices.end].map(to_u32);
        part.vertices = rows.partition_point(|row| *row < start)..rows.partition_point(|row| *row < end);
    }
    let measured = mesh.parts.iter().map(|part| measure(mesh, part)).collect();
    mesh.parts = measured;
    Ok(())
}

/// Returns `part` with the area, volume and bounds of its triangles in `mesh`.
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
