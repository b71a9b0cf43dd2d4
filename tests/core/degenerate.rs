//! Exact measures are continuous: where probes touch more than three spheres, or spheres nearly coincide, a small
//! perturbation changes area and volume by its order only.

use crate::exact_measures::{Numbers, exact, fullerene};
use crate::sphere_surfaces::Ball;

use std::f64::consts::PI;

use molmesh::surface::SurfaceKind;

/// Largest relative change that rounding alone causes.
const ROUNDING: f64 = 1e-5;

/// Largest relative change of an area or a volume for each Å of a perturbation, 1/Å.
const SLOPE: f64 = 3.0;

/// Returns `n` spheres of radius `r` on a circle around the z axis.
fn ring(n: u32, circle: f64, z: f64, turn: f64, r: f64) -> impl Iterator<Item = Ball> {
    (0..n).map(move |i| {
        let (sin, cos) = (2.0 * PI * (f64::from(i) + turn) / f64::from(n)).sin_cos();
        ([circle * cos, circle * sin, z], r)
    })
}

/// Returns `n`³ spheres of radius `r` on a cubic lattice.
fn cubic(n: i32, spacing: f64, r: f64) -> Vec<Ball> {
    let row = |i: i32| f64::from(i) * spacing;
    (0..n.pow(3)).map(|i| ([row(i % n), row(i / n % n), row(i / n / n)], r)).collect()
}

fn shapes() -> Vec<(&'static str, Vec<Ball>)> {
    let benzene = ring(6, 1.39, 0.0, 0.0, 1.7).chain(ring(6, 2.48, 0.0, 0.0, 1.1)).collect();
    let tube = (0..6).flat_map(|k| ring(8, 3.0, 1.23 * f64::from(k), 0.5 * f64::from(k % 2), 1.7)).collect();
    let helix = (0..30_u32).flat_map(|i| ring(1, 2.3, 1.5 * f64::from(i), f64::from(i) / 3.6, 1.9)).collect();
    let golden = f64::midpoint(1.0, 5.0_f64.sqrt());
    let corner = |i: usize| {
        let [a, b] = [0, 1].map(|bit| if i >> bit & 1 == 0 { 1.5 } else { -1.5 });
        (std::array::from_fn(|k| [0.0, a, b * golden][(k + i / 4) % 3]), 1.6)
    };
    let graphene = (0..32_u32).map(|i| {
        let [x, y] = [i / 2 % 4, i / 8].map(|cell| f64::from(cell) + f64::from(i % 2) / 3.0);
        ([2.46 * (x + 0.5 * y), 2.46 * 0.75_f64.sqrt() * y, 0.0], 1.7)
    });
    let twice = [1.7, 1.7, 1.6].into_iter().flat_map(|r| cubic(2, 2.0, r)).collect();
    vec![
        ("benzene", benzene),
        ("fullerene", fullerene()),
        ("nanotube", tube),
        ("graphene", graphene.collect()),
        ("helix", helix),
        ("icosahedron", (0..12).map(corner).collect()),
        ("cubic lattice", cubic(3, 3.6, 1.7)),
        ("integer lattice", cubic(3, 3.0, 1.7)),
        ("dense lattice", cubic(4, 1.0, 1.5)),
        ("coincident spheres", twice),
    ]
}

/// Number from the standard normal distribution.
fn normal(numbers: &mut Numbers) -> f64 {
    let (a, b) = (1.0 - numbers.next(), numbers.next());
    (-2.0 * a.ln()).sqrt() * (2.0 * PI * b).cos()
}

/// Turns and shifts the spheres at random.
fn turned(balls: &[Ball], numbers: &mut Numbers) -> Vec<Ball> {
    let q: [f64; 4] = std::array::from_fn(|_| normal(numbers));
    let [w, x, y, z] = q.map(|c| c / q.iter().map(|c| c * c).sum::<f64>().sqrt());
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let shift: [f64; 3] = std::array::from_fn(|_| 20.0 * numbers.next());
    let place = |c: [f64; 3]| std::array::from_fn(|k| (0..3).map(|l| rows[k][l] * c[l]).sum::<f64>() + shift[k]);
    balls.iter().map(|&(centre, r)| (place(centre), r)).collect()
}

