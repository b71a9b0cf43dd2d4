//! End-to-end tests of real structures. Every surface yields a closed, oriented manifold by the exact check and by
//! trimesh; the same bytes with 1, 2 and 7 threads; the same surface with permuted atoms; valid glTF.
//!
//! The samples always run. Structures in a folder beside the repository run too: those of up to [`EVERYDAY`] atoms on
//! every run, all of them with `MOLMESH_ALL_STRUCTURES=1`.

#![expect(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use crate::tools;

use std::path::{Path, PathBuf};

use molmesh::formats::{Format, Meta};
use molmesh::structure::{self, ReadLimits, Selection, StructureError};
use molmesh::surface::{
    Backend, Control, CpuBackend, Measures, Mesh, Spheres, SurfaceKind, SurfaceLimits, SurfaceOptions, SurfaceParams,
    Validation,
};
use tools::files::encoded;

/// Largest number of selected atoms of structures that run every time.
const EVERYDAY: usize = 5_000;
/// Largest number of triangles for trimesh, which takes 1 KiB per triangle. The exact check covers larger meshes.
const TRIMESH_LIMIT: usize = 6_000_000;

/// Files that must be rejected, with the reason.
const REFUSED: &[(&str, &str)] = &[("2ins_header_only.pdb.gz", "no atoms")];

struct Case {
    name: String,
    spheres: Spheres,
}

fn folders() -> Vec<PathBuf> {
    vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("samples"), tools::some_structures()]
}

/// Returns all available structures with atoms, smallest first. Asserts that the others are rejected as expected.
fn cases() -> Vec<Case> {
    let all = std::env::var_os("MOLMESH_ALL_STRUCTURES").is_some();
    let mut cases = Vec::new();
    for folder in folders() {
        let mut files: Vec<PathBuf> = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        for path in files {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if !["pdb", "cif", "ent", "bcif"].iter().any(|ext| name.contains(&format!(".{ext}"))) {
                continue;
            }
            let selected = structure::read(&std::fs::read(&path).unwrap(), &ReadLimits::default())
                .and_then(|s| structure::select(&s, &Selection::default()).map(|selected| (s, selected)));
            match (selected, REFUSED.iter().find(|(file, _)| *file == name)) {
                (Ok((structure, selected)), None) => {
                    if all || selected.atoms.len() <= EVERYDAY {
                        cases.push(Case { name, spheres: selected.spheres(&structure).unwrap() });
                    }
                }
                (Err(error), Some((_, reason))) => assert!(error.to_string().contains(reason), "{name}: {error}"),
                (Err(StructureError::EmptySelection { .. }), None) if name.starts_with("odd_") => {}
                (outcome, expected) => panic!(
                    "{name}: {:?}, expected refusal {expected:?}",
                    outcome.map(|_| "read").map_err(|e| e.to_string())
                ),
            }
        }
    }
    cases.sort_by_key(|case| case.spheres.len());
    assert!(cases.len() >= 2, "the samples are missing");
    cases
}

fn mesh(spheres: &Spheres, surface: SurfaceKind, resolution: f64, threads: usize) -> Mesh {
    let options = SurfaceOptions { surface: Some(surface), resolution: Some(resolution), ..SurfaceOptions::default() };
    let params = SurfaceParams::new(&options).unwrap();
    let backend = CpuBackend::new(Some(threads)).unwrap();
    backend.run(spheres, &params, &SurfaceLimits::default(), &Control::default()).unwrap().mesh
}

