//! The meshing core compared with analytic spheres, a brute-force field in double precision and the sequential
//! reference. Meshes are closed, deterministic and independent of the order of atoms.

#![expect(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::float_cmp,
    reason = "tests fail by panicking, and exact equality is intended"
)]

use crate::measure_support::agree;
use crate::tools::shapes::Random;

use molmesh::surface::reference::Density;
use molmesh::surface::{
    Backend, BackendJob, CancelToken, Control, CpuBackend, Kernel, Limit, Measures, Mesh, MeshOutput, MeshPart,
    MeshSink, Observer, Quantized, ReferenceBackend, SinkFailed, Spheres, Stage, Step, SurfaceError, SurfaceLimits,
    SurfaceOptions, SurfaceParams, Validation, Vertices, lattice,
};
use std::collections::BTreeSet;
use std::sync::Mutex;

const KERNELS: [Kernel; 3] = [Kernel::Gaussian, Kernel::SoftObject, Kernel::InverseSquare];

fn spheres(rows: &[[f64; 4]]) -> Spheres {
    let column = |k: usize| rows.iter().map(|row| row[k]).collect();
    Spheres::new(column(0), column(1), column(2), rows.iter().map(|row| row[3] as f32).collect()).unwrap()
}

fn params(kernel: Kernel, resolution: f64) -> SurfaceParams {
    let options =
        SurfaceOptions { surface: Some(kernel.into()), resolution: Some(resolution), ..SurfaceOptions::default() };
    SurfaceParams::new(&options).unwrap()
}

