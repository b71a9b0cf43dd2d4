//! Improvement of the triangles of a mesh: few small angles, vertices on the surface.
//!
//! Marching cubes leaves slivers where the surface passes near a grid point. Short edges are collapsed, edges are
//! flipped, and vertices are moved in their tangent plane and then along the gradient back to the surface (Botsch and
//! Kobbelt, A Remeshing Approach to Multiresolution Modeling, SGP 2004).
//!
//! Space is divided into cubes. The vertices in the interior of a cube are free; the others stay, with the triangles
//! between them. Triangles that change in one cube share no point with those that change in another, so cubes are
//! independent. Each pass shifts the cubes; every vertex is free in at least one pass. Each operation keeps a closed
//! manifold. After them, the triangles of a cube are searched for intersections; if there are any, the cube is improved
//! again without the vertices of the intersecting triangles.

mod cube;
mod patch;
mod shapes;

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use self::cube::{CubeMesh, CubeResult, MovedVertex};
pub use self::shapes::TriangleShapes;
use super::control::{Control, Stage};
use super::cpu::points::PointField;
use super::error::SurfaceError;
use super::lattice::{to_f32, to_i32, to_u32};
use super::mesh::Mesh;
use super::params::{SurfaceLimits, SurfaceParams};
use super::spheres::Spheres;
use super::triangle::Vector;
use crate::named;

/// Edge length of a cube, spacings.
const SIDE: i32 = 24;
/// Shift of the cubes in each pass, spacings.
const SHIFTS: [i32; 4] = [0, 12, 6, 18];
/// Distance of free vertices from the walls of their cube, spacings: more than the longest edge. It is less than an
/// eighth of [`SIDE`], so along each axis, a vertex is near a wall in at most one of the four passes: it is free in
/// one.
const MARGIN: i32 = 2;
/// Distance from a cube within which triangles with a vertex there may intersect triangles that change, spacings.
const AROUND: i32 = 1;
/// Memory per triangle of the mesh, bytes: the list of cubes, the results of all cubes, and open patches.
pub const TRIANGLE_BYTES: u64 = 96;

/// Quality of the triangles of a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TriangleQuality {
    /// Triangles of marching cubes.
    #[default]
    Standard,
    /// Triangles with few small angles.
    High,
}

named!(TriangleQuality, Standard => "standard", High => "high");

/// Position of a cube, in edge lengths.
type CubeIndex = [i32; 3];

/// Improves `mesh`, the closed mesh of `spheres`. `params` are those of the mesh, which is not quantized.
///
/// # Errors
/// Those of preparing the field, [`SurfaceError::Memory`] and [`SurfaceError::Cancelled`].
pub fn improve(
    mesh: &mut Mesh,
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
    mesh.make_contiguous();
    let _patches = control.reserve(TRIANGLE_BYTES * mesh.n_triangles() as u64)?;
    // The memory of the field ends with this function.
    let metered = control.metered();
    let field = PointField::new(spheres, params, limits, &metered)?;
    for (pass, shift) in SHIFTS.into_iter().enumerate() {
        let division = Cubes { field: &field, spacing: params.resolution, shift };
        let by_cube = division.by_cube(mesh, control)?;
        let cubes: Vec<&[(CubeIndex, u32)]> = by_cube.chunk_by(|a, b| a.0 == b.0).collect();
        let done = AtomicUsize::new(pass * cubes.len());
        let improved = |entries: &&[(CubeIndex, u32)]| {
            let n_done = done.fetch_add(1, Ordering::Relaxed);
            control.observer.progress(Stage::Improve, n_done, SHIFTS.len() * cubes.len());
            CubeMesh::new(&division, mesh, entries).improved(control)
        };
        let results = cubes.par_iter().map(improved).collect::<Result<Vec<_>, SurfaceError>>()?;
        apply(mesh, results);
    }
    mesh.drop_unused_vertices(control)?;
    Ok(())
}

/// Writes the changes of all cubes to the mesh.
fn apply(mesh: &mut Mesh, results: Vec<CubeResult>) {
    const REMOVED: [u32; 3] = [u32::MAX; 3];
    for CubeResult { numbers, triangles, vertices } in results {
        for (number, triangle) in numbers.into_iter().zip(triangles) {
            mesh.triangles[number as usize] = triangle.unwrap_or(REMOVED);
        }
        for MovedVertex { number, position, normal, sphere } in vertices {
            mesh.positions[number as usize] = position;
            mesh.normals[number as usize] = normal;
            if let (Some(ids), Some(sphere)) = (&mut mesh.atom_ids, sphere) {
                ids[number as usize] = sphere;
            }
        }
    }
    let kept: Vec<[u32; 3]> = mesh.triangles.iter().copied().filter(|row| *row != REMOVED).collect();
    mesh.triangles = kept.into();
}

/// Division of space into cubes, in one pass.
struct Cubes<'a> {
    field: &'a PointField,
    /// Grid spacing, Å.
    spacing: f64,
    /// Shift of the cubes, spacings.
    shift: i32,
}

impl Cubes<'_> {
    /// Returns a position in spacings from a grid point.
    fn to_spacings(&self, position: Vector, origin: [i32; 3]) -> Vector {
        let centre = self.field.centre();
        std::array::from_fn(|k| to_f32(f64::from(position[k]) / self.spacing + f64::from(centre[k] - origin[k])))
    }

    /// Returns a position in Å relative to the centre of the mesh.
    fn position(&self, point: Vector, origin: [i32; 3]) -> Vector {
        let centre = self.field.centre();
        std::array::from_fn(|k| to_f32((f64::from(point[k]) + f64::from(origin[k] - centre[k])) * self.spacing))
    }

    /// Returns the grid points at the ends of a cube.
    fn ends(&self, cube: CubeIndex) -> [[i32; 3]; 2] {
        [0, 1].map(|end| cube.map(|c| (c + end) * SIDE - self.shift))
    }

    /// Returns the cubes that contain a vertex or are within [`AROUND`] of it.
    fn cubes_of(&self, position: Vector) -> impl Iterator<Item = CubeIndex> {
        let point = self.to_spacings(position, [0; 3]);
        let along = |k: usize, margin: i32| {
            let c = f64::from(point[k]) + f64::from(self.shift + margin);
            to_i32((c / f64::from(SIDE)).floor())
        };
        let range = |k: usize| along(k, -AROUND)..=along(k, AROUND);
        let [x, y, z] = [range(0), range(1), range(2)];
        z.flat_map(move |z| {
            y.clone().flat_map({
                let x = x.clone();
                move |y| x.clone().map(move |x| [x, y, z])
            })
        })
    }

    /// Returns each triangle with each cube that it belongs to or is near, sorted.
    fn by_cube(&self, mesh: &Mesh, control: &Control<'_>) -> Result<Vec<(CubeIndex, u32)>, SurfaceError> {
        control.check()?;
        let entries = |(i, row): (usize, &[u32; 3])| {
            let mut cubes: Vec<CubeIndex> =
                row.iter().flat_map(|v| self.cubes_of(mesh.positions[*v as usize])).collect();
            cubes.sort_unstable();
            cubes.dedup();
            cubes.into_iter().map(move |cube| (cube, to_u32(i)))
        };
        let rows: &[[u32; 3]] = &mesh.triangles;
        let mut sorted: Vec<(CubeIndex, u32)> = rows.par_iter().enumerate().flat_map_iter(entries).collect();
        super::checked_sort::sort(&mut sorted, Ord::cmp, control)?;
        Ok(sorted)
    }
}
