//! Exact area and enclosed volume of the components of the boundary.

use std::f64::consts::PI;

use super::caps::dot;
use super::components::{Arc, Components, add, cross, sub, unit};
use super::radius;
use crate::surface::lattice::to_u32;

/// Longest piece of an arc whose area is computed at once: its ends are never opposite points.
const PIECE: f64 = 2.0 * PI / 3.0;

/// Connected component of the boundary.
#[derive(Debug, Clone)]
pub(in crate::surface) struct Shell {
    /// Number of the component.
    pub(in crate::surface) number: u32,
    /// Area.
    pub(in crate::surface) area: f64,
    /// Enclosed volume; negative for a cavity of the union.
    pub(in crate::surface) volume: f64,
    /// Numbers of the spheres with a face in it, ascending.
    pub(in crate::surface) spheres: Vec<u32>,
    /// Lowest and highest coordinates of its arcs. A cavity lies within them: its faces bulge inwards.
    pub(in crate::surface) bounds: [[f64; 3]; 2],
}

impl Components<'_> {
    /// Measures all components.
    pub(in crate::surface) fn shells(&self) -> Vec<Shell> {
        let empty = |number| Shell {
            number,
            area: 0.0,
            volume: 0.0,
            spheres: Vec::new(),
            bounds: [[f64::MAX; 3], [f64::MIN; 3]],
        };
        let mut shells: Vec<Shell> = (0..self.n).map(empty).collect();
        for own in 0..to_u32(self.atoms.len()) {
            let mut sets: Vec<u32> = self.on(own).iter().map(|arc| self.of_arc[*arc as usize]).collect();
            sets.sort_unstable();
            sets.dedup();
            for set in sets {
                let arcs = self.on(own).iter().filter(|arc| self.of_arc[**arc as usize] == set);
                self.add_face(own, arcs, &mut shells[set as usize]);
            }
        }
        for (arc, set) in self.arcs.iter().zip(&self.of_arc) {
            let [from, to, _] = arc.points();
            // Bounding sphere: around the chord of an arc of up to half a circle, else around the whole circle.
            let (centre, reach) = match arc.half {
                [cos, sin] if cos > 0.0 => (add(from, to).map(|c| 0.5 * c), arc.radius * sin),
                _ => (arc.centre, arc.radius),
            };
            let [low, high] = &mut shells[*set as usize].bounds;
            for k in 0..3 {
                let c = self.atoms[arc.spheres[0] as usize].position(k) + centre[k];
                (low[k], high[k]) = (low[k].min(c - reach), high[k].max(c + reach));
            }
        }
        shells
    }

    /// Adds the faces of a sphere that `arcs`, all arcs of one component on it, bound.
    fn add_face<'b>(&self, own: u32, arcs: impl Iterator<Item = &'b u32>, shell: &mut Shell) {
        let r = radius(&self.atoms[own as usize]);
        // On the unit sphere: the area up to multiples of 4π, and the integral of the normal.
        let (mut solid, mut vector, mut largest) = (0.0, [0.0; 3], 1.0_f64);
        for &arc in arcs {
            let (centre, axis, [sin, cos]) = self.seen(arc, own);
            let Arc { middle, side, radius: of_circle, .. } = self.arcs[arc as usize];
            let (height, rho) = (dot(centre, axis) / r, of_circle / r);
            largest = largest.min(height);
            let angle = 2.0 * sin.abs().atan2(cos);
            let n_pieces = if angle <= PIECE { 1_u8 } else { 3 };
            let step = angle / f64::from(n_pieces);
            let point = |turn: f64| -> [f64; 3] {
                let (s, c) = turn.sin_cos();
                std::array::from_fn(|k| height * axis[k] + rho * (c * middle[k] + s * side[k]))
            };
            let (start, direction) = (0.5 * angle.copysign(sin), -step.copysign(sin));
            let mut from = point(start);
            for piece in 1..=n_pieces {
                let to = point(start + f64::from(piece) * direction);
                solid += triangle(pole(), from, to) - triangle(axis, from, to) - step * (1.0 - height);
                let swept = cross(axis.map(|c| height * c), sub(to, from));
                (0..3).for_each(|k| vector[k] += 0.5 * (swept[k] - rho * rho * step * axis[k]));
                from = to;
            }
        }
        let mut solid = solid.rem_euclid(4.0 * PI);
        // The face lies outside the largest cap, so a larger area is a small one that rounding has made negative.
        if solid > 4.0 * PI - PI * (1.0 - largest) {
            solid = 0.0;
        }
        let first = *shell.spheres.first().unwrap_or(&own);
        let out = self.between(first, own);
        shell.area += r * r * solid;
        shell.volume += r * r * (dot(out, vector) + r * solid) / 3.0;
        shell.spheres.push(own);
    }
}

/// Direction from which areas on the unit sphere are summed. Its components have no simple ratio, so that no end of an
/// arc of a symmetric structure lies opposite to it.
fn pole() -> [f64; 3] {
    unit([0.411, 0.723, 0.559_17])
}

/// Returns the signed area of a triangle on the unit sphere, up to multiples of 4π.
fn triangle(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> f64 {
    2.0 * dot(a, cross(b, c)).atan2(1.0 + dot(a, b) + dot(b, c) + dot(c, a))
}
