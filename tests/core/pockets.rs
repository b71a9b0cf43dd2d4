//! Pockets in the report, and colours of the vertices that line them.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{Choice, JobError, JobLimits, PocketReport, Product, run};
use molmesh::structure::ReadLimits;
use molmesh::surface::{Control, CpuBackend, Limit, SurfaceLimits};

use crate::tools;

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
const UBIQUITIN: &[u8] = include_bytes!("../structures/1ubq.pdb.gz");

fn meshed_with(file: &[u8], pairs: &[(&str, &str)], limits: &JobLimits) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let pairs = [&[("resolution", "1")], pairs].concat();
    let options = params::parse(pairs).unwrap().options;
    run(file, &options, limits, &choice, &Control::default(), &(), None)
}

fn meshed(file: &[u8], pairs: &[(&str, &str)]) -> Product {
    meshed_with(file, pairs, &JobLimits::default()).unwrap()
}

fn list(product: &Product) -> &[PocketReport] {
    product.report.pocket_list.as_deref().unwrap()
}

/// Compares with pyKVFinder 0.9.6 with the same radii on the same grid: `benches/peers/kvfinder_peer.py`.
#[test]
fn pockets_are_those_of_kvfinder() {
    type Reference = (&'static [f64], &'static [u32]);
    let same = |file: &[u8], (volumes, openings): Reference, pairs: &[(&str, &str)]| {
        let product = meshed(file, &[&[("pockets", "true")], pairs].concat());
        let found = list(&product);
        product.report.pockets == Some(volumes.len() as u64)
            && found.iter().zip(volumes).all(|(pocket, volume)| (pocket.volume / volume - 1.0).abs() < 0.05)
            && found.iter().zip(openings).all(|(pocket, openings)| pocket.openings == *openings)
    };
    let ubiquitin: Reference = (&[18.58, 7.13], &[1, 1]);
    assert!(same(SAMPLE, (&[42.12, 7.78], &[0, 1]), &[]));
    assert!(same(UBIQUITIN, ubiquitin, &[]));
    // Another large probe is the control.
    assert!(!same(UBIQUITIN, ubiquitin, &[("pocket_probe", "4.2")]));
    let Some(path) = tools::some_structure("1a0q.pdb.gz") else { return };
    let volumes = &[
        321.84, 178.63, 82.30, 58.97, 52.92, 33.48, 29.38, 27.65, 25.27, 21.17, 20.30, 19.44, 17.50, 16.85, 16.85,
        14.04, 13.18, 12.96, 12.96, 12.53, 12.31, 12.31, 12.31, 12.10, 10.80,
    ];
    assert!(same(&std::fs::read(path).unwrap(), (volumes, &[1, 2, 1, 1, 1, 1, 0]), &[]));
}

#[test]
fn pockets_depend_on_neither_the_mesh_nor_its_surface() {
    let json = |pairs: &[(&str, &str)]| {
        let product = meshed(UBIQUITIN, &[&[("pockets", "true")], pairs].concat());
        serde_json::to_value(list(&product)).unwrap()
    };
    let expected = json(&[]);
    for surface in ["vdw", "sas", "ses"] {
        assert_eq!(json(&[("surface", surface)]), expected, "{surface}");
    }
    assert_ne!(json(&[("surface", "ses"), ("probe", "1.2")]), expected);
    assert_ne!(json(&[("radius_scale", "0.9")]), expected);
    // Without the parameter, nothing is searched.
    let plain = meshed(UBIQUITIN, &[]).report;
    assert!(plain.pockets.is_none() && plain.pocket_list.is_none());
    // The list is too long for mesh files.
    let extras = meshed(UBIQUITIN, &[("pockets", "true")]).report.extras();
    assert!(extras.contains_key("pockets") && !extras.contains_key("pocket_list"));
}

#[test]
fn residues_line_a_pocket() {
    let product = meshed(UBIQUITIN, &[("pockets", "true"), ("atom_ids", "true"), ("color", "pocket")]);
    let pocket = &list(&product)[0];
    assert!(pocket.atoms >= pocket.residues.len() as u64 && pocket.residues.len() >= 5, "{pocket:?}");
    assert!(pocket.residues.windows(2).all(|pair| pair[0] < pair[1]));
    assert!(pocket.residues.iter().all(|residue| residue.chain == "A" && (1..=76).contains(&residue.number)));
    assert!(pocket.depth > 2.0 && pocket.area > 20.0 && pocket.area < 60.0, "{pocket:?}");
}

#[test]
fn vertices_at_a_pocket_have_its_colour() {
    const GREY: [u8; 4] = [0xb0, 0xb0, 0xb0, 0xff];
    for surface in ["gaussian", "ses"] {
        let product = meshed(UBIQUITIN, &[("color", "pocket"), ("surface", surface)]);
        // The scheme implies the search.
        assert_eq!(product.report.pockets, Some(2));
        let color = product.report.color.as_ref().unwrap();
        let labels: Vec<&str> = color.legend.iter().map(|entry| entry.label.as_str()).collect();
        assert_eq!((color.scheme.as_str(), labels), ("pocket", vec!["1", "2"]));
        let mesh = &product.mesh;
        for (pocket, entry) in list(&product).iter().zip(&color.legend) {
            let rgb = u32::from_str_radix(&entry.color[1..], 16).unwrap().to_be_bytes();
            let colored = mesh.colors.as_ref().unwrap().iter().enumerate().filter(|(_, c)| c[..3] == rgb[1..]);
            let places: Vec<f64> = colored
                .map(|(i, _)| {
                    let p = mesh.position(i);
                    let at = |k: usize| mesh.centre[k] + f64::from(p[k]) - pocket.center[k];
                    (at(0).powi(2) + at(1).powi(2) + at(2).powi(2)).sqrt()
                })
                .collect();
            assert!(places.len() > 3 && places.iter().all(|d| *d < 8.0), "{surface} {places:?}");
        }
        let grey = mesh.colors.as_ref().unwrap().iter().filter(|color| **color == GREY).count();
        assert!(grey > mesh.n_vertices() * 8 / 10, "{grey} of {}", mesh.n_vertices());
        let plain = meshed(UBIQUITIN, &[("surface", surface)]).mesh;
        assert_eq!((&plain.positions, &plain.triangles), (&mesh.positions, &mesh.triangles));
    }
}

