//! Jobs with simplified meshes.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use molmesh::formats::Format;
use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{Choice, JobError, JobLimits, Product, estimate, run};
use molmesh::structure;
use molmesh::surface::{Control, CpuBackend, Limit, Measures, SurfaceError, Validation};

use crate::tools;

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
const CHAINS: &[u8] = include_bytes!("../structures/1ubq.pdb.gz");

fn meshed(file: &[u8], pairs: &[(&str, &str)]) -> Product {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(file, &options, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap()
}

fn glb(product: &Product) -> Vec<u8> {
    let mut bytes = Vec::new();
    product.file(Format::Glb).unwrap().write(&mut bytes).unwrap();
    bytes
}

#[test]
fn simplified_meshes_are_smaller_closed_and_near_the_surface() {
    for surface in ["gaussian", "ses"] {
        for extra in [
            &[][..],
            &[("compress", "quantize")],
            &[("compress", "meshopt")],
            &[("atom_ids", "true"), ("color", "element")],
            &[("split", "residue-group"), ("select", "all")],
            &[("context", "whole"), ("select", "resi 1-20")],
            &[("cavities", "drop")],
            &[("detail", "4"), ("compress", "meshopt")],
        ] {
            let pairs = [&[("surface", surface)][..], extra].concat();
            let whole = meshed(SAMPLE, &pairs);
            let product = meshed(SAMPLE, &[&pairs[..], &[("simplify", "0.1")]].concat());
            let (report, found) = (&product.report, product.report.simplification.unwrap());
            let what = format!("{pairs:?}: {found:?}");
            assert_eq!(found.triangles_before, whole.report.triangles, "{what}");
            assert!(report.triangles < whole.report.triangles * 3 / 4, "{what}: {}", report.triangles);
            assert!(found.max_deviation > 0.01 && found.max_deviation < 0.2, "{what}");
            assert!(found.mean_deviation > 0.001 && found.mean_deviation < 0.03, "{what}");
            // A compressed mesh has no columns.
            if !extra.contains(&("compress", "meshopt")) {
                let m = Measures::of(&product.mesh, Validation::Exact, &Control::default()).unwrap();
                let is_closed = m.closed && m.oriented && m.manifold;
                assert_eq!(is_closed, report.closed, "{what}");
                assert_eq!(product.mesh.n_vertices() as u64, report.vertices, "{what}");
            }
            let topology =
                |product: &Product| (product.report.closed, product.report.manifold, product.report.components);
            assert_eq!(topology(&product), topology(&whole), "{what}");
            assert!((report.area / whole.report.area - 1.0).abs() < 0.03, "{what}");
            if let (Some(volume), Some(before)) = (report.volume, whole.report.volume) {
                assert!((volume / before - 1.0).abs() < 0.01, "{what}");
            }
            assert!(glb(&product).len() < glb(&whole).len() * 9 / 10, "{what}");
        }
    }
}

#[test]
fn a_limit_on_triangles_ends_the_simplification() {
    let control = &Control::default();
    let (backend, limits) = (CpuBackend::new(Some(2)).unwrap(), JobLimits::default());
    let choice = Choice { backend: &backend, reason: "" };
    for surface in ["gaussian", "ses"] {
        for extra in
            [&[][..], &[("detail", "5")], &[("compress", "meshopt")], &[("split", "residue-group"), ("select", "all")]]
        {
            let mut deviations = Vec::new();
            for limit in ["20000", "8000"] {
                let pairs =
                    [&[("surface", surface), ("simplify", "0.7"), ("max_triangles", limit)][..], extra].concat();
                let report = meshed(SAMPLE, &pairs).report;
                let (most, found) = (limit.parse::<u64>().unwrap(), report.simplification.unwrap());
                let what = format!("{pairs:?}: {} triangles, {found:?}", report.triangles);
                assert!(report.triangles <= most && report.triangles > most * 9 / 10, "{what}");
                assert!(report.closed && report.manifold && found.max_deviation < 1.4, "{what}");
                assert_eq!((report.max_triangles, report.tries), (Some(most), None), "{what}");
                assert_eq!(report.resolution_from, if extra == [("detail", "5")] { "detail" } else { "resolution" });
                deviations.push(found.mean_deviation);
                let read = |control: &Control<'_>| structure::read_with(SAMPLE, &limits.read, control).map(Box::new);
                let options = params::parse(pairs).unwrap().options;
                let expected = estimate(read, &options, &limits, &choice, control).unwrap().mesh.unwrap();
                assert_eq!(expected.triangles, most, "{what}");
            }
            assert!(deviations[0] < deviations[1], "{surface} {extra:?}: {deviations:?}");
        }
    }
    let options = params::parse([("simplify", "0.02"), ("max_triangles", "1000")]).unwrap().options;
    match run(SAMPLE, &options, &limits, &choice, control, &(), None) {
        Err(JobError::Surface(SurfaceError::Limit(error))) => {
            assert_eq!((error.limit, error.max, error.resolution), (Limit::Triangles, 1000, Some(0.5)));
            assert!(error.actual > Some(10_000) && error.to_string().contains("an error of 0.02 Å"), "{error}");
        }
        other => panic!("{:?}", other.map(drop)),
    }
    // A limit above the number of triangles changes nothing.
    let whole = meshed(SAMPLE, &[]);
    let unchanged = meshed(SAMPLE, &[("simplify", "0.1"), ("max_triangles", "4000000")]);
    assert_eq!(unchanged.mesh.triangles, whole.mesh.triangles);
    // Distances have single precision.
    assert!(unchanged.report.simplification.unwrap().max_deviation < 2e-3);
    // Without a simplification, the limit sets the spacing.
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    assert_ne!(canonical(&[("simplify", "1")]), canonical(&[("simplify", "1"), ("max_triangles", "9000")]));
    for several in [[("resolution", "0.6"), ("max_triangles", "9000")], [("detail", "3"), ("resolution", "0.6")]] {
        let Err(ParamError::BadValue { name, .. }) = params::parse(several) else { panic!("{several:?}") };
        assert_eq!(name, several[1].0);
        let simplified = params::parse([&several[..], &[("simplify", "0.1")]].concat());
        assert_eq!(simplified.is_ok(), name == "max_triangles", "{several:?}");
    }
}

/// Answer of `mesh_distance.py`.
#[derive(serde::Deserialize)]
struct Compared {
    distance: f64,
    intersections: u64,
}

#[test]
fn stated_deviations_are_those_that_another_program_measures() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: String, product: &Product| {
        let path = folder.path().join(name);
        product.file(Format::Ply).unwrap().write(&mut std::fs::File::create(&path).unwrap()).unwrap();
        path
    };
    let (mut stated, mut pairs) = (Vec::new(), Vec::new());
    for surface in ["gaussian", "ses", "vdw"] {
        let pairs_of = |error: &'static str| [("surface", surface), ("resolution", "1"), ("simplify", error)];
        let whole = write(format!("{surface}.ply"), &meshed(SAMPLE, &pairs_of("0.1")[..2]));
        for error in ["0.1", "1"] {
            let product = meshed(SAMPLE, &pairs_of(error));
            let simplified = write(format!("{surface}-{error}.ply"), &product);
            stated.push((surface, error, product.report.simplification.unwrap()));
            pairs.push(format!("{}\t{}", whole.display(), simplified.display()));
        }
    }
    let Some(found) = tools::python::<Compared>("mesh_distance.py", &pairs) else { return };
    for ((surface, error, stated), Compared { distance, intersections }) in stated.iter().zip(&found) {
        // Points are at most 1 Å from a sample; in practice, the excess is below a tenth of that.
        let what = format!("{surface} {error}: {stated:?} stated, {distance} found");
        let most = stated.max_deviation;
        assert!(*distance > 0.9 * most && *distance < most + 0.1, "{what}");
        assert_eq!(*intersections, stated.intersections, "{what}");
    }
}

