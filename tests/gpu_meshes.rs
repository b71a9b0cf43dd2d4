//! Whole meshes of the engine against the CPU backend's, on the software device.
#![cfg(feature = "gpu")]
#![expect(clippy::unwrap_used, reason = "a test may panic")]

mod gpu_support;

use gpu_support::{KERNELS, Random, engine, engine_with, job, measures, mesh_of, params, run, sample, spheres};
use molmesh::gpu::{Executor, GpuError};
use molmesh::surface::{
    Backend, Control, CpuBackend, Mesh, Meshed, Spheres, SurfaceLimits, SurfaceOptions, SurfaceParams,
};

fn cpu(spheres: &Spheres, params: &SurfaceParams) -> Meshed {
    CpuBackend::new(Some(2)).unwrap().run(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap()
}

/// What is wrong with `mesh`, going by `expected`; bounds in Å.
fn difference(mesh: &Mesh, expected: &Mesh) -> Option<String> {
    if mesh.centre != expected.centre {
        return Some("centre".to_owned());
    }
    if mesh.triangles != expected.triangles {
        let first = mesh.triangles.iter().zip(&expected.triangles).position(|(a, b)| a != b);
        return Some(format!("{} triangles of {}, first at {first:?}", mesh.n_triangles(), expected.n_triangles()));
    }
    let furthest = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        let apart = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f32::max);
        a.iter().zip(b).map(apart).fold(0.0, f32::max)
    };
    let (n, apart) = (mesh.n_vertices(), furthest(&mesh.positions, &expected.positions));
    let turned = furthest(&mesh.normals, &expected.normals);
    (n != expected.n_vertices() || mesh.normals.len() != n || apart > 1e-4 || turned > 2e-2)
        .then(|| format!("{n} vertices of {}, {apart} Å apart, normals {turned}", expected.n_vertices()))
}

fn assert_equal(gpu: &Meshed, spheres: &Spheres, params: &SurfaceParams, what: &str) {
    let cpu = cpu(spheres, params);
    assert_eq!(difference(&gpu.mesh, &cpu.mesh), None, "{what}");
    assert_eq!(gpu.grid, cpu.grid, "{what}");
    let (a, b) = (measures(gpu), measures(&cpu));
    assert!(a.closed && a.oriented && a.manifold, "{what}: {a:?}");
    assert_eq!((a.euler, a.components.len()), (b.euler, b.components.len()), "{what}");
    assert!((a.area / b.area - 1.0).abs() < 1e-5 && (a.volume / b.volume - 1.0).abs() < 1e-5, "{what}");
    for n in &gpu.mesh.normals {
        let length = n.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
        assert!((length - 1.0).abs() < 1e-5, "{what}: normal {n:?}");
    }
}

#[test]
fn structures_are_as_on_the_cpu_with_every_kernel() {
    for name in ["4pti.pdb", "1crn.cif"] {
        let spheres = sample(name);
        for kernel in KERNELS {
            let params = params(kernel, 0.5);
            let meshed = mesh_of(&mut engine(), &spheres, &params);
            assert_equal(&meshed, &spheres, &params, &format!("{name} {kernel}"));
        }
    }
}
