//! Comparison of the 2010 program on the software device with the CPU backend.

use std::collections::HashSet;
use std::mem::offset_of;
use std::sync::{Mutex, OnceLock, PoisonError};

use molmesh::surface::{
    Backend, Control, CpuBackend, Measures, Mesh, Spheres, SurfaceLimits, SurfaceOptions, SurfaceParams, Validation,
};

use super::*;
use crate::device::Selected;
use crate::structures;

fn run(spheres: &Spheres, params: &SurfaceParams) -> Result<Mesh> {
    static PROGRAM: OnceLock<Mutex<Program2010>> = OnceLock::new();
    let make = || {
        let software = "software".parse().unwrap();
        Mutex::new(Program2010::new(Selected::new(&software).unwrap().gpu().unwrap()).unwrap())
    };
    let job = Prepared::new(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap();
    let mut program = PROGRAM.get_or_init(make).lock().unwrap_or_else(PoisonError::into_inner);
    let mesh = program.run(&job)?.mesh(job.lattice.centre());
    let steps = program.steps()?;
    assert!(steps.is_none_or(|steps| steps.iter().all(|(_, seconds)| *seconds > 0.0)), "{steps:?}");
    Ok(mesh)
}

impl Soup<'_> {
    fn mesh(&self, centre: [f64; 3]) -> Mesh {
        let n = u32::try_from(self.n_triangles).unwrap();
        let view = self.readback.slice(..72 * u64::from(n)).get_mapped_range().unwrap();
        let (positions, normals) = view.split_at(36 * self.n_triangles);
        let column = |bytes| bytemuck::pod_collect_to_vec::<u8, [f32; 3]>(bytes).into();
        Mesh {
            centre,
            positions: column(positions),
            normals: column(normals),
            triangles: (0..n).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..Mesh::default()
        }
    }
}

fn crambin() -> Spheres {
    structures::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../samples/1crn.cif").as_ref(), None).unwrap()
}

fn params(options: &SurfaceOptions) -> SurfaceParams {
    SurfaceParams::new(options).unwrap()
}

fn of(kernel: Kernel, resolution: f64) -> SurfaceParams {
    params(&SurfaceOptions { surface: Some(kernel.into()), resolution: Some(resolution), ..SurfaceOptions::default() })
}

fn spheres(rows: &[[f64; 4]]) -> Spheres {
    let column = |k: usize| rows.iter().map(|row| row[k]).collect();
    Spheres::new(column(0), column(1), column(2), rows.iter().map(|row| single(row[3])).collect()).unwrap()
}

fn measures(mesh: &Mesh) -> Measures {
    Measures::of(mesh, Validation::Exact, &Control::default()).unwrap()
}

