//! Cavities in the report, and meshes without or of their walls.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::f64::consts::PI;
use std::fmt::Write;

use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{CavityReport, Choice, JobError, JobLimits, Product, run};
use molmesh::surface::{Control, CpuBackend, Measures, SurfaceError, Validation};

use crate::tools;

/// Returns a PDB file of carbon atoms: a hollow ball of radius 7 Å, whose cavity holds a sphere of about 5.3 Å. Atoms
/// above `z` are missing. A residue has ten atoms.
fn hollow(z: f64) -> String {
    let n = 130;
    let mut text = String::new();
    for i in 0..n {
        let at = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(n);
        let (sin, cos) = (f64::from(i) * PI * (3.0 - 5.0_f64.sqrt())).sin_cos();
        let r = 7.0 * (1.0 - at * at).sqrt();
        if 7.0 * at < z {
            let residue = i / 10 + 1;
            writeln!(
                text,
                "ATOM  {:5}  CA  ALA A{residue:4}    {:8.3}{:8.3}{:8.3}  1.00  0.00           C",
                i + 1,
                r * cos + 20.0,
                r * sin,
                7.0 * at
            )
            .unwrap();
        }
    }
    text + "END\n"
}

fn meshed_with(file: impl AsRef<[u8]>, pairs: &[(&str, &str)]) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(file.as_ref(), &options, &JobLimits::default(), &choice, &Control::default(), &(), None)
}

fn meshed(file: impl AsRef<[u8]>, pairs: &[(&str, &str)]) -> Product {
    meshed_with(file, pairs).unwrap()
}

fn list(product: &Product) -> &[CavityReport] {
    product.report.cavity_list.as_deref().unwrap()
}

#[test]
fn cavities_depend_on_neither_the_spacing_nor_the_surface() {
    let text = hollow(9.0);
    let expected = meshed(&text, &[("cavities", "keep"), ("surface", "ses"), ("resolution", "0.4")]);
    let [cavity] = list(&expected) else { panic!("{:?}", list(&expected)) };
    assert_eq!(expected.report.cavities, Some(1));
    assert!((cavity.radius - 5.3).abs() < 0.1 && (cavity.center[0] - 20.0).abs() < 0.3, "{cavity:?}");
    let numbers: Vec<i32> = cavity.residues.iter().map(|residue| residue.number).collect();
    assert_eq!(numbers, (1..=13).collect::<Vec<_>>());
    assert!(cavity.residues.iter().all(|residue| residue.chain == "A" && residue.name == "ALA"));
    let json = serde_json::to_value(list(&expected)).unwrap();
    for surface in ["gaussian", "vdw", "sas", "ses"] {
        for resolution in ["0.7", "1"] {
            let product = meshed(&text, &[("cavities", "keep"), ("surface", surface), ("resolution", resolution)]);
            assert_eq!(serde_json::to_value(list(&product)).unwrap(), json, "{surface} {resolution}");
        }
    }
    // The mesh of the solvent-accessible surface has the same cavity, up to the error of a mesh with creases.
    let void = &meshed(&text, &[("surface", "sas"), ("resolution", "0.4")]).report.void_list[0];
    assert!((void.volume / cavity.accessible_volume - 1.0).abs() < 0.01, "{void:?} {cavity:?}");
    assert!((void.area / cavity.accessible_area - 1.0).abs() < 0.05, "{void:?} {cavity:?}");
    // The mesh of the solvent-excluded surface encloses the region that the probe covers.
    let void = &expected.report.void_list[0];
    assert!((void.volume / cavity.volume - 1.0).abs() < 0.003, "{void:?} {cavity:?}");
    assert!((void.area / cavity.area - 1.0).abs() < 0.01, "{void:?} {cavity:?}");
    // Without the parameter, nothing is searched. A wider opening is the control.
    assert_eq!(meshed(&text, &[]).report.cavities, None);
    assert_eq!(meshed(hollow(3.0), &[("cavities", "keep")]).report.cavities, Some(0));
}

#[test]
fn walls_of_cavities_are_removed_or_kept_alone() {
    let text = hollow(9.0);
    for surface in ["gaussian", "vdw", "ses"] {
        for extra in [&[][..], &[("compress", "quantize")], &[("atom_ids", "true"), ("color", "element")]] {
            let meshed = |mode: &str| {
                let pairs = [&[("surface", surface), ("resolution", "0.5"), ("cavities", mode)], extra].concat();
                let product = meshed(&text, &pairs);
                let m = Measures::of(&product.mesh, Validation::Exact, &Control::default()).unwrap();
                assert!(m.closed && m.oriented && m.manifold, "{surface} {mode}");
                assert_eq!(product.report.vertices, product.mesh.n_vertices() as u64);
                let same = |found: f64, expected: f64| (found / expected - 1.0).abs() < 1e-6;
                assert!(same(product.report.area, m.area) && same(product.report.volume.unwrap(), m.volume));
                for column in
                    [product.mesh.atom_ids.as_ref().map(|c| c.len()), product.mesh.colors.as_ref().map(|c| c.len())]
                {
                    assert!(column.is_none_or(|len| len == product.mesh.n_vertices()));
                }
                (product, m)
            };
            let ((keep, whole), (drop, outer), (_, inner)) = (meshed("keep"), meshed("drop"), meshed("only"));
            assert_eq!((keep.report.voids, drop.report.voids), (1, 0), "{surface}");
            assert_eq!(inner.components.len(), 1);
            assert!(inner.volume < -500.0 && outer.volume > whole.volume);
            assert!((outer.area + inner.area - whole.area).abs() < 1e-6 * whole.area, "{surface}");
            assert!((outer.volume + inner.volume - whole.volume).abs() < 1e-6 * whole.volume, "{surface}");
        }
    }
    let open = hollow(3.0);
    assert_eq!(meshed(&open, &[("cavities", "drop")]).mesh, meshed(&open, &[]).mesh);
    let nothing = meshed_with(&open, &[("cavities", "only"), ("surface", "ses")]).map(drop);
    assert_eq!(nothing, Err(JobError::Surface(SurfaceError::NoCavity { probe: 1.4, cavities: 0 })));
}

