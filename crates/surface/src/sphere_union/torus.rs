//! Toroidal part of a solvent-excluded surface: the probe touches two spheres and moves along an arc.

use super::region::EdgeArc;
use crate::vector::dot;

/// Positions of the probe along an arc.
#[derive(Debug, Clone, Copy)]
pub(super) struct ProbePath<'a> {
    /// Arc of the probe's centre.
    pub(super) arc: &'a EdgeArc,
    /// Unit vector along the axis of its circle, from the first sphere to the second.
    pub(super) axis: [f64; 3],
    /// Centre of its circle, Å.
    pub(super) centre: [f64; 3],
    /// Radius of its circle, Å.
    pub(super) radius: f64,
    /// Distances of the centre of the circle from those of the spheres along the axis, Å, positive between them.
    pub(super) offsets: [f64; 2],
    /// Radius of the probe, Å.
    pub(super) probe: f64,
}

impl ProbePath<'_> {
    /// Returns the area of the toroidal part that counts for each sphere, Å², and the integral of x·n over the whole
    /// part, Å³, where n is the outward normal at x. A point counts for the sphere whose point of contact is nearer.
    /// Where the torus intersects itself, the area that the probe covers at other positions on the arc is left out.
    pub(super) fn measure(&self) -> ([f64; 2], f64) {
        let Self { radius, offsets, probe, .. } = *self;
        // A point of the probe has an angle from the direction to the axis, positive on the side of the first sphere.
        let [high, low] = [offsets[0].atan2(radius), -offsets[1].atan2(radius)];
        let cusp = if radius < probe { (radius / probe).acos() } else { 0.0 };
        let middle = 0.5 * (high + low);
        let (mut areas, mut flux) = ([0.0; 2], 0.0);
        for (area, [low, high]) in areas.iter_mut().zip([[middle, high], [low, middle]]) {
            for [from, to] in [[low.max(cusp), high], [low, high.min(-cusp)]].into_iter().filter(|[from, to]| from < to)
            {
                let sums = self.between(from, to);
                *area += sums[0];
                flux += sums[1];
            }
        }
        (areas, flux)
    }

    /// Returns the area between two angles, Å², and the integral of x·n over it, Å³.
    fn between(&self, from: f64, to: f64) -> [f64; 2] {
        let Self { arc, axis, centre, radius, probe, .. } = *self;
        let turn = 2.0 * arc.half_angle;
        let ((s0, c0), (s1, c1)) = (from.sin_cos(), to.sin_cos());
        let (one, cos, sin) = (to - from, s1 - s0, c0 - c1);
        let cos2 = 0.5 * (one + s1 * c1 - s0 * c0);
        let sin_cos = 0.5 * (s1 * s1 - s0 * s0);
        let of_path = (radius * radius + probe * probe) * cos - radius * probe * (cos2 + one);
        // The normal is the direction to the probe: outward from the axis by the cosine, along it by the sine.
        let outward = 2.0 * arc.half[1] * (radius * cos - probe * cos2);
        let along = turn * (radius * sin - probe * sin_cos);
        let normal = dot(centre, arc.middle) * outward + dot(centre, axis) * along;
        [probe * turn * (radius * one - probe * cos), probe * (turn * of_path + normal)]
    }
}
