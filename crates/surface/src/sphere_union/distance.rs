//! Signed distance from points of a brick to the boundary of a union of spheres.

use super::{Arc, SphereUnion};
use crate::lattice::LatticeAtom;
use crate::simd::{LANES, dispatched, extent};
use crate::vector::length;

/// Coordinates of points, axis by axis, in spacings from the brick's first grid point.
pub(crate) type Lanes = [[f32; LANES]; 3];

/// Marks a point whose nearest boundary point lies in a face.
const NO_ARC: u32 = u32::MAX;

/// Distance outside the union, spacings, beyond which there are no vertices. It exceeds the tolerance of vertices on
/// the finest grid.
const OUTSIDE: f32 = 0.1;

/// Margin for rounding in comparisons of distances, spacings. Coordinates stay below 100 spacings per sphere radius.
const SLACK: f32 = 1e-3;

/// Spheres and arcs around a brick, in coordinates of the brick.
#[derive(Debug, Default)]
pub(crate) struct BrickUnion {
    /// Centres and radii column by column, padded to whole vectors by spheres that contain no point.
    columns: [Vec<f32>; 4],
    /// Numbers of the spheres.
    spheres: Vec<u32>,
    /// Spheres in which a point of the batch may lie deepest: centre and radius, index in `columns`.
    near: Vec<([f32; 4], u32)>,
    /// Depth of the batch's centre in each sphere, or the distance of the centre from each arc.
    depths: Vec<f32>,
    arcs: Arcs,
}

/// Part of the boundary: a face, stored as the number of its sphere, or an arc with its ends, stored as its number with
/// the highest bit set.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Feature(u32);

/// Marks an arc in [`Feature`].
const IS_ARC: u32 = 1 << 31;

impl Feature {
    /// Returns the number of the arc, or the number of the sphere as an error.
    pub(crate) const fn arc(self) -> Result<u32, u32> {
        if self.0 & IS_ARC == 0 { Err(self.0) } else { Ok(self.0 & !IS_ARC) }
    }
}

/// Distances of points to the boundary.
#[derive(Debug, Clone)]
pub(crate) struct Nearest {
    /// Signed distance, positive inside, spacings. Exact between 0 and the level; elsewhere only its comparisons with 0
    /// and the level are exact.
    pub(crate) distance: [f32; LANES],
    /// Index of the sphere in which the point lies deepest.
    sphere: [u32; LANES],
    /// Index of the nearest arc, or [`NO_ARC`].
    arc: [u32; LANES],
}

impl Default for Nearest {
    fn default() -> Self {
        Self { distance: [f32::MIN; LANES], sphere: [0; LANES], arc: [NO_ARC; LANES] }
    }
}

impl BrickUnion {
    /// Loads the spheres and arcs around the brick at `origin`. Each arc comes with its bounding sphere; its
    /// coordinates are relative to the cell of that sphere.
    pub(crate) fn load<'a>(
        &mut self,
        origin: [i32; 3],
        spheres: impl Iterator<Item = (u32, &'a LatticeAtom)>,
        arcs: impl Iterator<Item = (u32, &'a LatticeAtom, &'a Arc)>,
    ) {
        let Self { columns, spheres: numbers, arcs: own, depths, .. } = self;
        columns.iter_mut().for_each(Vec::clear);
        numbers.clear();
        for (number, atom) in spheres {
            for (k, column) in columns.iter_mut().enumerate().take(3) {
                column.push((atom.cell[k] - origin[k]) as f32 + atom.frac[k]);
            }
            columns[3].push(atom.inv_length2.sqrt().recip());
            numbers.push(number);
        }
        own.groups.clear();
        own.numbers.clear();
        arcs.for_each(|(number, bound, arc)| own.push(number, arc.row(bound, origin)));
        let padded = numbers.len().next_multiple_of(LANES);
        for (column, value) in columns.iter_mut().zip([0.0, 0.0, 0.0, f32::MIN]) {
            column.resize(padded, value);
        }
        depths.resize(padded.max(LANES * own.groups.len()), 0.0);
    }

    /// Evaluates the distance at `points`. With a `union`, it is exact up to `level`; without one, it is the distance
    /// to the nearest sphere.
    pub(crate) fn nearest(&mut self, union: Option<&SphereUnion>, level: f32, points: &Lanes) -> Nearest {
        let mut found = Nearest::default();
        nearest(self, union, level, points, &mut found);
        found
    }

    /// Returns the feature that is nearest to a point.
    pub(crate) fn feature(&self, found: &Nearest, lane: usize) -> Feature {
        match found.arc[lane] {
            NO_ARC => Feature(self.sphere(found, lane)),
            arc => Feature(self.arcs.numbers[arc as usize] | IS_ARC),
        }
    }

    /// Returns the number of the sphere in which a point lies deepest.
    pub(crate) fn sphere(&self, found: &Nearest, lane: usize) -> u32 {
        self.spheres.get(found.sphere[lane] as usize).copied().unwrap_or_default()
    }

