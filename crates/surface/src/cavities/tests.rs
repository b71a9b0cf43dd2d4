//! Cavities compared with a flood fill of a fine grid in double precision.

use std::f64::consts::PI;

use super::*;
use crate::params::SurfaceOptions;
use crate::sphere_union::ExactMeasures;

/// Centre and radius, Å.
type Ball = ([f64; 3], f64);

fn spheres(balls: &[Ball]) -> Spheres {
    let column = |k: usize| balls.iter().map(|(centre, _)| centre[k]).collect();
    #[expect(clippy::cast_possible_truncation, reason = "radii are single precision")]
    let radii = balls.iter().map(|(_, radius)| *radius as f32).collect();
    Spheres::new(column(0), column(1), column(2), radii).unwrap()
}

fn params(probe: f64) -> SurfaceParams {
    let options = SurfaceOptions { surface: Some(SurfaceKind::Ses), probe: Some(probe), ..SurfaceOptions::default() };
    SurfaceParams::new(&options).unwrap()
}

fn cavities(balls: &[Ball], probe: f64) -> Vec<Cavity> {
    find(&spheres(balls), &params(probe), &SurfaceLimits::default(), &Control::default()).unwrap()
}

/// Returns a hollow ball of `n` spheres.
fn hollow(centre: [f64; 3], radius: f64, n: u32) -> Vec<Ball> {
    let on = |i: u32| {
        let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
        let (sin, cos) = (f64::from(i) * PI * (3.0 - 5.0_f64.sqrt())).sin_cos();
        let r = (1.0 - z * z).sqrt();
        ([centre[0] + radius * r * cos, centre[1] + radius * r * sin, centre[2] + radius * z], 1.7)
    };
    (0..n).map(on).collect()
}

/// Region of a grid in which the distance from all spheres is at least `probe`, without a way out: volume, distance
/// from the enlarged spheres at the deepest point, and this point.
#[derive(Debug)]
struct Region {
    volume: f64,
    deepest: (f64, [f64; 3]),
}

/// Distances of grid points from the enlarged spheres.
struct Grid {
    low: [f64; 3],
    n: [usize; 3],
    h: f64,
    depths: Vec<f64>,
}

/// Evaluates the grid of spacing `h` around the spheres.
fn grid(balls: &[Ball], probe: f64, h: f64) -> Grid {
    let reach = balls.iter().map(|(_, r)| r + probe).fold(0.0, f64::max) + 2.0 * h;
    let bound = |k: usize, sign: f64| balls.iter().map(|(c, _)| sign * c[k]).fold(f64::MIN, f64::max);
    let low: [f64; 3] = std::array::from_fn(|k| -bound(k, -1.0) - reach);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a small positive number")]
    let n: [usize; 3] = std::array::from_fn(|k| ((bound(k, 1.0) + reach - low[k]) / h).ceil() as usize + 1);
    let depth = |i: usize| {
        let at = [i % n[0], i / n[0] % n[1], i / (n[0] * n[1])];
        let x: [f64; 3] = std::array::from_fn(|k| low[k] + h * at[k] as f64);
        let distance = |(c, r): &Ball| ((0..3).map(|k| (x[k] - c[k]).powi(2)).sum::<f64>()).sqrt() - r - probe;
        balls.iter().map(distance).fold(f64::MAX, f64::min)
    };
    Grid { low, n, h, depths: (0..n[0] * n[1] * n[2]).into_par_iter().map(depth).collect() }
}

/// Finds the closed regions. Neighbours are connected if their distances from the enlarged spheres exceed `margin`; a
/// negative one connects more points.
fn fill(grid: &Grid, margin: f64) -> Vec<Region> {
    let Grid { low, n, h, ref depths } = *grid;
    let at = |i: usize| [i % n[0], i / n[0] % n[1], i / (n[0] * n[1])];
    let point = |i: usize| -> [f64; 3] { std::array::from_fn(|k| low[k] + h * at(i)[k] as f64) };
    let mut seen = vec![false; depths.len()];
    let mut regions = Vec::new();
    for start in 0..depths.len() {
        if seen[start] || depths[start] <= margin {
            continue;
        }
        seen[start] = true;
        let (mut stack, mut members, mut open) = (vec![start], Vec::new(), false);
        while let Some(i) = stack.pop() {
            members.push(i);
            let place = at(i);
            open |= (0..3).any(|k| place[k] == 0 || place[k] == n[k] - 1);
            for (k, step) in [1, n[0], n[0] * n[1]].into_iter().enumerate() {
                let near = [(place[k] > 0).then(|| i - step), (place[k] + 1 < n[k]).then(|| i + step)];
                for j in near.into_iter().flatten() {
                    if !seen[j] && depths[j] > margin {
                        seen[j] = true;
                        stack.push(j);
                    }
                }
            }
        }
        members.retain(|&i| depths[i] > 0.0);
        let deepest = members.iter().copied().max_by(|a, b| depths[*a].total_cmp(&depths[*b]));
        if let (false, Some(deepest)) = (open, deepest) {
            let volume = h * h * h * members.len() as f64;
            regions.push(Region { volume, deepest: (depths[deepest], point(deepest)) });
        }
    }
    regions
}

