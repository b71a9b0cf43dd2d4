//! Exact areas and volumes compared with closed forms, with points spread over spheres, with fine meshes, with MSMS and
//! with `FreeSASA`.

#![expect(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::float_cmp,
    reason = "tests fail by panicking, random numbers are from 0 to 1, and exact equality is intended"
)]

use crate::sphere_surfaces::{Ball, mesh, params, sample, spheres};
use crate::tools;

use std::f64::consts::PI;

use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::{
    CancelToken, Control, ExactMeasures, Limit, Measures, Spheres, SurfaceError, SurfaceKind, SurfaceLimits, Validation,
};

const VDW: SurfaceKind = SurfaceKind::Vdw;
const SAS: SurfaceKind = SurfaceKind::Sas;
const SES: SurfaceKind = SurfaceKind::Ses;

fn exact_of(spheres: &Spheres, surface: SurfaceKind, probe: Option<f64>) -> ExactMeasures {
    let params = params(surface, probe, 0.5);
    ExactMeasures::of(spheres, &params, &SurfaceLimits::default(), &Control::default()).unwrap()
}

pub(crate) fn exact(balls: &[Ball], surface: SurfaceKind, probe: Option<f64>) -> ExactMeasures {
    exact_of(&spheres(balls), surface, probe)
}

/// Returns true if the numbers differ by at most `tolerance`, relative to the larger one or to 1.
fn near(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance * a.abs().max(b.abs()).max(1.0)
}

fn assert_near(what: &str, found: f64, expected: f64, tolerance: f64) {
    assert!(near(found, expected, tolerance), "{what}: {found}, expected {expected}");
}

/// Radii of spheres have 32 bits.
const ROUNDING: f64 = 1e-6;

#[test]
fn one_sphere_and_spheres_far_apart() {
    let r = 1.7;
    for (surface, scale) in [(VDW, r), (SAS, r + 1.4), (SES, r)] {
        let one = exact(&[([0.3, -7.2, 20.1], r)], surface, None);
        let (area, volume) = (4.0 * PI * scale * scale, 4.0 / 3.0 * PI * scale.powi(3));
        assert_near("area", one.area(), area, ROUNDING);
        assert_near("volume", one.volume, volume, ROUNDING);
        assert!(!near(one.area(), 1.0001 * area, ROUNDING), "the control");
        let two = exact(&[([0.0; 3], r), ([0.0, 90.0, 5.0], r)], surface, None);
        assert_near("two areas", two.area(), 2.0 * area, ROUNDING);
        assert_near("two volumes", two.volume, 2.0 * volume, ROUNDING);
        assert_eq!((one.parts().toroidal, one.parts().concave, two.parts().toroidal), (0.0, 0.0, 0.0));
    }
}

#[test]
fn two_spheres_overlap_in_lenses() {
    let (a, b) = (2.0, 1.5);
    for apart in [0.6, 1.0, 2.0, 3.0, 3.45] {
        let two = exact(&[([0.0; 3], a), ([0.0, 0.6 * apart, 0.8 * apart], b)], VDW, None);
        // Height of the cap on each sphere.
        let caps =
            [(a, b), (b, a)].map(|(r, other): (f64, f64)| r - (apart * apart + r * r - other * other) / (2.0 * apart));
        for (k, (r, h)) in [(a, caps[0]), (b, caps[1])].into_iter().enumerate() {
            assert_near("area", two.of_spheres[k].total(), 4.0 * PI * r * r - 2.0 * PI * r * h, ROUNDING);
        }
        let cap = |r: f64, h: f64| PI * h * h * (3.0 * r - h) / 3.0;
        let volume = 4.0 / 3.0 * PI * (a.powi(3) + b.powi(3)) - cap(a, caps[0]) - cap(b, caps[1]);
        assert_near("volume", two.volume, volume, ROUNDING);
    }
}