    /// Returns the outward normal, of any length, of the level set through a point inside.
    pub(crate) fn outward(&self, found: &Nearest, points: &Lanes, lane: usize) -> [f32; 3] {
        let point: [f32; 3] = std::array::from_fn(|k| points[k][lane]);
        let sphere = found.sphere[lane] as usize;
        match found.arc[lane] {
            NO_ARC => std::array::from_fn(|k| point[k] - self.columns[k].get(sphere).copied().unwrap_or_default()),
            arc => toward(&self.arcs.get(arc as usize), point),
        }
    }
}

impl Arc {
    /// Returns the vector from `x` to the nearest point of the arc, in the coordinates of the brick at `origin`.
    /// `bound` is the bounding sphere of the arc.
    pub(crate) fn toward(&self, bound: &LatticeAtom, origin: [i32; 3], x: [f32; 3]) -> [f32; 3] {
        toward(&self.row(bound, origin), x)
    }

    fn row(&self, bound: &LatticeAtom, origin: [i32; 3]) -> [f32; ARC_ROWS] {
        let [x, y, z] = std::array::from_fn(|k| (bound.cell[k] - origin[k]) as f32 + self.centre[k]);
        let ([ax, ay, az], [mx, my, mz], [sx, sy, sz]) = (self.axis, self.middle, self.side);
        [x, y, z, ax, ay, az, mx, my, mz, sx, sy, sz, self.radius, self.half[0], self.half[1]]
    }
}

/// Returns the vector from `x` to the nearest point of an arc.
#[inline]
fn toward(arc: &[f32; ARC_ROWS], x: [f32; 3]) -> [f32; 3] {
    let ([p, q, _], [radius, mut cos, mut sin]) = (relative(arc, x), [arc[12], arc[13], arc[14]]);
    let s = (p * p + q * q).sqrt();
    if p >= s * cos && s > 0.0 {
        (cos, sin) = (p / s, q / s);
    } else {
        sin = sin.copysign(q);
    }
    std::array::from_fn(|k| (arc[k] - x[k]) + radius * (cos * arc[6 + k] + sin * arc[9 + k]))
}

dispatched! {
fn nearest(brick: &mut BrickUnion, union: Option<&SphereUnion>, level: f32, points: &Lanes, found: &mut Nearest) {
    deepest(brick, level + 0.05, points, found);
    let Some(union) = union else { return };
    // Deeper points are inside in any case. The margin keeps the distance continuous around the level.
    let enough = level + 0.05;
    let mut buried = [false; LANES];
    for lane in 0..LANES {
        let depth = found.distance[lane];
        if depth > 0.0 && depth < enough {
            let sphere = found.sphere[lane] as usize;
            let from: [f32; 3] = std::array::from_fn(|k| points[k][lane] - brick.columns[k][sphere]);
            let scale = length(from).recip();
            buried[lane] = !union.is_exposed(brick.spheres[sphere], from.map(|c| c * scale));
        }
    }
    if buried != [false; LANES] {
        nearest_arc(brick, points, level + 1.0, &buried, found);
    }
}
}

/// Finds for each point the sphere in which it lies deepest. If all points are [`OUTSIDE`], or all are deeper than
/// `enough`, sets an approximate depth and no sphere.
#[inline(always)]
fn deepest(brick: &mut BrickUnion, enough: f32, points: &Lanes, found: &mut Nearest) {
    let BrickUnion { columns: [x, y, z, radii], near, depths, .. } = brick;
    let BoundingSphere { centre, span } = BoundingSphere::new(points);
    let mut best = [f32::MIN; LANES];
    let [cx, cy, cz, cr] = [&*x, y, z, radii].map(|column| column.as_chunks::<LANES>().0);
    for ((((x, y), z), r), depth) in cx.iter().zip(cy).zip(cz).zip(cr).zip(depths.as_chunks_mut::<LANES>().0) {
        for i in 0..LANES {
            let (dx, dy, dz) = (centre[0] - x[i], centre[1] - y[i], centre[2] - z[i]);
            depth[i] = r[i] - (dx * dx + dy * dy + dz * dz).sqrt();
            best[i] = if depth[i] > best[i] { depth[i] } else { best[i] };
        }
    }
    let [_, deepest] = extent(&best);
    // The depths of two points differ at most by their distance.
    if deepest + span < -OUTSIDE || deepest - span > enough {
        found.distance = [deepest; LANES];
        return;
    }
    let least = deepest - 2.0 * span - SLACK;
    near.clear();
    for (first, depths) in (0_u32..).step_by(LANES).zip(depths[..radii.len()].as_chunks::<LANES>().0) {
        let mut left = (0..LANES).fold(0_u32, |bits, i| bits | u32::from(depths[i] >= least) << i);
        while left != 0 {
            let sphere = first + left.trailing_zeros();
            left &= left - 1;
            let i = sphere as usize;
            near.push(([x[i], y[i], z[i], radii[i]], sphere));
        }
    }
    let [px, py, pz] = points;
    for &([x, y, z, r], sphere) in &*near {
        for i in 0..LANES {
            let (dx, dy, dz) = (px[i] - x, py[i] - y, pz[i] - z);
            let depth = r - (dx * dx + dy * dy + dz * dz).sqrt();
            let deeper = depth > found.distance[i];
            found.distance[i] = if deeper { depth } else { found.distance[i] };
            found.sphere[i] = if deeper { sphere } else { found.sphere[i] };
        }
    }
}

