//! Van der Waals, solvent-accessible and solvent-excluded surfaces compared with closed forms, with probe positions in
//! double precision, and with `FreeSASA`.

#![expect(clippy::unwrap_used, clippy::cast_possible_truncation, reason = "tests fail by panicking")]

use crate::tools;

use std::f64::consts::PI;
use std::path::Path;

use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::{
    Backend, CancelToken, Control, CpuBackend, Limit, Measures, Mesh, Observer, ReferenceBackend, Spheres, Stage, Step,
    SurfaceError, SurfaceKind, SurfaceLimits, SurfaceOptions, SurfaceParams, Validation,
};

/// Centre and radius, Å.
pub(crate) type Ball = ([f64; 3], f64);

/// Largest distance of a vertex from the surface: the tolerance of the root search, a thousandth of an edge where the
/// surface meets a grid point, and rounding.
fn tolerance(spacing: f64) -> f64 {
    1.5e-4 + spacing / 1024.0
}

pub(crate) fn spheres(balls: &[Ball]) -> Spheres {
    let column = |k: usize| balls.iter().map(|(c, _)| c[k]).collect();
    Spheres::new(column(0), column(1), column(2), balls.iter().map(|(_, r)| *r as f32).collect()).unwrap()
}

pub(crate) fn params(surface: SurfaceKind, probe: Option<f64>, resolution: f64) -> SurfaceParams {
    let options =
        SurfaceOptions { surface: Some(surface), probe, resolution: Some(resolution), ..SurfaceOptions::default() };
    SurfaceParams::new(&options).unwrap()
}

pub(crate) fn mesh(spheres: &Spheres, params: &SurfaceParams) -> Mesh {
    let backend = CpuBackend::new(Some(2)).unwrap();
    backend.run(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap().mesh
}

/// Measures of a mesh, which must be closed, oriented and manifold by the exact check.
fn measures(mesh: &Mesh, what: &str) -> Measures {
    let m = Measures::of(mesh, Validation::Exact, &Control::default()).unwrap();
    assert!(m.closed && m.oriented && m.manifold, "{what}: {m:?}");
    m
}

pub(crate) fn sample(name: &str) -> Spheres {
    let bytes = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("samples").join(name)).unwrap();
    let structure = structure::read(&bytes, &ReadLimits::default()).unwrap();
    structure::select(&structure, &Selection::default()).unwrap().spheres(&structure).unwrap()
}

/// Positions in Å in the coordinates of the spheres.
fn positions(mesh: &Mesh) -> impl Iterator<Item = [f64; 3]> {
    mesh.positions.iter().map(|p| std::array::from_fn(|k| mesh.centre[k] + f64::from(p[k])))
}

/// Distance of a point to the nearest of the spheres enlarged by `probe`, negative inside.
fn clearance(spheres: &Spheres, probe: f64, x: [f64; 3]) -> f64 {
    let distance = |i: usize| {
        let c = spheres.centre(i);
        (0..3).map(|k| (x[k] - c[k]).powi(2)).sum::<f64>().sqrt() - f64::from(spheres.radius(i)) - probe
    };
    (0..spheres.len()).map(distance).fold(f64::MAX, f64::min)
}

/// Order of convergence of errors at a spacing and its half.
fn order([coarse, fine]: [f64; 2]) -> f64 {
    (coarse / fine).log2()
}

/// Area and volume of the solvent-excluded surface of two spheres of radius `r`, `apart` from each other, with a probe
/// that touches both: two spherical caps and a part of a torus, whose middle is missing if the probe reaches the axis.
fn two_spheres(r: f64, apart: f64, probe: f64) -> [f64; 2] {
    let sum = r + probe;
    let rho = (sum * sum - apart * apart / 4.0).sqrt();
    let sin = 0.5 * apart / sum;
    let (end, start) = (sin.asin(), if rho < probe { (rho / probe).acos() } else { 0.0 });
    let torus = 2.0 * 2.0 * PI * probe * (rho * (end - start) - probe * (end.sin() - start.sin()));
    let spherical = 2.0 * PI * r * r * (1.0 + sin);
    let h = r * (1.0 - sin);
    let cap = PI * h * h * (3.0 * r - h) / 3.0;
    // Simpson's rule for the solid of revolution between the circles of contact.
    let n = 20_000;
    let (from, to) = (probe * start.sin(), probe * sin);
    let section = |i: i32| {
        let z = from + (to - from) * f64::from(i) / f64::from(n);
        PI * (rho - (probe * probe - z * z).max(0.0).sqrt()).powi(2)
    };
    let weight = |i: i32| if i == 0 || i == n { 1.0 } else { f64::from(2 + 2 * (i % 2)) };
    let neck = (0..=n).map(|i| weight(i) * section(i)).sum::<f64>() * (to - from) / f64::from(n) / 3.0;
    [2.0 * spherical + torus, 2.0 * (4.0 / 3.0 * PI * r.powi(3) - cap) + 2.0 * neck]
}

