//! Distances compared with closed forms, and with points spread over the exposed parts of the spheres.

#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::float_cmp,
    reason = "random numbers are from 0 to 1, and exact equality is intended"
)]

use std::f64::consts::PI;

use super::*;
use crate::vector::{length, sub};

/// Centre and radius, Å.
type Ball = ([f64; 3], f64);

fn atom(&(centre, radius): &Ball) -> LatticeAtom {
    let cell = centre.map(f64::round);
    let frac = std::array::from_fn(|k| to_f32(centre[k] - cell[k]));
    LatticeAtom { cell: cell.map(to_i32), inv_length2: to_f32(radius.powi(-2)), frac, source: 0 }
}

/// Point of the boundary that is nearest to a point, and the signed distance to it.
#[derive(Debug, Clone, Copy)]
struct Found {
    distance: f64,
    vector: [f64; 3],
    on_arc: bool,
}

/// Evaluates the distance at points on a lattice of 1 Å; it is exact up to `level`.
fn distances(balls: &[Ball], level: f64, points: &[[f64; 3]]) -> Vec<Found> {
    let atoms: Vec<LatticeAtom> = balls.iter().map(atom).collect();
    let (limits, control) = (SurfaceLimits::default(), Control::default());
    let (union, bounds) = SphereUnion::new(&atoms, 1.0, level + 1.0, &limits, &control).unwrap();
    let mut brick = BrickUnion::default();
    brick.load([0; 3], (0..).zip(&atoms), (0..).zip(&bounds).zip(&union.arcs).map(|((i, bound), arc)| (i, bound, arc)));
    let evaluate = |points: &[[f64; 3]]| {
        let lanes: Lanes = std::array::from_fn(|k| std::array::from_fn(|i| to_f32(points[i.min(points.len() - 1)][k])));
        let found = brick.nearest(Some(&union), to_f32(level), &lanes);
        let outward = |lane: usize| {
            let vector = brick.outward(&found, &lanes, lane);
            let on_arc = brick.feature(&found, lane).arc().is_ok();
            Found { distance: f64::from(found.distance[lane]), vector: vector.map(f64::from), on_arc }
        };
        (0..points.len()).map(outward).collect::<Vec<_>>()
    };
    points.chunks(16).map(evaluate).collect::<Vec<_>>().concat()
}

fn distance(balls: &[Ball], level: f64, point: [f64; 3]) -> f64 {
    distances(balls, level, &[point])[0].distance
}

/// Returns the distance from the point to the sphere in which it lies deepest.
fn depth(balls: &[Ball], x: [f64; 3]) -> f64 {
    balls.iter().map(|(c, r)| r - length(sub(x, *c))).fold(f64::MIN, f64::max)
}

/// Returns evenly spread points of a unit sphere.
fn spread(n: u32) -> impl Iterator<Item = [f64; 3]> {
    (0..n).map(move |i| {
        let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
        let (sin, cos) = (f64::from(i) * PI * (3.0 - 5.0_f64.sqrt())).sin_cos();
        let r = (1.0 - z * z).sqrt();
        [r * cos, r * sin, z]
    })
}

/// Returns points on the boundary: `n` per sphere, without those within another sphere.
fn boundary(balls: &[Ball], n: u32) -> Vec<[f64; 3]> {
    let on = |&(c, r): &Ball| spread(n).map(move |u| std::array::from_fn(|k| c[k] + r * u[k]));
    balls.iter().flat_map(on).filter(|p| depth(balls, *p) < 1e-9).collect()
}

/// Returns pseudorandom numbers from 0 to 1, the same in every run.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        f64::from(to_u32((self.0 >> 40) as usize)) / f64::from(1_u32 << 24)
    }

    fn point(&mut self, half: f64) -> [f64; 3] {
        std::array::from_fn(|_| half * (2.0 * self.next() - 1.0))
    }
}