fn close(what: &str, found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() <= tolerance * expected.abs(), "{what}: {found}, expected {expected}");
}

/// Compares a cavity with the region of a flood fill.
fn check(what: &str, balls: &[Ball], probe: f64, cavity: &Cavity, region: &Region, h: f64) {
    close(what, cavity.accessible_volume, region.volume, 0.02);
    let (depth, _) = region.deepest;
    assert!(cavity.radius >= depth + probe - RADIUS_ERROR && cavity.radius <= depth + probe + h, "{what}: {cavity:?}");
    let gap = |(c, r): &Ball| (0..3).map(|k| (cavity.centre[k] - c[k]).powi(2)).sum::<f64>().sqrt() - r;
    let clear = balls.iter().map(gap).fold(f64::MAX, f64::min);
    assert!((clear - cavity.radius).abs() < 1e-5, "{what}: a sphere of {} does not fit, {clear} does", cavity.radius);
    // The region shrinks by its area as the probe grows. Differences of volumes do not use the formula of areas.
    let volume = |probe: f64| cavities(balls, probe).iter().map(|c| c.accessible_volume).sum::<f64>();
    if cavities(balls, probe).len() == 1 {
        close(what, cavity.accessible_area, (volume(probe - 1e-4) - volume(probe + 1e-4)) / 2e-4, 1e-3);
    }
}

#[test]
fn hollow_balls_have_one_cavity_each() {
    let probe = 1.4;
    let one = hollow([0.3, -0.2, 0.1], 7.0, 130);
    let found = cavities(&one, probe);
    let [cavity] = &found[..] else { panic!("{found:?}") };
    let regions = fill(&grid(&one, probe, 0.2), 0.0);
    check("one", &one, probe, cavity, &regions[0], 0.2);
    // Another probe is the control: the volumes differ by more than the tolerance.
    let other = cavities(&one, probe + 0.1)[0].accessible_volume;
    assert!((other / regions[0].volume - 1.0).abs() > 0.04, "{other}");
    assert!(cavity.lining.len() > 100 && cavity.lining.is_sorted());
    assert!((cavity.radius - 5.3).abs() < 0.1, "{}", cavity.radius);
    assert!(cavity.opening_radius <= 0.0, "the spheres overlap, but {} is open", cavity.opening_radius);
    assert!((0..3).all(|k| (cavity.centre[k] - [0.3, -0.2, 0.1][k]).abs() < 0.3));
    // Two of them, and a third one apart that is too small for a probe.
    let mut two = [hollow([0.0; 3], 7.0, 130), hollow([17.0, 0.0, 0.0], 6.0, 110)].concat();
    two.extend(hollow([40.0, 0.0, 0.0], 2.9, 40));
    let found = cavities(&two, probe);
    let volumes: Vec<f64> = fill(&grid(&two, probe, 0.2), 0.0).iter().map(|region| region.volume).collect();
    assert_eq!((found.len(), volumes.len()), (2, 2));
    let [most, least] = [f64::max(volumes[0], volumes[1]), f64::min(volumes[0], volumes[1])];
    close("larger", found[0].accessible_volume, most, 0.02);
    close("smaller", found[1].accessible_volume, least, 0.02);
    // A smaller probe finds the third one.
    assert_eq!(cavities(&two, 0.7).len(), 3);
}