#[test]
fn one_sphere_is_exact_and_converges_with_the_square_of_the_spacing() {
    let (at, r) = (([0.31, -0.17, 0.44], 1.7), 1.7);
    for (surface, probe, radius) in [
        (SurfaceKind::Vdw, None, r),
        (SurfaceKind::Sas, None, r + 1.4),
        (SurfaceKind::Sas, Some(0.0), r),
        (SurfaceKind::Ses, None, r),
        (SurfaceKind::Ses, Some(10.0), r),
    ] {
        let mut errors = [[0.0; 2]; 2];
        for (i, h) in [0.3, 0.15].into_iter().enumerate() {
            let what = format!("{surface} {probe:?} {h}");
            let mesh = mesh(&spheres(&[at]), &params(surface, probe, h));
            for (x, n) in positions(&mesh).zip(&mesh.normals) {
                let d: [f64; 3] = std::array::from_fn(|k| x[k] - at.0[k]);
                let length = d.iter().map(|c| c * c).sum::<f64>().sqrt();
                assert!((length - radius).abs() < tolerance(h), "{what}: {length}");
                let cos = (0..3).map(|k| d[k] * f64::from(n[k])).sum::<f64>() / length;
                assert!(cos > 1.0 - 1e-6, "{what}: {cos}");
            }
            let m = measures(&mesh, &what);
            let exact = [4.0 * PI * radius.powi(2), 4.0 / 3.0 * PI * radius.powi(3)];
            errors[0][i] = 1.0 - m.area / exact[0];
            errors[1][i] = 1.0 - m.volume / exact[1];
        }
        assert!(errors.iter().all(|error| (1.8..2.3).contains(&order(*error))), "{surface} {probe:?}: {errors:?}");
    }
}

#[test]
fn two_spheres_have_the_area_and_volume_of_caps_and_a_torus() {
    // A wide neck, a narrow one, and one that the probe cuts through.
    for (r, apart, probe) in [(1.7, 1.5, 1.4), (1.7, 4.5, 1.4), (1.7, 5.9, 1.4), (1.5, 3.2, 3.0)] {
        let at = spheres(&[([0.1, 0.2, 0.3], r), ([0.1 + 0.6 * apart, 0.2, 0.3 + 0.8 * apart], r)]);
        let exact = two_spheres(r, apart, probe);
        let mut errors = [[0.0_f64; 2]; 2];
        for (i, h) in [0.2, 0.1].into_iter().enumerate() {
            let m = measures(&mesh(&at, &params(SurfaceKind::Ses, Some(probe), h)), &format!("{apart} {h}"));
            for (k, value) in [m.area, m.volume].into_iter().enumerate() {
                errors[k][i] = 1.0 - value / exact[k];
            }
        }
        let worst = errors.iter().map(|error| error[1].abs()).fold(0.0, f64::max);
        assert!(worst < 3e-3, "{apart}: {errors:?}");
        // The cusps of a torus that is cut through are blunted, with an error of first order.
        let rho = ((r + probe).powi(2) - apart * apart / 4.0).sqrt();
        let least = if rho < probe { 0.9 } else { 1.8 };
        assert!(errors.iter().all(|error| order(*error) > least), "{r} {apart} {probe}: {errors:?}");
    }
    // The unions are two spherical caps without a neck; creases are blunted.
    for (surface, radius) in [(SurfaceKind::Vdw, 1.7), (SurfaceKind::Sas, 3.1)] {
        let (apart, h) = (1.5, 0.1);
        let at = spheres(&[([0.1, 0.2, 0.3], 1.7), ([0.1 + 0.6 * apart, 0.2, 0.3 + 0.8 * apart], 1.7)]);
        let m = measures(&mesh(&at, &params(surface, None, h)), surface.name());
        let lost = PI * (radius - apart / 2.0).powi(2) * (3.0 * radius - (radius - apart / 2.0)) / 3.0;
        let area = 4.0 * PI * radius * (radius + apart / 2.0);
        let volume = 2.0 * (4.0 / 3.0 * PI * radius.powi(3) - lost);
        assert!((m.area / area - 1.0).abs() < 4e-3, "{surface}: {} {area}", m.area);
        assert!((m.volume / volume - 1.0).abs() < 2e-3, "{surface}: {} {volume}", m.volume);
    }
}

