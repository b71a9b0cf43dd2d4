//! Jobs with simplified meshes.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use molmesh::formats::Format;
use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{Choice, JobLimits, Product, run};
use molmesh::surface::{Control, CpuBackend, Measures, Validation};

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
const CHAINS: &[u8] = include_bytes!("../structures/1ubq.pdb.gz");

fn meshed(file: &[u8], pairs: &[(&str, &str)]) -> Product {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let job = params::parse(pairs.iter().copied()).unwrap().job;
    run(file, &job, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap()
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
            &[("max_triangles", "20000")],
            &[("max_triangles", "20000"), ("compress", "meshopt")],
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
    let triangles = ["0.01", "0.05", "0.2", "0.5"].map(|error| meshed(SAMPLE, &[("simplify", error)]).report.triangles);
    assert!(triangles.windows(2).all(|pair| pair[1] < pair[0]), "{triangles:?}");
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().job);
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
