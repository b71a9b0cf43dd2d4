//! Pockets compared with brute force, and with shapes of known volume.

use std::f64::consts::PI;

use super::*;
use crate::OutOfMemory;
use crate::params::SurfaceOptions;

/// Centre and radius, Å.
type Shape = ([f64; 3], f64);

fn spheres(balls: &[Shape]) -> Spheres {
    let column = |k: usize| balls.iter().map(|(centre, _)| centre[k]).collect();
    #[expect(clippy::cast_possible_truncation, reason = "radii are single precision")]
    let radii = balls.iter().map(|(_, radius)| *radius as f32).collect();
    Spheres::new(column(0), column(1), column(2), radii).unwrap()
}

fn params(probe: f64) -> SurfaceParams {
    let options = SurfaceOptions { surface: Some(SurfaceKind::Ses), probe: Some(probe), ..SurfaceOptions::default() };
    SurfaceParams::new(&options).unwrap()
}

fn found(balls: &[Shape], probe: f64, pocket_probe: f64) -> Pockets {
    find(&spheres(balls), &params(probe), pocket_probe, &SurfaceLimits::default(), &Control::default()).unwrap()
}

fn found_at(spacing: f64, balls: &[Shape]) -> Vec<Pocket> {
    let (limits, control) = (SurfaceLimits::default(), Control::default());
    find_at(spacing, &spheres(balls), &params(1.4), 4.0, &limits, &control).unwrap().list
}

fn pockets(balls: &[Shape]) -> Vec<Pocket> {
    found(balls, 1.4, 4.0).list
}

/// Number of spheres and radius of a cluster with several pockets.
const CLUSTER: (usize, f64) = (100, 10.0);

