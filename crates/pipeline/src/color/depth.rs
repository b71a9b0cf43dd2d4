//! Depth of vertices below the convex hull of their mesh.
//!
//! The hull is built by the quickhull algorithm (Barber, Dobkin and Huhdanpaa, ACM Trans. Math. Softw. 22, 1996).
//! Points are displaced by up to 10⁻⁴ Å, so that no four of them lie in one plane and every facet is a triangle.

use std::ops::Range;

use molmesh_surface::vector::{add, area_vector, cross, dot, joined_bounds, length, sub, unit};
use molmesh_surface::{Control, MemoryMeter, SurfaceError};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::vertex::single;

/// Distance by which points may lie outside the hull, Å.
const TOLERANCE: f64 = 0.01;
/// Maximum displacement of a point along each axis, Å.
const DISPLACEMENT: f64 = 1e-4;
/// Number of vertices, or of facets near them, below which all distances are computed.
const FEW: usize = 16;
/// Memory of a facet, of its entries in tables and of the lists of facets that are near vertices, bytes.
const FACET_BYTES: u64 = 320;
/// Minimum number of points that a task assigns to facets.
const POINTS_PER_TASK: usize = 1 << 12;

type Point = [f64; 3];

/// Plane with its unit normal and the distance of the origin below it.
#[derive(Debug, Clone, Copy)]
struct Plane {
    normal: Point,
    offset: f64,
}

impl Plane {
    /// Returns the plane through three points. The normal points to the side from which they are counter-clockwise.
    fn through([a, b, c]: [Point; 3]) -> Self {
        let normal = unit(area_vector([a, b, c]));
        Self { normal, offset: dot(normal, a) }
    }

    /// Returns the height of a point above the plane, Å.
    fn height(&self, point: Point) -> f64 {
        dot(self.normal, point) - self.offset
    }
}

/// Facet of a hull.
struct Facet {
    corners: [u32; 3],
    plane: Plane,
    /// Points above the facet that the hull does not contain yet, each in the list of one facet.
    outside: Vec<u32>,
}

/// Returns the distance of each of `n` points from their convex hull, Å; 0 for all points if they lie in one plane.
///
/// # Errors
/// Returns [`SurfaceError::Cancelled`].
pub(super) fn depths(
    n: usize,
    point: impl Fn(usize) -> Point + Sync,
    control: &Control<'_>,
) -> Result<Vec<f32>, SurfaceError> {
    let memory = control.reserve(0)?;
    let hull = hull(n, &point, &memory, control)?;
    let mut found: Vec<(u32, f32)> = indices(n).map(|i| (i, 0.0)).collect();
    if !hull.is_empty() {
        measure(&mut found, &hull, &point, control)?;
    }
    let mut depths = vec![0.0; n];
    for (i, depth) in found {
        depths[i as usize] = depth;
    }
    Ok(depths)
}

/// Sets the depth of each vertex, given by its index, below the planes of a hull. Divides the vertices in halves with
/// ever fewer planes.
fn measure(
    vertices: &mut [(u32, f32)],
    planes: &[Plane],
    point: &(impl Fn(usize) -> Point + Sync),
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
    control.check()?;
    let points = vertices.iter().map(|(i, _)| [point(*i as usize); 2]);
    let [low, high] = points.fold([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], joined_bounds);
    let centre = add(low, high).map(|sum| 0.5 * sum);
    let sides = sub(high, low);
    let lowest =
        |point: Point, planes: &[Plane]| planes.iter().map(|plane| -plane.height(point)).fold(f64::INFINITY, f64::min);
    // In the bounding box, distances from a plane differ from that of the centre by half the diagonal at most.
    let most = lowest(centre, planes) + length(sides);
    let near: Vec<Plane> = planes.iter().filter(|plane| -plane.height(centre) <= most).copied().collect();
    if vertices.len().min(near.len()) <= FEW {
        for (i, depth) in vertices {
            *depth = single(lowest(point(*i as usize), &near).max(0.0));
        }
        return Ok(());
    }
    let axis = if sides[0] >= sides[1].max(sides[2]) { 0 } else { 1 + usize::from(sides[2] > sides[1]) };
    let along = |(i, _): &(u32, f32)| point(*i as usize)[axis];
    let middle = vertices.len() / 2;
    vertices.select_nth_unstable_by(middle, |a, b| along(a).total_cmp(&along(b)));
    let (below, above) = vertices.split_at_mut(middle);
    let half = |vertices| measure(vertices, &near, point, control);
    let (below, above) = rayon::join(|| half(below), || half(above));
    below.and(above)
}

