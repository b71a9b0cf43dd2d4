//! Exact areas in reports and tables, and buried areas compared with `FreeSASA`.

use std::collections::HashMap;

use molmesh::pipeline::areas::MeasuredSelection;
use molmesh::pipeline::{AreaLevel, Choice, JobError, JobLimits, Product, SelectionMeasures, areas, params, run};
use molmesh::structure::{self, ReadLimits, Selection, Structure};
use molmesh::surface::{Control, CpuBackend, SurfaceLimits};

use crate::tools;

/// Two chains of DNA and peptide.
fn complex() -> (Vec<u8>, Structure) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/structures/1pfe.cif.gz");
    let bytes = std::fs::read(path).unwrap();
    let structure = structure::read(&bytes, &ReadLimits::default()).unwrap();
    (bytes, structure)
}

fn product(input: &[u8], pairs: &[(&str, &str)]) -> Result<Product, JobError> {
    let pairs = [("exact", "true"), ("resolution", "1.5")].into_iter().chain(pairs.iter().copied());
    let options = params::parse(pairs).unwrap().options;
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    run(input, &options, &JobLimits::default(), &choice, &Control::default(), &(), None)
}

/// Measures a structure without a mesh.
fn measured(structure: &Structure, pairs: &[(&str, &str)]) -> MeasuredSelection {
    let options = params::parse(pairs.iter().copied().chain([("exact", "true")])).unwrap().options;
    let (read, surface) = (ReadLimits::default(), SurfaceLimits::default());
    areas::measure_selection(structure, &options, &read, &surface, &Control::default()).unwrap()
}

/// Rows of a table, by the names of its columns.
fn rows(measured: &MeasuredSelection, structure: &Structure, level: AreaLevel) -> Vec<HashMap<String, String>> {
    let mut text = Vec::new();
    measured.areas.write_csv(structure, level, &Control::default(), &mut text).unwrap();
    let text = String::from_utf8(text).unwrap();
    let mut lines = text.lines().map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
    let names = lines.next().unwrap();
    lines.map(|fields| names.iter().cloned().zip(fields).collect()).collect()
}

fn sum(rows: &[HashMap<String, String>], column: &str) -> f64 {
    rows.iter().map(|row| row[column].parse::<f64>().unwrap()).sum()
}

#[test]
fn rows_of_all_levels_have_the_sum_of_the_report() {
    let (bytes, structure) = complex();
    let column = "area";
    for surface in ["vdw", "sas", "ses"] {
        let product = product(&bytes, &[("surface", surface)]).unwrap();
        let measured = measured(&structure, &[("surface", surface)]);
        let exact = product.report.exact.as_ref().unwrap();
        let area = exact.area;
        for level in AreaLevel::ALL {
            let rows = rows(&measured, &structure, level);
            assert!((sum(&rows, column) - area).abs() < 1e-4 * rows.len() as f64, "{surface}, {}", level.name());
            if level != AreaLevel::Atom {
                assert!((sum(&rows, "atoms") - product.report.atoms as f64).abs() < 0.5);
            }
        }
        let chains: Vec<&str> = exact.chains.iter().map(|chain| chain.chain.as_str()).collect();
        assert_eq!(chains, ["A", "B"]);
        assert!((exact.chains.iter().map(|chain| chain.area).sum::<f64>() - area).abs() < 1e-3);
        assert_eq!(exact.parts.is_some(), surface == "ses");
        if let Some(parts) = &exact.parts {
            let rows = rows(&measured, &structure, AreaLevel::Atom);
            let sums = ["contact", "toroidal", "concave"].map(|part| sum(&rows, part));
            for (of_rows, total) in sums.into_iter().zip([parts.contact, parts.toroidal, parts.concave]) {
                assert!(total > 100.0 && (of_rows - total).abs() < 1e-4 * rows.len() as f64, "{parts:?}");
            }
            assert!((sums.iter().sum::<f64>() - area).abs() < 1e-4 * rows.len() as f64);
        }
        // The mesh is coarse, but of the same surface.
        assert!((product.report.volume.unwrap() / exact.volume - 1.0).abs() < 0.05, "{surface}");
        // The first residue of the DNA.
        let first = &rows(&measured, &structure, AreaLevel::Residue)[0];
        assert_eq!((first["chain"].as_str(), first["residue_number"].as_str()), ("A", "1"));
        let atoms: Vec<_> = rows(&measured, &structure, AreaLevel::Atom)
            .into_iter()
            .filter(|row| row["chain"] == "A" && row["residue_number"] == "1")
            .collect();
        assert_eq!(atoms.len().to_string(), first["atoms"]);
        assert!((sum(&atoms, column) - first[column].parse::<f64>().unwrap()).abs() < 1e-2);
    }
}