/// Lists the differences between the soup and the CPU's mesh. Both have vertices on the same edges of the grid; the CPU
/// moves them to the isosurface, and the program of 2010 interpolates linearly.
#[expect(clippy::float_cmp, reason = "both centres come from the same lattice")]
fn difference(here: &Mesh, there: &Mesh, spacing: f64) -> Vec<String> {
    let mut wrong = Vec::new();
    if here.n_triangles() != there.n_triangles() {
        wrong.push(format!("{} triangles of {}", here.n_triangles(), there.n_triangles()));
    }
    if here.centre != there.centre || here.n_vertices() != 3 * here.n_triangles() {
        wrong.push(format!("centre {:?} of {:?}, {} vertices", here.centre, there.centre, here.n_vertices()));
    }
    let (a, b) = (measures(here), measures(there));
    for (what, a, b) in [("area", a.area, b.area), ("volume", volume(here), b.volume)] {
        if (a / b - 1.0).abs() > 0.015 {
            wrong.push(format!("{what} {a} of {b}"));
        }
    }
    let edges: HashSet<[i64; 3]> = here.positions.iter().map(|p| edge(p, spacing)).collect();
    let missing = there.positions.iter().filter(|p| !edges.contains(&edge(p, spacing))).count();
    if missing > 0 {
        wrong.push(format!("{missing} vertices of {} are missing", there.n_vertices()));
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

/// Returns the signed volume. [`Measures`] would treat each triangle as a component.
fn volume(mesh: &Mesh) -> f64 {
    let of = |t: &[u32; 3]| {
        let corner = mesh.positions[t[0] as usize].map(f64::from);
        let face = mesh.face_normal(*t);
        (0..3).map(|k| corner[k] * face[k]).sum::<f64>() / 6.0
    };
    mesh.triangles.iter().map(of).sum()
}

/// Returns the edge of the grid on which a vertex lies: twice the coordinates of its middle, in spacings.
#[expect(clippy::cast_possible_truncation, reason = "coordinates of a protein")]
fn edge(p: &[f32; 3], spacing: f64) -> [i64; 3] {
    p.map(|c| {
        let at = f64::from(c) / spacing;
        let on_grid = (at - at.round()).abs() < 5e-4;
        if on_grid { 2 * at.round() as i64 } else { 2 * at.floor() as i64 + 1 }
    })
}

fn cpu(spheres: &Spheres, params: &SurfaceParams) -> Mesh {
    let backend = CpuBackend::new(Some(2)).unwrap();
    backend.run(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap().mesh
}

#[test]
fn surfaces_equal_those_of_the_cpu_for_all_kernels() {
    let crambin = crambin();
    for kernel in [Kernel::Gaussian, Kernel::SoftObject, Kernel::InverseSquare] {
        let params = of(kernel, 0.5);
        let (soup, cpu) = (run(&crambin, &params).unwrap(), cpu(&crambin, &params));
        assert_eq!(difference(&soup, &cpu, 0.5), Vec::<String>::new(), "{kernel}");
        assert!(!measures(&soup).closed, "triangles that share no vertices enclose nothing");
        for n in &soup.normals {
            let length = n.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
            assert!((length - 1.0).abs() < 1e-5, "{kernel}: normal {n:?}");
        }
    }
}

#[test]
fn raw_kernel_parameters_give_the_surface_of_the_cpu() {
    let crambin = crambin();
    let raw = |kernel: Kernel, [a, b, c]: [Option<f64>; 3], iso| {
        params(&SurfaceOptions {
            surface: Some(kernel.into()),
            paper_a: a,
            paper_b: b,
            paper_c: c,
            isovalue: Some(iso),
            resolution: Some(0.6),
            ..SurfaceOptions::default()
        })
    };
    for params in [
        raw(Kernel::Gaussian, [Some(0.4), Some(3.0), None], 1.0),
        raw(Kernel::SoftObject, [Some(2.0), Some(3.0), None], 0.7),
        raw(Kernel::InverseSquare, [None, Some(5.0), Some(0.8)], 0.4),
    ] {
        let (soup, cpu) = (run(&crambin, &params).unwrap(), cpu(&crambin, &params));
        assert_eq!(difference(&soup, &cpu, 0.6), Vec::<String>::new(), "{}", params.surface);
    }
}

#[test]
fn different_surfaces_are_detected() {
    let crambin = crambin();
    let at = |isovalue| params(&SurfaceOptions { isovalue: Some(isovalue), ..SurfaceOptions::default() });
    let soup = run(&crambin, &at(1.0)).unwrap();
    let wrong = difference(&soup, &cpu(&crambin, &at(1.01)), 0.5);
    assert!(wrong.len() >= 2, "{wrong:?}");
    let mut flipped = soup.clone();
    flipped.normals.iter_mut().for_each(|n| *n = n.map(|c| -c));
    assert_eq!(difference(&flipped, &cpu(&crambin, &at(1.0)), 0.5).len(), 1);
}

#[test]
fn single_atoms_and_odd_sizes_are_meshed() {
    for (n, spacing) in [(1, 0.5), (2, 0.31), (65, 0.47)] {
        let rows: Vec<[f64; 4]> = (0..n).map(|i| [1.3 * f64::from(i), 0.1, -7.7, 1.6]).collect();
        let (spheres, params) = (spheres(&rows), of(Kernel::SoftObject, spacing));
        let wrong = difference(&run(&spheres, &params).unwrap(), &cpu(&spheres, &params), spacing);
        assert_eq!(wrong, Vec::<String>::new(), "{n}");
    }
}

#[test]
fn unsuitable_jobs_are_rejected() {
    let far = spheres(&[[0.0, 0.0, 0.0, 1.5], [900.0, 900.0, 900.0, 1.5]]);
    let rejected = run(&far, &of(Kernel::Gaussian, 0.5)).unwrap_err().to_string();
    assert!(rejected.contains("points") && rejected.contains("fits"), "{rejected}");
    // A hundred atoms at the same position.
    let heap = spheres(&[[0.0, 0.0, 0.0, 1.5]; 100]);
    let steep = params(&SurfaceOptions { smoothness: Some(20.0), ..SurfaceOptions::default() });
    let rejected = run(&heap, &steep).unwrap_err().to_string();
    assert!(rejected.contains("too dense"), "{rejected}");
}

#[test]
fn the_grid_is_laid_out_as_in_the_shaders() {
    let module = naga::front::wgsl::parse_str(SHADERS[0].1).unwrap();
    let (_, ty) = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some("Grid")).unwrap();
    let naga::TypeInner::Struct { members, span } = &ty.inner else { panic!("Grid is a struct") };
    assert_eq!(*span as usize, size_of::<GridUniform>());
    let declared: Vec<(&str, usize)> =
        members.iter().map(|member| (member.name.as_deref().unwrap(), member.offset as usize)).collect();
    macro_rules! offsets {
        ($($field:ident),+) => { vec![$((stringify!($field), offset_of!(GridUniform, $field))),+] };
    }
    let host = offsets!(
        origin, n_atoms, n, n_points, centre, spacing, scale, n_active, support, share, rate, tail_share, tail_rate,
        amplitude, u_min
    );
    assert_eq!(declared[..host.len()], host);
}
