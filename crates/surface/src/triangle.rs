//! Triangles in single precision, and their intersections, with signs of volumes in double precision.

use crate::vector::{cross, dot, length, map_components, sub};

/// Position or vector, Å.
pub type Vector = [f32; 3];
/// Corners of a triangle, Å.
pub type Corners = [Vector; 3];

/// Returns the bounding box of a triangle.
#[must_use]
pub fn bounds([a, b, c]: Corners) -> [Vector; 2] {
    [f32::min, f32::max].map(|f: fn(f32, f32) -> f32| map_components(map_components(a, b, f), c, f))
}

/// Returns the centroid of a triangle.
#[must_use]
pub fn centroid([a, b, c]: Corners) -> Vector {
    std::array::from_fn(|k| (a[k] + b[k] + c[k]) / 3.0)
}

/// Returns the tangent of the smallest angle of a triangle; 0 for a degenerate one.
#[must_use]
pub fn tan_smallest_angle([a, b, c]: Corners) -> f32 {
    let (u, v, w) = (sub(b, a), sub(c, b), sub(a, c));
    let [uu, vv, ww] = [dot(u, u), dot(v, v), dot(w, w)];
    // The smallest angle is opposite to the shortest edge. The product of the other two edges and its cosine is half of
    // the sum of their squares less that of the shortest edge.
    let shortest = uu.min(vv).min(ww);
    let cosine = 0.5 * (uu + vv + ww) - shortest;
    if cosine > 0.0 { length(cross(u, w)) / cosine } else { 0.0 }
}

/// Returns six times the signed volume of a tetrahedron.
fn volume6([a, b, c]: &Corners, d: Vector) -> f64 {
    let [a, b, c] = [a, b, c].map(|p| sub(p.map(f64::from), d.map(f64::from)));
    dot(a, cross(b, c))
}

/// Returns true if a line segment passes through a triangle. One that only touches its plane or its boundary does not.
#[must_use]
pub fn segment_intersects(from: Vector, to: Vector, triangle: &Corners) -> bool {
    let [a, b, c] = *triangle;
    if volume6(triangle, from) * volume6(triangle, to) >= 0.0 {
        return false;
    }
    let around = [[a, b], [b, c], [c, a]].map(|[p, q]| volume6(&[p, q, from], to));
    around.iter().all(|volume| *volume > 0.0) || around.iter().all(|volume| *volume < 0.0)
}

/// Rounds down to a whole number.
#[expect(clippy::cast_possible_truncation, reason = "casts saturate, and callers limit the number of cells")]
#[must_use]
pub fn floor(value: f32) -> i32 {
    // The library's function is slow without vector extensions.
    let towards_zero = value as i32;
    towards_zero.saturating_sub(i32::from(value < towards_zero as f32))
}