#[test]
fn molecules_inside_a_cavity_reduce_it() {
    let probe = 1.4;
    let wall = hollow([0.0; 3], 12.5, 420);
    let with = |inside: &[Ball]| [&wall[..], inside].concat();
    let [empty] = &cavities(&wall, probe)[..] else { panic!("one cavity") };
    // One atom, which touches no other atom: its measures have closed forms.
    let found = cavities(&with(&[([0.2, 0.1, -0.3], 1.7)]), probe);
    let [one] = &found[..] else { panic!("{found:?}") };
    let (area, volume) = (|r: f64| 4.0 * PI * r * r, |r: f64| 4.0 / 3.0 * PI * r * r * r);
    close("area", one.area, empty.area + area(1.7), 1e-7);
    close("volume", one.volume, empty.volume - volume(1.7), 1e-7);
    close("accessible area", one.accessible_area, empty.accessible_area + area(3.1), 1e-7);
    close("accessible volume", one.accessible_volume, empty.accessible_volume - volume(3.1), 1e-7);
    assert_eq!(one.lining, [&empty.lining[..], &[420]].concat());
    assert!(one.radius < 0.6 * empty.radius, "{one:?}");
    // A hollow molecule with a cavity of its own, and an atom outside all of them.
    let shell = hollow([0.2, 0.1, -0.3], 5.2, 80);
    let mut nested = with(&shell);
    nested.push(([25.0, 0.0, 0.0], 1.7));
    let found = cavities(&nested, probe);
    let ([own], [outer, inner]) = (&cavities(&shell, probe)[..], &found[..]) else { panic!("{found:?}") };
    assert_eq!(inner.lining.iter().map(|i| i - 420).collect::<Vec<_>>(), own.lining);
    let exact = ExactMeasures::of(&spheres(&shell), &params(probe), &SurfaceLimits::default(), &Control::default());
    let exact = exact.unwrap();
    close("area of the cavity inside", inner.area, own.area, 1e-7);
    close("area around it", outer.area, empty.area + exact.area() - own.area, 1e-7);
    close("volume around it", outer.volume, empty.volume - exact.volume - own.volume, 1e-7);
    // The flood fill counts grid points, also in the thin gap between both walls.
    let regions = fill(&grid(&nested, probe, 0.5), 0.0);
    let most = regions.iter().map(|region| region.volume).fold(0.0, f64::max);
    close("flood fill", outer.accessible_volume, most, 0.05);
    assert!(empty.accessible_volume > 1.5 * most, "control: the empty cavity is larger");
}

#[test]
fn an_opening_wide_enough_for_the_probe_is_the_end_of_a_cavity() {
    let probe = 1.4;
    let open = |angle: f64| -> Vec<Ball> {
        let z = 7.0 * angle.to_radians().cos();
        hollow([0.0; 3], 7.0, 130).into_iter().filter(|(centre, _)| centre[2] < z).collect()
    };
    for angle in [8.0, 20.0, 26.0, 60.0] {
        let balls = open(angle);
        let (found, regions) = (cavities(&balls, probe).len(), fill(&grid(&balls, probe, 0.2), 0.0).len());
        assert_eq!(found, regions, "{angle}");
    }
    assert_eq!((cavities(&open(8.0), probe).len(), cavities(&open(60.0), probe).len()), (1, 0));
}

#[test]
fn a_cubic_hole_has_the_symmetry_of_its_spheres() {
    // Eight spheres at the corners of a cube cover its faces, but not its centre.
    let (side, probe) = (4.0_f64, 1.2);
    let corner = |i: u32| ([0, 1, 2].map(|k| if i >> k & 1 == 0 { -0.5 * side } else { 0.5 * side }), 1.8);
    let balls: Vec<Ball> = (0..8).map(corner).collect();
    let found = cavities(&balls, probe);
    let [cavity] = &found[..] else { panic!("{found:?}") };
    check("cube", &balls, probe, cavity, &fill(&grid(&balls, probe, 0.03), 0.0)[0], 0.03);
    assert!((cavity.radius - (0.5 * side * 3.0_f64.sqrt() - 1.8)).abs() < RADIUS_ERROR, "{cavity:?}");
    assert_eq!(cavity.lining, (0..8).collect::<Vec<_>>());
    // The openings are the centres of the faces.
    for radius in [1.8, 1.75, 1.7] {
        let balls: Vec<Ball> = balls.iter().map(|(centre, _)| (*centre, radius)).collect();
        let widest = side / 2.0_f64.sqrt() - radius;
        let [Cavity { opening_radius: opening, .. }] = cavities(&balls, probe)[..] else { panic!("{radius}") };
        assert!(
            (widest - probe / f64::from(OPENING_STEPS)..widest).contains(&opening),
            "{radius}: {opening} of {widest}"
        );
    }
    // The lattice of the same cube has a hole in each cell, which touches the next ones at the centres of faces if the
    // spheres just reach them.
    let lattice = |n: i32, radius: f64| -> Vec<Ball> {
        let index = (0..n).flat_map(move |z| (0..n).flat_map(move |y| (0..n).map(move |x| [x, y, z])));
        index.map(|at| (at.map(|c| side * f64::from(c)), radius)).collect()
    };
    assert_eq!(cavities(&lattice(4, 1.8), probe).len(), 27);
    assert_eq!(cavities(&lattice(4, side / 2.0_f64.sqrt() - probe - 0.01), probe).len(), 0, "open");
}