#[test]
fn every_vertex_touches_a_probe_that_touches_an_atom_and_enters_none() {
    let atoms = sample("1crn.cif");
    for (surface, probe) in [(SurfaceKind::Ses, 1.4), (SurfaceKind::Ses, 3.0), (SurfaceKind::Sas, 1.4)] {
        let h = 0.5;
        let mesh = mesh(&atoms, &SurfaceParams { atom_ids: true, ..params(surface, Some(probe), h) });
        measures(&mesh, surface.name());
        // A normal is exact up to the rounding of f32; the probe's centre moves by that times its radius.
        let allowed = 2.0 * tolerance(h) + 1e-5 * probe;
        let ids = mesh.atom_ids.as_ref().unwrap();
        let mut kinds = [0_usize; 2];
        for ((x, n), id) in positions(&mesh).zip(&mesh.normals).zip(ids.iter()) {
            let length = if surface == SurfaceKind::Ses { probe } else { 0.0 };
            let centre: [f64; 3] = std::array::from_fn(|k| x[k] + length * f64::from(n[k]));
            let free = clearance(&atoms, probe, centre);
            assert!(free.abs() < allowed, "{surface} {probe}: {x:?} {n:?}: {free}");
            // The nearest atom is the one whose sphere is nearest.
            let c = atoms.centre(*id as usize);
            let own = (0..3).map(|k| (x[k] - c[k]).powi(2)).sum::<f64>().sqrt() - f64::from(atoms.radius(*id as usize));
            let nearest = clearance(&atoms, 0.0, x);
            assert!(own < nearest + 1e-4, "{surface} {probe}: {x:?} {id}: {own} {nearest}");
            kinds[usize::from(own > length.min(1.0) * 1e-2)] += 1;
        }
        // The solvent-excluded surface has contact and re-entrant parts.
        assert!(surface == SurfaceKind::Sas || kinds.iter().all(|n| *n > 1000), "{surface} {probe}: {kinds:?}");
    }
}

#[test]
fn degenerate_arrangements_give_closed_meshes() {
    let grid = |n: i32, a: f64, r: f64| -> Vec<Ball> {
        let index = (0..n).flat_map(move |z| (0..n).flat_map(move |y| (0..n).map(move |x| [x, y, z])));
        index.map(|at| (at.map(|c| a * f64::from(c)), r)).collect()
    };
    let line = (0..5).map(|i| ([1.4 * f64::from(i), 0.0, 0.0], 1.7)).collect();
    for (what, balls) in [
        ("touching", vec![([0.0; 3], 1.5), ([3.0, 0.0, 0.0], 1.5)]),
        ("touching probes", vec![([0.0; 3], 1.6), ([6.0, 0.0, 0.0], 1.6)]),
        ("nested", vec![([0.0; 3], 2.0), ([0.25, 0.0, 0.0], 1.0)]),
        ("equal", vec![([0.5; 3], 1.7); 3]),
        ("line", line),
        ("cubic lattice", grid(4, 3.0, 1.7)),
        ("cubic lattice of touching spheres", grid(3, 3.0, 1.5)),
    ] {
        for surface in [SurfaceKind::Vdw, SurfaceKind::Sas, SurfaceKind::Ses] {
            for (probe, h) in [(None, 0.5), (None, 0.25), (Some(10.0), 0.5)] {
                let probe = probe.filter(|_| surface.has_probe());
                measures(
                    &mesh(&spheres(&balls), &params(surface, probe, h)),
                    &format!("{what} {surface} {probe:?} {h}"),
                );
            }
        }
    }
}