#[test]
fn buried_areas_agree_with_freesasa() {
    let (bytes, structure) = complex();
    let selected = structure::select(&structure, &Selection::default()).unwrap();
    let spheres = selected.spheres(&structure).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let paths = ["A", "B", "AB"].map(|chains| {
        let row = |(row, &i): (usize, &u32)| {
            let ([x, y, z], r) = (spheres.centre(row), spheres.radius(row));
            chains.contains(structure.chain.get(i as usize)).then(|| format!("{x} {y} {z} {r}\n"))
        };
        let path = folder.path().join(chains);
        std::fs::write(&path, selected.atoms.iter().enumerate().filter_map(row).collect::<String>()).unwrap();
        path
    });
    let pairs = [("surface", "sas"), ("interface", "A,B")];
    let (product, measured) = (product(&bytes, &pairs).unwrap(), measured(&structure, &pairs));
    let interface = product.report.exact.as_ref().unwrap().interface.as_ref().unwrap();
    let [first, second] = &interface.sides;
    for level in AreaLevel::ALL {
        let rows = rows(&measured, &structure, level);
        assert!((sum(&rows, "buried") - first.buried - second.buried).abs() < 1e-4 * rows.len() as f64);
        assert!((sum(&rows, "alone") - first.alone - second.alone).abs() < 1e-4 * rows.len() as f64);
        assert!(rows.iter().all(|row| row["buried"].parse::<f64>().unwrap() > -1e-4));
    }
    assert!((interface.area - 0.5 * (first.buried + second.buried)).abs() < 1e-3);
    let Some(sasa) = tools::sasa(&paths) else { return };
    let [a, b, both] = [0, 1, 2].map(|k| sasa[k].area);
    println!("{interface:?} {a} {b} {both}");
    assert!((first.alone - a).abs() < 5e-4 * a && (second.alone - b).abs() < 5e-4 * b);
    let buried = a + b - both;
    assert!((2.0 * interface.area - buried).abs() < 1e-3 * both && buried > 400.0, "{interface:?} {buried}");
    assert!((2.02 * interface.area - buried).abs() > 1e-3 * both, "the control");
}

#[test]
fn areas_without_a_mesh_are_those_of_the_job() {
    let (bytes, structure) = complex();
    let pairs = [("surface", "ses"), ("assembly", "1")];
    let whole = measured(&structure, &pairs);
    let SelectionMeasures::Exact(found) = &whole.measures else { panic!("{:?}", whole.measures) };
    let expected = product(&bytes, &pairs).unwrap().report.exact.unwrap();
    assert_eq!(serde_json::to_value(found).unwrap(), serde_json::to_value(&expected).unwrap());
    let buried = [("surface", "ses"), ("interface", "A,B")];
    let of_sides = measured(&structure, &buried);
    let SelectionMeasures::Interface(found) = &of_sides.measures else { panic!("{:?}", of_sides.measures) };
    let expected = product(&bytes, &buried).unwrap().report.exact.unwrap().interface;
    assert_eq!(serde_json::to_value(found).unwrap(), serde_json::to_value(&expected).unwrap());
    assert_ne!(whole.areas, of_sides.areas);
    // Copies of a chain have rows of their own, except in the table of chains.
    let single = measured(&structure, &pairs[..1]);
    let count = |measured: &MeasuredSelection, level| rows(measured, &structure, level).len();
    assert_eq!(count(&whole, AreaLevel::Residue), 2 * count(&single, AreaLevel::Residue));
    assert_eq!(count(&whole, AreaLevel::Chain), count(&single, AreaLevel::Chain));
}

#[test]
fn an_interface_names_the_blank_chain() {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb")).unwrap();
    let chain_of = |line: &str| if line[22..26].trim().parse::<u32>().is_ok_and(|n| n < 30) { "B" } else { " " };
    let lines = text.lines().filter(|line| line.starts_with("ATOM"));
    let renamed = |line: &str| [&line[..21], chain_of(line), &line[22..]].concat();
    let named = lines.map(renamed).collect::<Vec<_>>().join("\n");
    let product = product(named.as_bytes(), &[("surface", "vdw"), ("interface", "B,_")]).unwrap();
    let exact = product.report.exact.unwrap();
    let interface = exact.interface.unwrap();
    // Both sides together are the whole.
    let together = interface.sides.iter().map(|side| side.alone - side.buried).sum::<f64>();
    assert!((together - exact.area).abs() < 1e-3 && interface.area > 30.0, "{interface:?}");
}

#[test]
fn requests_that_have_no_exact_areas_are_rejected() {
    for (pairs, name) in [
        (&[("exact", "true")][..], "exact"),
        (&[("exact", "true"), ("surface", "ses"), ("split", "chain")], "exact"),
        (&[("exact", "true"), ("surface", "ses"), ("model", "all")], "exact"),
        (&[("exact", "true"), ("surface", "ses"), ("context", "whole")], "exact"),
        (&[("surface", "ses"), ("interface", "A,B")], "interface"),
        (&[("exact", "true"), ("surface", "ses"), ("interface", "A,B,C")], "interface"),
        (&[("exact", "true"), ("surface", "ses"), ("interface", "A,")], "interface"),
        (&[("exact", "true"), ("surface", "ses"), ("interface", "A/B,B")], "interface"),
    ] {
        let error = params::parse(pairs.iter().copied()).unwrap_err().to_string();
        assert!(error.contains(&format!("`{name}`")), "{error}");
    }
    let (bytes, _) = complex();
    for (interface, more, name) in [("A,Z", &[][..], "`Z`"), ("A,B", &[("chains", "A")], "`B`"), ("A,_", &[], "`_`")] {
        let pairs = [&[("surface", "sas"), ("interface", interface)], more].concat();
        let error = product(&bytes, &pairs).unwrap_err().to_string();
        assert!(error.contains("interface") && error.contains(name), "{error}");
    }
    assert!(product(&bytes, &[("surface", "sas"), ("interface", "A,B")]).is_ok());
}