fn run_on(backend: &dyn Backend, spheres: &Spheres, params: &SurfaceParams) -> MeshOutput {
    backend.run(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap()
}

fn run(spheres: &Spheres, params: &SurfaceParams) -> MeshOutput {
    run_on(&CpuBackend::new(Some(2)).unwrap(), spheres, params)
}

fn exact(meshed: &MeshOutput) -> Measures {
    Measures::of(&meshed.mesh, Validation::Exact, &Control::default()).unwrap()
}

fn assert_sound(meshed: &MeshOutput, what: &str) -> Measures {
    let m = exact(meshed);
    assert!(m.closed && m.oriented && m.manifold, "{what}: {m:?}");
    let quick = Measures::of(&meshed.mesh, Validation::Checksum, &Control::default()).unwrap();
    assert_eq!((quick.closed, quick.manifold, quick.euler), (true, true, m.euler), "{what}");
    if let Some(taken) = &meshed.measures {
        assert!(agree(taken, &quick, &meshed.mesh), "{what}: {taken:?} {quick:?}");
    }
    for (p, n) in meshed.mesh.positions.iter().zip(&meshed.mesh.normals) {
        assert!(p.iter().all(|c| c.is_finite()), "{what}");
        let length = n.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
        assert!((length - 1.0).abs() < 1e-5, "{what}: normal {n:?}");
    }
    m
}

#[test]
fn measures_during_meshing_are_those_of_the_mesh() {
    // Voids, several sheets in a brick, cells with two sheets, components across tiles.
    let crowd = spheres(&Random(11).cloud(4000, 70.0));
    for (h, kernel) in [(0.5, Kernel::Gaussian), (1.3, Kernel::SoftObject), (2.5, Kernel::InverseSquare)] {
        let meshed = run(&crowd, &params(kernel, h));
        let m = assert_sound(&meshed, &format!("{h} {kernel}"));
        assert!(m.components.len() > 1 && meshed.measures.is_some(), "{h} {kernel}: {}", m.components.len());
    }
    // Control: one atom more or less.
    let fewer = spheres(&Random(11).cloud(3999, 70.0));
    let [all, fewer] = [&crowd, &fewer].map(|at| run(at, &params(Kernel::Gaussian, 1.0)));
    let measured = exact(&all);
    assert!(!agree(&measured, &fewer.measures.unwrap(), &all.mesh));
    assert!(agree(&measured, all.measures.as_ref().unwrap(), &all.mesh));
}

/// Returns the slope of log(error) over log(spacing) between the coarsest and the finest spacing.
fn order(errors: &[(f64, f64)]) -> f64 {
    let (first, last) = (errors[0], errors[errors.len() - 1]);
    (first.1 / last.1).ln() / (first.0 / last.0).ln()
}

#[test]
fn a_single_sphere_has_its_analytic_area_and_volume() {
    let r = 1.7_f64;
    let at = spheres(&[[0.123, -4.321, 7.007, r]]);
    for kernel in KERNELS {
        let (mut areas, mut volumes) = (Vec::new(), Vec::new());
        for h in [0.4, 0.2, 0.1, 0.05] {
            let meshed = run(&at, &params(kernel, h));
            let m = assert_sound(&meshed, "sphere");
            assert_eq!((m.euler, m.components.len()), (2, 1));
            areas.push((h, (m.area - 4.0 * std::f64::consts::PI * r * r).abs()));
            volumes.push((h, (m.volume - 4.0 / 3.0 * std::f64::consts::PI * r.powi(3)).abs()));
            let (mut off, mut turned) = (0.0_f64, 0.0_f64);
            for (p, n) in meshed.mesh.positions.iter().zip(&meshed.mesh.normals) {
                let c = [0.123, -4.321, 7.007];
                let d: [f64; 3] = std::array::from_fn(|k| f64::from(p[k]) + meshed.mesh.centre[k] - c[k]);
                let length = d.iter().map(|c| c * c).sum::<f64>().sqrt();
                off = off.max((length - r).abs());
                let cosine: f64 = (0..3).map(|k| d[k] / length * f64::from(n[k])).sum();
                turned = turned.max(cosine.min(1.0).acos());
            }
            // The step squares the error of linear interpolation. The arc cosine magnifies the rounding of normals.
            assert!(off < (8.0 * h.powi(4)).min(0.03), "{kernel} {h}: {off} Å");
            assert!(turned < 1e-3, "{kernel} {h}: {turned} rad");
        }
        assert!(order(&areas) >= 1.9, "{kernel}: area of order {} {areas:?}", order(&areas));
        assert!(order(&volumes) >= 1.9, "{kernel}: volume of order {} {volumes:?}", order(&volumes));
    }
}

/// Returns area and volume of the body of revolution around two overlapping atoms by integrating the profile. A root
/// finder computes the profile from the double-precision density.
fn two_atom_truth(density: &Density, iso: f64, half_length: f64) -> (f64, f64) {
    let n = 4000;
    let radius = |x: f64| {
        let (mut lo, mut hi) = (0.0, 6.0);
        if density.value([x, 0.0, 0.0]) < iso {
            return 0.0;
        }
        for _ in 0..60 {
            let mid = 0.5 * (lo + hi);
            if density.value([x, mid, 0.0]) >= iso { lo = mid } else { hi = mid }
        }
        lo
    };
    // x = L·sin(θ) makes the square-root ends of the profile smooth in θ.
    let (mut lo, mut hi) = (0.0, 2.0 * half_length);
    for _ in 0..60 {
        let mid = 0.5 * (lo + hi);
        if density.value([mid, 0.0, 0.0]) >= iso { lo = mid } else { hi = mid }
    }
    let end = lo;
    let (mut area, mut volume) = (0.0, 0.0);
    let step = std::f64::consts::PI / f64::from(n);
    let points: Vec<(f64, f64)> = (0..=n)
        .map(|i| {
            let x = end * (-std::f64::consts::FRAC_PI_2 + step * f64::from(i)).sin();
            (x, if i == 0 || i == n { 0.0 } else { radius(x) })
        })
        .collect();
    for pair in points.windows(2) {
        let ((x0, r0), (x1, r1)) = (pair[0], pair[1]);
        // Frustums: second order in the step, far below the error of the mesh.
        area += std::f64::consts::PI * (r0 + r1) * ((x1 - x0).powi(2) + (r1 - r0).powi(2)).sqrt();
        volume += std::f64::consts::PI / 3.0 * (x1 - x0) * (r0 * r0 + r0 * r1 + r1 * r1);
    }
    (area, volume)
}

#[test]
fn two_overlapping_atoms_converge_to_the_integrated_truth() {
    let at = spheres(&[[-0.8, 0.0, 0.0, 1.7], [0.8, 0.0, 0.0, 1.7]]);
    for kernel in KERNELS {
        let density = Density::new(&at, &params(kernel, 0.5)).unwrap();
        let (area, volume) = two_atom_truth(&density, 1.0, 2.5);
        let (mut areas, mut volumes) = (Vec::new(), Vec::new());
        for h in [0.4, 0.2, 0.1, 0.05] {
            let m = assert_sound(&run(&at, &params(kernel, h)), "two atoms");
            areas.push((h, (m.area - area).abs()));
            volumes.push((h, (m.volume - volume).abs()));
        }
        assert!(order(&areas) >= 1.9, "{kernel}: area of order {} {areas:?}", order(&areas));
        assert!(order(&volumes) >= 1.9, "{kernel}: volume of order {} {volumes:?}", order(&volumes));
    }
}

/// Parameters on an edge with the densities `ends` (over the isovalue): the linearly interpolated one, and that after
/// one step on the logarithm, of at most three quarters of the rest of the edge. `at` returns density and derivative.
fn stepped(ends: [f64; 2], at: impl Fn(f64) -> (f64, f64)) -> [f64; 2] {
    let within = |t: f64| t.clamp(1.0 / 1024.0, 1.0 - 1.0 / 1024.0);
    let t = within((ends[0] - 1.0) / (ends[0] - ends[1]));
    let (value, slope) = at(t);
    let rest = f64::from((value >= 1.0) == (ends[0] >= 1.0)) - t;
    let share = -2.0 * (value - 1.0) / (value + 1.0) * value / slope / rest;
    [t, within(t + rest * if (0.0..0.75).contains(&share) { share } else { 0.75 })]
}

/// Each vertex is one step from the linear interpolation of the exact densities of its edge. Its normal is that of the
/// exact gradient at the vertex, and not that at the interpolated point.
#[test]
fn vertices_and_normals_agree_with_the_brute_force_field() {
    let rows = Random(7).cloud(300, 18.0);
    let at = spheres(&rows);
    for kernel in KERNELS {
        for h in [0.5, 0.37, 1.0] {
            let params = params(kernel, h);
            let density = Density::new(&at, &params).unwrap();
            let meshed = run(&at, &params);
            assert_sound(&meshed, kernel.name());
            let (mut off, mut n_linear, mut turned) = (Vec::new(), 0, [0.0_f64; 2]);
            for (p, n) in meshed.mesh.positions.iter().zip(&meshed.mesh.normals).step_by(17) {
                let x: [f64; 3] = std::array::from_fn(|k| f64::from(p[k]) + meshed.mesh.centre[k]);
                let lattice = x.map(|c| c / h);
                let axis = (0..3).max_by(|&a, &b| fraction(lattice[a]).total_cmp(&fraction(lattice[b]))).unwrap();
                let mut low = lattice.map(f64::round);
                low[axis] = lattice[axis].floor();
                let along = |t: f64| {
                    let mut point = low;
                    point[axis] += t;
                    point.map(|c| c * h)
                };
                let ends = [0.0, 1.0].map(|t| density.value(along(t)));
                let crosses = (ends[0] >= 1.0) != (ends[1] >= 1.0);
                assert!(crosses || ends.iter().any(|f| (f - 1.0).abs() < 1e-5), "{ends:?}");
                let [linear, t] = stepped(ends, |t| (density.value(along(t)), density.gradient(along(t))[axis] * h));
                off.push((low[axis] + t - lattice[axis]).abs() * h);
                n_linear += usize::from((low[axis] + linear - lattice[axis]).abs() * h < 2e-4);
                for (point, turned) in [x, along(linear)].into_iter().zip(&mut turned) {
                    let g = density.gradient(point);
                    let length = g.iter().map(|c| c * c).sum::<f64>().sqrt();
                    if length > 1e-2 {
                        let cosine: f64 = (0..3).map(|k| -g[k] / length * f64::from(n[k])).sum();
                        *turned = turned.max(1.0 - cosine);
                    }
                }
            }
            let worst = off.iter().copied().fold(0.0, f64::max);
            assert!(worst < 1e-3, "{kernel} {h}: vertices off by {worst} Å");
            assert!(n_linear * 5 < off.len(), "{kernel} {h}: {n_linear} of {} did not move", off.len());
            assert!(turned[0] < 1e-5 && turned[1] > 1e-2, "{kernel} {h}: normals off by 1 − cos = {turned:?}");
        }
    }
}

fn fraction(v: f64) -> f64 {
    (v - v.round()).abs()
}

#[test]
fn the_gradient_is_the_derivative_of_the_field() {
    let rows = Random(11).cloud(60, 9.0);
    let at = spheres(&rows);
    let mut random = Random(5);
    for kernel in KERNELS {
        let density = Density::new(&at, &params(kernel, 0.5)).unwrap();
        for _ in 0..200 {
            let x: [f64; 3] = std::array::from_fn(|_| random.next() * 9.0);
            let g = density.gradient(x);
            let e = 1e-5;
            for k in 0..3 {
                let (mut a, mut b) = (x, x);
                a[k] -= e;
                b[k] += e;
                let numeric = (density.value(b) - density.value(a)) / (2.0 * e);
                let bound = 1e-4 * g.iter().map(|c| c.abs()).fold(1.0, f64::max);
                assert!((numeric - g[k]).abs() < bound, "{kernel} at {x:?}: {numeric} {}", g[k]);
            }
        }
    }
}

#[test]
fn the_native_backend_agrees_with_the_sequential_reference() {
    let rows = Random(3).cloud(40, 8.0);
    let at = spheres(&rows);
    for kernel in KERNELS {
        let params = SurfaceParams { atom_ids: true, ..params(kernel, 0.6) };
        let native = run(&at, &params);
        let reference = run_on(&ReferenceBackend, &at, &params);
        let (a, b) = (assert_sound(&native, "native"), assert_sound(&reference, "reference"));
        assert_eq!(native.mesh.n_vertices(), reference.mesh.n_vertices(), "{kernel}");
        assert_eq!(native.mesh.n_triangles(), reference.mesh.n_triangles(), "{kernel}");
        assert_eq!((a.euler, a.components.len()), (b.euler, b.components.len()), "{kernel}");
        assert!(
            (a.area / b.area - 1.0).abs() < 1e-5 && (a.volume / b.volume - 1.0).abs() < 1e-5,
            "{kernel} {a:?} {b:?}"
        );
        assert_eq!(native.mesh.centre, reference.mesh.centre);
        // The backends number vertices differently, so they are compared in the order of their grid edges.
        let sorted = |m: &MeshOutput| {
            let ids = m.mesh.atom_ids.as_ref().unwrap();
            let mut rows: Vec<_> =
                m.mesh.positions.iter().zip(ids).map(|(p, id)| (p.map(|c| (c * 500.0).round() as i64), *id)).collect();
            rows.sort_unstable();
            rows
        };
        let (x, y) = (sorted(&native), sorted(&reference));
        let same = x.iter().filter(|row| y.binary_search(row).is_ok()).count();
        assert!(same * 100 >= x.len() * 97, "{kernel}: {same} of {} rows equal", x.len());
    }
    // Negative control: another isovalue.
    let other = SurfaceParams { isovalue: 1.01, ..params(Kernel::Gaussian, 0.6) };
    let (a, b) = (exact(&run(&at, &params(Kernel::Gaussian, 0.6))), exact(&run(&at, &other)));
    assert!((a.volume / b.volume - 1.0).abs() > 1e-4, "{} {}", a.volume, b.volume);
}

#[test]
fn the_same_bytes_with_any_number_of_threads_and_any_order_of_atoms() {
    let mut rows = Random(21).cloud(1500, 45.0);
    let at = spheres(&rows);
    for kernel in KERNELS {
        let params = params(kernel, 0.5);
        let [one, two, seven] = [1, 2, 7].map(|n| run_on(&CpuBackend::new(Some(n)).unwrap(), &at, &params));
        assert_eq!(one.mesh, two.mesh);
        assert_eq!(one.mesh, seven.mesh);
        assert_eq!(one.grid, seven.grid);
        rows.reverse();
        rows.rotate_left(311);
        let permuted = run(&spheres(&rows), &params);
        assert_eq!(one.mesh.triangles, permuted.mesh.triangles, "{kernel}");
        assert_eq!(one.mesh.positions, permuted.mesh.positions, "{kernel}");
        let changed = run(&spheres(&rows[1..]), &params);
        assert_ne!(one.mesh.positions, changed.mesh.positions, "negative control");
    }
}

#[test]
fn shifts_by_whole_spacings_shift_the_mesh() {
    let rows = Random(77).cloud(200, 15.0);
    let moved: Vec<[f64; 4]> = rows.iter().map(|r| [r[0] + 512.5, r[1] - 100.0, r[2] + 33.0, r[3]]).collect();
    let (a, b) =
        (run(&spheres(&rows), &params(Kernel::Gaussian, 0.5)), run(&spheres(&moved), &params(Kernel::Gaussian, 0.5)));
    let (m, n) = (assert_sound(&a, "original"), assert_sound(&b, "shifted"));
    assert_eq!(
        (m.euler, a.mesh.n_vertices(), a.mesh.n_triangles()),
        (n.euler, b.mesh.n_vertices(), b.mesh.n_triangles())
    );
    assert!((m.area - n.area).abs() < 1e-3 && (m.volume - n.volume).abs() < 1e-3);
    let shift: [f64; 3] = std::array::from_fn(|k| b.mesh.centre[k] - a.mesh.centre[k]);
    assert_eq!(shift, [512.5, -100.0, 33.0]);
}

#[test]
fn adding_atoms_never_shrinks_the_volume() {
    let rows = Random(99).cloud(120, 12.0);
    for kernel in KERNELS {
        let part = exact(&run(&spheres(&rows[..60]), &params(kernel, 0.5)));
        let whole = exact(&run(&spheres(&rows), &params(kernel, 0.5)));
        assert!(whole.volume > part.volume, "{kernel}: {} {}", whole.volume, part.volume);
    }
}

#[test]
fn atoms_at_tile_and_brick_borders_have_sound_meshes() {
    // One atom at a time, moved across the corner of a tile in steps that hit grid points, faces and half spacings.
    for step in 0..24 {
        let x = 31.0 + f64::from(step) * 0.125;
        for at in [[x, 0.0, 0.0], [x, x, 0.25], [x, x, x], [-x, x, -x]] {
            let m =
                assert_sound(&run(&spheres(&[[at[0], at[1], at[2], 1.7]]), &params(Kernel::Gaussian, 0.5)), "swept");
            assert_eq!((m.euler, m.components.len()), (2, 1), "{at:?}");
            // Chords reduce a sphere of 3.4 spacings by a few per cent.
            assert!((19.5..20.58).contains(&m.volume), "{at:?} {}", m.volume);
        }
    }
}

#[test]
fn densities_equal_to_the_isovalue_are_inside_and_manifold() {
    // The density of the soft object is exactly 1 at half its support, which is placed on grid points.
    let at = spheres(&[[0.0, 0.0, 0.0, 1.5], [6.0, 0.0, 0.0, 1.5], [3.0, 0.0, 0.0, 1.5]]);
    for h in [0.5, 0.25, 0.75, 1.5] {
        assert_sound(&run(&at, &params(Kernel::SoftObject, h)), "ties");
    }
    // Equal atoms on a lattice give saddles with zero gradient.
    let rows: Vec<[f64; 4]> = (0..125)
        .map(|i| [i % 5, i / 5 % 5, i / 25].map(|c| f64::from(c) * 3.0))
        .map(|c| [c[0], c[1], c[2], 1.5])
        .collect();
    for kernel in KERNELS {
        for h in [0.25, 0.5, 0.75] {
            assert_sound(&run(&spheres(&rows), &params(kernel, h)), "lattice of atoms");
        }
    }
}

#[test]
fn a_hollow_shell_has_a_void() {
    // Atoms on a sphere of radius 9 Å: an outer surface and an inner one of negative volume.
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    let n = 300;
    let rows: Vec<[f64; 4]> = (0..n)
        .map(|i| {
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / f64::from(n);
            let (r, a) = ((1.0 - z * z).sqrt(), golden * f64::from(i));
            [9.0 * r * a.cos(), 9.0 * r * a.sin(), 9.0 * z, 1.7]
        })
        .collect();
    let rows: Vec<[f64; 4]> = rows.into_iter().map(|[x, y, z, r]| [x + 40.0, y - 20.0, z + 7.0, r]).collect();
    let meshed = run(&spheres(&rows), &params(Kernel::Gaussian, 0.5));
    let mesh = &meshed.mesh;
    let m = assert_sound(&meshed, "shell");
    let volumes: Vec<f64> = m.components.iter().map(|c| c.volume).collect();
    assert_eq!(m.components.len(), 2, "{volumes:?}");
    assert!(volumes[0] > 4000.0 && volumes[1] < -1000.0, "{volumes:?}");
    for component in &m.components {
        // Both surfaces have the centre of the shell.
        let off = (0..3)
            .map(|k| (component.centroid()[k] + mesh.centre[k] - [40.0, -20.0, 7.0][k]).abs())
            .fold(0.0, f64::max);
        assert!(off < 0.05, "{component:?}");
    }
}

#[test]
fn atom_indices_name_the_nearest_atom_of_each_vertex() {
    let mut random = Random(13);
    let rows: Vec<[f64; 4]> =
        random.cloud(400, 20.0).into_iter().map(|[x, y, z, r]| [x, y, z, 1.5 * r - 0.7]).collect();
    let at = spheres(&rows);
    for kernel in [Kernel::Gaussian, Kernel::SoftObject, Kernel::InverseSquare] {
        let params = SurfaceParams { atom_ids: true, radius_scale: 1.1, radius_offset: 0.2, ..params(kernel, 0.5) };
        let run_on = |backend: &dyn Backend| {
            backend.run(&at, &params, &SurfaceLimits::default(), &Control::default()).unwrap().mesh
        };
        for mesh in [run_on(&CpuBackend::new(Some(2)).unwrap()), run_on(&ReferenceBackend)] {
            let ids = mesh.atom_ids.as_ref().unwrap();
            assert_eq!(ids.len(), mesh.n_vertices());
            let (mut wrong, mut not_nearest_centre) = (0, 0);
            for (p, &id) in mesh.positions.iter().zip(ids.iter()) {
                let centre = |row: &[f64; 4]| {
                    (0..3).map(|k| (f64::from(p[k]) + mesh.centre[k] - row[k]).powi(2)).sum::<f64>().sqrt()
                };
                let surface = |row: &[f64; 4]| centre(row) - (1.1 * f64::from(row[3] as f32) + 0.2);
                let least = |distance: &dyn Fn(&[f64; 4]) -> f64| rows.iter().map(distance).fold(f64::MAX, f64::min);
                let named = &rows[id as usize];
                wrong += usize::from(surface(named) > least(&surface) + 1e-4);
                not_nearest_centre += usize::from(centre(named) > least(&centre) + 1e-4);
            }
            assert_eq!(wrong, 0, "{kernel:?}");
            // The two distances give different atoms.
            assert!(not_nearest_centre * 20 > ids.len(), "{kernel:?}: {not_nearest_centre} of {}", ids.len());
        }
    }
}

/// Returns the grid spacing that an error suggests.
fn suggestion(error: &SurfaceError) -> Option<f64> {
    match error {
        SurfaceError::Limit(exceeded) => exceeded.suggested_resolution,
        _ => None,
    }
}

#[test]
fn limits_are_checked_and_suggested_spacings_fit() {
    let at = spheres(&Random(1).cloud(500, 40.0));
    let backend = CpuBackend::new(Some(2)).unwrap();
    for limits in [
        SurfaceLimits { max_grid_points: 100_000, ..SurfaceLimits::default() },
        SurfaceLimits { max_mesh_bytes: 300_000, ..SurfaceLimits::default() },
        SurfaceLimits { max_candidates: 6_000, ..SurfaceLimits::default() },
    ] {
        for h in [0.5, 0.2, 0.05, 0.02] {
            let started = std::time::Instant::now();
            let error = backend.run(&at, &params(Kernel::Gaussian, h), &limits, &Control::default()).unwrap_err();
            let mut h = suggestion(&error).unwrap_or_else(|| panic!("{error}"));
            assert!(started.elapsed().as_secs_f64() < 60.0, "rejected late");
            // A backend extrapolates, so its suggestion may need further steps.
            for attempt in 0.. {
                match backend.run(&at, &params(Kernel::Gaussian, h), &limits, &Control::default()) {
                    Ok(_) => break,
                    Err(error) => {
                        let suggested = suggestion(&error).unwrap_or_else(|| panic!("{error}"));
                        assert!(attempt < 5 && suggested > h, "no progress from {h} to {suggested}");
                        h = suggested;
                    }
                }
            }
        }
    }
}

#[test]
fn far_too_large_grids_are_rejected_before_evaluation() {
    // 10⁴ times the allowed grid points: even the field of the allowed ones would take seconds here.
    let at = spheres(&Random(1).cloud(3000, 40.0));
    let limits = SurfaceLimits { max_grid_points: 1 << 28, ..SurfaceLimits::default() };
    let seen = Stages::default();
    let control = Control { observer: &seen, ..Control::default() };
    let backend = CpuBackend::new(Some(2)).unwrap();
    let error = backend.run(&at, &params(Kernel::Gaussian, 0.01), &limits, &control);
    let error = error.unwrap_err();
    let exceeded = error.exceeded(Limit::GridPoints).unwrap();
    assert!(exceeded.actual.unwrap() > exceeded.max, "{error}");
    assert!((0.05..1.0).contains(&exceeded.suggested_resolution.unwrap()), "{error}");
    assert_eq!(seen.all(), [Stage::Bin], "nothing was evaluated");
    // Control: a grid within the limit reaches later stages.
    backend.run(&at, &params(Kernel::Gaussian, 1.0), &limits, &control).unwrap();
    assert!(seen.all().contains(&Stage::Field));
}

/// Records the stages of a run.
#[derive(Default)]
struct Stages(Mutex<BTreeSet<Stage>>);

impl Stages {
    fn all(&self) -> Vec<Stage> {
        self.0.lock().unwrap().iter().copied().collect()
    }
}

impl Observer for Stages {
    fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
        self.0.lock().unwrap().insert(stage);
        work();
    }
}