#[test]
fn without_a_probe_all_surfaces_are_the_van_der_waals_surface() {
    let atoms = sample("4pti.pdb");
    let vdw = mesh(&atoms, &params(SurfaceKind::Vdw, None, 0.7));
    for surface in [SurfaceKind::Sas, SurfaceKind::Ses] {
        assert!(mesh(&atoms, &params(surface, Some(0.0), 0.7)) == vdw, "{surface}");
    }
    // The solvent-excluded surface lies between the other two.
    let [sas, ses] = [SurfaceKind::Sas, SurfaceKind::Ses].map(|surface| mesh(&atoms, &params(surface, None, 0.7)));
    let [vdw, sas, ses] = [&vdw, &sas, &ses].map(|mesh| measures(mesh, "4pti").volume);
    assert!(vdw < 0.9 * ses && ses < 0.75 * sas, "{vdw} {ses} {sas}");
}

#[test]
fn solvent_accessible_areas_agree_with_freesasa() {
    let atoms = sample("1crn.cif");
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("spheres.txt");
    let row = |i: usize| {
        let [x, y, z] = atoms.centre(i);
        format!("{x} {y} {z} {}\n", atoms.radius(i))
    };
    std::fs::write(&path, (0..atoms.len()).map(row).collect::<String>()).unwrap();
    let Some(sasa) = tools::sasa(&[&path]) else { return };
    let m = measures(&mesh(&atoms, &params(SurfaceKind::Sas, None, 0.2)), "1crn");
    // Creases between spheres are cut off, so the mesh has slightly less area.
    let share = m.area / sasa[0].area;
    assert!((0.985..1.0).contains(&share), "{} {}", m.area, sasa[0].area);
}

#[test]
fn quantized_meshes_are_rounded_ones() {
    let atoms = sample("4pti.pdb");
    let single = params(SurfaceKind::Ses, None, 0.8);
    let step = Step::covering(molmesh::surface::lattice::extent(&atoms, &single));
    let quantized = mesh(&atoms, &SurfaceParams { quantize: Some(step), ..single.clone() });
    let mut rounded = mesh(&atoms, &single);
    rounded.quantize(step);
    assert!(quantized == rounded);
}

/// Cancels the run while its boundary is searched for.
struct CancelAfter(CancelToken);

impl Observer for CancelAfter {
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        assert!(done <= total);
        if stage == Stage::Bin {
            self.0.cancel();
        }
    }
}

#[test]
fn overlaps_and_candidates_are_limited_and_the_search_can_be_cancelled() {
    let atoms = sample("4pti.pdb");
    let ses = params(SurfaceKind::Ses, None, 0.2);
    let backend = CpuBackend::new(Some(2)).unwrap();
    let run = |max_candidates, params: &SurfaceParams, control: &Control<'_>| {
        let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
        backend.run(&atoms, params, &limits, control)
    };
    // A large probe makes atoms overlap, and a coarse grid has few bricks.
    let large = params(SurfaceKind::Ses, Some(10.0), 8.0);
    let error = run(20_000, &large, &Control::default()).unwrap_err();
    let exceeded = error.exceeded(Limit::Overlaps).unwrap();
    assert!(exceeded.max == 20_000 && exceeded.actual > Some(20_000), "{error:?}");
    assert!(run(1 << 20, &large, &Control::default()).is_ok());
    // Many caps of one sphere: the comparisons count as well.
    let n = 2000;
    let on_sphere = |i: i32| {
        let (height, turn) = (1.0 - f64::from(2 * i + 1) / f64::from(n), 2.399_963 * f64::from(i));
        let across = (1.0 - height * height).sqrt();
        ([across * turn.cos(), across * turn.sin(), height].map(|c| 2.9 * c), 0.3)
    };
    let crowd: Vec<Ball> = std::iter::once(([0.0; 3], 0.3)).chain((0..n).map(on_sphere)).collect();
    let distance2 = |a: &Ball, b: &Ball| (0..3).map(|k| (a.0[k] - b.0[k]).powi(2)).sum::<f64>();
    let of = |a: &Ball| crowd.iter().filter(|b| distance2(a, b).sqrt() < a.1 + b.1 + 2.8).count() as u64;
    let pairs: u64 = crowd.iter().map(of).sum();
    let probed = params(SurfaceKind::Ses, Some(1.4), 2.0);
    let run_crowd = |max_candidates| {
        let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
        backend.run(&spheres(&crowd), &probed, &limits, &Control::default()).map(|output| output.grid.overlaps)
    };
    let overlaps = run_crowd(1 << 31).unwrap();
    assert!(overlaps > pairs + pairs / 100, "{overlaps} with comparisons, {pairs} pairs");
    assert_eq!(run_crowd(overlaps), Ok(overlaps));
    let refused = run_crowd(overlaps - 1).unwrap_err();
    assert!(refused.exceeded(Limit::Overlaps).is_some_and(|exceeded| exceeded.max == overlaps - 1), "{refused:?}");
    // Arcs near bricks count as atoms near bricks do.
    let pairs = backend.run(&atoms, &ses, &SurfaceLimits::default(), &Control::default()).unwrap().grid.candidates;
    let error = run(pairs + 1000, &ses, &Control::default()).unwrap_err();
    assert!(error.exceeded(Limit::Candidates).is_some(), "{error:?}");

    let cancel = CancelToken::default();
    let observer = CancelAfter(cancel.clone());
    // Many cells: a progress report precedes the end.
    let apart: Vec<Ball> = (0..4000)
        .map(|i| ([f64::from(i % 20), f64::from(i / 20 % 20), f64::from(i / 400)].map(|c| 7.0 * c), 1.7))
        .collect();
    let control = Control { cancel, observer: &observer, ..Control::default() };
    let error = backend.run(&spheres(&apart), &ses, &SurfaceLimits::default(), &control).unwrap_err();
    assert_eq!(error, SurfaceError::Cancelled);
}