/// Returns the planes of the convex hull of `n` points, up to the tolerance; none if the points lie in one plane.
fn hull(
    n: usize,
    point: &(impl Fn(usize) -> Point + Sync),
    memory: &impl MemoryMeter,
    control: &Control<'_>,
) -> Result<Vec<Plane>, SurfaceError> {
    let displaced = |i: u32| -> Point {
        let point = point(i as usize);
        std::array::from_fn(|k| point[k] + DISPLACEMENT * random(3 * u64::from(i) + k as u64))
    };
    let facet =
        |corners: [u32; 3]| Facet { corners, plane: Plane::through(corners.map(displaced)), outside: Vec::new() };
    let Some([a, b, c, d]) = tetrahedron(n, displaced) else { return Ok(Vec::new()) };
    let (mut facets, mut next, mut counted) = (FxHashMap::default(), 0_u64, 0);
    // Facet of each directed edge. Its neighbour at the edge has the opposite one.
    let mut facet_of: FxHashMap<[u32; 2], u64> = FxHashMap::default();
    // Facets that have had points outside.
    let mut pending = Vec::new();
    let mut new: Vec<Facet> = [[a, b, c], [a, c, d], [a, d, b], [b, d, c]].map(facet).into();
    let mut points: Vec<u32> = indices(n).collect();
    loop {
        control.check()?;
        assign(&mut new, points, displaced);
        for facet in new {
            facet_of.extend(edges(facet.corners).map(|edge| (edge, next)));
            pending.extend((!facet.outside.is_empty()).then_some(next));
            facets.insert(next, facet);
            next += 1;
        }
        let uncounted = facets.len().saturating_sub(counted);
        memory.grow(FACET_BYTES * uncounted as u64)?;
        counted += uncounted;
        let Some(from) = std::iter::from_fn(|| pending.pop()).find(|id| facets.contains_key(id)) else { break };
        let heights = facets[&from].outside.iter().map(|&i| (facets[&from].plane.height(displaced(i)), i));
        let Some((_, eye)) = heights.max_by(|a, b| a.0.total_cmp(&b.0)) else { break };
        let top = displaced(eye);
        // The facets below the point are connected. The edges of their outline are the horizon.
        let (mut seen, mut horizon) = (vec![from], Vec::new());
        points = Vec::new();
        while let Some(id) = seen.pop() {
            let Some(Facet { corners, outside, .. }) = facets.remove(&id) else { continue };
            points.extend(outside.into_iter().filter(|i| *i != eye));
            for [a, b] in edges(corners) {
                facet_of.remove(&[a, b]);
                match facet_of.get(&[b, a]) {
                    Some(neighbour) if facets[neighbour].plane.height(top) > 0.0 => seen.push(*neighbour),
                    Some(_) => horizon.push([a, b]),
                    None => {}
                }
            }
        }
        // A point above a facet that was removed is above a new one, or inside.
        new = horizon.into_iter().map(|[a, b]| facet([a, b, eye])).collect();
    }
    Ok(facets.into_values().map(|facet| facet.plane).collect())
}

/// Returns the directed edges of a triangle.
fn edges([a, b, c]: [u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]]
}

/// Returns the indices of `n` points. Meshes have 32-bit indices.
fn indices(n: usize) -> Range<u32> {
    0..u32::try_from(n).unwrap_or(u32::MAX)
}

/// Adds each point to the list of the facet that it is farthest above, unless it is inside all of them.
fn assign(facets: &mut [Facet], points: Vec<u32>, displaced: impl Fn(u32) -> Point + Sync) {
    let highest = |i: u32| {
        let point = displaced(i);
        let heights = facets.iter().map(|facet| facet.plane.height(point)).enumerate();
        heights.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, height)| *height > TOLERANCE).map(|(at, _)| (at, i))
    };
    let found: Vec<(usize, u32)> = points.into_par_iter().with_min_len(POINTS_PER_TASK).filter_map(highest).collect();
    for (at, i) in found {
        facets[at].outside.push(i);
    }
}

/// Returns four points that span a tetrahedron, with the fourth one below the plane of the others; `None` if all points
/// lie in one plane.
fn tetrahedron(n: usize, displaced: impl Fn(u32) -> Point + Sync) -> Option<[u32; 4]> {
    let farthest = |measure: &(dyn Fn(Point) -> f64 + Sync)| {
        let measured = indices(n).into_par_iter().map(|i| (measure(displaced(i)), i));
        measured.max_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
    };
    let (_, a) = farthest(&|p| p[0])?;
    let from = displaced(a);
    let (_, b) = farthest(&|p| length(sub(p, from)))?;
    let along = sub(displaced(b), from);
    let (_, c) = farthest(&|p| length(cross(along, sub(p, from))))?;
    let plane = Plane::through([a, b, c].map(&displaced));
    let (height, d) = farthest(&|p| plane.height(p).abs())?;
    let is_below = plane.height(displaced(d)) < 0.0;
    // The height is not a number if all points lie on one line.
    (height > TOLERANCE).then_some(if is_below { [a, b, c, d] } else { [a, c, b, d] })
}