/// Mesh collected from parts in any order, and the number of received vertices.
#[derive(Default)]
struct Collected(Mutex<(Mesh, usize)>);

impl MeshSink for Collected {
    fn begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), SinkFailed> {
        let (mesh, _) = &mut *self.0.lock().unwrap();
        // The first part decides which vertex columns are used.
        mesh.positions = vec![[f32::NAN; 3]; n_vertices].into();
        mesh.normals = vec![[f32::NAN; 3]; n_vertices].into();
        mesh.triangles = vec![[u32::MAX; 3]; n_triangles].into();
        Ok(())
    }

    fn part(&self, part: &MeshPart<'_>) -> Result<(), SinkFailed> {
        let (mesh, received) = &mut *self.0.lock().unwrap();
        *received += part.vertices.len();
        let (v, t) = (part.first_vertex..part.first_vertex + part.vertices.len(), part.first_triangle);
        match part.vertices {
            Vertices::Single { positions, normals } => {
                mesh.positions[v.clone()].copy_from_slice(positions);
                mesh.normals[v].copy_from_slice(normals);
            }
            Vertices::Quantized { step, positions, normals } => {
                let n = mesh.positions.len();
                let quantized = mesh.quantized.get_or_insert_with(|| Quantized {
                    step,
                    positions: vec![[i16::MAX; 4]; n].into(),
                    normals: vec![[i8::MAX; 4]; n].into(),
                });
                quantized.positions[v.clone()].copy_from_slice(positions);
                quantized.normals[v].copy_from_slice(normals);
            }
        }
        mesh.triangles[t..t + part.triangles.len()].copy_from_slice(part.triangles);
        Ok(())
    }
}

