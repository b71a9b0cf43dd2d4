//! Triangles of a cube, with their surroundings, and their improvement.

use super::patch::Patch;
use super::{CubeIndex, Cubes, MARGIN, SIDE};
use crate::control::Control;
use crate::cpu::points::NearbySpheres;
use crate::error::SurfaceError;
use crate::lattice::{to_f32, to_u32};
use crate::mesh::Mesh;
use crate::triangle::Vector;
use crate::triangle_grid::TriangleGrid;

/// Number of rounds of collapses, flips and moves.
const ROUNDS: usize = 3;
/// Number of attempts to improve a cube without intersections.
const ATTEMPTS: usize = 6;
/// Maximum number of steps of Newton's method for a vertex.
const NEWTON_STEPS: usize = 3;
/// Maximum length of a step, spacings.
const MAX_STEP: f32 = 0.5;
/// Maximum distance of a moved vertex from the surface, spacings.
const TOLERANCE: f32 = 2e-3;

/// Changes of a cube, in the numbers of the mesh.
#[derive(Default)]
pub(super) struct CubeResult {
    /// Numbers of the triangles that may have changed, ascending.
    pub(super) numbers: Vec<u32>,
    /// These triangles; `None` for removed ones.
    pub(super) triangles: Vec<Option<[u32; 3]>>,
    pub(super) vertices: Vec<MovedVertex>,
}

/// Vertex that was moved.
pub(super) struct MovedVertex {
    pub(super) number: u32,
    pub(super) position: Vector,
    pub(super) normal: Vector,
    /// Nearest sphere, if requested.
    pub(super) sphere: Option<u32>,
}

/// Triangles of a cube, with vertex numbers of their own.
pub(super) struct CubeMesh<'a> {
    cubes: &'a Cubes<'a>,
    mesh: &'a Mesh,
    /// Grid points at the ends of the cube.
    ends: [[i32; 3]; 2],
    /// Numbers of the vertices in the mesh, ascending.
    vertices: Vec<u32>,
    /// Positions, Å.
    points: Vec<Vector>,
    /// True for the vertices in the interior of the cube.
    free: Vec<bool>,
    /// Triangles with a free vertex, then the others.
    triangles: Vec<[u32; 3]>,
    /// Numbers in the mesh of the triangles with a free vertex.
    numbers: Vec<u32>,
}

impl<'a> CubeMesh<'a> {
    /// Collects the triangles of a cube from the entries of [`Cubes::by_cube`].
    pub(super) fn new(cubes: &'a Cubes<'a>, mesh: &'a Mesh, entries: &[(CubeIndex, u32)]) -> Self {
        let ends = cubes.ends(entries[0].0);
        let rows = || entries.iter().map(|(_, i)| mesh.triangles[*i as usize]);
        let mut vertices: Vec<u32> = rows().flatten().collect();
        vertices.sort_unstable();
        vertices.dedup();
        let points: Vec<Vector> = vertices.iter().map(|v| mesh.positions[*v as usize]).collect();
        let free: Vec<bool> = points.iter().map(|p| is_inside(cubes.to_spacings(*p, ends[0]))).collect();
        let number = |v| to_u32(vertices.partition_point(|other| *other < v));
        let rows = rows().map(|row| row.map(number)).zip(entries);
        let (own, context): (Vec<_>, Vec<_>) = rows.partition(|(row, _)| row.iter().any(|v| free[*v as usize]));
        let numbers = own.iter().map(|(_, (_, number))| *number).collect();
        let triangles = own.into_iter().chain(context).map(|(row, _)| row).collect();
        Self { cubes, mesh, ends, vertices, points, free, triangles, numbers }
    }