#[test]
fn two_spheres_have_a_torus_with_or_without_a_cusp() {
    let (r, probe) = (1.7_f64, 1.4_f64);
    let length = r + probe;
    for apart in [1.0, 3.0, 4.5, 5.2, 6.1] {
        let two = exact(&[([0.0; 3], r), ([apart, 0.0, 0.0], r)], SES, None);
        let rho = (length * length - apart * apart / 4.0).sqrt();
        let angle = (apart / 2.0 / length).asin();
        let cusp = if rho < probe { (rho / probe).acos() } else { 0.0 };
        let toroidal = 2.0 * 2.0 * PI * probe * (rho * (angle - cusp) - probe * (angle.sin() - cusp.sin()));
        let contact = 2.0 * 2.0 * PI * r * r * (1.0 + angle.sin());
        assert_near("toroidal", two.parts().toroidal, toroidal, ROUNDING);
        assert_near("contact", two.parts().contact, contact, ROUNDING);
        assert_eq!(two.parts().concave, 0.0);
        for half in &two.of_spheres {
            assert_near("half of the torus", half.toroidal, 0.5 * toroidal, ROUNDING);
        }
        // Volume of revolution, with distances from the middle plane along the axis.
        let n = 200_000;
        let (neck, end) = (probe * cusp.sin(), apart / 2.0 + r);
        let profile = |z: f64| {
            let touch = probe * angle.sin();
            if z < neck {
                0.0
            } else if z < touch {
                rho - (probe * probe - z * z).sqrt()
            } else {
                (r * r - (z - apart / 2.0).powi(2)).max(0.0).sqrt()
            }
        };
        let step = end / f64::from(n);
        let volume: f64 = (0..n).map(|i| PI * profile((f64::from(i) + 0.5) * step).powi(2) * step).sum();
        assert_near("volume", two.volume, 2.0 * volume, 1e-5);
        assert!(!near(two.volume, 2.0 * volume * 1.0001, 1e-5), "the control");
    }
}

