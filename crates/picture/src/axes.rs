//! Principal axes of a surface, weighted by area rather than by vertices, so that they rotate with the molecule.

use molmesh_surface::vector::{add, area_vector, cross, dot, length, sub};
use rayon::prelude::*;

/// Number of triangles per task. Fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 1 << 14;
/// Maximum number of triangles that are used. Of a larger mesh, only every nth triangle is used.
const MAX_TRIANGLES: usize = 1 << 16;
/// Skewness (third moment divided by the cube of the standard deviation) below which a shape is considered symmetric
/// along an axis.
const SKEWED: f64 = 1e-3;
/// Number of sweeps of the eigenvalue iteration; five suffice for 3 × 3 matrices.
const SWEEPS: usize = 32;

type Vec3 = [f64; 3];
type Mat3 = [Vec3; 3];

/// Returns the axes of the view: right, up, towards the viewer. The variance of the area is largest along the first and
/// smallest along the last. The longer tail of the area points right and up; for symmetric shapes, the largest
/// component of the axis in file coordinates is positive.
pub(super) fn principal(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Mat3 {
    let step = triangles.len().div_ceil(MAX_TRIANGLES).max(1);
    let sample: Vec<[u32; 3]> = if step > 1 { triangles.iter().step_by(step).copied().collect() } else { Vec::new() };
    let triangles = if step > 1 { &sample[..] } else { triangles };
    let (area, sum, square) = moments(positions, triangles);
    if area <= 0.0 {
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    }
    let mean = sum.map(|s| s / area);
    let covariance = std::array::from_fn(|i| std::array::from_fn(|j| square[i][j] / area - mean[i] * mean[j]));
    let (values, axes) = eigen(covariance);
    let skews = third_moments(positions, triangles, mean, [axes[0], axes[1]]);
    let pointed = |k: usize| {
        let deviation = values[k].max(0.0).sqrt();
        let skew = skews[k] / area;
        let flip = if skew.abs() > SKEWED * deviation * deviation * deviation {
            skew < 0.0
        } else {
            let greatest = axes[k].iter().copied().fold(0.0, |a: f64, c| if c.abs() > a.abs() + 1e-9 { c } else { a });
            greatest < 0.0
        };
        if flip { axes[k].map(|c| -c) } else { axes[k] }
    };
    let (right, up) = (pointed(0), pointed(1));
    [right, up, cross(right, up)]
}

/// Corners and area of a triangle.
fn corners(positions: &[[f32; 3]], triangle: [u32; 3]) -> ([Vec3; 3], f64) {
    let corners = triangle.map(|v| positions[v as usize].map(f64::from));
    (corners, 0.5 * length(area_vector(corners)))
}

/// Integrals of 1, of the position, and of products of its components over the surface.
fn moments(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> (f64, Vec3, Mat3) {
    let of_chunk = |chunk: &[[u32; 3]]| {
        let (mut area, mut sum, mut square) = (0.0, [0.0; 3], [[0.0; 3]; 3]);
        for triangle in chunk {
            let (corners, a) = corners(positions, *triangle);
            let total = add(add(corners[0], corners[1]), corners[2]);
            area += a;
            for i in 0..3 {
                sum[i] += a * total[i] / 3.0;
                for j in 0..3 {
                    // Exact over a flat triangle.
                    let corners: f64 = corners.iter().map(|c| c[i] * c[j]).sum();
                    square[i][j] += a / 12.0 * (corners + total[i] * total[j]);
                }
            }
        }
        (area, sum, square)
    };
    let parts: Vec<_> = triangles.par_chunks(CHUNK).map(of_chunk).collect();
    parts.iter().fold((0.0, [0.0; 3], [[0.0; 3]; 3]), |(area, sum, square), part| {
        let square = std::array::from_fn(|i| std::array::from_fn(|j| square[i][j] + part.2[i][j]));
        (area + part.0, add(sum, part.1), square)
    })
}

/// Integrals of the cubed distance from `mean` along two axes over the surface.
fn third_moments(positions: &[[f32; 3]], triangles: &[[u32; 3]], mean: Vec3, axes: [Vec3; 2]) -> [f64; 2] {
    let of_chunk = |chunk: &[[u32; 3]]| {
        let mut sums = [0.0; 2];
        for triangle in chunk {
            let ([a, b, c], area) = corners(positions, *triangle);
            let middle = sub(add(add(a, b), c).map(|sum| sum / 3.0), mean);
            for (sum, axis) in sums.iter_mut().zip(axes) {
                let along = dot(middle, axis);
                *sum += area * along * along * along;
            }
        }
        sums
    };
    let parts: Vec<_> = triangles.par_chunks(CHUNK).map(of_chunk).collect();
    parts.iter().fold([0.0; 2], |sums, part| std::array::from_fn(|k| sums[k] + part[k]))
}

/// Eigenvalues in descending order and their unit vectors, by Jacobi rotations.
fn eigen(mut m: Mat3) -> (Vec3, Mat3) {
    // The rows of `axes` become the vectors.
    let mut axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let size: f64 = m.iter().flatten().map(|v| v * v).sum();
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if m[p][q] * m[p][q] <= 1e-30 * size {
                continue;
            }
            let theta = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            let turn = |a: f64, b: f64| (c * a - s * b, s * a + c * b);
            for row in &mut m {
                (row[p], row[q]) = turn(row[p], row[q]);
            }
            for k in 0..3 {
                (m[p][k], m[q][k]) = turn(m[p][k], m[q][k]);
                (axes[p][k], axes[q][k]) = turn(axes[p][k], axes[q][k]);
            }
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|a: &usize, b| m[*b][*b].total_cmp(&m[*a][*a]));
    (order.map(|k| m[k][k]), order.map(|k| axes[k]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_satisfy_their_definition() {
        let m = [[4.0, 1.0, -2.0], [1.0, 3.0, 0.5], [-2.0, 0.5, 1.0]];
        let (values, axes) = eigen(m);
        assert!(values[0] > values[1] && values[1] > values[2], "{values:?}");
        for (value, axis) in values.iter().zip(axes) {
            let image: Vec3 = std::array::from_fn(|i| dot(m[i], axis));
            assert!((0..3).all(|k| (image[k] - value * axis[k]).abs() < 1e-12), "{value} {axis:?}");
            assert!((dot(axis, axis) - 1.0).abs() < 1e-12);
        }
        let plain = eigen([[1.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 2.0]]);
        assert_eq!(plain.1, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]);
    }

    #[test]
    fn the_view_of_a_plate_does_not_depend_on_its_triangulation() {
        // A plate of 4 × 2 in the y-z plane, as two and as eight triangles.
        let at = |y: f32, z: f32| [0.0, y, z];
        let coarse = ([at(0., 0.), at(4., 0.), at(4., 2.), at(0., 2.)].to_vec(), vec![[0, 1, 2], [0, 2, 3]]);
        let mut fine = (Vec::new(), Vec::new());
        for i in 0..2_u8 {
            for j in 0..2_u8 {
                let (y, z, first) = (2.0 * f32::from(i), f32::from(j), u32::try_from(fine.0.len()).unwrap());
                fine.0.extend([at(y, z), at(y + 2.0, z), at(y + 2.0, z + 1.0), at(y, z + 1.0)]);
                fine.1.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
            }
        }
        for (positions, triangles) in [coarse, fine] {
            let (area, _, square) = moments(&positions, &triangles);
            assert!((area - 8.0).abs() < 1e-12 && (square[1][1] - 2.0 * 64.0 / 3.0).abs() < 1e-9, "{area} {square:?}");
            assert_eq!(principal(&positions, &triangles), [[0., 1., 0.], [0., 0., 1.], [1., 0., 0.]]);
        }
        let [.., least] = principal(&[], &[]);
        assert!(least.iter().zip([0.0, 0.0, 1.0]).all(|(a, b)| a.total_cmp(&b).is_eq()), "{least:?}");
    }
}