fn permuted(spheres: &Spheres) -> Spheres {
    let n = spheres.len();
    // A stride that shares no factor with n visits every atom.
    let stride = (n / 2 + 1..2 * n + 2).find(|s| gcd(*s, n) == 1).unwrap();
    let order: Vec<usize> = (0..n).map(|i| (i * stride + n / 3) % n).collect();
    let column = |k: usize| order.iter().map(|&i| spheres.centre(i)[k]).collect();
    Spheres::new(column(0), column(1), column(2), order.iter().map(|&i| spheres.radius(i)).collect()).unwrap()
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[test]
fn every_structure_and_surface_gives_a_closed_oriented_manifold() {
    let dir = tempfile::tempdir().unwrap();
    for case in cases() {
        let mut files = Vec::new();
        for surface in SurfaceKind::ALL {
            for resolution in [1.0, 0.5] {
                let what = format!("{} {surface} {resolution}", case.name);
                let mesh = mesh(&case.spheres, surface, resolution, 2);
                let exact = Measures::of(&mesh, Validation::Exact, &Control::default()).unwrap();
                let quick = Measures::of(&mesh, Validation::Checksum, &Control::default()).unwrap();
                assert!(exact.closed && exact.oriented && exact.manifold, "{what}: {exact:?}");
                assert!(quick.closed && quick.manifold && quick.euler == exact.euler, "{what}: {quick:?}");
                assert!(exact.volume > 0.0 && exact.area > 0.0, "{what}");
                for n in &mesh.normals {
                    let length = n.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
                    assert!((length - 1.0).abs() < 1e-5, "{what}: {n:?}");
                }
                assert!(outward(&mesh) > 0.98, "{what}: {} of normals agree with their faces", outward(&mesh));
                if mesh.n_triangles() > TRIMESH_LIMIT {
                    eprintln!("SKIPPED: trimesh on {what}: {} triangles", mesh.n_triangles());
                    continue;
                }
                // trimesh takes most of the time, so it checks the fine meshes of two surfaces only.
                if resolution < 1.0 && ![SurfaceKind::Gaussian, SurfaceKind::Ses].contains(&surface) {
                    continue;
                }
                let path = dir.path().join(format!("{}-{surface}-{resolution}.ply", case.name));
                std::fs::write(&path, encoded(Format::Ply, &mesh, &Meta::default())).unwrap();
                files.push((path, exact));
            }
        }
        let paths: Vec<&PathBuf> = files.iter().map(|(path, _)| path).collect();
        for (report, (path, ours)) in tools::trimesh(&paths).into_iter().flatten().zip(&files) {
            let what = path.display();
            assert_eq!(report.error, None, "{what}");
            assert!(report.watertight && report.winding_consistent && report.is_volume, "{what}: {report:#?}");
            assert_eq!((report.bad_edges, report.nan_count, report.unused_vertices), (0, 0, 0), "{what}: {report:#?}");
            assert_eq!(report.euler, ours.euler, "{what}");
            assert_eq!(report.bodies, ours.components.len() as u64, "{what}");
            assert!((report.area / ours.area - 1.0).abs() < 1e-4, "{what}: {} {}", report.area, ours.area);
            assert!((report.volume / ours.volume - 1.0).abs() < 1e-4, "{what}: {} {}", report.volume, ours.volume);
        }
        for (path, _) in files {
            std::fs::remove_file(path).unwrap();
        }
    }
}

/// Returns the fraction of vertices whose normal points to the same side as the area-weighted mean of their faces.
fn outward(mesh: &Mesh) -> f64 {
    let mut mean = vec![[0.0_f64; 3]; mesh.n_vertices()];
    for t in &mesh.triangles {
        let n = mesh.face_normal(*t);
        for v in t {
            (0..3).for_each(|k| mean[*v as usize][k] += n[k]);
        }
    }
    let agrees = |(n, m): (&[f32; 3], &[f64; 3])| (0..3).map(|k| f64::from(n[k]) * m[k]).sum::<f64>() > 0.0;
    mesh.normals.iter().zip(&mean).filter(|&pair| agrees(pair)).count() as f64 / mesh.n_vertices() as f64
}

#[test]
fn the_same_bytes_with_1_2_and_7_threads_and_the_same_surface_permuted() {
    for case in cases() {
        for surface in SurfaceKind::ALL {
            let one = mesh(&case.spheres, surface, 1.0, 1);
            for threads in [2, 7] {
                assert!(one == mesh(&case.spheres, surface, 1.0, threads), "{} {surface} {threads} threads", case.name);
            }
            let other = mesh(&permuted(&case.spheres), surface, 1.0, 2);
            assert!(one.triangles == other.triangles, "{} {surface}: topology", case.name);
            let furthest = one
                .positions
                .iter()
                .zip(&other.positions)
                .flat_map(|(p, q)| (0..3).map(|k| (p[k] - q[k]).abs()))
                .fold(0.0, f32::max);
            assert!(furthest <= 1e-4, "{} {surface}: {furthest} Å", case.name);
        }
    }
}

#[test]
fn every_structure_gives_valid_gltf() {
    let dir = tempfile::tempdir().unwrap();
    let mut paths = Vec::new();
    for case in cases() {
        for format in [Format::Glb, Format::Gltf] {
            let mesh = mesh(&case.spheres, SurfaceKind::Gaussian, 1.0, 2);
            let path = dir.path().join(format!("{}.{}", case.name, format.name()));
            std::fs::write(&path, encoded(format, &mesh, &Meta::default())).unwrap();
            paths.push(path);
        }
    }
    for report in tools::gltf_validate(&paths).into_iter().flatten() {
        report.assert_clean();
    }
}
