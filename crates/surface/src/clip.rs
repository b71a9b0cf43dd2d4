//! Part of a mesh within a box of grid cells.

use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::column::Column;
use super::control::Control;
use super::error::SurfaceError;
use super::kernel::Shape;
use super::lattice::{effective_radius, to_f32, to_u32};
use super::mesh::Mesh;
use super::params::SurfaceParams;
use super::spheres::Spheres;

/// Triangles that one task tests.
const TESTED: usize = 1 << 14;

/// Returns a distance, Å: spheres whose centres are farther away from a point do not affect the surface there.
#[must_use]
pub fn influence(spheres: &Spheres, params: &SurfaceParams) -> f64 {
    influence_of(spheres.radius_range().1, params)
}

/// Returns the distance of [`influence`] for spheres whose largest radius is `radius`, Å.
#[must_use]
pub fn influence_of(radius: f32, params: &SurfaceParams) -> f64 {
    let shape = Shape::new(params);
    let length = shape.length(effective_radius(radius, params));
    match shape {
        Shape::Density(_) => shape.reach(length),
        // The nearest point of the boundary is at most the radius of the probe away, and so is each sphere that could
        // cover it at most one enlarged radius from there.
        Shape::Sphere { enlarged } => enlarged + length,
    }
}

impl Mesh {
    /// Keeps the triangles in the box from `low` to `high`, Å, whose faces are planes of the grid. The middle of the
    /// box becomes the centre of the mesh. Boxes that share a face divide the mesh without gaps and overlaps, because a
    /// triangle lies in one cell of the grid.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub fn clip(&mut self, [low, high]: [[f64; 3]; 2], control: &Control<'_>) -> Result<(), SurfaceError> {
        self.make_contiguous();
        let positions = &self.positions[..];
        let inside = |triangle: &&[u32; 3]| {
            let corners = triangle.map(|v| positions[v as usize]);
            (0..3).all(|k| {
                let middle = self.centre[k] + corners.iter().map(|p| f64::from(p[k])).sum::<f64>() / 3.0;
                (low[k]..high[k]).contains(&middle)
            })
        };
        let kept = |some: &[[u32; 3]]| some.iter().filter(inside).copied().collect::<Column<_>>();
        self.triangles = Column::from_chunks(self.triangles.par_chunks(TESTED).map(kept).collect());
        self.drop_unused_vertices(control)?;
        let centre: [f64; 3] = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
        for position in self.positions.iter_mut() {
            *position = std::array::from_fn(|k| to_f32(f64::from(position[k]) + self.centre[k] - centre[k]));
        }
        self.centre = centre;
        Ok(())
    }

    /// Returns the directed edges on the boundary of a clipped mesh with the grid spacing `spacing`. The faces of its
    /// box are at a distance of `half` from the centre. Lengths are in Å.
    pub fn boundary(&self, half: f64, spacing: f64) -> Vec<[u32; 2]> {
        // Vertices that are not on a face are at least 1/1024 of a spacing away from it.
        let near = half - 2e-4 * spacing;
        // Faces on which each vertex lies, as bits.
        let faces_of = |p: &[f32; 3]| {
            let faces = p.iter().flat_map(|c| [f64::from(*c) > near, f64::from(-*c) > near]);
            faces.fold(0_u8, |bits, on_face| bits << 1 | u8::from(on_face))
        };
        let faces: Vec<u8> = self.positions.iter().map(faces_of).collect();
        let on_same_face = |[a, b]: &[u32; 2]| faces[*a as usize] & faces[*b as usize] != 0;
        let edges = |[a, b, c]: &[u32; 3]| [[*a, *b], [*b, *c], [*c, *a]];
        let on_face = self.triangles.iter().flat_map(edges).filter(on_same_face);
        let on_face: FxHashSet<[u32; 2]> = on_face.collect();
        let mut boundary: Vec<[u32; 2]> =
            on_face.iter().copied().filter(|[a, b]| !on_face.contains(&[*b, *a])).collect();
        boundary.sort_unstable();
        boundary
    }

    /// Adds skirts to a clipped mesh with this boundary. A skirt is a strip of triangles from an edge of the boundary
    /// into the molecule, one grid spacing deep, cut off at the faces of the box, which are at a distance of `half`
    /// from the centre. It hides the gap to an adjacent mesh with another spacing. Lengths are in Å.
    pub fn add_skirts(&mut self, boundary: &[[u32; 2]], half: f64, spacing: f64) {
        let mut upper: Vec<u32> = boundary.as_flattened().to_vec();
        upper.sort_unstable();
        upper.dedup();
        let n = self.n_vertices();
        let lower = |v: u32| to_u32(n + upper.partition_point(|other| *other < v));
        let strips = boundary.iter().flat_map(|[a, b]| [[*b, *a, lower(*a)], [*b, lower(*a), lower(*b)]]);
        self.triangles.append(strips.collect());
        self.take_vertices(&(0..to_u32(n)).chain(upper.iter().copied()).collect::<Vec<_>>());
        for v in n..self.n_vertices() {
            let normal = self.normals[v];
            let position = &mut self.positions[v];
            for k in 0..3 {
                position[k] = (position[k] - to_f32(spacing) * normal[k]).clamp(-to_f32(half), to_f32(half));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Backend, CpuBackend, Measures, SurfaceLimits, SurfaceOptions, Validation};

    #[test]
    fn skirts_close_the_edges_of_a_clipped_mesh() {
        // The centre lies outside the box, so skirts at the nearest face would leave it.
        let spheres = Spheres::new(vec![3.0], vec![0.5], vec![-1.0], vec![4.0]).unwrap();
        let options = SurfaceOptions { resolution: Some(0.5), ..SurfaceOptions::default() };
        let params = SurfaceParams::new(&options).unwrap();
        let run = CpuBackend::default().run(&spheres, &params, &SurfaceLimits::default(), &Control::default());
        let whole = run.unwrap().mesh;
        let mut mesh = whole.clone();
        mesh.clip([[-2.0; 3], [2.0; 3]], &Control::default()).unwrap();
        assert!(mesh.n_triangles() > 100 && mesh.n_triangles() < whole.n_triangles() / 2);
        let open = |mesh: &Mesh| {
            let edges = |[a, b, c]: &[u32; 3]| [[*a, *b], [*b, *c], [*c, *a]];
            let all: FxHashSet<[u32; 2]> = mesh.triangles.iter().flat_map(edges).collect();
            all.iter().filter(|[a, b]| !all.contains(&[*b, *a])).copied().collect::<FxHashSet<_>>()
        };
        let (before, n_vertices, n_triangles) = (open(&mesh), mesh.n_vertices(), mesh.n_triangles());
        assert!(before.len() > 20);
        let boundary = mesh.boundary(2.0, 0.5);
        assert_eq!(boundary.iter().copied().collect::<FxHashSet<_>>(), before);
        let control = Control::default();
        let [part, exact] =
            [Measures::of_part(&mesh, before.len(), &control), Measures::of(&mesh, Validation::Exact, &control)];
        let (part, exact) = (part.unwrap(), exact.unwrap());
        assert_eq!((part.euler, part.closed, part.oriented, part.manifold), (exact.euler, false, true, false));
        assert_eq!((exact.closed, exact.oriented, exact.manifold, part.area), (false, true, false, exact.area));
        mesh.add_skirts(&boundary, 2.0, 0.5);
        assert_eq!(mesh.n_triangles(), n_triangles + 2 * before.len());
        // All open edges are now those of the skirts.
        assert!(open(&mesh).iter().all(|edge| edge.iter().any(|v| *v as usize >= n_vertices)));
        // They are a spacing deep, but do not leave the box.
        let (mut n_cut, mut n_deep) = (0, 0);
        for v in n_vertices..mesh.n_vertices() {
            let p: [f64; 3] = std::array::from_fn(|k| mesh.centre[k] + f64::from(mesh.position(v)[k]));
            assert!(p.iter().all(|c| c.abs() <= 2.0), "{p:?}");
            let radius = ((p[0] - 3.0).powi(2) + (p[1] - 0.5).powi(2) + (p[2] + 1.0).powi(2)).sqrt();
            let is_deep = (radius - 3.5).abs() < 0.02;
            assert!(is_deep || (3.5..4.02).contains(&radius) && p.iter().any(|c| c.abs() > 1.999), "{p:?}: {radius}");
            (n_cut, n_deep) = (n_cut + usize::from(!is_deep), n_deep + usize::from(is_deep));
        }
        assert!(n_cut > 0 && n_deep > 0, "{n_cut} {n_deep}");
    }
}