/// Returns true if the colours differ.
fn is_corner([a, b, c]: [[u8; 4]; 3]) -> bool {
    a != b && b != c && c != a
}

#[test]
fn pockets_are_parts_of_one_surface() {
    for surface in ["gaussian", "ses"] {
        let extra = [("surface", surface), ("compress", "quantize")];
        for extra in [&extra[..1], &extra] {
            let pairs = |more: &[(&'static str, &'static str)]| [more, extra].concat();
            let product = meshed(UBIQUITIN, &pairs(&[("split", "pocket"), ("color", "pocket")]));
            let whole = meshed(UBIQUITIN, &pairs(&[("color", "pocket")]));
            let (report, parts) = (&product.report, &product.report.parts);
            let names: Vec<&str> = parts.iter().map(|part| part.name.as_str()).collect();
            assert_eq!(names, ["pocket 1", "pocket 2", "other"]);
            assert_eq!((report.triangles, report.closed), (whole.report.triangles, true));
            assert!((report.area / whole.report.area - 1.0).abs() < 1e-6);
            assert!((parts.iter().map(|part| part.area).sum::<f64>() / report.area - 1.0).abs() < 1e-6);
            assert!(parts.iter().all(|part| part.volume.is_none() && part.triangles > 10));
            for (part, pocket) in parts.iter().zip(list(&product)) {
                assert_eq!(part.atoms, pocket.atoms);
            }
            // Two vertices of a triangle have the colour of its pocket, or one of three where two pockets meet.
            let mesh = &product.mesh;
            let colors = mesh.colors.as_ref().unwrap();
            for (range, entry) in mesh.parts.iter().zip(&report.color.as_ref().unwrap().legend) {
                let rgb = u32::from_str_radix(&entry.color[1..], 16).unwrap().to_be_bytes();
                for triangle in &mesh.triangles[range.triangles.clone()] {
                    let n = triangle.iter().filter(|v| colors[**v as usize][..3] == rgb[1..]).count();
                    let shown = triangle.map(|v| colors[v as usize]);
                    assert!(n >= 2 || n == 1 && is_corner(shown), "{surface}, {}: {shown:?}, {rgb:?}", range.name);
                }
            }
        }
    }
    let limits = JobLimits { read: ReadLimits { max_parts: 2, ..ReadLimits::default() }, ..JobLimits::default() };
    let error = meshed_with(UBIQUITIN, &[("split", "pocket")], &limits).unwrap_err();
    assert!(error.to_string().contains("split=pocket"), "{error}");
}

#[test]
fn parameters_of_pockets_are_checked() {
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    let all = [
        &[][..],
        &[("pockets", "true")],
        &[("pockets", "true"), ("pocket_probe", "5")],
        &[("color", "pocket")],
        &[("split", "pocket")],
    ]
    .map(canonical);
    assert!((0..5).all(|i| (0..i).all(|j| all[i] != all[j])), "{all:?}");
    assert_eq!(canonical(&[("pockets", "true"), ("pocket_probe", "4.0")]), all[1]);
    let refused = |pairs: &[(&str, &str)]| params::parse(pairs.iter().copied()).map(drop).unwrap_err();
    for (pairs, name) in [
        (&[("pocket_probe", "5")][..], "pocket_probe"),
        (&[("pockets", "true"), ("pocket_probe", "0.5")], "pocket_probe"),
        (&[("pockets", "true"), ("pocket_probe", "21")], "pocket_probe"),
        (&[("pockets", "true"), ("surface", "ses"), ("probe", "4")], "pocket_probe"),
        (&[("pockets", "yes")], "pockets"),
        (&[("pockets", "true"), ("split", "chain")], "pockets"),
        (&[("pockets", "true"), ("model", "all")], "pockets"),
        (&[("pockets", "true"), ("context", "whole")], "pockets"),
        (&[("pockets", "true"), ("instances", "true"), ("assembly", "1")], "pockets"),
        (&[("color", "pocket"), ("split", "chain")], "color"),
        (&[("split", "pocket"), ("context", "whole")], "split"),
        (&[("split", "pocket"), ("model", "all")], "split"),
        (&[("split", "pocket"), ("cavities", "drop")], "cavities"),
        (&[("color", "pocket"), ("palette", "cividis")], "palette"),
    ] {
        let ParamError::BadValue { name: named, .. } = refused(pairs) else { panic!("{pairs:?}") };
        assert_eq!(named, name, "{pairs:?}");
    }
}

#[test]
fn a_large_grid_is_rejected_with_the_limit() {
    let surface = SurfaceLimits { max_grid_points: 300_000, ..SurfaceLimits::default() };
    let limits = JobLimits { surface, ..JobLimits::default() };
    assert!(meshed_with(UBIQUITIN, &[], &limits).is_ok());
    let error = meshed_with(UBIQUITIN, &[("pockets", "true")], &limits).map(drop).unwrap_err();
    assert!(matches!(&error, JobError::Surface(error) if error.exceeded(Limit::PocketPoints).is_some()), "{error}");
    assert!(error.to_string().contains("the limit is 300000"), "{error}");
}