#[test]
fn a_sink_gets_the_same_mesh_as_memory() {
    // Adjacent tiles; and a spacing so wide that no atom reaches some vertices. These have no gradient, so normals are
    // computed from the triangles and every vertex is written twice.
    let lone = spheres(&[[0.0, 0.0, 0.0, 0.7]]);
    let (many, wide) = (spheres(&Random(5).cloud(900, 60.0)), 20.0);
    for (at, h, times, quantized) in
        [(&many, 0.5, 1, false), (&lone, wide, 2, false), (&many, 0.5, 1, true), (&lone, wide, 2, true)]
    {
        let p = params(Kernel::Gaussian, h);
        let p = if quantized { rounded(at, &p) } else { p };
        let whole = run(at, &p);
        for threads in [1, 3] {
            let sink = Collected::default();
            let backend = CpuBackend::new(Some(threads)).unwrap();
            let (limits, control) = (SurfaceLimits::default(), Control::default());
            let job = BackendJob { spheres: at, params: &p, limits: &limits, control: &control, sink: Some(&sink) };
            let output = backend.write(&job).unwrap();
            let (mut mesh, received) = sink.0.into_inner().unwrap();
            assert_eq!(received, times * mesh.n_vertices(), "{h} Å");
            assert_eq!(mesh.quantized.is_some(), quantized);
            if quantized {
                (mesh.positions, mesh.normals) = Default::default();
            }
            assert!(mesh.positions == whole.mesh.positions && mesh.normals == whole.mesh.normals);
            assert!(mesh.quantized == whole.mesh.quantized);
            assert!(mesh.triangles == whole.mesh.triangles);
            assert_eq!(output.size(), [mesh.n_vertices(), mesh.n_triangles()]);
            let bounds = output.streamed.unwrap().bounds;
            assert_eq!((bounds, output.mesh.centre, output.grid), (mesh.bounds(), whole.mesh.centre, whole.grid));
            assert_eq!(output.measures, whole.measures);
            assert!(output.mesh.triangles.is_empty());
        }
    }
}