#[test]
fn parts_are_simplified_on_their_own() {
    let pairs = [("split", "residue-group"), ("select", "all"), ("resolution", "0.4")];
    let whole = meshed(CHAINS, &pairs);
    let product = meshed(CHAINS, &[&pairs[..], &[("simplify", "0.1")]].concat());
    assert!(product.report.parts.len() > 1);
    for (part, before) in product.report.parts.iter().zip(&whole.report.parts) {
        assert_eq!((&part.name, part.atoms), (&before.name, before.atoms));
        assert!(part.triangles < before.triangles && part.vertices < before.vertices, "{part:?}");
        assert!((part.area / before.area - 1.0).abs() < 0.02, "{part:?} {before:?}");
        assert!((part.volume.unwrap() / before.volume.unwrap() - 1.0).abs() < 0.02, "{part:?} {before:?}");
    }
    let mesh = &product.mesh;
    for part in &mesh.parts {
        let own = &mesh.triangles[part.triangles.clone()];
        assert!(own.iter().flatten().all(|v| part.vertices.contains(&(*v as usize))), "{}", part.name);
        assert!(part.bounds[0] < part.bounds[1]);
    }
    assert_eq!(mesh.parts.iter().map(|part| part.triangles.len()).sum::<usize>(), mesh.n_triangles());
}

#[test]
fn a_larger_error_leaves_fewer_triangles_and_the_parameter_is_part_of_the_key() {
    for surface in ["gaussian", "ses", "vdw"] {
        let triangles = ["0.01", "0.05", "0.2", "0.3", "0.5"].map(|error| {
            let report = meshed(SAMPLE, &[("surface", surface), ("simplify", error)]).report;
            report.triangles
        });
        assert!(triangles.windows(2).all(|pair| pair[1] < pair[0]), "{surface} {triangles:?}");
    }
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    assert_ne!(canonical(&[]), canonical(&[("simplify", "0.1")]));
    assert_ne!(canonical(&[("simplify", "0.2")]), canonical(&[("simplify", "0.1")]));
    for value in ["0", "-1", "11", "nan", "fine"] {
        let Err(ParamError::BadValue { name, .. }) = params::parse([("simplify", value)]) else { panic!("{value}") };
        assert_eq!(name, "simplify");
    }
    for divided in [&[("split", "pocket")][..], &[("split", "chain"), ("context", "whole")]] {
        let pairs = [&[("simplify", "0.1")], divided].concat();
        let Err(ParamError::BadValue { name, .. }) = params::parse(pairs) else { panic!("{divided:?}") };
        assert_eq!(name, "simplify");
    }
    assert!(meshed(SAMPLE, &[]).report.simplification.is_none());
}
