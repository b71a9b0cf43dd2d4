//! Simplification of a mesh: fewer triangles, near the original surface.
//!
//! Space is divided into cubes, and the triangles whose centroids lie in one cube form a piece. meshoptimizer
//! simplifies each piece on its own (quadric error metric, Garland and Heckbert 1997) and does not change the boundary
//! of the piece. A second pass with shifted cubes simplifies the triangles at the boundaries of the first pass. The
//! vertices that remain are vertices of the original mesh, with their normals, colours and atom indices.
//!
//! meshoptimizer can join two sheets of a surface at a vertex or an edge, which would not be a manifold. So each result
//! is checked: it must be a manifold with the same boundary as the piece, so that a closed manifold mesh remains one.
//! It must keep the volumes of closed components, its triangles must not intersect, and it must be near the piece. A
//! piece that fails is simplified with a smaller error; if all errors fail, it stays unchanged. Two pieces can also
//! both create the same edge between two vertices of their boundaries. Then only one of them is simplified.

mod deviation;
mod fans;
mod piece;

use std::ops::Range;

use molmesh_surface::lattice::{to_f32, to_i32, to_u32};
use molmesh_surface::limit::{Exceeded, Limit};
use molmesh_surface::mesh::bounds_of;
use molmesh_surface::params::bad;
use molmesh_surface::triangle::{Corners, centroid};
use molmesh_surface::{Component, Control, Mesh, PartRange, SurfaceError};
use rayon::prelude::*;

pub use self::deviation::SimplificationReport;
use self::piece::{CubePiece, CubeResult};

/// Smallest and largest value of the parameter `simplify`, Å.
pub const SIMPLIFY_ERRORS: [f64; 2] = [0.001, 10.0];

/// Shifts of the cubes in each pass, in edge lengths. The passes after [`MIN_PASSES`] run only while the mesh has too
/// many triangles.
const SHIFTS: [f64; 4] = [0.0, 0.5, 0.25, 0.75];
/// Number of passes without a limit on triangles.
const MIN_PASSES: usize = 2;

/// Edge length of a cube, in grid spacings. A piece then has some thousand triangles.
const SIDE: f64 = 24.0;
/// Largest error, in grid spacings. Above one, the number of triangles hardly changes.
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

/// Edge length of the cubes, Å.
#[derive(Debug, Clone, Copy)]
struct CubeSide(f64);

impl CubeSide {
    /// Returns the grid spacing, Å.
    fn spacing(self) -> f64 {
        self.0 / SIDE
    }

    /// Returns the edge length of a cell of a [`super::triangle_grid::TriangleGrid`], Å: two grid spacings, so that a
    /// cell has few triangles.
    fn cell(self) -> f32 {
        to_f32(2.0 * self.spacing())
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

/// Simplifies `mesh`. Each pass may move the surface by up to the error of `wanted`, measured at samples. `spacing` is
/// the grid spacing of the mesh, Å. Each part is simplified on its own, and its area, volume and bounds are measured
/// again.
///
/// # Errors
/// Returns the errors of [`check_error`], [`SurfaceError::Limit`] if the error is too small for the limit on triangles,
/// [`SurfaceError::Memory`] and [`SurfaceError::Cancelled`].
pub(crate) fn simplify(
    mesh: &mut Mesh,
    wanted: Simplify,
    spacing: f64,
    control: &Control<'_>,
) -> Result<SimplificationReport, SurfaceError> {
    let Simplify { error, max_triangles } = wanted;
    check_error(error, spacing)?;
    mesh.make_contiguous();
    let memory = control.reserve(TRIANGLE_BYTES * mesh.n_triangles() as u64)?;
    let positions: Vec<[f32; 3]> = (0..mesh.n_vertices()).into_par_iter().map(|v| mesh.position(v)).collect();
    let (rows, parts) = (mesh.triangles.to_vec(), part_ranges(mesh));
    let before = Triangles { positions: &positions, rows: &rows, parts: &parts };
    let side = CubeSide(SIDE * spacing);
    let mut n_passes = 0;
    for (pass, shift) in SHIFTS.into_iter().enumerate() {
        let excess = max_triangles.map_or(f64::INFINITY, |limit| mesh.n_triangles() as f64 / limit as f64);
        if excess <= 1.0 || pass >= MIN_PASSES && max_triangles.is_none() {
            break;
        }
        n_passes += 1;
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
        let subject = format!("after simplification with an error of {error} Å, the mesh").into();
        // Above one grid spacing, a larger error hardly changes the number of triangles.
        let larger = if error < spacing { "a larger simplify or " } else { "" };
        let hint = Some(format!("{larger}a coarser resolution").into());
        let exceeded = Exceeded { subject, actual: Some(triangles), hint, ..Exceeded::new(Limit::Triangles, limit) };
        return Err(Exceeded { resolution: Some(spacing), ..exceeded }.error());
    }
    let parts = part_ranges(mesh);
    let after = Triangles { positions: &positions, rows: &mesh.triangles, parts: &parts };
    let report = SimplificationReport::sampled(before, after, error * f64::from(n_passes), side, control)?;
    drop((rows, positions, memory));
    compact(mesh, control)?;
    Ok(report)
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
        molmesh_surface::checked_sort::sort(&mut sorted, Ord::cmp, control)?;
        Ok(sorted)
    }
}

/// Returns the part of a triangle; 0 without parts.
fn part_of(parts: &[Range<usize>], triangle: usize) -> u32 {
    to_u32(parts.partition_point(|rows| rows.end <= triangle).min(parts.len().saturating_sub(1)))
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