/// Returns the parameters with vertices rounded to the smallest step that covers them.
fn rounded(spheres: &Spheres, params: &SurfaceParams) -> SurfaceParams {
    SurfaceParams { quantize: Some(Step::covering(lattice::extent(spheres, params))), ..params.clone() }
}

#[test]
fn quantized_vertices_are_rounded_once_and_measured_after_rounding() {
    let relative = |a: f64, b: f64| (a / b - 1.0).abs();
    for (at, h) in [(spheres(&Random(5).cloud(400, 50.0)), 0.5), (spheres(&[[900.0, 0.0, -77.0, 1.7]]), 0.3)] {
        for kernel in Kernel::ALL {
            let single = params(kernel, h);
            let whole = run(&at, &single);
            // The smallest step, and one so coarse that it changes area and volume.
            for step in [rounded(&at, &single).quantize.unwrap(), Step::covering(4000.0)] {
                let meshed = run(&at, &SurfaceParams { quantize: Some(step), ..single.clone() });
                let mut expected = whole.mesh.clone();
                assert!(expected.quantize(step));
                assert!(meshed.mesh == expected, "{kernel} {step:?}");
                let found = Measures::of(&meshed.mesh, Validation::Checksum, &Control::default()).unwrap();
                let taken = meshed.measures.unwrap();
                let unrounded = whole.measures.as_ref().unwrap();
                assert_eq!((taken.euler, taken.components.len()), (found.euler, found.components.len()));
                assert!(relative(taken.area, found.area) < 2e-6, "{kernel} {step:?}: {taken:?} {found:?}");
                assert!(relative(taken.volume, found.volume) < 1e-5, "{kernel} {step:?}: {taken:?} {found:?}");
                // Control: measures before rounding differ.
                if step == Step::covering(4000.0) {
                    assert!(relative(taken.area, unrounded.area) > 1e-4, "{kernel}: {taken:?} {unrounded:?}");
                }
            }
        }
    }
}