/// Returns the angle at `a` of the spherical triangle of three unit vectors.
fn angle_at(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> f64 {
    let dot = |p: [f64; 3], q: [f64; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    let side = |p: [f64; 3]| -> [f64; 3] { std::array::from_fn(|k| p[k] - dot(p, a) * a[k]) };
    let (p, q) = (side(b), side(c));
    (dot(p, q) / (dot(p, p) * dot(q, q)).sqrt()).acos()
}

#[test]
fn three_spheres_have_concave_triangles() {
    let (r, probe, side) = (1.7_f64, 1.4_f64, 2.5_f64);
    let out = side / 3.0_f64.sqrt();
    let corner = |k: f64| [out * (2.0 * PI * k / 3.0).cos(), out * (2.0 * PI * k / 3.0).sin(), 0.0];
    let balls = [0.0, 1.0, 2.0].map(|k| (corner(k), r));
    let three = exact(&balls, SES, None);
    let height = ((r + probe).powi(2) - out * out).sqrt();
    assert!(height > probe, "no cusp");
    let [a, b, c] = balls.map(|(at, _)| [at[0], at[1], -height].map(|v| v / (r + probe)));
    let excess = angle_at(a, b, c) + angle_at(b, c, a) + angle_at(c, a, b) - PI;
    let concave = 2.0 * probe * probe * excess;
    assert_near("concave", three.parts().concave, concave, ROUNDING);
    assert!(!near(three.parts().concave, 1.001 * concave, ROUNDING), "the control");
    for third in &three.of_spheres {
        assert_near("a third of the triangles", third.concave, concave / 3.0, ROUNDING);
    }
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

/// Pseudorandom numbers from 0 to 1, the same in every run.
pub(crate) struct Numbers(pub(crate) u64);

impl Numbers {
    pub(crate) fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        f64::from((self.0 >> 40) as u32) / f64::from(1_u32 << 24)
    }
}

fn inside(balls: &[Ball], enlarged: f64, x: [f64; 3], but: usize) -> bool {
    let within = |(c, r): &Ball| (0..3).map(|k| (x[k] - c[k]).powi(2)).sum::<f64>() < (r + enlarged).powi(2);
    balls.iter().enumerate().any(|(i, ball)| i != but && within(ball))
}

/// Returns the exposed area of all spheres, by `n` points on each.
fn sampled_area(balls: &[Ball], enlarged: f64, n: u32) -> f64 {
    let exposed = |(i, &(c, r)): (usize, &Ball)| {
        let r = r + enlarged;
        let point = |u: [f64; 3]| std::array::from_fn(|k| c[k] + r * u[k]);
        let n_exposed = spread(n).filter(|u| !inside(balls, enlarged, point(*u), i)).count();
        4.0 * PI * r * r * n_exposed as f64 / f64::from(n)
    };
    balls.iter().enumerate().map(exposed).sum()
}

/// Returns the volume of the union of all spheres, by `n` points in its box.
fn sampled_volume(balls: &[Ball], enlarged: f64, n: u32) -> f64 {
    let end = |k: usize, sign: f64| balls.iter().map(|(c, r)| sign * c[k] + r + enlarged).fold(f64::MIN, f64::max);
    let low: [f64; 3] = std::array::from_fn(|k| -end(k, -1.0));
    let size: [f64; 3] = std::array::from_fn(|k| end(k, 1.0) - low[k]);
    // Additive recurrence of low discrepancy (Roberts).
    let share = [0.819_172_513_396_164_4, 0.671_043_606_703_789_2, 0.549_700_477_901_970_2];
    let point = |i: u32| std::array::from_fn(|k| low[k] + size[k] * (f64::from(i) * share[k] + 0.5).fract());
    let n_inside = (0..n).filter(|i| inside(balls, enlarged, point(*i), usize::MAX)).count();
    size.iter().product::<f64>() * n_inside as f64 / f64::from(n)
}

fn cluster(seed: u64) -> Vec<Ball> {
    let mut numbers = Numbers(seed);
    let n = 2 + (numbers.next().powi(2) * 60.0) as usize;
    let half = 1.2 * (n as f64).cbrt() * (0.6 + numbers.next());
    (0..n)
        .map(|_| {
            let centre = std::array::from_fn(|_| half * (2.0 * numbers.next() - 1.0));
            (centre, f64::from((1.0 + numbers.next()) as f32))
        })
        .collect()
}

#[test]
fn random_clusters_match_points() {
    let mut sums = [0.0; 4];
    let clusters = std::env::var("MOLMESH_CLUSTERS").map_or(40, |number| number.parse().unwrap());
    for seed in 0..clusters {
        let balls = cluster(seed);
        for (surface, enlarged) in [(VDW, 0.0), (SAS, 1.4)] {
            let found = exact(&balls, surface, None);
            let points = [sampled_area(&balls, enlarged, 4000), sampled_volume(&balls, enlarged, 100_000)];
            let what = format!("cluster {seed}, {surface}");
            assert_near(&format!("{what}, area"), found.area(), points[0], 0.02);
            assert_near(&format!("{what}, volume"), found.volume, points[1], 0.02);
            for (sum, value) in sums.iter_mut().zip([found.area(), found.volume, points[0], points[1]]) {
                *sum += value;
            }
        }
    }
    println!("areas and volumes of all clusters: {sums:?}");
    assert_near("all areas", sums[0], sums[2], 5e-4);
    assert_near("all volumes", sums[1], sums[3], 5e-4);
    assert!(!near(sums[0], 1.001 * sums[2], 5e-4) && !near(sums[1], 1.001 * sums[3], 5e-4), "the control");
}

#[test]
fn random_clusters_match_fine_meshes() {
    for seed in 100..106 {
        let balls = cluster(seed);
        let balls = &balls[..balls.len().min(20)];
        let found = exact(balls, SES, None);
        let [coarse, fine] = [0.2, 0.1].map(|spacing| {
            let mesh = mesh(&spheres(balls), &params(SES, None, spacing));
            let m = Measures::of(&mesh, Validation::Checksum, &Control::default()).unwrap();
            [m.area, m.volume]
        });
        // The errors of area and volume are of the second order, except for the area along creases.
        let [area, volume] = [0, 1].map(|k| fine[k] + (fine[k] - coarse[k]) / 3.0);
        println!("cluster {seed}: {} and {area}, {} and {volume}", found.area(), found.volume);
        assert_near(&format!("cluster {seed}, area"), found.area(), area, 2e-3);
        assert_near(&format!("cluster {seed}, volume"), found.volume, volume, 5e-4);
        assert!(!near(found.volume, 1.002 * volume, 5e-4), "the control");
    }
}

#[test]
fn areas_of_spheres_are_those_of_the_triangles_nearest_to_their_contacts() {
    const PROBE: f64 = 1.4;
    let (mut divided, mut equal_shares, mut n) = ([0.0; 2], 0, 0);
    for seed in [101, 104] {
        let balls: Vec<Ball> = cluster(seed).into_iter().take(20).collect();
        let found = exact(&balls, SES, None);
        let mesh = mesh(&spheres(&balls), &params(SES, None, 0.1));
        let mut areas = vec![0.0; balls.len()];
        for triangle in &mesh.triangles {
            let corners = triangle.map(|v| mesh.position(v as usize).map(f64::from));
            let normals = triangle.map(|v| mesh.normals[v as usize].map(f64::from));
            let mean = |of: [[f64; 3]; 3]| std::array::from_fn(|k| (of[0][k] + of[1][k] + of[2][k]) / 3.0);
            let length = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
            let [middle, normal]: [[f64; 3]; 2] = [mean(corners), mean(normals)];
            let probe = |k: usize| mesh.centre[k] + middle[k] + PROBE * normal[k] / length(normal);
            let apart = |of: &dyn Fn(usize) -> f64, x: [f64; 3]| length(std::array::from_fn(|k| of(k) - x[k]));
            // Distance of the centroid from the point of contact of each sphere that the probe touches.
            let contact = |i: usize| {
                let (centre, r) = balls[i];
                let to_probe = apart(&probe, centre);
                let at = |k: usize| centre[k] + r * (probe(k) - centre[k]) / to_probe;
                let centroid = std::array::from_fn(|k| mesh.centre[k] + middle[k]);
                (to_probe < r + PROBE + 0.01).then(|| (apart(&at, centroid), i))
            };
            let nearest = (0..balls.len()).filter_map(contact).min_by(|a, b| a.0.total_cmp(&b.0));
            let [u, v]: [[f64; 3]; 2] =
                [1, 2].map(|corner: usize| std::array::from_fn(|k| corners[corner][k] - corners[0][k]));
            let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            areas[nearest.unwrap().1] += 0.5 * length(cross);
        }
        for (i, (parts, area)) in found.of_spheres.iter().zip(&areas).enumerate() {
            assert!((parts.total() - area).abs() < 0.02 * area + 0.05, "{seed}, sphere {i}: {parts:?} and {area}");
            divided[0] += parts.toroidal;
            divided[1] += parts.concave;
            n += 1;
            let mean = found.parts().concave / balls.len() as f64;
            equal_shares += usize::from((parts.contact + parts.toroidal + mean - area).abs() < 0.02 * area + 0.05);
        }
    }
    assert!(equal_shares < n / 2, "the control: {equal_shares} of {n}");
    assert!(divided.iter().all(|area| *area > 50.0), "the surfaces have parts to divide: {divided:?}");
}

#[test]
fn solvent_excluded_areas_are_those_of_msms() {
    // Sums of the analytic areas of all components, computed by MSMS 2.6.1 with these radii and a probe of 1.4 Å.
    for (name, msms) in [("1crn.cif", 2319.1), ("4pti.pdb", 3144.8)] {
        let found = exact_of(&sample(name), SES, None);
        println!("{name}: {:?} {}", found.parts(), found.volume);
        assert_near(name, found.area(), msms, 1e-4);
        assert!(!near(found.area(), 1.001 * msms, 1e-4), "the control");
    }
}

/// Radius of the degenerate arrangements, Å.
const R: f64 = 1.7;

fn at(x: f64, y: f64, z: f64) -> Ball {
    ([x, y, z], R)
}

#[test]
fn spheres_in_others_have_no_area() {
    let one = [at(1.0, 2.0, 3.0)];
    for surface in [VDW, SAS, SES] {
        let alone = exact(&one, surface, None);
        for (what, balls) in [
            ("equal", &[one[0], one[0], one[0]][..]),
            ("nested", &[one[0], ([1.1, 2.1, 3.2], 1.2), ([1.0, 2.0, 3.0], 0.3)]),
            ("touching from inside", &[one[0], ([1.5, 2.0, 3.0], 1.2)]),
            ("nearly equal", &[one[0], at(1.0 + 1e-9, 2.0, 3.0)]),
        ] {
            let found = exact(balls, surface, None);
            assert_near(&format!("{what}, {surface}, area"), found.area(), alone.area(), 1e-5);
            assert_near(&format!("{what}, {surface}, volume"), found.volume, alone.volume, 1e-5);
        }
        let moved = exact(&[one[0], at(1.01, 2.0, 3.0)], surface, None);
        assert!(!near(moved.area(), alone.area(), 1e-5), "the control");
        let equal = exact(&[one[0], one[0]], surface, None).of_spheres;
        assert!(
            equal[0].total() > 0.0 && equal[1].total() == 0.0,
            "the first of equal spheres has the area: {equal:?}"
        );
    }
    let touching = exact(&[at(0.0, 0.0, 0.0), at(2.0 * R, 0.0, 0.0)], VDW, None);
    assert_near("touching", touching.area(), 8.0 * PI * R * R, 1e-5);
}

#[test]
fn all_surfaces_without_a_probe_are_the_van_der_waals_surface() {
    let balls = cluster(5);
    let vdw = exact(&balls, VDW, None);
    for surface in [SAS, SES] {
        assert_eq!(exact(&balls, surface, Some(0.0)), vdw);
        assert_ne!(exact(&balls, surface, Some(0.1)), vdw, "the control");
    }
}

/// Returns spheres at the corners of a truncated icosahedron.
pub(crate) fn fullerene() -> Vec<Ball> {
    let golden = f64::midpoint(1.0, 5.0_f64.sqrt());
    let mut balls: Vec<Ball> = Vec::new();
    for kind in [[0.0, 1.0, 3.0 * golden], [1.0, 2.0 + golden, 2.0 * golden], [2.0, 1.0 + 2.0 * golden, golden]] {
        for signs in 0..8 {
            for turn in 0..3 {
                let v: [f64; 3] = std::array::from_fn(|k| kind[k] * if signs >> k & 1 == 0 { 0.725 } else { -0.725 });
                let p: [f64; 3] = std::array::from_fn(|k| v[(k + turn) % 3]);
                if !balls.iter().any(|(c, _)| (0..3).all(|k| (c[k] - p[k]).abs() < 1e-6)) {
                    balls.push((p, R));
                }
            }
        }
    }
    assert_eq!(balls.len(), 60);
    balls
}

#[test]
fn symmetric_spheres_match_points_and_meshes() {
    let line: Vec<Ball> = (0..7).map(|i| at(f64::from(i), 0.0, 0.0)).collect();
    let grid = |n: i32, spacing: f64| -> Vec<Ball> {
        let row = |i: i32| f64::from(i) * spacing;
        (0..n.pow(3)).map(|i| at(row(i % n), row(i / n % n), row(i / n / n))).collect()
    };
    let fullerene = fullerene();
    // Three spheres with one common circle, and holes of a lattice that just hold a probe or just do not.
    let common = [at(-1.0, 0.0, 0.0), ([0.0; 3], (R * R - 1.0).sqrt()), at(1.0, 0.0, 0.0)];
    let holes =
        |more: f64| -> Vec<Ball> { grid(3, 2.0).into_iter().map(|(c, _)| (c, 3.0_f64.sqrt() - 1.0 + more)).collect() };
    for (what, balls, probe) in [
        ("line", &line[..], 1.4),
        ("line, large probe", &line, 10.0),
        ("cube", &grid(2, 3.0), 1.4),
        ("cubic lattice", &grid(4, 3.6), 1.4),
        ("open holes", &holes(-1e-3), 1.0),
        ("closed holes", &holes(1e-3), 1.0),
        ("fullerene", &fullerene, 1.4),
        ("fullerene, large probe", &fullerene, 10.0),
        ("common circle", &common, 1.4),
    ] {
        for (surface, enlarged) in [(VDW, 0.0), (SAS, probe)] {
            let found = exact(balls, surface, (surface == SAS).then_some(probe));
            let sampled = [sampled_area(balls, enlarged, 6_000), sampled_volume(balls, enlarged, 60_000)];
            assert_near(&format!("{what}, {surface}"), found.area(), sampled[0], 0.01);
            assert_near(&format!("{what}, {surface}"), found.volume, sampled[1], 0.01);
            assert!(!near(1.03 * found.area(), sampled[0], 0.01) && !near(1.03 * found.volume, sampled[1], 0.01));
        }
        let found = exact(balls, SES, Some(probe));
        // The walls of the holes are creased.
        let spacing = if what == "open holes" { 0.08 } else { 0.2 };
        let m = mesh(&spheres(balls), &params(SES, Some(probe), spacing));
        let m = Measures::of(&m, Validation::Checksum, &Control::default()).unwrap();
        assert_near(&format!("{what}, area"), found.area(), m.area, 0.01);
        assert_near(&format!("{what}, volume"), found.volume, m.volume, 0.008);
    }
}

#[test]
fn areas_do_not_depend_on_the_order_and_the_threads() {
    let atoms = sample("4pti.pdb");
    let rows: Vec<u32> = (0..atoms.len() as u32).rev().collect();
    let on = |threads: usize, spheres: &Spheres| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| exact_of(spheres, SES, None))
    };
    let one = on(1, &atoms);
    assert_eq!(one, on(3, &atoms));
    let reversed = on(2, &atoms.subset(&rows));
    assert_near("area", one.area(), reversed.area(), 1e-9);
    for (i, area) in one.of_spheres.iter().enumerate() {
        let other = reversed.of_spheres[atoms.len() - 1 - i];
        for (area, other) in
            [(area.contact, other.contact), (area.toroidal, other.toroidal), (area.concave, other.concave)]
        {
            assert_near("area of a sphere", area, other, 1e-9);
        }
    }
}

