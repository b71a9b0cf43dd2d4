//! Shapes of the triangles of a mesh: their smallest angles and aspect ratios.

use rayon::prelude::*;

use crate::lattice::to_u64;
use crate::mesh::Mesh;
use crate::triangle::{Corners, Vector, tan_smallest_angle};
use crate::vector::{area_vector, length, sub};

/// Upper ends of the classes of aspect ratios; the last class has none.
pub(super) const ASPECT_ENDS: [f64; 7] = [1.25, 1.5, 2.0, 3.0, 5.0, 10.0, 100.0];
/// Classes of smallest angles, 5° each.
const ANGLE_CLASSES: usize = 12;
/// Classes for percentiles, per degree.
const PER_DEGREE: usize = 10;
/// Largest smallest angle of a triangle, degrees.
const MAX_ANGLE: usize = 60;
/// Triangles per task.
const ROWS: usize = 1 << 14;

/// Distribution of the shapes of triangles.
#[derive(Debug, Clone, PartialEq)]
pub struct TriangleShapes {
    /// Smallest angle of any triangle, degrees.
    pub smallest_angle: f64,
    /// Numbers of triangles by class of smallest angles, in tenths of a degree.
    fine: Vec<u64>,
    /// Numbers of triangles by aspect ratio: up to 1.25, 1.5, 2, 3, 5, 10, 100, and above.
    pub aspects: [u64; ASPECT_ENDS.len() + 1],
}

impl TriangleShapes {
    /// Returns the shapes of the triangles of `mesh`.
    #[must_use]
    pub fn of(mesh: &Mesh) -> Self {
        let of_chunk = |rows: &[[u32; 3]]| {
            let mut shapes = Self::empty();
            for row in rows {
                shapes.add(row.map(|v| mesh.position(v as usize)));
            }
            shapes
        };
        mesh.triangles.par_chunks(ROWS).map(of_chunk).reduce(Self::empty, Self::with)
    }

    fn empty() -> Self {
        let aspects = [0; ASPECT_ENDS.len() + 1];
        Self { smallest_angle: MAX_ANGLE as f64, fine: vec![0; MAX_ANGLE * PER_DEGREE + 1], aspects }
    }

    fn add(&mut self, corners: Corners) {
        let angle = f64::from(tan_smallest_angle(corners)).atan().to_degrees();
        self.smallest_angle = self.smallest_angle.min(angle);
        let class = usize::try_from(to_u64(angle * PER_DEGREE as f64)).unwrap_or_default();
        self.fine[class.min(MAX_ANGLE * PER_DEGREE)] += 1;
        let aspect = aspect(corners);
        self.aspects[ASPECT_ENDS.iter().position(|end| aspect <= *end).unwrap_or(ASPECT_ENDS.len())] += 1;
    }

    fn with(mut self, other: Self) -> Self {
        self.smallest_angle = self.smallest_angle.min(other.smallest_angle);
        self.fine.iter_mut().zip(other.fine).for_each(|(own, n)| *own += n);
        self.aspects.iter_mut().zip(other.aspects).for_each(|(own, n)| *own += n);
        self
    }

    /// Returns the angle below which this share of the smallest angles lies, degrees, rounded down to tenths.
    #[must_use]
    pub fn angle_at(&self, share: f64) -> f64 {
        let most = share * self.fine.iter().sum::<u64>() as f64;
        let mut below = 0;
        let class = self.fine.iter().position(|n| {
            below += n;
            below as f64 > most
        });
        class.unwrap_or(MAX_ANGLE * PER_DEGREE) as f64 / PER_DEGREE as f64
    }

    /// Returns the numbers of triangles by classes of 5° of their smallest angles.
    #[must_use]
    pub fn angles(&self) -> [u64; ANGLE_CLASSES] {
        let width = MAX_ANGLE * PER_DEGREE / ANGLE_CLASSES;
        let mut classes = [0; ANGLE_CLASSES];
        self.fine.iter().enumerate().for_each(|(i, n)| classes[(i / width).min(ANGLE_CLASSES - 1)] += n);
        classes
    }
}

/// Returns the circumradius of a triangle over twice its inradius: 1 for an equilateral one, infinite for a degenerate
/// one.
fn aspect(corners @ [a, b, c]: Corners) -> f64 {
    let [x, y, z] = [sub(b, a), sub(c, b), sub(a, c)].map(|edge: Vector| f64::from(length(edge)));
    let twice_area = f64::from(length(area_vector(corners)));
    // R = xyz / 4A and r = 2A / (x + y + z), with A the area.
    if twice_area > 0.0 { x * y * z * (x + y + z) / (4.0 * twice_area * twice_area) } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_of_known_triangles() {
        let height = 0.75_f32.sqrt();
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, height, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]];
        // Equilateral, right-angled and degenerate.
        let triangles: Vec<[u32; 3]> = vec![[0, 1, 2], [0, 1, 3], [0, 1, 4]];
        let mesh = Mesh { positions: corners.to_vec().into(), triangles: triangles.into(), ..Mesh::default() };
        let shapes = TriangleShapes::of(&mesh);
        assert!(shapes.smallest_angle.abs() < 1e-6, "{shapes:?}");
        let angles = shapes.angles();
        assert_eq!((angles[0], angles[8] + angles[9], angles[11]), (1, 1, 1), "{angles:?}");
        // R/2r of the right-angled triangle is (√2/2) / (2 − √2) = 1.207.
        assert_eq!((shapes.aspects[0], shapes.aspects[7]), (2, 1), "{shapes:?}");
        assert!((shapes.angle_at(0.4) - 45.0).abs() < 0.11 && shapes.angle_at(0.9) >= 59.9, "{shapes:?}");
    }
}