#[test]
fn a_symmetric_cavity_changes_by_the_order_of_a_perturbation() {
    // The probe touches four spheres at each vertex of the cavity.
    let corner = |i: u32| ([0, 1, 2].map(|k| if i >> k & 1 == 0 { -2.0 } else { 2.0 }), 1.8);
    let balls: Vec<Ball> = (0..8).map(corner).chain([([0.0, 0.0, 60.0], 1.0)]).collect();
    let measures = |balls: &[Ball]| {
        let [Cavity { area, volume, accessible_area, accessible_volume, .. }] = cavities(balls, 1.2)[..] else {
            panic!("one cavity")
        };
        [area, volume, accessible_area, accessible_volume]
    };
    let still = measures(&balls);
    let mut state = 1_u64;
    let mut number = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        f64::from((state >> 40) as u32) / f64::from(1_u32 << 23) - 1.0
    };
    let mut largest = |noise: f64| {
        let moved: Vec<Ball> = balls.iter().map(|(c, r)| (c.map(|x| x + noise * number()), *r)).collect();
        still.iter().zip(measures(&moved)).map(|(a, b)| (b / a - 1.0).abs()).fold(0.0, f64::max)
    };
    for k in 3..=14 {
        let noise = 10.0_f64.powi(-k);
        let change = largest(noise);
        assert!(change < 1e-5 + 30.0 * noise, "{noise}: {change}");
    }
    assert!(largest(0.01) > 1e-3, "the control");
    // Copies of the spheres, as at a special position of an assembly.
    for shift in [1e-16, 1e-12, 1e-11, 1e-10, 1e-9, 1e-7] {
        let copies = balls.iter().map(|([x, y, z], r)| ([x + shift, y - shift, *z], *r));
        let twice = measures(&balls.iter().copied().chain(copies).collect::<Vec<_>>());
        let change = still.iter().zip(twice).map(|(a, b)| (b / a - 1.0).abs()).fold(0.0, f64::max);
        assert!(change < 1e-5, "copies {shift} Å away: {change}");
    }
}

#[test]
fn random_clusters_have_the_cavities_of_a_flood_fill() {
    let mut state = 3_u64;
    let mut number = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / f64::from(1_u32 << 24)
    };
    let (probe, h) = (0.8, 0.25);
    let mut n_cavities = 0;
    for cluster in 0..6 {
        // Spheres in a hollow ball, with holes by chance.
        let (n, half) = (200 + 25 * cluster, 6.5 + 1.5 * number());
        let mut balls: Vec<Ball> = Vec::new();
        while balls.len() < n {
            let at = [0; 3].map(|_| half * (2.0 * number() - 1.0));
            let distance = at.iter().map(|c| c * c).sum::<f64>().sqrt() / half;
            if (0.55..1.0).contains(&distance) {
                balls.push((at, 1.0 + 0.8 * number()));
            }
        }
        balls.push(balls[0]);
        // Neighbours whose distances exceed half the spacing are connected by free points; with a negative margin, all
        // points that free points connect are.
        let grid = grid(&balls, probe, h);
        let [less, regions, more] = [0.5 * h, 0.0, -0.87 * h].map(|margin| fill(&grid, margin));
        let found = cavities(&balls, probe);
        let near =
            |region: &Region, cavity: &Cavity| (0..3).all(|k| (region.deepest.1[k] - cavity.centre[k]).abs() < 2.0 * h);
        for cavity in found.iter().filter(|cavity| cavity.accessible_volume > 1.0) {
            assert!(less.iter().any(|region| near(region, cavity)), "{cluster}: {cavity:?} is open");
        }
        for region in more.iter().filter(|region| region.volume > 1.0) {
            let cavity = found.iter().find(|cavity| near(region, cavity));
            let cavity = cavity.unwrap_or_else(|| panic!("{cluster}: {region:?} is closed, unlike {found:?}"));
            if let Some(same) = regions.iter().find(|other| other.deepest == region.deepest) {
                close("random", cavity.accessible_volume, same.volume, 0.15);
            }
            n_cavities += 1;
        }
    }
    assert!(n_cavities >= 2, "{n_cavities} cavities");
}
