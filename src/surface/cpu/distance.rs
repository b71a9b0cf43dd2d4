//! Van der Waals, solvent-accessible and solvent-excluded surfaces: level sets of the distance to the boundary of a
//! union of spheres, in the stages `field`, `classify` and `interpolate`.
//!
//! Every distance depends on the point and the boundary alone: spheres and arcs out of reach do not affect its bits. As
//! for densities, the signs at the grid points determine the topology. Vertices are then moved along their edges to the
//! exact surface.

use std::ops::Range;

use super::RunContext;
use super::bin::{Bricks, NORMAL_ONLY, Tiles};
use super::classify::ClassifiedBricks;
use super::edge::Edge;
use super::field::{BrickField, GridPointRange};
use crate::surface::error::SurfaceError;
use crate::surface::lattice::{EDGE_MARGIN, Lattice, LatticeAtom, to_f32};
use crate::surface::params::SurfaceKind;
use crate::surface::simd::LANES;
use crate::surface::sphere_union::{BrickUnion, Feature, Lanes, Nearest, SphereUnion};

/// Value at a grid point on the surface. Grid points more than a spacing outside are 0, those more than a spacing
/// inside 2.
pub(super) const SURFACE: f32 = 1.0;

/// Maximum distance of vertices from the surface, Å.
const TOLERANCE: f64 = 1e-4;
/// Minimum of [`TOLERANCE`] in spacings: coordinates within a brick are rounded.
const ROUNDING: f32 = 4e-6;
/// Maximum number of steps of a root search. Every fourth one halves the bracket.
const MAX_STEPS: usize = 64;

/// Distance to the boundary of a union of spheres.
pub(super) struct DistanceField {
    /// Boundary of the spheres enlarged by the probe. `None` uses the distance to the nearest sphere, which is exact
    /// outside and on the boundary.
    boundary: Option<Boundary>,
    /// Distance at the surface, spacings.
    level: f32,
    tolerance: f32,
    /// True if the nearest sphere of each vertex is requested.
    atom_ids: bool,
}

/// Boundary whose arcs are assigned to tiles by their bounding spheres.
struct Boundary {
    union: SphereUnion,
    bounds: Lattice,
    tiles: Tiles,
}