/// Returns numbers from 0 to 1.
fn random() -> impl FnMut() -> f64 {
    let mut state = 11_u64;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Returns spheres at random places in a ball.
fn cluster(n: usize, radius: f64) -> Vec<Shape> {
    let mut random = random();
    let mut balls = Vec::new();
    while balls.len() < n {
        let at = [0, 1, 2].map(|_| radius * (2.0 * random() - 1.0));
        if at.iter().map(|c| c * c).sum::<f64>() < radius * radius {
            balls.push((at, 1.2 + random()));
        }
    }
    balls
}

/// Volumes of the pockets by the definition: every point is compared with every sphere and every point.
fn by_brute_force(balls: &[Shape], probe: f64, pocket_probe: f64) -> Vec<f64> {
    const N: i64 = 60;
    let at = |i: i64| (i - N / 2) as f64 * SPACING;
    let all: Vec<[i64; 3]> = (0..N).flat_map(|z| (0..N).flat_map(move |y| (0..N).map(move |x| [x, y, z]))).collect();
    let number = |[x, y, z]: [i64; 3]| usize::try_from((z * N + y) * N + x).unwrap();
    let reached = |probe: f64| {
        let is_centre = |point: &[i64; 3]| {
            balls.iter().all(|(centre, radius)| {
                (0..3).map(|k| (at(point[k]) - centre[k]).powi(2)).sum::<f64>() >= (radius + probe).powi(2)
            })
        };
        let is_centre: Vec<bool> = all.par_iter().map(is_centre).collect();
        let length = |d: &[i64; 3]| (d.iter().map(|d| d * d).sum::<i64>() as f64).sqrt() * SPACING;
        let offsets = all.iter().map(|point| point.map(|c| c - N / 2));
        let mut ball: Vec<[i64; 3]> = offsets.filter(|offset| length(offset) <= probe).collect();
        ball.sort_by(|a, b| length(a).total_cmp(&length(b)));
        let is_reached = |point: &[i64; 3]| {
            ball.iter().any(|offset| {
                let to = [0, 1, 2].map(|k| point[k] + offset[k]);
                to.iter().all(|c| (0..N).contains(c)) && is_centre[number(to)]
            })
        };
        let reached: Vec<bool> = all.par_iter().map(is_reached).collect();
        reached
    };
    let (outside, large) = (reached(probe), reached(pocket_probe));
    let is_pocket = |point: &[i64; 3]| {
        let near = |[x, y, z]: [i64; 3]| {
            (-4..=4).any(|dz| {
                (-4..=4).any(|dy| {
                    (-4..=4).any(|dx| {
                        let to = [x + dx, y + dy, z + dz];
                        to.iter().any(|c| !(0..N).contains(c)) || large[number(to)]
                    })
                })
            })
        };
        outside[number(*point)] && !near(*point)
    };
    let mut open: Vec<bool> = all.iter().map(is_pocket).collect();
    let mut volumes = Vec::new();
    for start in &all {
        let mut pending = vec![*start];
        let mut n = 0;
        while let Some([x, y, z]) = pending.pop() {
            if !std::mem::take(&mut open[number([x, y, z])]) {
                continue;
            }
            n += 1;
            let steps = || -1..=1;
            pending.extend(
                steps().flat_map(|dz| steps().flat_map(move |dy| steps().map(move |dx| [x + dx, y + dy, z + dz]))),
            );
        }
        volumes.push(f64::from(n) * SPACING.powi(3));
    }
    volumes.retain(|volume| *volume >= MIN_VOLUME);
    volumes.sort_by(|a, b| b.total_cmp(a));
    volumes
}

#[test]
fn volumes_are_those_of_brute_force() {
    let balls = cluster(CLUSTER.0, CLUSTER.1);
    let expected = by_brute_force(&balls, 1.4, 4.0);
    assert!(expected.len() > 1, "{expected:?}");
    let same = |pocket_probe: f64| {
        let list = found(&balls, 1.4, pocket_probe).list;
        list.len() == expected.len()
            && list.iter().zip(&expected).all(|(pocket, volume)| (pocket.volume - volume).abs() < 1e-9)
    };
    assert!(same(4.0));
    // Another probe is the control.
    assert!(!same(4.3));
}

/// Radius of the spheres of walls, Å.
const WALL: f64 = 2.0;

/// Returns a plate between z = 0 and −`depth` with a cylindrical hole of this radius through it.
fn pierced(radius: f64, depth: f64) -> Vec<Shape> {
    let mut balls = Vec::new();
    let mut z = WALL;
    while z <= depth - WALL {
        for i in 0..64 {
            let (sin, cos) = (f64::from(i) / 64.0 * 2.0 * PI).sin_cos();
            balls.push(([(radius + WALL) * cos, (radius + WALL) * sin, -z], WALL));
        }
        for x in -9..=9 {
            for y in -9..=9 {
                let at = [f64::from(x), f64::from(y)];
                if at[0].hypot(at[1]) > radius + WALL {
                    balls.push(([at[0], at[1], -z], WALL));
                }
            }
        }
        z += 1.0;
    }
    balls
}

#[test]
fn a_hole_of_known_volume_is_a_pocket_with_two_openings() {
    let (radius, depth) = (3.0, 24.0);
    let balls = pierced(radius, depth);
    // The rim is a torus. The large probe touches it and covers the hole down to this depth; the points within 2.4 Å of
    // that belong to no pocket.
    let covered = WALL + 4.0 - ((4.0 + WALL).powi(2) - (radius + WALL).powi(2)).sqrt();
    let height = depth - 2.0 * (covered + REMOVED);
    let (volume, area) = (PI * radius * radius * height, 2.0 * PI * radius * height);
    let errors = |spacing: f64| {
        let found = found_at(spacing, &balls);
        let [pocket] = found.as_slice() else { panic!("{found:?}") };
        assert_eq!(pocket.openings, 2);
        let off = [0.0, 0.0, -0.5 * depth].iter().zip(pocket.centre).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 0.5 * spacing, "{:?}", pocket.centre);
        assert!((pocket.depth - 0.5 * height).abs() < 2.0 * spacing, "{} {height}", pocket.depth);
        [pocket.volume / volume - 1.0, pocket.area / area - 1.0]
    };
    // Centres of probes are grid points, which do not reach the walls, so volumes are too small on a coarse grid.
    let [coarse, fine] = [SPACING, 0.2].map(errors);
    assert!(coarse.iter().all(|error| *error > -0.15 && *error < 0.0), "{coarse:?}");
    assert!(fine.iter().all(|error| error.abs() < 0.05), "{fine:?}");
    // The large probe fits through one hole, the small one into neither the other nor a plate without a hole.
    for radius in [4.5, 1.2] {
        assert_eq!(pockets(&pierced(radius, depth)), []);
    }
}

