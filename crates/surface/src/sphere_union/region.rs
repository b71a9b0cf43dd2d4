//! Solid angle and vector area of the part of a unit sphere that no cap covers, from its exposed arcs.
//!
//! The area between a pole p and an arc of a boundary is the integral of p·(n × dn)/(1 + p·n) along the arc. Its sum
//! over the boundary is the area of the region up to a multiple of 4π, for any number of connected pieces and holes.
//! The area is at most that outside the largest cap, which determines the multiple.

use std::f64::consts::PI;

use super::Circle;
use super::caps::Cap;
use super::circle::{Exposed, Uncovered};
use crate::candidates::Comparisons;
use crate::error::SurfaceError;
use crate::vector::dot;

/// Part of a unit sphere.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Region {
    /// Solid angle, steradian.
    pub(super) solid_angle: f64,
    /// Vector area: integral of the unit normal over the part.
    pub(super) vector: [f64; 3],
}

/// Exposed arc of the edge of a cap.
#[derive(Debug, Clone, Copy)]
pub(super) struct EdgeArc {
    /// Unit vector from the centre of the edge to the middle of the arc.
    pub(super) middle: [f64; 3],
    /// Unit vector along the edge at that middle, counter-clockwise about the axis of the cap.
    pub(super) along: [f64; 3],
    /// Cosine and sine of the half-angle.
    pub(super) half: [f64; 2],
    /// Half-angle, from 0 to π.
    pub(super) half_angle: f64,
    /// Numbers of the caps that cover the edge before the start and after the end of the arc; `None` for a whole edge.
    pub(super) end_caps: Option<[u32; 2]>,
}

impl EdgeArc {
    fn new(circle: &Circle, Exposed { middle: [x, y], half, end_caps }: Exposed) -> Self {
        let vector = |x: f64, y: f64| std::array::from_fn(|k| x * circle.first[k] + y * circle.second[k]);
        Self { middle: vector(x, y), along: vector(-y, x), half, half_angle: half[1].atan2(half[0]), end_caps }
    }
}

impl Region {
    /// Measures the part of the unit sphere outside `caps`, which [`prune`](super::caps::prune) has sorted. `component`
    /// returns the component of each exposed arc of the edge of a cap; a sphere without caps is component `whole`.
    /// Fills `regions` with the components, each with the region that its arcs bound.
    ///
    /// # Errors
    /// Returns the errors of [`Comparisons::add`].
    pub(super) fn outside(
        caps: &[Cap],
        whole: u32,
        uncovered: &mut Uncovered,
        comparisons: &mut Comparisons<'_>,
        regions: &mut Vec<(u32, Self)>,
        mut component: impl FnMut(&Cap, &EdgeArc) -> u32,
    ) -> Result<(), SurfaceError> {
        regions.clear();
        let Some(largest) = caps.first() else {
            regions.push((whole, Self { solid_angle: 4.0 * PI, vector: [0.0; 3] }));
            return Ok(());
        };
        // The integrand is singular opposite to the pole, so that point lies within a cap, far from the boundary.
        let pole = largest.axis.map(|c| -c);
        for cap in caps {
            let circle = Circle::new(1.0, cap);
            circle.uncover(cap, caps, 0.0, uncovered, comparisons)?;
            uncovered.arcs(|arc| {
                let arc = EdgeArc::new(&circle, arc);
                let number = component(cap, &arc);
                let at = regions.iter().position(|(other, _)| *other == number).unwrap_or_else(|| {
                    regions.push((number, Self::default()));
                    regions.len() - 1
                });
                regions[at].1.subtract(cap, circle.sin, &arc, pole);
            });
        }
        let most = 2.0 * PI * (1.0 + largest.height);
        for (_, region) in regions {
            let turns = ((region.solid_angle - 0.5 * most) / (4.0 * PI)).round();
            region.solid_angle = (region.solid_angle - 4.0 * PI * turns).clamp(0.0, most);
        }
        Ok(())
    }

    /// Subtracts the integrals along an arc counter-clockwise about the axis of the cap: the region lies to its right.
    /// `sin` is the radius of the cap's edge.
    fn subtract(&mut self, cap: &Cap, sin: f64, arc: &EdgeArc, pole: [f64; 3]) {
        let height = cap.height;
        // Coordinates of the pole along the axis and in the plane of the edge.
        let up = dot(pole, cap.axis);
        let [x, y] = [dot(pole, arc.middle), dot(pole, arc.along)];
        let across = x.hypot(y);
        // Angle of the middle of the arc, from the direction to the pole.
        let middle = (-y).atan2(x);
        let (sum, low) = (1.0 + height * up + sin * across, height + up);
        let antiderivative = |angle: f64| {
            let (s, c) = (0.5 * angle).sin_cos();
            2.0 * (low.abs() * s).atan2(sum * c * if low < 0.0 { -1.0 } else { 1.0 })
        };
        let half = arc.half_angle;
        self.solid_angle -= antiderivative(middle + half) - antiderivative(middle - half) - 2.0 * half * height;
        for k in 0..3 {
            self.vector[k] -= sin * (half * sin * cap.axis[k] - height * arc.half[1] * arc.middle[k]);
        }
    }
}
