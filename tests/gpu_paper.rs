//! The 2010 program against the CPU backend, on the software device: the same surface as a soup of triangles.
#![cfg(feature = "gpu")]
#![expect(clippy::unwrap_used, clippy::float_cmp, reason = "a test may panic, and means equality where it asks for it")]

mod gpu_support;

use std::collections::HashSet;
use std::sync::{Mutex, OnceLock};

use gpu_support::{KERNELS, device, job, measures, params, sample, spheres};
use molmesh::gpu::{Engine, Executor, GpuError, GpuJob, Paper, Prepared};
use molmesh::surface::{
    Backend, CancelToken, Control, CpuBackend, Kernel, Mesh, MeshOutput, Spheres, SurfaceError, SurfaceLimits,
    SurfaceOptions, SurfaceParams,
};

fn run(job: &GpuJob) -> Result<MeshOutput, GpuError> {
    static PAPER: OnceLock<Mutex<Paper>> = OnceLock::new();
    let make = || {
        let (device, queue) = device();
        Mutex::new(Paper::new(Engine::new(device, queue).unwrap()).expect("the program compiles"))
    };
    let mut paper = PAPER.get_or_init(make).lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let finished = paper.run(std::slice::from_ref(job)).pop().unwrap()?;
    let timed = paper.times().iter().filter(|(_, ns)| *ns > 0).count();
    assert!(finished.stages.is_empty() || timed == 6, "{:?}", paper.times());
    Ok(finished.meshed)
}

/// What the soup has otherwise than the CPU's mesh: triangles, and what single precision does not explain.
fn difference(soup: &MeshOutput, cpu: &MeshOutput) -> Vec<String> {
    let mut wrong = Vec::new();
    let (here, there) = (&soup.mesh, &cpu.mesh);
    if here.n_triangles() != there.n_triangles() {
        wrong.push(format!("{} triangles of {}", here.n_triangles(), there.n_triangles()));
    }
    if here.centre != there.centre || here.n_vertices() != 3 * here.n_triangles() {
        wrong.push(format!("centre {:?} of {:?}, {} vertices", here.centre, there.centre, here.n_vertices()));
    }
    let (a, b) = (measures(soup), measures(cpu));
    for (what, a, b) in [("area", a.area, b.area), ("volume", volume(here), b.volume)] {
        if (a / b - 1.0).abs() > 1e-4 {
            wrong.push(format!("{what} {a} of {b}"));
        }
    }
    // Vertices that are shared there lie at one place here.
    let places: HashSet<[i64; 3]> = here.positions.iter().map(key).collect();
    let missing = there.positions.iter().filter(|p| !near(&places, p)).count();
    if missing > 0 {
        wrong.push(format!("{missing} vertices of {} are not there", there.n_vertices()));
    }
    // Central differences are not the gradient, but they do not point inwards.
    let inward = here.triangles.iter().filter(|t| {
        let face = here.face_normal(**t);
        let mean: [f64; 3] =
            std::array::from_fn(|k| t.iter().map(|v| f64::from(here.normals[*v as usize][k])).sum::<f64>());
        (0..3).map(|k| face[k] * mean[k]).sum::<f64>() < 0.0
    });
    let inward = inward.count();
    if inward * 100 > here.n_triangles() {
        wrong.push(format!("{inward} triangles face inwards"));
    }
    wrong
}

/// Signed volume of a soup; its triangles belong together though they share no vertex.
fn volume(mesh: &Mesh) -> f64 {
    let of = |t: &[u32; 3]| {
        let corner = mesh.positions[t[0] as usize].map(f64::from);
        let face = mesh.face_normal(*t);
        (0..3).map(|k| corner[k] * face[k]).sum::<f64>() / 6.0
    };
    mesh.triangles.iter().map(of).sum()
}

#[expect(clippy::cast_possible_truncation, reason = "coordinates of a protein")]
fn key(p: &[f32; 3]) -> [i64; 3] {
    p.map(|c| (f64::from(c) / 1e-3).round() as i64)
}

fn near(places: &HashSet<[i64; 3]>, p: &[f32; 3]) -> bool {
    let at = key(p);
    (0..27).any(|n| places.contains(&[at[0] + n % 3 - 1, at[1] + n / 3 % 3 - 1, at[2] + n / 9 - 1]))
}