/// Returns a hollow ball of 900 inner and 900 outer spheres with this inner radius. The wall is so thick that the
/// points within 2.4 Å along each axis of the large probe outside do not reach through it.
fn hollow(inner: f64) -> Vec<Shape> {
    let on = |i: u32| {
        let z = 1.0 - (2.0 * f64::from(i % 900) + 1.0) / 900.0;
        let (sin, cos) = (f64::from(i % 900) * PI * (3.0 - 5.0_f64.sqrt())).sin_cos();
        let r = (1.0 - z * z).sqrt();
        ([r * cos, r * sin, z].map(|c| (inner + WALL * f64::from(1 + i / 900)) * c), WALL)
    };
    (0..1800).map(on).collect()
}

#[test]
fn a_void_is_a_pocket_unless_it_holds_the_large_probe() {
    let (volume, area) = (4.0 / 3.0 * PI * 3.5_f64.powi(3), 4.0 * PI * 3.5_f64.powi(2));
    for (spacing, worst) in [(SPACING, 0.15), (0.15, 0.04)] {
        let found = found_at(spacing, &hollow(3.5));
        let [pocket] = found.as_slice() else { panic!("{found:?}") };
        let errors = [pocket.volume / volume - 1.0, pocket.area / area - 1.0];
        assert!(errors.iter().all(|error| error.abs() < worst), "{spacing} {errors:?}");
        assert_eq!((pocket.openings, pocket.depth, pocket.lining.len()), (0, 0.0, 900));
    }
    assert_eq!(pockets(&hollow(4.6)), []);
    assert_eq!(found(&hollow(4.6), 1.4, 5.0).list.len(), 1);
    // A void that no small probe fits into, and single spheres: convex bodies have no pocket.
    assert_eq!(pockets(&hollow(1.2)), []);
    assert_eq!(pockets(&[([0.3, 0.1, 0.2], 9.0)]), []);
    assert_eq!(pockets(&[([0.3, 0.1, 0.2], 0.1)]), []);
}

#[test]
fn pockets_do_not_depend_on_the_order_of_the_spheres_on_threads_and_on_shifts_of_the_grid() {
    let balls = cluster(CLUSTER.0, CLUSTER.1);
    let expected = pockets(&balls);
    assert!(expected.len() > 1);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert_eq!(pool.install(|| pockets(&balls)), expected);
    }
    let reversed: Vec<Shape> = balls.iter().rev().copied().collect();
    let mut other = pockets(&reversed);
    for pocket in &mut other {
        pocket.lining.iter_mut().for_each(|i| *i = 99 - *i);
        pocket.lining.reverse();
    }
    assert_eq!(other, expected);
    let moved =
        |by: f64| -> Vec<Shape> { balls.iter().map(|(c, r)| ([c[0] + by, c[1] - 2.0 * by, c[2] + by], *r)).collect() };
    let volumes = |list: &[Pocket]| list.iter().map(|pocket| pocket.volume).collect::<Vec<_>>();
    let shifted = pockets(&moved(30.0 * SPACING));
    assert_eq!(volumes(&shifted), volumes(&expected));
    assert!((shifted[0].centre[0] - expected[0].centre[0] - 30.0 * SPACING).abs() < 1e-9);
    // Another shift moves the spheres relative to the grid: the control.
    assert_ne!(volumes(&pockets(&moved(0.5 * SPACING))), volumes(&expected));
}

#[test]
fn lining_spheres_are_near_the_pocket() {
    let balls = pierced(3.0, 24.0);
    let found = found(&balls, 1.4, 4.0);
    let lining = &found.list[0].lining;
    // The two inner rings of each layer in the middle, and none of the outer spheres.
    let distance = |i: u32| balls[i as usize].0[0].hypot(balls[i as usize].0[1]);
    assert!(lining.len() > 600 && lining.iter().all(|i| distance(*i) < 3.0 + WALL + 1.41), "{}", lining.len());
    // A point of the wall, in the middle of the hole, at its mouth and inside the plate.
    assert_eq!(found.lined_at([3.0, 0.0, -12.0]), Some(0));
    assert_eq!(found.lined_at([3.0, 0.0, -0.5]), None);
    assert_eq!(found.lined_at([6.0, 0.0, -12.0]), None);
    assert_eq!(found.lined_at([1e9, 0.0, f64::MAX]), None);
}