#[test]
fn a_grid_without_a_point_inside_has_no_surface_and_other_backends_reject_the_request() {
    let one = spheres(&[([0.5; 3], 0.3)]);
    let run = |backend: &dyn Backend, surface| {
        let params = params(surface, None, 1.0);
        backend.run(&one, &params, &SurfaceLimits::default(), &Control::default()).unwrap_err()
    };
    let error = run(&CpuBackend::new(Some(1)).unwrap(), SurfaceKind::Vdw);
    assert_eq!(error, SurfaceError::NoSurface { isovalue: None });
    assert!(error.to_string().contains("finer grid"), "{error}");
    for surface in [SurfaceKind::Vdw, SurfaceKind::Sas, SurfaceKind::Ses] {
        let error = run(&ReferenceBackend, surface);
        assert!(matches!(error, SurfaceError::BadParameter { name: "surface", .. }), "{error:?}");
    }
}

#[test]
fn parameters_without_effect_are_rejected() {
    let plain = |surface| SurfaceOptions { surface: Some(surface), ..SurfaceOptions::default() };
    let refused = |options: SurfaceOptions, expected: &str| {
        let error = SurfaceParams::new(&options).unwrap_err();
        assert!(matches!(error, SurfaceError::BadParameter { name, .. } if name == expected), "{expected}: {error:?}");
    };
    for surface in [SurfaceKind::Vdw, SurfaceKind::Sas, SurfaceKind::Ses] {
        let of = || plain(surface);
        refused(SurfaceOptions { isovalue: Some(1.1), ..of() }, "isovalue");
        refused(SurfaceOptions { smoothness: Some(2.0), ..of() }, "smoothness");
        refused(SurfaceOptions { cutoff_tolerance: Some(0.02), ..of() }, "cutoff_tolerance");
        refused(SurfaceOptions { preset: Some(molmesh::surface::Preset::SesLike), ..of() }, "preset");
        refused(SurfaceOptions { paper_c: Some(0.5), ..of() }, "paper_c");
        let defaults = SurfaceOptions {
            isovalue: Some(1.0),
            smoothness: Some(1.25),
            cutoff_tolerance: Some(0.01),
            preset: Some(molmesh::surface::Preset::Default),
            ..of()
        };
        assert_eq!(SurfaceParams::new(&defaults), SurfaceParams::new(&of()), "{surface}");
    }
    for surface in [SurfaceKind::Gaussian, SurfaceKind::SoftObject, SurfaceKind::Vdw] {
        refused(SurfaceOptions { probe: Some(1.5), ..plain(surface) }, "probe");
        assert!(SurfaceParams::new(&SurfaceOptions { probe: Some(1.4), ..plain(surface) }).is_ok());
    }
    for probe in [-0.1, 10.1, f64::NAN] {
        refused(SurfaceOptions { probe: Some(probe), ..plain(SurfaceKind::Ses) }, "probe");
    }
}