#[test]
fn exact_measures_change_by_the_order_of_a_perturbation() {
    let measures = |balls: &[Ball], surface: SurfaceKind, probe: f64| {
        let found = exact(balls, surface, (surface != SurfaceKind::Vdw).then_some(probe));
        [found.area(), found.volume]
    };
    // More directions: MOLMESH_DIRECTIONS=30.
    let directions: u64 = std::env::var("MOLMESH_DIRECTIONS").map_or(1, |number| number.parse().unwrap());
    let mut larger = 0;
    for (what, balls) in &shapes() {
        for probe in [0.5, 1.1, 1.4, 2.0, 3.0, 10.0] {
            let surfaces = [SurfaceKind::Ses, SurfaceKind::Sas, SurfaceKind::Vdw];
            for surface in surfaces.into_iter().take(if probe > 0.5 { 2 } else { 3 }) {
                let still = measures(balls, surface, probe);
                let change = |numbers: &mut Numbers, is_turned: bool, noise: f64| {
                    let mut moved = if is_turned { turned(balls, numbers) } else { balls.clone() };
                    moved.iter_mut().flat_map(|(c, _)| c).for_each(|x| *x += noise * normal(numbers));
                    let [area, volume] = measures(&moved, surface, probe);
                    (area / still[0] - 1.0).abs().max((volume / still[1] - 1.0).abs())
                };
                let noises = [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13, 1e-14, 0.0];
                for (noise, k) in noises.into_iter().zip(0_u64..) {
                    for seed in 0..directions {
                        let mut numbers = Numbers(seed << 8 | k);
                        let change = change(&mut numbers, (seed + k).is_multiple_of(2), noise);
                        let limit = ROUNDING + SLOPE * noise;
                        assert!(change < limit, "{what}, {surface}, probe {probe}, noise {noise}: {change}");
                    }
                }
                larger += usize::from(change(&mut Numbers(1), true, 0.03) > 1e-3);
            }
        }
    }
    assert!(larger > 50, "the control: a larger perturbation changes {larger} measures");
}

#[test]
fn exact_measures_do_not_depend_on_the_distance_from_the_origin() {
    let lattice = cubic(3, 3.6, 1.7);
    let measures = |balls: &[Ball]| {
        let found = exact(balls, SurfaceKind::Ses, Some(3.0));
        [found.parts().concave, found.area(), found.volume]
    };
    let near = measures(&turned(&lattice, &mut Numbers(1)));
    let distant = ([9e4, 2e4, -5e4], 2.0);
    let alone = measures(&[distant]);
    // The lattice is far from the middle of all spheres, to which integrals refer.
    let both = measures(&[&turned(&lattice, &mut Numbers(1))[..], &[distant]].concat());
    for ((both, alone), (near, limit)) in both.iter().zip(alone).zip(near.iter().zip([1e-6, 1e-6, 1e-4])) {
        assert!(((both - alone) / near - 1.0).abs() < limit, "{both} − {alone}, {near}");
    }
}

#[test]
fn a_probe_that_just_fits_between_three_spheres_is_cut_by_that_on_the_other_side() {
    let balls = [[0.25, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.25]].map(|centre| (centre, 0.1));
    let fits = (2.0_f64 / 3.0).sqrt() / 4.0 - 0.1;
    let [found, wider] = [0.0, 1e-6].map(|more| exact(&balls, SurfaceKind::Ses, Some(fits + more)).area());
    assert!((found / wider - 1.0).abs() < 0.03, "{found}, {wider}");
    assert!((found / 0.529 - 1.0).abs() > 0.2, "the area of both probes uncut: {found}");
}
