//! Vectors of three numbers as arrays, the type of positions in columns and files.
//!
//! Meshes keep their bytes as long as each function keeps its operations and their order. `glam` has types of its own,
//! to which every array would have to be converted, and normalizes by the reciprocal of the length.

use std::ops::{Add, Div, Mul, Sub};

/// Number type of a vector.
pub trait Real: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> {
    /// Returns the square root.
    #[must_use]
    fn square_root(self) -> Self;
}

impl Real for f32 {
    #[inline]
    fn square_root(self) -> Self {
        self.sqrt()
    }
}

impl Real for f64 {
    #[inline]
    fn square_root(self) -> Self {
        self.sqrt()
    }
}

/// Applies `f` to each pair of components.
#[inline]
pub fn map_components<T: Copy>(a: [T; 3], b: [T; 3], f: impl Fn(T, T) -> T) -> [T; 3] {
    std::array::from_fn(|k| f(a[k], b[k]))
}

/// Returns the sum of two vectors.
#[must_use]
#[inline]
pub fn add<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    map_components(a, b, T::add)
}

/// Returns the difference `a − b`.
#[must_use]
#[inline]
pub fn sub<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    map_components(a, b, T::sub)
}

/// Returns the dot product.
#[must_use]
#[inline]
pub fn dot<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the cross product.
#[must_use]
#[inline]
pub fn cross<T: Real>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Returns the length of a vector.
#[must_use]
#[inline]
pub fn length<T: Real>(a: [T; 3]) -> T {
    dot(a, a).square_root()
}

/// Returns the square of the distance between two points.
#[must_use]
#[inline]
pub fn squared_distance<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    let apart = sub(a, b);
    dot(apart, apart)
}

/// Returns the vector of length 1 in the direction of a vector other than zero.
#[must_use]
#[inline]
pub fn unit<T: Real>(a: [T; 3]) -> [T; 3] {
    let length = length(a);
    a.map(|c| c / length)
}

/// Returns the normal of a triangle by the right-hand rule, twice as long as its area.
#[must_use]
#[inline]
pub fn area_vector<T: Real>([a, b, c]: [[T; 3]; 3]) -> [T; 3] {
    cross(sub(b, a), sub(c, a))
}

/// Returns the bounds of both boxes.
#[must_use]
pub fn joined_bounds<T: Copy + PartialOrd>([a, b]: [[T; 3]; 2], [c, d]: [[T; 3]; 2]) -> [[T; 3]; 2] {
    [map_components(a, c, |a, c| if c < a { c } else { a }), map_components(b, d, |b, d| if d > b { d } else { b })]
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "the bits of results are compared")]
mod tests {
    use super::*;

    #[test]
    fn operations_keep_their_order() {
        // In another order, or fused, the sum of the products would be 2⁻⁶⁰ or 1.
        let (one, small) = (1.0 + 2.0_f64.powi(-30), 1.0 - 2.0_f64.powi(-30));
        assert_eq!(dot([one, -1.0, 1e300], [small, 1.0, 0.0]), 0.0);
        assert_eq!(dot([1e300, -1e300, 1.0], [1.0; 3]), 1.0);
        assert_eq!(dot([1.0, 1e300, -1e300], [1.0; 3]), 0.0);
        assert_eq!(cross([one, 1.0, 0.0], [1.0, small, 0.0]), [0.0; 3]);
        // 1/49 times 49 is less than 1.
        assert_eq!(unit([49.0, 0.0, 0.0]), [1.0, 0.0, 0.0]);
        assert_eq!(length([2.0_f32, 3.0, 6.0]), 7.0);
        assert_eq!(area_vector([[1.0, 1.0, 1.0], [3.0, 1.0, 1.0], [1.0, 2.0, 1.0]]), [0.0, 0.0, 2.0]);
    }
}
