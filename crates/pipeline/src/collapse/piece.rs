//! Simplification of a piece: the triangles of a cube.

use meshopt::{SimplifyOptions, VertexDataAdapter};
use molmesh_surface::Component;
use molmesh_surface::lattice::{to_f32, to_u32};
use molmesh_surface::triangle::Corners;
use molmesh_surface::triangle_grid::TriangleGrid;
use molmesh_surface::union_find::UnionFind;
use rustc_hash::FxHashSet;

use super::deviation::samples;
use super::fans::{BoundaryFans, topology};
use super::{Cube, CubeSide, Triangles};

/// Largest error that is passed to meshoptimizer, relative to the permitted error. Its error is an average, so the
/// largest distance exceeds it, and most results of a larger one would be rejected.
const MAX_SHARE_OF_PERMITTED: f64 = 0.7;
/// Number of errors that are tried even if they are smaller than [`MIN_TRIED_SPACINGS`].
const MIN_TRIES: usize = 3;
/// Largest error that is tried, in grid spacings: with larger ones, later pieces have large triangles and fail.
const MAX_TRIED_SPACINGS: f64 = 0.5;
/// Smallest error that is tried, in grid spacings.
const MIN_TRIED_SPACINGS: f64 = 1.0 / 16.0;

/// Returns the errors to pass to meshoptimizer one after another for a permitted error, Å, largest first. All permitted
/// errors share one sequence, so that a larger permitted error hardly ever leaves more triangles.
pub(super) fn errors(permitted: f64, spacing: f64) -> impl Iterator<Item = f64> {
    let largest = MAX_TRIED_SPACINGS * spacing;
    let steps = (largest / (MAX_SHARE_OF_PERMITTED * permitted)).log2().ceil().max(0.0);
    let first = largest * (-steps).exp2();
    let errors = std::iter::successors(Some(first), |error| Some(0.5 * error)).enumerate();
    errors
        .take_while(move |(n, error)| *n < MIN_TRIES || *error >= MIN_TRIED_SPACINGS * spacing)
        .map(|(_, error)| error)
}

/// Result of the simplification of a piece, with the vertex numbers of the mesh.
#[derive(Default)]
pub(super) struct CubeResult {
    /// Simplified triangles; `None` if the piece stays unchanged.
    pub(super) triangles: Option<Vec<[u32; 3]>>,
    /// Chords after the simplification: inner edges of the piece that join two vertices of its boundary.
    pub(super) chords: Vec<[u32; 2]>,
    /// Chords before the simplification.
    pub(super) original_chords: Vec<[u32; 2]>,
}

/// Piece: the triangles of a cube, with their vertices.
pub(super) struct CubePiece {
    /// Numbers of the vertices in the mesh, ascending.
    pub(super) vertices: Vec<u32>,
    /// Positions of these vertices, Å.
    pub(super) positions: Vec<[f32; 3]>,
    /// Triangles, as indices of `vertices`.
    pub(super) triangles: Vec<[u32; 3]>,
}

impl CubePiece {
    pub(super) fn new(mesh: &Triangles<'_>, piece: &[(Cube, u32)]) -> Self {
        let triangles = piece.iter().map(|(_, i)| mesh.rows[*i as usize]);
        let mut vertices: Vec<u32> = triangles.clone().flatten().collect();
        vertices.sort_unstable();
        vertices.dedup();
        let number = |v| to_u32(vertices.partition_point(|other| *other < v));
        let triangles = triangles.map(|triangle| triangle.map(number)).collect();
        let positions = vertices.iter().map(|v| mesh.positions[*v as usize]).collect();
        Self { vertices, positions, triangles }
    }