    /// Improves the cube. If all attempts fail, it stays unchanged.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub(super) fn improved(mut self, control: &Control<'_>) -> Result<CubeResult, SurfaceError> {
        if self.numbers.is_empty() {
            return Ok(CubeResult::default());
        }
        let mut near = self.cubes.field.near(self.ends);
        for _attempt in 0..ATTEMPTS {
            let mut patch = self.patch();
            for _ in 0..ROUNDS {
                control.check()?;
                patch.collapse();
                patch.flip();
                self.smooth(&mut patch, &mut near);
                patch.flip();
            }
            let frozen = self.intersecting(&patch);
            if frozen.is_empty() {
                return Ok(self.result(&patch, &mut near));
            }
            if !frozen.iter().any(|v| self.free[*v as usize]) {
                break;
            }
            for v in frozen {
                self.free[v as usize] = false;
            }
        }
        Ok(CubeResult::default())
    }

    fn patch(&self) -> Patch {
        let normals = self.vertices.iter().map(|v| self.mesh.normals[*v as usize]).collect();
        let (triangles, spacing) = (self.triangles.clone(), to_f32(self.cubes.spacing));
        Patch::new(self.points.clone(), normals, self.free.clone(), triangles, self.numbers.len(), spacing)
    }

    /// Moves the free vertices.
    fn smooth(&self, patch: &mut Patch, near: &mut NearbySpheres) {
        let (cubes, origin) = (self.cubes, self.ends[0]);
        let (vertices, targets) = patch.smoothed();
        let mut points: Vec<Vector> = targets.into_iter().map(|p| cubes.to_spacings(p, origin)).collect();
        let mut samples = cubes.field.evaluate(near, &points);
        for _ in 0..NEWTON_STEPS {
            for (point, sample) in points.iter_mut().zip(&samples) {
                if sample.is_finite() {
                    let step = sample.depth.clamp(-MAX_STEP, MAX_STEP);
                    *point = std::array::from_fn(|k| point[k] + step * sample.normal[k]);
                }
            }
            samples = cubes.field.evaluate(near, &points);
        }
        for ((v, point), sample) in vertices.into_iter().zip(points).zip(samples) {
            if sample.is_finite() && sample.depth.abs() <= TOLERANCE && is_inside(point) {
                patch.move_vertex(v, cubes.position(point, origin), sample.normal);
            }
        }
    }

    /// Returns the vertices of triangles that intersect and were changed.
    fn intersecting(&self, patch: &Patch) -> Vec<u32> {
        let kept = patch.triangles.iter().enumerate().filter_map(|(i, row)| Some((i, (*row)?)));
        let (indices, rows): (Vec<usize>, Vec<[u32; 3]>) = kept.unzip();
        let is_changed = |(i, row): (&usize, &[u32; 3])| {
            *row != self.triangles[*i] || row.iter().any(|v| patch.is_moved[*v as usize])
        };
        let changed: Vec<bool> = indices.iter().zip(&rows).map(is_changed).collect();
        let corners = rows.iter().map(|row| row.map(|v| patch.points[v as usize])).collect();
        let pairs = TriangleGrid::new(corners, to_f32(self.cubes.spacing)).intersections(&rows, &changed);
        let of_pairs = pairs.into_iter().flatten().filter(|i| changed[*i]);
        of_pairs.flat_map(|i| rows[i].into_iter().chain(self.triangles[indices[i]])).collect()
    }

    /// Returns the changes of a patch.
    fn result(self, patch: &Patch, near: &mut NearbySpheres) -> CubeResult {
        let (cubes, origin) = (self.cubes, self.ends[0]);
        let moved: Vec<usize> = (0..self.points.len()).filter(|v| patch.is_moved[*v]).collect();
        let spheres = self.mesh.atom_ids.as_ref().map(|_| {
            let points: Vec<Vector> = moved.iter().map(|v| cubes.to_spacings(patch.points[*v], origin)).collect();
            cubes.field.nearest_spheres(near, &points)
        });
        let of_vertex = |(i, v): (usize, &usize)| MovedVertex {
            number: self.vertices[*v],
            position: patch.points[*v],
            normal: patch.normals[*v],
            sphere: spheres.as_ref().map(|spheres| spheres[i]),
        };
        let vertices = moved.iter().enumerate().map(of_vertex).collect();
        let in_mesh = |row: &Option<[u32; 3]>| row.map(|row| row.map(|v| self.vertices[v as usize]));
        let triangles = patch.triangles[..self.numbers.len()].iter().map(in_mesh).collect();
        CubeResult { numbers: self.numbers, triangles, vertices }
    }
}

/// Returns true if a vertex at a point, in spacings relative to the lower end of its cube, is free.
fn is_inside(point: Vector) -> bool {
    let (low, high) = (MARGIN as f32, (SIDE - MARGIN) as f32);
    point.iter().all(|c| (low..high).contains(c))
}