/// Replaces the distance of points that are `buried` by that to the nearest arc, or by `most` if that is smaller.
#[inline(always)]
fn nearest_arc(brick: &mut BrickUnion, points: &Lanes, most: f32, buried: &[bool; LANES], found: &mut Nearest) {
    let BrickUnion { arcs, depths, .. } = brick;
    let BoundingSphere { centre, span } = BoundingSphere::new(points);
    let mut best = [f32::MAX; LANES];
    for (group, distances) in arcs.groups.iter().zip(depths.as_chunks_mut::<LANES>().0) {
        for i in 0..LANES {
            distances[i] = distance2(&std::array::from_fn(|row| group[row][i]), centre).sqrt();
            best[i] = if distances[i] < best[i] { distances[i] } else { best[i] };
        }
    }
    let [nearest, _] = extent(&best);
    let farthest = if nearest + span < most { nearest + 2.0 * span } else { most + span } + SLACK;
    let (mut best, mut which) = ([most * most; LANES], [NO_ARC; LANES]);
    for ((first, group), distances) in (0_u32..).step_by(LANES).zip(&arcs.groups).zip(depths.as_chunks::<LANES>().0) {
        let mut left = (0..LANES).fold(0_u32, |bits, i| bits | u32::from(distances[i] <= farthest) << i);
        while left != 0 {
            let lane = left.trailing_zeros();
            left &= left - 1;
            let arc = std::array::from_fn(|row| group[row][lane as usize % LANES]);
            for i in 0..LANES {
                let d2 = distance2(&arc, [points[0][i], points[1][i], points[2][i]]);
                let nearer = d2 < best[i];
                best[i] = if nearer { d2 } else { best[i] };
                which[i] = if nearer { first + lane } else { which[i] };
            }
        }
    }
    for i in 0..LANES {
        if buried[i] {
            found.distance[i] = best[i].sqrt();
            found.arc[i] = which[i];
        }
    }
}

/// Arcs around a brick, packed into vectors.
#[derive(Debug, Default)]
struct Arcs {
    groups: Vec<[[f32; LANES]; ARC_ROWS]>,
    /// Numbers of the arcs.
    numbers: Vec<u32>,
}

/// Number of values per arc: centre, axis, middle, side, radius, cosine and sine of the half-angle.
const ARC_ROWS: usize = 15;

impl Arcs {
    fn push(&mut self, number: u32, row: [f32; ARC_ROWS]) {
        let lane = self.numbers.len() % LANES;
        if lane == 0 {
            self.groups.push([[FAR; LANES]; ARC_ROWS]);
        }
        self.numbers.push(number);
        if let Some(group) = self.groups.last_mut() {
            group.iter_mut().zip(row).for_each(|(column, value)| column[lane] = value);
        }
    }

    #[inline(always)]
    fn get(&self, i: usize) -> [f32; ARC_ROWS] {
        let group = &self.groups[i / LANES];
        std::array::from_fn(|row| group[row][i % LANES])
    }
}

/// Coordinate of unused lanes, far from every point.
const FAR: f32 = 1e9;

/// Returns the coordinates of a point relative to an arc: along its middle, its side and its axis.
#[inline(always)]
fn relative(arc: &[f32; ARC_ROWS], x: [f32; 3]) -> [f32; 3] {
    let from = [x[0] - arc[0], x[1] - arc[1], x[2] - arc[2]];
    let along = |row: usize| from[0] * arc[row] + from[1] * arc[row + 1] + from[2] * arc[row + 2];
    [along(6), along(9), along(3)]
}

/// Returns the squared distance from a point to an arc.
#[inline(always)]
fn distance2(arc: &[f32; ARC_ROWS], x: [f32; 3]) -> f32 {
    let ([p, q, z], [radius, cos, sin]) = (relative(arc, x), [arc[12], arc[13], arc[14]]);
    let s = (p * p + q * q).sqrt();
    let circle = (s - radius) * (s - radius);
    // By symmetry, the end on the same side as the point is the nearer one.
    let (to_p, to_q) = (p - radius * cos, q.abs() - radius * sin);
    let end = to_p * to_p + to_q * to_q;
    z * z + if p >= s * cos { circle } else { end }
}

/// Sphere around the bounding box of points: centre, and half the diagonal of the box.
struct BoundingSphere {
    centre: [f32; 3],
    span: f32,
}

impl BoundingSphere {
    #[inline(always)]
    fn new(points: &Lanes) -> Self {
        let [x, y, z] = [extent(&points[0]), extent(&points[1]), extent(&points[2])];
        let [a, b, c] = [0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0]), 0.5 * (z[1] - z[0])];
        let centre = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]), 0.5 * (z[0] + z[1])];
        Self { centre, span: (a * a + b * b + c * c).sqrt() }
    }
}