    /// Simplifies the piece to a `share` of its triangles, with the largest error of [`errors`] that passes all checks:
    /// the result is a manifold with the same boundary, no new triangle intersects another one, and samples of both
    /// surfaces are at most `permitted`, Å, away from the other.
    pub(super) fn simplified(&self, permitted: f64, share: f64, side: CubeSide) -> CubeResult {
        let Some(before) = topology(&self.triangles) else { return CubeResult::default() };
        let in_mesh = |edge: &[u32; 2]| edge.map(|v| self.vertices[v as usize]);
        let original_chords = before.chords.iter().map(in_mesh).collect();
        let components = ClosedComponents::new(self, &before.fans);
        let original = TriangleGrid::new(self.triangles.iter().map(|t| self.corners(t)).collect(), side.cell());
        let mut results = errors(permitted, side.spacing()).map_while(|error| self.run_simplifier(error, share));
        let checked = |found: Vec<[u32; 3]>| {
            let after = topology(&found).filter(|after| after.fans == before.fans && after.euler == before.euler)?;
            let is_new = self.is_new(&found);
            let simplified = TriangleGrid::new(found.iter().map(|t| self.corners(t)).collect(), side.cell());
            let is_valid = components.keep_volume(self, &found)
                && self.is_within(to_f32(permitted), &found, &is_new, [&original, &simplified], side)
                && simplified.intersections(&found, &is_new).is_empty();
            is_valid.then_some((found, after.chords))
        };
        let Some((found, chords)) = results.find_map(checked) else {
            return CubeResult { original_chords, ..CubeResult::default() };
        };
        CubeResult {
            triangles: Some(found.iter().map(|triangle| triangle.map(|v| self.vertices[v as usize])).collect()),
            chords: chords.iter().map(in_mesh).collect(),
            original_chords,
        }
    }

    /// Returns for each triangle of a result whether the piece does not have it.
    fn is_new(&self, found: &[[u32; 3]]) -> Vec<bool> {
        let from_lowest = |&[a, b, c]: &[u32; 3]| match a.min(b).min(c) {
            lowest if lowest == a => [a, b, c],
            lowest if lowest == b => [b, c, a],
            _ => [c, a, b],
        };
        let own: FxHashSet<[u32; 3]> = self.triangles.iter().map(from_lowest).collect();
        found.iter().map(|triangle| !own.contains(&from_lowest(triangle))).collect()
    }

    /// Returns true if samples of the piece and of a result are at most `error`, Å, away from the other. The grids are
    /// those of the piece and of the result.
    fn is_within(
        &self,
        error: f32,
        found: &[[u32; 3]],
        is_new: &[bool],
        [original, simplified]: [&TriangleGrid; 2],
        side: CubeSide,
    ) -> bool {
        let mut is_kept = vec![false; self.vertices.len()];
        found.iter().flatten().for_each(|v| is_kept[*v as usize] = true);
        let mut removed = self.positions.iter().zip(&is_kept).filter(|(_, is_kept)| !**is_kept);
        let mut new = found.iter().zip(is_new).filter(|(_, is_new)| **is_new);
        let mut near = 0;
        let removed_are_near = removed.all(|(point, _)| simplified.is_within(*point, error, &mut near));
        near = 0;
        removed_are_near
            && new.all(|(triangle, _)| {
                let mut samples = samples(*triangle, self.corners(triangle), to_f32(side.spacing()));
                samples.all(|point| original.is_within(point, error, &mut near))
            })
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
    fn run_simplifier(&self, error: f64, share: f64) -> Option<Vec<[u32; 3]>> {
        let options = SimplifyOptions::LockBorder | SimplifyOptions::ErrorAbsolute;
        let stride = size_of::<[f32; 3]>();
        let vertices = VertexDataAdapter::new(bytemuck::cast_slice(&self.positions), stride, 0).ok()?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a small number")]
        let target = 3 * (share * self.triangles.len() as f64) as usize;
        let found = meshopt::simplify(self.triangles.as_flattened(), &vertices, target, to_f32(error), options, None);
        (found.len() < 3 * self.triangles.len()).then(|| found.as_chunks::<3>().0.to_vec())
    }
}

/// Closed components of a piece.
pub(super) struct ClosedComponents {
    /// Component of each vertex of the piece.
    of_vertex: Vec<u32>,
    /// Signed volume of each component, Å³; `None` for those with a boundary.
    volumes: Vec<Option<f64>>,
}

impl ClosedComponents {
    pub(super) fn new(piece: &CubePiece, fans: &BoundaryFans) -> Self {
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
    pub(super) fn keep_volume(&self, piece: &CubePiece, simplified: &[[u32; 3]]) -> bool {
        let after = piece.volumes(simplified, &self.of_vertex, to_u32(self.volumes.len()));
        let remains = |(before, after): (&Option<f64>, f64)| before.is_none_or(|before| after / before >= 0.5);
        self.volumes.iter().zip(after).all(remains)
    }
}