fn cpu(spheres: &Spheres, params: &SurfaceParams) -> MeshOutput {
    CpuBackend::new(Some(2)).unwrap().run(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap()
}

#[test]
fn the_soup_is_the_surface_of_the_cpu_with_every_kernel() {
    let crambin = sample("1crn.cif");
    for kernel in KERNELS {
        let params = params(kernel, 0.5);
        let (soup, cpu) = (run(&job(&crambin, &params)).unwrap(), cpu(&crambin, &params));
        assert_eq!(difference(&soup, &cpu), Vec::<String>::new(), "{kernel}");
        assert!(!measures(&soup).closed, "triangles that share no vertices enclose nothing");
        for n in &soup.mesh.normals {
            let length = n.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
            assert!((length - 1.0).abs() < 1e-5, "{kernel}: normal {n:?}");
        }
    }
}

#[test]
fn the_papers_raw_parameters_are_the_cpus() {
    let crambin = sample("1crn.cif");
    let raw = |kernel, [a, b, c]: [Option<f64>; 3], iso| {
        let options = SurfaceOptions {
            kernel: Some(kernel),
            paper_a: a,
            paper_b: b,
            paper_c: c,
            isovalue: Some(iso),
            resolution: Some(0.6),
            ..SurfaceOptions::default()
        };
        SurfaceParams::new(&options).unwrap()
    };
    for params in [
        raw(Kernel::Gaussian, [Some(0.4), Some(3.0), None], 1.0),
        raw(Kernel::SoftObject, [Some(2.0), Some(3.0), None], 0.7),
        raw(Kernel::InverseSquare, [None, Some(5.0), Some(0.8)], 0.4),
    ] {
        let (soup, cpu) = (run(&job(&crambin, &params)).unwrap(), cpu(&crambin, &params));
        assert_eq!(difference(&soup, &cpu), Vec::<String>::new(), "{}", params.kernel);
    }
}

#[test]
fn another_surface_is_seen_to_be_another() {
    let crambin = sample("1crn.cif");
    let of = |kernel, iso| {
        let options = SurfaceOptions { kernel: Some(kernel), isovalue: Some(iso), ..SurfaceOptions::default() };
        SurfaceParams::new(&options).unwrap()
    };
    let soup = run(&job(&crambin, &of(Kernel::Gaussian, 1.0))).unwrap();
    let wrong = difference(&soup, &cpu(&crambin, &of(Kernel::Gaussian, 1.01)));
    assert!(wrong.len() >= 3, "{wrong:?}");
    let mut flipped = soup.clone();
    flipped.mesh.normals.iter_mut().for_each(|n| *n = n.map(|c| -c));
    assert_eq!(difference(&flipped, &cpu(&crambin, &of(Kernel::Gaussian, 1.0))).len(), 1);
}

#[test]
fn single_atoms_and_odd_sizes() {
    for (n, spacing) in [(1, 0.5), (2, 0.31), (65, 0.47)] {
        let rows: Vec<[f64; 4]> = (0..n).map(|i| [1.3 * f64::from(i), 0.1, -7.7, 1.6]).collect();
        let (spheres, params) = (spheres(&rows), params(Kernel::SoftObject, spacing));
        let soup = run(&job(&spheres, &params)).unwrap();
        assert_eq!(difference(&soup, &cpu(&spheres, &params)), Vec::<String>::new(), "{n}");
    }
}

#[test]
fn what_it_cannot_do_is_refused() {
    let far = spheres(&[[0.0, 0.0, 0.0, 1.5], [900.0, 900.0, 900.0, 1.5]]);
    match run(&job(&far, &params(Kernel::Gaussian, 0.5))) {
        Err(GpuError::Surface(SurfaceError::GridTooLarge { samples, limit, suggested_resolution, .. })) => {
            assert!(samples > limit && suggested_resolution > 0.5, "{samples} {limit} {suggested_resolution}");
        }
        other => panic!("{:?}", other.map(|m| m.mesh.n_triangles())),
    }
    let one = spheres(&[[0.0, 0.0, 0.0, 1.5]]);
    let nearest = SurfaceParams { atom_ids: true, ..SurfaceParams::default() };
    let refused = run(&job(&one, &nearest)).unwrap_err();
    assert!(matches!(refused, GpuError::Surface(SurfaceError::BadParameter { name: "atom_ids", .. })), "{refused}");
    // A hundred atoms at one place are more than its numbers hold.
    let heap = spheres(&[[0.0, 0.0, 0.0, 1.5]; 100]);
    let steep = SurfaceOptions { smoothness: Some(20.0), ..SurfaceOptions::default() };
    let refused = run(&job(&heap, &SurfaceParams::new(&steep).unwrap())).unwrap_err();
    assert!(matches!(&refused, GpuError::Failed(why) if why.contains("densely")), "{refused}");
    let small = SurfaceLimits { max_mesh_bytes: 1000, ..SurfaceLimits::default() };
    let prepared = Prepared::new(&one, &SurfaceParams::default(), &small, &Control::default()).unwrap();
    let job = GpuJob { prepared: std::sync::Arc::new(prepared), cancel: CancelToken::default(), deadline: None };
    assert!(matches!(run(&job), Err(GpuError::Surface(SurfaceError::MeshTooLarge { .. }))));
    job.cancel.cancel();
    assert!(matches!(run(&job), Err(GpuError::Surface(SurfaceError::Cancelled))));
}