#[test]
fn the_byte_limit_counts_delivered_vertices() {
    let at = spheres(&Random(5).cloud(100, 30.0));
    let single = params(Kernel::Gaussian, 0.5);
    let small = rounded(&at, &single);
    let (n, bytes) = (run(&at, &single).mesh.n_vertices() as u64, run(&at, &small).mesh.bytes());
    assert_eq!(run(&at, &single).mesh.bytes(), bytes + 12 * n);
    let limits = SurfaceLimits { max_mesh_bytes: bytes, ..SurfaceLimits::default() };
    let backend = CpuBackend::new(Some(2)).unwrap();
    let within = |p: &SurfaceParams, limits: &SurfaceLimits| backend.run(&at, p, limits, &Control::default());
    assert!(within(&small, &limits).is_ok());
    assert!(within(&single, &limits).unwrap_err().exceeded(Limit::MeshBytes).is_some());
    let less = SurfaceLimits { max_mesh_bytes: bytes - 1, ..limits };
    assert!(within(&small, &less).unwrap_err().exceeded(Limit::MeshBytes).is_some());
}

#[test]
fn every_vertex_is_within_the_extent_known_in_advance() {
    let far = spheres(&[[900.0, -70.0, 3.3, 1.7], [930.2, -64.0, 3.4, 2.9]]);
    for at in [spheres(&[[0.3, 0.2, 0.1, 1.7]]), spheres(&Random(8).cloud(60, 25.0)), far] {
        for kernel in Kernel::ALL {
            for h in [0.31, 1.0] {
                let mut options =
                    SurfaceOptions { surface: Some(kernel.into()), resolution: Some(h), ..SurfaceOptions::default() };
                // At a low level the surface is closest to the support of the densities.
                for isovalue in [None, Some(0.001)] {
                    options.isovalue = isovalue;
                    let params = SurfaceParams::new(&options).unwrap();
                    let extent = lattice::extent(&at, &params);
                    for backend in [&CpuBackend::new(Some(2)).unwrap() as &dyn Backend, &ReferenceBackend] {
                        let bounds = run_on(backend, &at, &params).mesh.bounds();
                        let furthest = bounds.as_flattened().iter().fold(0.0_f64, |far, c| far.max(f64::from(c.abs())));
                        assert!(furthest <= extent, "{kernel} {h} {isovalue:?}: {furthest} beyond {extent}");
                        // The extent is tight: at the lowest level little more than its margin remains.
                        assert!(
                            isovalue.is_none() || extent - furthest < 4.0 * h + 1.0,
                            "{kernel} {h}: {furthest} of {extent}"
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn a_sink_that_fails_ends_the_run() {
    struct Full(usize);
    impl MeshSink for Full {
        fn begin(&self, n_vertices: usize, _: usize) -> Result<(), SinkFailed> {
            if n_vertices > self.0 { Err(SinkFailed) } else { Ok(()) }
        }

        fn part(&self, part: &MeshPart<'_>) -> Result<(), SinkFailed> {
            if part.first_vertex > 0 { Err(SinkFailed) } else { Ok(()) }
        }
    }
    let at = spheres(&Random(6).cloud(900, 60.0));
    let p = params(Kernel::Gaussian, 0.5);
    let (limits, control) = (SurfaceLimits::default(), Control::default());
    for room in [0, usize::MAX] {
        let full = Full(room);
        let job = BackendJob { spheres: &at, params: &p, limits: &limits, control: &control, sink: Some(&full) };
        let error = CpuBackend::new(Some(2)).unwrap().write(&job).unwrap_err();
        assert_eq!(error, SurfaceError::Sink);
    }
}

#[test]
fn empty_and_invalid_input_is_rejected() {
    let backend = CpuBackend::new(Some(1)).unwrap();
    let limits = SurfaceLimits::default();
    let empty = Spheres::new(vec![], vec![], vec![], vec![]).unwrap();
    let run =
        |at: &Spheres, p: &SurfaceParams| backend.run(at, p, &limits, &Control::default()).map(|_| ()).unwrap_err();
    assert_eq!(run(&empty, &params(Kernel::Gaussian, 0.5)), SurfaceError::NoSpheres);
    let one = spheres(&[[0.3, 0.3, 0.3, 1.7]]);
    let high = SurfaceParams { isovalue: 50.0, ..params(Kernel::Gaussian, 0.5) };
    assert_eq!(run(&one, &high), SurfaceError::NoSurface { isovalue: Some(50.0) });
    let shrunk = SurfaceParams { radius_offset: -1.7, ..params(Kernel::Gaussian, 0.5) };
    assert!(matches!(run(&one, &shrunk), SurfaceError::BadParameter { name: "radius_offset", .. }));
    for bad in [
        [f64::NAN, 0.0, 0.0, 1.0],
        [0.0, 1e30, 0.0, 1.0],
        [0.0, 0.0, 2e5, 1.0],
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, -1.0],
    ] {
        let column = |k: usize| vec![bad[k]];
        let refused = Spheres::new(column(0), column(1), column(2), vec![bad[3] as f32]);
        assert!(matches!(refused, Err(SurfaceError::BadSphere { index: 0, .. })), "{bad:?}");
    }
}

#[test]
fn a_cancelled_run_stops() {
    let at = spheres(&Random(1).cloud(3000, 60.0));
    let cancel = CancelToken::default();
    cancel.cancel();
    let control = Control { cancel, ..Control::default() };
    for backend in [&CpuBackend::new(Some(2)).unwrap() as &dyn Backend, &ReferenceBackend] {
        let started = std::time::Instant::now();
        let stopped = backend.run(&at, &params(Kernel::Gaussian, 0.3), &SurfaceLimits::default(), &control);
        assert_eq!(stopped.map(|_| ()).unwrap_err(), SurfaceError::Cancelled);
        assert!(started.elapsed().as_secs_f64() < 60.0);
    }
}

#[test]
fn distant_atoms_cost_only_their_own_bricks() {
    let rows: Vec<[f64; 4]> = (0..8)
        .map(|i| [i & 1, i >> 1 & 1, i >> 2].map(|c| f64::from(c) * 180_000.0 - 90_000.0))
        .map(|c| [c[0], c[1], c[2], 1.7])
        .collect();
    let meshed = run(&spheres(&rows), &params(Kernel::Gaussian, 0.5));
    let m = assert_sound(&meshed, "far apart");
    assert_eq!(m.components.len(), 8);
    assert!(meshed.grid.box_cells > 1 << 52 && meshed.grid.grid_points < 1 << 18, "{:?}", meshed.grid);
}

#[test]
fn raw_parameters_of_the_paper_give_a_mesh() {
    let rows = Random(31).cloud(100, 12.0);
    let raw = |kernel: Kernel, a, b, c, iso| SurfaceOptions {
        surface: Some(kernel.into()),
        paper_a: a,
        paper_b: b,
        paper_c: c,
        isovalue: Some(iso),
        ..SurfaceOptions::default()
    };
    for options in [
        raw(Kernel::Gaussian, Some(0.5), Some(4.0), None, 1.0),
        raw(Kernel::SoftObject, Some(2.0), Some(3.4), None, 1.0),
        raw(Kernel::InverseSquare, None, Some(4.0), Some(1.0), 0.5),
    ] {
        let params = SurfaceParams::new(&options).unwrap();
        let m = assert_sound(&run(&spheres(&rows), &params), "raw");
        assert!(m.volume > 0.0);
        // Radii do not matter: the mesh is the same with other radii.
        let other: Vec<[f64; 4]> = rows.iter().map(|r| [r[0], r[1], r[2], 1.0]).collect();
        assert_eq!(run(&spheres(&rows), &params).mesh.positions, run(&spheres(&other), &params).mesh.positions);
    }
}