/// Checks distances at `points`: the nearest point lies on the boundary, and no point of the boundary is nearer.
fn check(what: &str, balls: &[Ball], level: f64, n: u32, points: &[[f64; 3]]) {
    let boundary = boundary(balls, n);
    for (x, found) in points.iter().zip(distances(balls, level, points)) {
        let deepest = depth(balls, *x);
        if deepest <= 0.0 {
            assert!((found.distance - deepest).abs() < 1e-4, "{what}: {x:?} {found:?} {deepest}");
            continue;
        }
        if deepest > level {
            assert!(found.distance > level - 1e-4, "{what}: {x:?} {found:?} {deepest}");
            continue;
        }
        let nearest = boundary.iter().map(|p| length(sub(*p, *x))).fold(level + 1.0, f64::min);
        assert!(found.distance < nearest + 1e-4, "{what}: {x:?} {found:?}, but a point is {nearest} away");
        if found.distance < level {
            // The vector leads to a point of an arc, or comes from the centre of the face's sphere.
            let length = length(found.vector);
            let scale = if found.on_arc { 1.0 } else { found.distance / length };
            let foot: [f64; 3] = std::array::from_fn(|k| x[k] + scale * found.vector[k]);
            let off = depth(balls, foot);
            assert!(off.abs() < 1e-4, "{what}: {x:?} {found:?}, {foot:?} is {off} from the boundary");
            assert!((scale * length - found.distance).abs() < 1e-4, "{what}: {x:?} {found:?}");
        }
    }
}

/// Returns random points around the spheres.
fn around(balls: &[Ball], numbers: &mut Numbers, n: usize) -> Vec<[f64; 3]> {
    let point = |_| {
        let (centre, r) = balls[(numbers.next() * balls.len() as f64) as usize % balls.len()];
        let offset = numbers.point(r);
        std::array::from_fn(|k| centre[k] + offset[k])
    };
    (0..n).map(point).collect()
}

#[test]
fn one_sphere_has_its_own_distance() {
    let ball = [([0.3, -0.2, 0.1], 3.1)];
    for d in [0.1, 1.8, 3.0, 3.2] {
        let x = [0.3 + d * 0.6, -0.2 + d * 0.8, 0.1];
        assert!((distance(&ball, 3.0, x) - (3.1 - d)).abs() < 1e-5, "{d}");
    }
}

#[test]
fn two_spheres_have_a_torus_with_or_without_a_cusp() {
    let r = 3.1_f64;
    for apart in [1.0, 4.0, 5.9] {
        let balls = [([0.0; 3], r), ([0.0, 0.0, apart], r)];
        let rho = (r * r - apart * apart / 4.0).sqrt();
        // On the middle plane, the circle is nearest at any position.
        for y in [0.0, 0.3, 0.5 * rho, 0.9 * rho] {
            let found = distance(&balls, 4.0, [y, 0.0, apart / 2.0]);
            assert!((found - (rho - y)).abs() < 1e-5, "{apart} {y}: {found}");
        }
        // Beside it, but still between the lines from both centres to the circle.
        let (y, z) = (0.5 * rho, 0.2 * apart);
        let found = distance(&balls, 4.0, [0.0, y, apart / 2.0 + z]);
        assert!((found - (rho - y).hypot(z)).abs() < 1e-5, "{apart}: {found}");
    }
}

#[test]
fn three_spheres_have_a_concave_triangle() {
    for (side, r) in [(2.0_f64, 3.0_f64), (4.0, 3.1), (5.0, 3.0)] {
        let out = side / 3.0_f64.sqrt();
        let corner = |k: f64| [out * (2.0 * PI * k / 3.0).cos(), out * (2.0 * PI * k / 3.0).sin(), 0.0];
        let balls = [0.0, 1.0, 2.0].map(|k| (corner(k), r));
        let height = (r * r - out * out).sqrt();
        // Both vertices lie on the axis; at height 0 they are equally far. With r = 3 and side 5, they nearly meet.
        for z in [-0.9, -0.5, 0.0, 0.2, 0.7].map(|share| share * height) {
            let found = distance(&balls, 4.0, [0.0, 0.0, z]);
            assert!((found - (height - z.abs())).abs() < 2e-5, "{side} {z}: {found} {height}");
        }
    }
}

