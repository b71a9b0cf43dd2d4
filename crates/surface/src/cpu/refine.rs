//! Stage `refine` of surfaces of spheres: moves vertices along their edges to the surface. For isosurfaces,
//! `interpolate` does it.

use std::ops::Range;

use super::classify::ClassifiedBricks;
use super::distance::{DistanceField, SURFACE};
use super::edge::Edge;
use super::field::BrickField;
use crate::groups::Groups;
use crate::lattice::EDGE_MARGIN;
use crate::simd::LANES;
use crate::sphere_union::{BrickUnion, Feature, Lanes, Nearest};
use crate::vector::length;

/// Maximum number of steps of a root search. Every fourth one halves the bracket.
const MAX_STEPS: usize = 64;

impl DistanceField {
    /// Moves the vertices `range`, those of a brick, along their edges to the surface. Adds the nearest
    /// feature of each, and the nearest sphere if atom ids are requested.
    pub(super) fn refine(
        &self,
        spheres: &mut BrickUnion,
        fields: &[&BrickField; 8],
        range: Range<usize>,
        found: &mut ClassifiedBricks,
    ) {
        let ClassifiedBricks { t, edges, features, spheres: nearest, .. } = found;
        let (edges, t) = (&edges[range.clone()], &mut t[range.clone()]);
        features.resize(range.end, Feature::default());
        if self.atom_ids {
            nearest.resize(range.end, 0);
        }
        // For vertices that are close together, few spheres and arcs can be the nearest ones.
        for order in by_cube(edges).chunks(LANES) {
            let mut search = RootSearch::new(order, edges, t, fields);
            for step in 0..MAX_STEPS {
                let points = search.points();
                let at = spheres.nearest(self.union(), self.level, &points);
                if search.advance(self, spheres, &points, &at, step) {
                    break;
                }
            }
            for (lane, i) in order.iter().enumerate() {
                t[*i] = search.t[lane].clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN);
                features[range.start + i] = search.features[lane];
                if let Some(sphere) = nearest.get_mut(range.start + i) {
                    *sphere = search.spheres[lane];
                }
            }
        }
    }
}

/// Returns the indices of edges, sorted by cubes of 4 × 4 × 4 grid points, then of 2 × 2 × 2.
fn by_cube(edges: &[Edge]) -> Vec<usize> {
    let cube = |edge: &Edge| {
        let bit = |b: u16| (edge.x() >> b & 1) | (edge.y() >> b & 1) << 1 | (edge.z() >> b & 1) << 2;
        usize::from(bit(2) << 3 | bit(1))
    };
    Groups::new(64, edges.iter().enumerate().map(|(i, edge)| (cube(edge), i))).into_items()
}

/// Search for the surface on a vector of edges: Newton's method within a bracket, with bisection if it is slow.
struct RootSearch {
    /// First point of each edge.
    base: Lanes,
    axis: [usize; LANES],
    /// True if the first point is inside.
    from_inside: [bool; LANES],
    /// Ends of the bracket: parameters of one point on each side of the surface.
    ends: [[f32; LANES]; 2],
    /// Current parameters.
    t: [f32; LANES],
    features: [Feature; LANES],
    spheres: [u32; LANES],
    done: [bool; LANES],
}

impl RootSearch {
    /// Starts the search on the edges `of`. Unused lanes repeat the last edge.
    fn new(of: &[usize], edges: &[Edge], t: &[f32], fields: &[&BrickField; 8]) -> Self {
        let index = |lane: usize| of[lane.min(of.len() - 1)];
        let edge = |lane: usize| edges[index(lane)];
        let coordinate = |k: usize, edge: Edge| f32::from([edge.x(), edge.y(), edge.z()][k]);
        Self {
            base: std::array::from_fn(|k| std::array::from_fn(|lane| coordinate(k, edge(lane)))),
            axis: std::array::from_fn(|lane| usize::from(edge(lane).axis())),
            from_inside: std::array::from_fn(|lane| fields[0][edge(lane).grid_point()] >= SURFACE),
            ends: [[0.0; LANES], [1.0; LANES]],
            t: std::array::from_fn(|lane| t[index(lane)]),
            features: [Feature::default(); LANES],
            spheres: [0; LANES],
            done: [false; LANES],
        }
    }

    fn points(&self) -> Lanes {
        let along = |k: usize, lane: usize| if self.axis[lane] == k { self.t[lane] } else { 0.0 };
        std::array::from_fn(|k| std::array::from_fn(|lane| self.base[k][lane] + along(k, lane)))
    }

    /// Stores the nearest features of `points`, the points at the current parameters, and chooses the next parameters.
    /// Returns true if all vertices lie on the surface.
    fn advance(
        &mut self,
        field: &DistanceField,
        spheres: &BrickUnion,
        points: &Lanes,
        found: &Nearest,
        step: usize,
    ) -> bool {
        for lane in 0..LANES {
            if self.done[lane] {
                continue;
            }
            (self.features[lane], self.spheres[lane]) = (spheres.feature(found, lane), spheres.sphere(found, lane));
            let (t, value) = (self.t[lane], found.distance[lane] - field.level);
            // Replaces the end that is on the same side of the surface.
            let end = usize::from((value >= 0.0) != self.from_inside[lane]);
            self.ends[end][lane] = t;
            let [from, to] = [self.ends[0][lane], self.ends[1][lane]];
            if value.abs() <= field.tolerance || to - from <= field.tolerance {
                self.done[lane] = true;
                continue;
            }
            let normal = spheres.outward(found, points, lane);
            let length = length(normal);
            let next = t + value * length / normal[self.axis[lane]];
            let bisect = step % 4 == 3 || !(from < next && next < to);
            self.t[lane] = if bisect { 0.5 * (from + to) } else { next };
        }
        self.done == [true; LANES]
    }
}
