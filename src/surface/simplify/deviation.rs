//! Distance between a mesh and its simplification, at samples on both.

use rayon::prelude::*;

use super::{Cube, by_cube};
use crate::surface::control::Control;
use crate::surface::error::SurfaceError;
use crate::surface::mesh::Mesh;

/// Samples per cube and direction.
const SAMPLES: usize = 32;

/// Distance between two surfaces, at samples on both: vertices of the original, and centroids of triangles of the
/// simplified mesh.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Deviation {
    /// Largest distance, Å.
    pub maximum: f64,
    /// Mean distance, Å.
    pub mean: f64,
}

/// Sum and maximum of distances.
#[derive(Clone, Copy, Default)]
struct Distances {
    sum: f64,
    maximum: f64,
    n: u32,
}

impl Distances {
    fn with(self, other: Self) -> Self {
        Self { sum: self.sum + other.sum, maximum: self.maximum.max(other.maximum), n: self.n + other.n }
    }
}

impl Deviation {
    /// Measures the distance between `mesh` and the triangles `before`, which share its vertices.
    pub(super) fn sampled(
        mesh: &Mesh,
        before: &[[u32; 3]],
        side: f64,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let original = Surface { mesh, triangles: before, by_cube: by_cube(mesh, before, side, 0.0, control)? };
        let simplified =
            Surface { mesh, triangles: &mesh.triangles, by_cube: by_cube(mesh, &mesh.triangles, side, 0.0, control)? };
        let cubes: Vec<Cube> = original.by_cube.chunk_by(|a, b| a.0 == b.0).map(|cube| cube[0].0).collect();
        let of_cube = |cube: &Cube| {
            control.check()?;
            let vertices = original.samples(*cube, |corners| corners[0]);
            let centroids = simplified.samples(*cube, |[a, b, c]| std::array::from_fn(|k| (a[k] + b[k] + c[k]) / 3.0));
            Ok(simplified.distances(*cube, &vertices).with(original.distances(*cube, &centroids)))
        };
        let of_cubes = cubes.par_iter().map(of_cube).collect::<Result<Vec<_>, SurfaceError>>()?;
        let Distances { sum, maximum, n } = of_cubes.into_iter().fold(Distances::default(), Distances::with);
        Ok(Self { maximum, mean: sum / f64::from(n.max(1)) })
    }
}

/// Triangles by cube.
struct Surface<'a> {
    mesh: &'a Mesh,
    triangles: &'a [[u32; 3]],
    by_cube: Vec<(Cube, u32)>,
}

impl Surface<'_> {
    /// Returns the corners of the triangles of a cube.
    fn of(&self, cube: Cube) -> impl ExactSizeIterator<Item = [[f32; 3]; 3]> + Clone {
        let [start, end] = [
            self.by_cube.partition_point(|(other, _)| *other < cube),
            self.by_cube.partition_point(|(other, _)| *other <= cube),
        ];
        self.by_cube[start..end].iter().map(|(_, i)| self.corners(self.triangles[*i as usize]))
    }

    fn corners(&self, triangle: [u32; 3]) -> [[f32; 3]; 3] {
        triangle.map(|v| self.mesh.position(v as usize))
    }

    /// Returns samples of the triangles of a cube.
    fn samples(&self, cube: Cube, point: impl Fn([[f32; 3]; 3]) -> [f32; 3]) -> Vec<[f32; 3]> {
        let triangles = self.of(cube);
        let step = triangles.len().div_ceil(SAMPLES).max(1);
        triangles.step_by(step).map(point).collect()
    }

    /// Returns the distances of points in a cube from the triangles of this cube and its neighbours.
    fn distances(&self, (part, [x, y, z]): Cube, points: &[[f32; 3]]) -> Distances {
        let steps = || -1..=1;
        let cubes = steps().flat_map(|dx| steps().flat_map(move |dy| steps().map(move |dz| [x + dx, y + dy, z + dz])));
        // The own cube first: its triangles are near, so that most others are too far away.
        let mut nearest = vec![f32::INFINITY; points.len()];
        let add = |nearest: &mut [f32], corners: [[f32; 3]; 3]| {
            for (nearest, point) in nearest.iter_mut().zip(points) {
                if box_distance2(*point, corners) < *nearest {
                    *nearest = nearest.min(distance2(*point, corners));
                }
            }
        };
        for cube in std::iter::once([x, y, z]).chain(cubes.filter(|cube| *cube != [x, y, z])) {
            self.of((part, cube)).for_each(|corners| add(&mut nearest, corners));
        }
        if nearest.iter().any(|distance2| distance2.is_infinite()) {
            self.triangles.iter().for_each(|triangle| add(&mut nearest, self.corners(*triangle)));
        }
        let mut distances = Distances::default();
        for distance in nearest.into_iter().map(|distance2| f64::from(distance2).sqrt()) {
            distances = distances.with(Distances { sum: distance, maximum: distance, n: 1 });
        }
        distances
    }
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

/// Returns the squared distance of a point from the bounding box of a triangle.
fn box_distance2(p: [f32; 3], [a, b, c]: [[f32; 3]; 3]) -> f32 {
    let gap = |k: usize| {
        let (low, high) = (a[k].min(b[k]).min(c[k]), a[k].max(b[k]).max(c[k]));
        (low - p[k]).max(p[k] - high).max(0.0)
    };
    let gaps = std::array::from_fn(gap);
    dot(gaps, gaps)
}

/// Returns the squared distance of a point from a triangle.
fn distance2(p: [f32; 3], [a, b, c]: [[f32; 3]; 3]) -> f32 {
    let (u, v, w) = (sub(b, a), sub(c, a), sub(p, a));
    let [uu, uv, vv] = [dot(u, u), dot(u, v), dot(v, v)];
    let (wu, wv) = (dot(w, u), dot(w, v));
    let area = uu * vv - uv * uv;
    if area > 0.0 {
        let (s, t) = ((vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area);
        if s >= 0.0 && t >= 0.0 && s + t <= 1.0 {
            let off: [f32; 3] = std::array::from_fn(|k| w[k] - s * u[k] - t * v[k]);
            return dot(off, off);
        }
    }
    [(a, b), (b, c), (c, a)].map(|(from, to)| to_segment2(p, from, to)).into_iter().fold(f32::INFINITY, f32::min)
}

/// Returns the squared distance of a point from a line segment.
fn to_segment2(p: [f32; 3], from: [f32; 3], to: [f32; 3]) -> f32 {
    let (along, w) = (sub(to, from), sub(p, from));
    let length2 = dot(along, along);
    let t = if length2 > 0.0 { (dot(w, along) / length2).clamp(0.0, 1.0) } else { 0.0 };
    let off: [f32; 3] = std::array::from_fn(|k| w[k] - t * along[k]);
    dot(off, off)
}