#[test]
fn solvent_accessible_areas_agree_with_freesasa() {
    let dir = tempfile::tempdir().unwrap();
    let mut structures = vec![("1crn".to_owned(), sample("1crn.cif")), ("4pti".to_owned(), sample("4pti.pdb"))];
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/structures");
    for name in ["1pfe.cif.gz", "1ubq.pdb.gz"] {
        let bytes = std::fs::read(folder.join(name)).unwrap();
        let structure = structure::read(&bytes, &ReadLimits::default()).unwrap();
        let spheres = structure::select(&structure, &Selection::default()).unwrap().spheres(&structure).unwrap();
        structures.push((name.to_owned(), spheres));
    }
    let write = |(name, atoms): &(String, Spheres)| {
        let row = |i: usize| {
            let [x, y, z] = atoms.centre(i);
            format!("{x} {y} {z} {}\n", atoms.radius(i))
        };
        let path = dir.path().join(name);
        std::fs::write(&path, (0..atoms.len()).map(row).collect::<String>()).unwrap();
        path
    };
    let paths: Vec<_> = structures.iter().map(write).collect();
    let Some(sasa) = tools::sasa(&paths) else { return };
    for ((name, atoms), sasa) in structures.iter().zip(&sasa) {
        let found = exact_of(atoms, SAS, None);
        println!("{name}: {} and {}", found.area(), sasa.area);
        assert_near(name, found.area(), sasa.area, 5e-4);
        assert!(!near(found.area(), 1.001 * sasa.area, 5e-4), "the control");
        for (i, (area, other)) in found.of_spheres.iter().zip(&sasa.of_spheres).enumerate() {
            assert!((area.total() - other).abs() < 0.15, "{name}, sphere {i}: {area:?} and {other}");
        }
    }
}

#[test]
fn overlaps_are_limited_and_the_search_can_be_cancelled() {
    let atoms = sample("4pti.pdb");
    let of = |max_candidates, control: &Control<'_>| {
        let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
        ExactMeasures::of(&atoms, &params(SES, None, 0.5), &limits, control)
    };
    let error = of(5_000, &Control::default()).unwrap_err();
    assert!(error.exceeded(Limit::Overlaps).is_some_and(|exceeded| exceeded.max == 5_000), "{error:?}");
    assert!(of(1 << 20, &Control::default()).is_ok());
    let cancel = CancelToken::default();
    cancel.cancel();
    let control = Control { cancel, ..Control::default() };
    assert_eq!(of(1 << 20, &control).unwrap_err(), SurfaceError::Cancelled);
    let isosurface = params(SurfaceKind::Gaussian, None, 0.5);
    let error = ExactMeasures::of(&atoms, &isosurface, &SurfaceLimits::default(), &Control::default()).unwrap_err();
    assert!(matches!(error, SurfaceError::BadParameter { name: "surface", .. }), "{error:?}");
}