/// Memory that is left, bytes.
#[derive(Debug)]
struct Budget(std::sync::atomic::AtomicI64);

impl crate::MemoryMeter for Budget {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let left = self.0.fetch_sub(bytes.cast_signed(), std::sync::atomic::Ordering::Relaxed);
        if left >= bytes.cast_signed() {
            return Ok(());
        }
        self.shrink(bytes);
        Err(OutOfMemory::System { needed: bytes })
    }

    fn shrink(&self, bytes: u64) {
        self.0.fetch_add(bytes.cast_signed(), std::sync::atomic::Ordering::Relaxed);
    }
}

#[test]
fn limits_and_cancellation_end_the_search() {
    let control = Control::default();
    let search = |balls: &[Shape], limit: u64, control: &Control<'_>| {
        let limits = SurfaceLimits { max_grid_points: limit, ..SurfaceLimits::default() };
        find(&spheres(balls), &params(1.4), 4.0, &limits, control).map(|found| found.list.len())
    };
    let balls = cluster(20, 5.0);
    let error = search(&balls, 100, &control).unwrap_err();
    let Some(Exceeded { actual: Some(grid_points), max: 100, .. }) = error.exceeded(Limit::PocketPoints) else {
        panic!("{error}")
    };
    let grid_points = *grid_points;
    assert_eq!(search(&balls, grid_points - 1, &control).map_err(drop), Err(()));
    assert!(search(&balls, grid_points, &control).is_ok());
    // Two spheres that are far from each other, with any limit.
    let far = [([0.0; 3], 1.0), ([1e5; 3], 1.0)];
    let error = search(&far, u64::MAX, &control).unwrap_err();
    assert!(error.exceeded(Limit::PocketPoints).is_some_and(|exceeded| exceeded.key().is_none()), "{error}");
    let n = cluster(CLUSTER.0, CLUSTER.1);
    let with = |bytes: i64| {
        let memory = Arc::new(Budget(bytes.into()));
        let control = Control { memory: Arc::<Budget>::clone(&memory), ..Control::default() };
        let result = search(&n, u64::MAX, &control).map(drop);
        // Everything that was added is subtracted.
        assert_eq!(memory.0.load(std::sync::atomic::Ordering::Relaxed), bytes);
        result
    };
    for bytes in [1_000, 10_000, 40_000, 60_000] {
        assert_eq!(with(bytes).map_err(|error| matches!(error, SurfaceError::Memory(_))), Err(true), "{bytes}");
    }
    assert_eq!(with(10_000_000), Ok(()));
    control.cancel.cancel();
    assert_eq!(search(&balls, u64::MAX, &control), Err(SurfaceError::Cancelled));
}

#[test]
fn rows_in_reach_of_probes_are_limited() {
    let balls = [([0.0; 3], 50.0), ([30.0, 0.0, 0.0], 50.0)];
    let run = |max_candidates: u64| {
        let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
        find(&spheres(&balls), &params(1.4), 20.0, &limits, &Control::default())
    };
    // The disc of a ball's layer has as many rows as its height; a sum over layers gives its area.
    let disc = |radius: f64| {
        let half = |z: i32| (radius / SPACING).powi(2) - f64::from(z).powi(2);
        (-200..=200).map(half).filter(|half2| *half2 > 0.0).map(|half2| 2.0 * half2.sqrt()).sum::<f64>()
    };
    let rows = 2.0 * (2.0 * disc(51.4) + disc(70.0));
    let error = run(10).unwrap_err();
    let exceeded = error.exceeded(Limit::PocketRows).unwrap();
    let counted = exceeded.actual.unwrap();
    assert!(exceeded.max == 50 && (counted as f64 / rows - 1.0).abs() < 0.01, "{counted} {rows}");
    let least = counted.div_ceil(ROWS_PER_PAIR);
    assert!(run(least).is_ok() && run(least - 1).is_err());
}