impl DistanceField {
    /// Prepares the surface of `context`.
    ///
    /// # Errors
    /// [`SurfaceError::TooManyOverlaps`], [`SurfaceError::TooManyCandidates`] and [`SurfaceError::GridTooLarge`] before
    /// memory is allocated beyond the limits, [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn new(lattice: &Lattice, context: RunContext<'_>) -> Result<Self, SurfaceError> {
        let RunContext { params, limits, control, .. } = context;
        let tolerance = to_f32(TOLERANCE / lattice.spacing).max(ROUNDING);
        let atom_ids = params.atom_ids;
        if params.surface != SurfaceKind::Ses || params.probe == 0.0 {
            return Ok(Self { boundary: None, level: 0.0, tolerance, atom_ids });
        }
        let level = params.probe / lattice.spacing;
        // Distances are exact up to a spacing inside the surface.
        let (union, bounds) = SphereUnion::new(&lattice.atoms, lattice.spacing, level + 1.0, limits, control)?;
        let bounds = Lattice { atoms: bounds.into(), ..lattice.clone() };
        let tiles = Tiles::new(&bounds, limits, control)?;
        Ok(Self { boundary: Some(Boundary { union, bounds, tiles }), level: to_f32(level), tolerance, atom_ids })
    }

    /// Returns the number of ordered pairs of overlapping spheres; 0 if the surface needs no boundary of their union.
    pub(super) fn overlaps(&self) -> u64 {
        self.boundary.as_ref().map_or(0, |boundary| boundary.union.n_overlaps)
    }

    /// Returns the bounding spheres of the arcs.
    pub(super) fn bounds(&self) -> Option<&Lattice> {
        self.boundary.as_ref().map(|boundary| &boundary.bounds)
    }

    /// Finds the arcs near every brick in `layers` of a tile, and in the layer beyond, as [`Bricks::fill`] finds atoms.
    ///
    /// # Errors
    /// Those of `count`.
    pub(super) fn fill_arcs(
        &self,
        arcs: &mut Bricks,
        tile: [i32; 3],
        layers: &Range<usize>,
        count: impl FnMut(u64) -> Result<(), SurfaceError>,
    ) -> Result<(), SurfaceError> {
        arcs.clear();
        let Some(Boundary { bounds, tiles, .. }) = &self.boundary else { return Ok(()) };
        let Some(t) = tiles.index.get(&tile) else { return Ok(()) };
        arcs.fill(bounds, tile, layers, tiles.atoms(*t as usize), count)
    }

    /// Loads the spheres and arcs near the brick at `origin`.
    pub(super) fn load(
        &self,
        spheres: &mut BrickUnion,
        atoms: &[LatticeAtom],
        candidates: &[u32],
        arcs: &[u32],
        origin: [i32; 3],
    ) {
        let index = |marked: &u32| marked & !NORMAL_ONLY;
        let candidates = candidates.iter().map(|i| (index(i), &atoms[index(i) as usize]));
        let arcs = self.boundary.iter().flat_map(|Boundary { union, bounds, .. }| {
            let bounds = &bounds.atoms[..];
            arcs.iter().map(move |i| (index(i), &bounds[index(i) as usize], union.arc(index(i))))
        });
        spheres.load(origin, candidates, arcs);
    }

    fn union(&self) -> Option<&SphereUnion> {
        self.boundary.as_ref().map(|boundary| &boundary.union)
    }

    /// Writes the values at the grid points of the brick that is loaded.
    pub(super) fn evaluate(&self, spheres: &mut BrickUnion, range: GridPointRange, out: &mut BrickField) {
        // In a block of 4 × 2 × 2 grid points, few spheres can be the nearest one.
        for (z, y, x) in blocks(range) {
            let point = |lane: usize| [x + lane % 4, y + lane / 4 % 2, z + lane / 8];
            let points: Lanes = std::array::from_fn(|k| std::array::from_fn(|lane| point(lane)[k] as f32));
            let found = spheres.nearest(self.union(), self.level, &points);
            for (lane, distance) in found.distance.into_iter().enumerate() {
                let [x, y, z] = point(lane);
                let value = (SURFACE + (distance - self.level)).clamp(0.0, 2.0 * SURFACE);
                // Outside all spheres, the distance itself is not needed.
                out[(z * 8 + y) * 8 + x] = if distance > 0.0 { value } else { 0.0 };
            }
        }
    }

    /// Moves the vertices of a brick, starting with the `first`, along their edges to the surface. Adds the nearest
    /// feature of each, and the nearest sphere if atom ids are requested.
    pub(super) fn refine(
        &self,
        spheres: &mut BrickUnion,
        fields: &[&BrickField; 8],
        first: usize,
        found: &mut ClassifiedBricks,
    ) {
        let ClassifiedBricks { t, edges, features, spheres: nearest, .. } = found;
        let (edges, t) = (&edges[first..], &mut t[first..]);
        features.resize(first + t.len(), Feature::default());
        if self.atom_ids {
            nearest.resize(first + t.len(), 0);
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
                features[first + i] = search.features[lane];
                if let Some(sphere) = nearest.get_mut(first + i) {
                    *sphere = search.spheres[lane];
                }
            }
        }
    }

    /// Writes outward normals of any length at vertices of the brick at `origin`.
    pub(super) fn normals(
        &self,
        atoms: &[LatticeAtom],
        features: &[Feature],
        origin: [i32; 3],
        p: &[Vec<f32>; 3],
        n: &mut [Vec<f32>; 3],
    ) {
        for (i, feature) in features.iter().enumerate() {
            let x: [f32; 3] = std::array::from_fn(|k| p[k][i]);
            let normal = match (feature.arc(), &self.boundary) {
                (Ok(arc), Some(Boundary { union, bounds, .. })) => {
                    union.arc(arc).toward(&bounds.atoms[arc as usize], origin, x)
                }
                (Ok(sphere) | Err(sphere), _) => {
                    let LatticeAtom { cell, frac, .. } = &atoms[sphere as usize];
                    std::array::from_fn(|k| x[k] - ((cell[k] - origin[k]) as f32 + frac[k]))
                }
            };
            for (column, value) in n.iter_mut().zip(normal) {
                column[i] = value;
            }
        }
    }
}

/// Returns the first grid point (z, y, x) of each block of a brick.
fn blocks(range: GridPointRange) -> impl Iterator<Item = (usize, usize, usize)> {
    let layers = (0..range.z_layers).step_by(2);
    layers.flat_map(move |z| (0..range.y_pairs).flat_map(move |pair| [0, 4].map(move |x| (z, 2 * pair, x))))
}

/// Returns the indices of edges, sorted by cubes of 4 × 4 × 4 grid points, then of 2 × 2 × 2.
fn by_cube(edges: &[Edge]) -> Vec<usize> {
    let cube = |edge: &Edge| {
        let bit = |b: u16| (edge.x() >> b & 1) | (edge.y() >> b & 1) << 1 | (edge.z() >> b & 1) << 2;
        usize::from(bit(2) << 3 | bit(1))
    };
    let mut starts = [0; 65];
    for edge in edges {
        starts[cube(edge) + 1] += 1;
    }
    for i in 0..64 {
        starts[i + 1] += starts[i];
    }
    let mut order = vec![0; edges.len()];
    for (i, edge) in edges.iter().enumerate() {
        let at = &mut starts[cube(edge)];
        order[*at] = i;
        *at += 1;
    }
    order
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
            let length = (normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]).sqrt();
            let next = t + value * length / normal[self.axis[lane]];
            let bisect = step % 4 == 3 || !(from < next && next < to);
            self.t[lane] = if bisect { 0.5 * (from + to) } else { next };
        }
        self.done == [true; LANES]
    }
}