/// Returns a number from −1 to 1 that depends on `seed` alone (`SplitMix64`).
fn random(seed: u64) -> f64 {
    let mut z = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(points: &[Point]) -> Vec<f64> {
        let found = depths(points.len(), |i| points[i], &Control::default()).unwrap();
        found.into_iter().map(f64::from).collect()
    }

    fn worst(found: &[f64], expected: &[f64]) -> f64 {
        found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// Surface of a cube with the side 20 and a hemispherical pit of this radius in its upper side, at z = 0.
    fn cube_with_pit(radius: f64) -> Vec<Point> {
        let mut points = Vec::new();
        for i in 0..=40 {
            for j in 0..=40 {
                let [u, v] = [i, j].map(|i| f64::from(i) * 0.5 - 10.0);
                points.extend([[u, v, -20.0], [u, -10.0, v - 10.0], [u, 10.0, v - 10.0]]);
                points.extend([[-10.0, u, v - 10.0], [10.0, u, v - 10.0]]);
                if u.hypot(v) > radius {
                    points.push([u, v, 0.0]);
                }
                let (polar, azimuth) = (f64::from(i) / 80.0, f64::from(j) / 40.0);
                let [polar, azimuth] = [polar * std::f64::consts::PI, azimuth * std::f64::consts::TAU];
                let across = radius * polar.sin();
                points.push([across * azimuth.cos(), across * azimuth.sin(), -radius * polar.cos()]);
            }
        }
        points
    }

    #[test]
    fn a_hemispherical_pit_is_as_deep_as_its_radius() {
        for radius in [1.0, 6.0] {
            let points = cube_with_pit(radius);
            let walls = |p: &Point| p[0].abs().max(p[1].abs()).max((p[2] + 10.0).abs());
            let expected: Vec<f64> = points.iter().map(|p| 10.0 - walls(p)).collect();
            let found = of(&points);
            assert!(worst(&found, &expected) < 2e-4, "{}", worst(&found, &expected));
            // The distance from the bottom of the pit to its own rim is not the depth.
            assert!((found.iter().copied().fold(0.0, f64::max) - radius).abs() < 2e-4);
        }
    }

    #[test]
    fn depths_are_those_of_all_planes_through_three_points() {
        let points: Vec<Point> =
            (0..40).map(|i| std::array::from_fn(|k| 20.0 * random(1_000_000 + 3 * i + k as u64))).collect();
        // A facet of the hull is a plane through three points that has no point above it.
        let mut expected = vec![f64::INFINITY; points.len()];
        let mut n = 0;
        for (i, a) in points.iter().enumerate() {
            for (j, b) in points.iter().enumerate() {
                for (k, c) in points.iter().enumerate() {
                    if i == j || j == k || k == i {
                        continue;
                    }
                    let plane = Plane::through([*a, *b, *c]);
                    if points.iter().all(|p| plane.height(*p) < 1e-9) {
                        n += 1;
                        expected.iter_mut().zip(&points).for_each(|(depth, p)| *depth = depth.min(-plane.height(*p)));
                    }
                }
            }
        }
        assert!(n >= 3 * 8, "{n}");
        assert!(worst(&of(&points), &expected) < 2e-4);
        // Without one corner of the hull, the depths are others.
        let corner = expected.iter().position(|depth| *depth < 1e-9).unwrap();
        let others: Vec<Point> = points.iter().enumerate().filter(|(i, _)| *i != corner).map(|(_, p)| *p).collect();
        expected.remove(corner);
        assert!(worst(&of(&others), &expected) > 0.1);
    }

    #[test]
    fn points_of_a_ball_have_depth_0() {
        let points: Vec<Point> = (0..2_000_u64)
            .map(|i| {
                let p: Point = std::array::from_fn(|k| random(3 * i + k as u64));
                let size = length(p);
                p.map(|v| 50.0 * v / size)
            })
            .collect();
        let found = of(&points);
        assert!(found.iter().all(|depth| *depth < 2.0 * TOLERANCE), "{:?}", found.iter().copied().fold(0.0, f64::max));
    }

    #[test]
    fn flat_and_small_sets_have_depth_0() {
        let flat: Vec<Point> = (0..100).map(|i| [f64::from(i % 10), f64::from(i / 10), 3.0]).collect();
        for n in [0, 1, 2, 3, 4, 100] {
            assert_eq!(of(&flat[..n]), vec![0.0; n], "{n}");
        }
        assert_eq!(of(&[[1.0; 3]; 9]), [0.0; 9]);
    }
}
