//! Great circles of a sphere, and the parts of them that no cap covers.

use super::caps::Cap;
use super::circle::Uncovered;
use crate::vector::{dot, unit};

/// Plane of a great circle, spanned by two unit vectors.
pub(super) struct GreatCircle {
    first: [f64; 3],
    second: [f64; 3],
}

impl GreatCircle {
    /// Returns the great circle through `start`, a unit vector, and a second direction.
    pub(super) fn through(start: [f64; 3], to: [f64; 3]) -> Self {
        let across = |to: [f64; 3]| -> [f64; 3] {
            let along = dot(start, to);
            std::array::from_fn(|k| to[k] - along * start[k])
        };
        let to = unit(to);
        let mut second = across(to);
        if dot(second, second) < 1e-12 {
            // Opposite points lie on every great circle through one of them.
            let least = if start[0].abs() < 0.6 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
            second = across(least);
        }
        Self { first: start, second: unit(second) }
    }

    /// Finds the parts of the great circle that no cap covers.
    pub(super) fn uncover(&self, caps: &[Cap], tolerance: f64, uncovered: &mut Uncovered) {
        uncovered.reset();
        for cap in caps {
            uncovered.cover([dot(cap.axis, self.first), dot(cap.axis, self.second)], cap.height + tolerance, cap.index);
        }
    }

    /// Returns the unit vector at an angle (cosine, sine) from a direction in the plane.
    pub(super) fn direction(&self, [x, y]: [f64; 2], [cos, sin]: [f64; 2]) -> [f64; 3] {
        let (p, q) = (x * cos - y * sin, x * sin + y * cos);
        std::array::from_fn(|k| p * self.first[k] + q * self.second[k])
    }
}