#[test]
fn cavities_of_divided_surfaces_are_rejected() {
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    let all = [&[][..], &[("cavities", "keep")], &[("cavities", "drop")], &[("cavities", "only")]].map(canonical);
    assert!((0..4).all(|i| (0..i).all(|j| all[i] != all[j])), "{all:?}");
    let others = [("split", "chain"), ("context", "whole"), ("model", "all"), ("instances", "true"), ("exact", "true")];
    for (name, value) in others {
        let pairs = |mode| {
            let assembly = if name == "instances" { "1" } else { "asymmetric-unit" };
            [("cavities", mode), (name, value), ("assembly", assembly), ("surface", "ses")]
        };
        let Err(ParamError::BadValue { name: named, .. }) = params::parse(pairs("drop")) else { panic!("{name}") };
        assert_eq!(named, "cavities");
        // The search alone leaves the surface as it is, so that exact measures describe the mesh.
        assert_eq!(params::parse(pairs("keep")).is_ok(), name == "exact");
    }
    let wrong = params::parse([("cavities", "all")]).unwrap_err().to_string();
    assert!(["`all`", "keep", "drop", "only"].iter().all(|word| wrong.contains(word)), "{wrong}");
}

#[test]
fn a_cavity_without_a_closed_wall_in_the_mesh_is_named() {
    let sample = include_bytes!("../../samples/4pti.pdb");
    let with = |mode: &str, resolution: &str| {
        meshed_with(sample, &[("surface", "ses"), ("resolution", resolution), ("cavities", mode)])
    };
    // The wall has a thin place, which is open at 0.5 Å.
    for (resolution, closed) in [("0.5", false), ("0.4", true)] {
        let [keep, drop] = ["keep", "drop"].map(|mode| with(mode, resolution).unwrap());
        assert_eq!((keep.report.voids, drop.report.voids), (u64::from(closed), 0), "{resolution}");
        assert_eq!(list(&keep).iter().map(|cavity| cavity.enclosed).collect::<Vec<_>>(), [None]);
        assert_eq!(list(&drop).iter().map(|cavity| cavity.enclosed).collect::<Vec<_>>(), [Some(closed)]);
        assert_eq!(keep.mesh != drop.mesh, closed);
        let only = with("only", resolution).map(|product| product.report.voids);
        let missing = JobError::Surface(SurfaceError::NoCavity { probe: 1.4, cavities: 1 });
        assert_eq!(only, if closed { Ok(1) } else { Err(missing) });
    }
}

/// Compares with the exact solvent-accessible areas of the inner components that MSMS 2.6.1 finds in the same atoms.
#[test]
fn cavities_are_those_of_msms() {
    let areas_with = |bytes: &[u8], probe: &str| {
        let found = meshed(bytes, &[("cavities", "keep"), ("surface", "sas"), ("probe", probe), ("resolution", "1")]);
        let mut areas: Vec<f64> = list(&found).iter().map(|cavity| cavity.accessible_area).collect();
        areas.sort_by(|a, b| b.total_cmp(a));
        areas
    };
    let areas = |bytes: &[u8]| areas_with(bytes, "1.4");
    let same = |found: &[f64], expected: &[f64]| {
        found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 2e-3)
    };
    let sample = include_bytes!("../../samples/4pti.pdb");
    assert!(same(&areas(sample), &[15.399]), "{:?}", areas(sample));
    // Another probe is the control.
    assert!(!same(&areas_with(sample, "1.401"), &[15.399]));
    let Some(path) = tools::some_structure("1a0q.pdb.gz") else { return };
    // MSMS finds one of those below 0.1 Å².
    let found: Vec<f64> = areas(&std::fs::read(path).unwrap()).into_iter().filter(|area| *area > 0.1).collect();
    let expected = [
        25.072, 10.377, 8.669, 7.955, 4.381, 3.286, 3.149, 2.6, 2.52, 1.743, 1.015, 1.001, 0.828, 0.791, 0.57, 0.538,
        0.48, 0.382, 0.326, 0.271, 0.141, 0.14,
    ];
    assert!(same(&found, &expected), "{found:?}");
}