#[test]
fn touching_nested_and_equal_spheres_change_nothing() {
    let mut numbers = Numbers(7);
    let one = [([0.0; 3], 3.0)];
    let points: Vec<[f64; 3]> = (0..200).map(|_| numbers.point(3.2)).collect();
    let alone = distances(&one, 2.0, &points);
    for (what, more) in [
        ("touching", ([6.0, 0.0, 0.0], 3.0)),
        ("nested", ([0.5, 0.5, 0.0], 1.0)),
        ("nested and touching", ([1.0, 0.0, 0.0], 2.0)),
        ("equal", ([0.0; 3], 3.0)),
    ] {
        for balls in [[one[0], more], [more, one[0]]] {
            for ((x, alone), found) in points.iter().zip(&alone).zip(distances(&balls, 2.0, &points)) {
                // The touching sphere has points of its own.
                if depth(&balls[..], *x) == depth(&one, *x) {
                    assert!((alone.distance - found.distance).abs() < 1e-5, "{what}: {x:?} {alone:?} {found:?}");
                }
            }
        }
    }
}

#[test]
fn degenerate_arrangements_match_points_on_the_boundary() {
    let mut numbers = Numbers(1);
    let line: Vec<Ball> = (0..6).map(|i| ([0.0, 0.0, 1.5 * f64::from(i)], 3.1)).collect();
    let grid = |n: i32, a: f64, r: f64| -> Vec<Ball> {
        let index = (0..n).flat_map(move |z| (0..n).flat_map(move |y| (0..n).map(move |x| [x, y, z])));
        index.map(|at| (at.map(|c| a * f64::from(c)), r)).collect()
    };
    // Carbon atoms of buckminsterfullerene: even permutations of three kinds of points, edge 1.45 Å.
    let golden = f64::midpoint(1.0, 5.0_f64.sqrt());
    let signs = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]];
    let kinds = [[0.0, 1.0, 3.0 * golden], [1.0, 2.0 + golden, 2.0 * golden], [2.0, 1.0 + 2.0 * golden, golden]];
    let mut fullerene: Vec<Ball> = Vec::new();
    for kind in kinds {
        for ([a, b], c) in signs.iter().flat_map(|s| [(s, 1.0), (s, -1.0)]) {
            let v = [kind[0] * a, kind[1] * b, kind[2] * c];
            for turn in 0..3 {
                let at = std::array::from_fn(|k| 0.725 * v[(k + turn) % 3] + 0.1);
                if !fullerene.iter().any(|(p, _)| length(sub(*p, at)) < 1e-6) {
                    fullerene.push((at, 3.1));
                }
            }
        }
    }
    assert_eq!(fullerene.len(), 60);
    for (what, balls, level) in [
        ("line", line.clone(), 1.4),
        ("line, large probe", line.iter().map(|(c, _)| (*c, 11.7)).collect(), 10.0),
        ("cube", grid(2, 3.0, 3.0), 1.4),
        ("cubic lattice", grid(4, 3.6, 3.1), 1.4),
        ("cubic lattice whose holes just close", grid(3, 2.0, 3.0_f64.sqrt()), 1.0),
        ("fullerene", fullerene.clone(), 1.4),
        ("fullerene, large probe", fullerene.iter().map(|(c, _)| (*c, 11.7)).collect(), 10.0),
    ] {
        check(what, &balls, level, 3000, &around(&balls, &mut numbers, 400));
    }
}

#[test]
fn random_clusters_match_points_on_the_boundary() {
    let clusters = std::env::var("MOLMESH_CLUSTERS").map_or(80, |number| number.parse().unwrap());
    for cluster in 0..clusters {
        let mut numbers = Numbers(cluster);
        let n = 2 + (numbers.next().powi(2) * 199.0) as usize;
        let half = 0.5 * (n as f64).cbrt() * (1.0 + 2.5 * numbers.next());
        let level = 0.2 + 2.0 * numbers.next();
        let mut balls: Vec<Ball> = (0..n).map(|_| (numbers.point(half), level + 0.5 + 1.5 * numbers.next())).collect();
        if cluster % 5 == 0 {
            balls.push(balls[0]);
        }
        check(&format!("cluster {cluster}"), &balls, level, 400, &around(&balls, &mut numbers, 128));
    }
}
