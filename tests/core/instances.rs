//! Instances of the units of an assembly: placements, rejected requests, sums and other readers.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::num::NonZeroU32;

use molmesh::formats::{Encoder, Format, FormatError};
use molmesh::pipeline::params;
use molmesh::pipeline::{Choice, JobError, JobLimits, Product, run};
use molmesh::structure::{ReadLimits, Selection, read, select};
use molmesh::surface::{Control, CpuBackend, Limit, SurfaceError};
use serde_json::Value;

use crate::split::dimer;
use crate::tools;
use crate::tools::files::Files;
use crate::tools::readers::{accessor_of, accessor_offset, split_glb, split_gltf, u32_at};

/// Operators: rows of matrix and translation. The second is a third of a turn.
pub(crate) const OPERATORS: [[f64; 12]; 3] = [
    [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    [-0.5, -0.866025, 0.0, 60.125, 0.866025, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0, 7.0],
    [0.0, 0.0, 1.0, -55.5, 1.0, 0.0, 0.0, 10.0, 0.0, 1.0, 0.0, 300.0],
];
const REFLECTION: [f64; 12] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0];

/// Returns a dimer with an assembly of these rules: chains, and numbers of operators.
pub(crate) fn with_rules(rules: &[(&str, &[[f64; 12]])]) -> String {
    let mut text = format!("{:<80}\n", "REMARK 350 BIOMOLECULE: 1");
    let mut serial = 0;
    for (chains, operators) in rules {
        text += &format!("{:<80}\n", format!("REMARK 350 APPLY THE FOLLOWING TO CHAINS: {chains}"));
        for m in *operators {
            serial += 1;
            for (k, row) in m.chunks(4).enumerate() {
                let line = format!(
                    "REMARK 350   BIOMT{} {serial:>3}{:>10.6}{:>10.6}{:>10.6}{:>15.5}",
                    k + 1,
                    row[0],
                    row[1],
                    row[2],
                    row[3]
                );
                text += &format!("{line:<80}\n");
            }
        }
    }
    text + &dimer()
}

fn meshed_with(text: &str, pairs: &[(&str, &str)], limits: &JobLimits) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let own = [("assembly", "1"), ("resolution", "1.2"), ("instances", "true")];
    let options = params::parse(own.iter().chain(pairs).copied()).unwrap().options;
    run(text.as_bytes(), &options, limits, &choice, &Control::default(), &(), None)
}

fn meshed(text: &str, pairs: &[(&str, &str)]) -> Product {
    meshed_with(text, pairs, &JobLimits::default()).unwrap()
}

fn encode(format: Format, product: &Product) -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder =
        Encoder::with_bounds(format, product.storage, &product.mesh, product.bounds, &product.meta()).unwrap();
    encoder.write(&mut bytes).unwrap();
    assert_eq!(encoder.encoded_len(), Some(bytes.len() as u64));
    bytes
}

/// Instance of a part in a file: name, and first positions after all transforms, in the units of the file.
struct Placed {
    name: String,
    positions: Vec<[f64; 3]>,
}

/// Returns all instances of a document, by the formula of the extension: node, then instance, then vertex.
fn instances(json: &Value, bin: &[u8]) -> Vec<Placed> {
    assert_eq!(json["extensionsUsed"], json["extensionsRequired"]);
    let names: Vec<&str> =
        json["extensionsUsed"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    assert!(names.contains(&"EXT_mesh_gpu_instancing"));
    let root = &json["nodes"][0];
    let number = |value: &Value| value.as_f64().unwrap();
    let translation: [f64; 3] = std::array::from_fn(|k| number(&root["translation"][k]));
    let scale = root.get("scale").map_or(1.0, |scale| number(&scale[0]));
    let floats = |accessor: &Value, n: usize| -> Vec<Vec<f64>> {
        let facts = accessor_of(json, accessor);
        assert_eq!(
            (facts["componentType"].as_u64(), facts["type"].as_str()),
            (Some(5126), Some(if n == 3 { "VEC3" } else { "VEC4" }))
        );
        let first = accessor_offset(json, accessor);
        assert_eq!(first % 4, 0);
        let row = |i: usize| (0..n).map(|k| f64::from(f32::from_bits(u32_at(bin, first + 4 * (n * i + k))))).collect();
        (0..facts["count"].as_u64().unwrap() as usize).map(row).collect()
    };
    let mut all = Vec::new();
    for child in root["children"].as_array().unwrap() {
        let node = &json["nodes"][child.as_u64().unwrap() as usize];
        let primitive = &json["meshes"][node["mesh"].as_u64().unwrap() as usize]["primitives"][0];
        let attributes = &node["extensions"]["EXT_mesh_gpu_instancing"]["attributes"];
        let [translations, rotations] =
            [("TRANSLATION", 3), ("ROTATION", 4)].map(|(name, n)| floats(&attributes[name], n));
        assert_eq!(translations.len(), rotations.len());
        let position = &primitive["attributes"]["POSITION"];
        let first = accessor_offset(json, position);
        let quantized = accessor_of(json, position)["componentType"] == 5122;
        let vertex = |i: usize| -> [f64; 3] {
            std::array::from_fn(|k| {
                if quantized {
                    let at = first + 8 * i + 2 * k;
                    f64::from(i16::from_le_bytes([bin[at], bin[at + 1]]))
                } else {
                    f64::from(f32::from_bits(u32_at(bin, first + 12 * i + 4 * k)))
                }
            })
        };
        for (t, q) in translations.iter().zip(&rotations) {
            let norm: f64 = q.iter().map(|v| v * v).sum();
            assert!((norm - 1.0).abs() < 1e-6);
            let (v, w) = ([q[0], q[1], q[2]], q[3]);
            let cross = |a: [f64; 3], b: [f64; 3]| {
                [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
            };
            let placed = |p: [f64; 3]| -> [f64; 3] {
                // p + 2w(v × p) + 2 v × (v × p)
                let once = cross(v, p);
                let twice = cross(v, once);
                std::array::from_fn(|k| translation[k] + scale * (t[k] + p[k] + 2.0 * w * once[k] + 2.0 * twice[k]))
            };
            let count = accessor_of(json, position)["count"].as_u64().unwrap() as usize;
            let positions = (0..count).step_by(97).map(|i| placed(vertex(i))).collect();
            all.push(Placed { name: node["name"].as_str().unwrap().to_owned(), positions });
        }
    }
    all
}

fn distance(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).flat_map(|(a, b)| (0..3).map(|k| (a[k] - b[k]).abs())).fold(0.0, f64::max)
}

#[test]
fn every_instance_is_the_units_mesh_moved_by_its_operator() {
    let text = with_rules(&[("A, B", &OPERATORS)]);
    for (pairs, unit, tolerance) in [
        (&[][..], 1.0, 1e-4),
        (&[("compress", "quantize")], 1.0, 3e-3),
        (&[("units", "nanometer"), ("color", "chain"), ("atom_ids", "true")], 0.1, 1e-4),
    ] {
        let product = meshed(&text, pairs);
        let mesh = &product.mesh;
        let at = |v: usize| -> [f64; 3] { std::array::from_fn(|k| mesh.centre[k] + f64::from(mesh.position(v)[k])) };
        let moved = |m: &[f64; 12], p: [f64; 3]| -> [f64; 3] {
            std::array::from_fn(|k| unit * (m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3]))
        };
        let expected: Vec<Vec<[f64; 3]>> =
            OPERATORS.iter().map(|m| (0..mesh.n_vertices()).step_by(97).map(|v| moved(m, at(v))).collect()).collect();
        let glb = split_glb(&encode(Format::Glb, &product));
        let gltf = split_gltf(&encode(Format::Gltf, &product));
        for (json, bin) in [(&glb.json, &glb.bin), (&gltf.0, &gltf.1)] {
            let found = instances(json, bin);
            assert_eq!(found.iter().map(|placed| placed.name.as_str()).collect::<Vec<_>>(), ["A,B"; 3]);
            for (n, placed) in found.iter().enumerate() {
                let error = distance(&placed.positions, &expected[n]);
                assert!(error < tolerance, "{pairs:?} {n}: {error}");
                // Negative control: another operator.
                assert!(distance(&placed.positions, &expected[(n + 1) % 3]) > 1.0);
            }
        }
    }
}

#[test]
fn units_are_meshed_once_and_sums_count_every_instance() {
    let [one, two, three] = OPERATORS;
    // Two rules for chain A, one of which also covers B.
    let text = with_rules(&[("A", &[one]), ("A, B", &[two, three]), ("A", &[three])]);
    let product = meshed(&text, &[]);
    let report = &product.report;
    let names: Vec<_> = report.parts.iter().map(|part| (part.name.as_str(), part.instances, part.atoms)).collect();
    assert_eq!(names, [("A", Some(2), 454), ("A,B", Some(2), 908)]);
    let instances = report.instances.as_ref().unwrap();
    assert_eq!((instances.count, instances.joined, instances.atoms_sum), (4, false, 2 * 454 + 2 * 908));
    assert_eq!((report.atoms, report.assembly.as_ref().unwrap().copies), (454 + 908, 4));
    let sum = |of: &dyn Fn(usize) -> f64| 2.0 * (of(0) + of(1));
    let close = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-12;
    assert!(close(instances.area_sum, sum(&|n| report.parts[n].area)));
    assert!(close(instances.volume_sum, sum(&|n| report.parts[n].volume.unwrap())));
    assert!(close(report.area, report.parts.iter().map(|part| part.area).sum::<f64>()));
    assert!(report.closed && report.manifold);
    // A unit has the mesh of its atoms alone.
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let alone = params::parse([("chains", "A"), ("resolution", "1.2")]).unwrap().options;
    let alone =
        run(text.as_bytes(), &alone, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap().report;
    assert_eq!((alone.triangles, alone.vertices), (report.parts[0].triangles, report.parts[0].vertices));
    // Without instances there are no sums, and the copies are in memory.
    let joined = params::parse([("assembly", "1"), ("resolution", "1.2")]).unwrap().options;
    let joined =
        run(text.as_bytes(), &joined, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap().report;
    assert!(joined.instances.is_none() && joined.parts.is_empty());
    assert_eq!((joined.atoms, joined.assembly.unwrap().copies), (instances.atoms_sum, 4));
    // A rule without selected atoms has no unit.
    let chain = meshed(&text, &[("chains", "B")]).report;
    assert_eq!(
        chain.parts.iter().map(|part| (part.name.as_str(), part.instances)).collect::<Vec<_>>(),
        [("B", Some(2))]
    );
}

#[test]
fn one_unit_is_meshed_where_it_is_in_the_file() {
    let [one, two, three] = OPERATORS;
    let text = with_rules(&[("A", &[one]), ("A, B", &[two, three]), ("B", &[three])]);
    let structure = read(text.as_bytes(), &ReadLimits::default()).unwrap();
    let selected = |instances: bool, unit: Option<u32>| {
        let unit = unit.and_then(NonZeroU32::new);
        let selection = Selection { assembly: Some("1".into()), instances, unit, ..Selection::default() };
        select(&structure, &selection)
    };
    let all = selected(true, None).unwrap();
    assert_eq!(all.units.iter().map(|unit| unit.name.as_str()).collect::<Vec<_>>(), ["A", "A,B", "B"]);
    let total = structure.len() as u64;
    for (number, unit) in (1..).zip(&all.units) {
        let own = selected(false, Some(number)).unwrap();
        let mut expected = all.atoms[unit.rows.clone()].to_vec();
        expected.sort_unstable();
        assert_eq!((&own.atoms, own.copies.len(), own.units.len()), (&expected, 0, 0), "{number}");
        assert_eq!(own.atoms.len() as u64 + own.left_out.total, total);
    }
    let missing = selected(false, Some(4)).unwrap_err().to_string();
    assert!(missing.contains("unit 4") && missing.contains("the units 1 to 3 in assembly 1"), "{missing}");
    // Atoms that the selection leaves out are not those of other units, also if they have chains of their own.
    let file = include_bytes!("../structures/1pfe.cif.gz");
    let structure = read(file, &ReadLimits::default()).unwrap();
    let left_out = |instances, unit| {
        let selection = Selection { assembly: Some("1".into()), instances, unit, ..Selection::default() };
        select(&structure, &selection).unwrap().left_out
    };
    assert_eq!(left_out(true, None), left_out(false, NonZeroU32::new(1)));
    assert!(!left_out(true, None).kinds.is_empty());
    // The number counts the units that have selected atoms.
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let pairs = [("assembly", "1"), ("unit", "2"), ("chains", "B"), ("resolution", "1.2")];
    let options = |pairs: &[(&str, &str)]| params::parse(pairs.iter().copied()).unwrap().options;
    let run = |options| run(text.as_bytes(), &options, &JobLimits::default(), &choice, &Control::default(), &(), None);
    assert!(run(options(&pairs)).unwrap_err().to_string().contains("one unit"));
    let report =
        run(options(&[("assembly", "1"), ("unit", "1"), ("chains", "B"), ("resolution", "1.2")])).unwrap().report;
    let alone = run(options(&[("chains", "B"), ("resolution", "1.2")])).unwrap().report;
    assert_eq!((report.triangles, report.area.to_bits()), (alone.triangles, alone.area.to_bits()));
    let assembly = report.assembly.unwrap();
    assert_eq!((assembly.copies, assembly.unit, alone.assembly.is_none()), (1, Some(1), true));
    for (pairs, reason) in [
        (&[("unit", "1")][..], "no value without assembly"),
        (&[("unit", "1"), ("assembly", "1"), ("context", "whole")], "no value with context=whole"),
        (&[("unit", "0"), ("assembly", "1")], "a whole number from 1"),
        (&[("unit", "1"), ("assembly", "1"), ("instances", "true")], "false with a value of unit"),
        (&[("tile", "1/0/0/0"), ("assembly", "1"), ("instances", "true")], "false for a tile"),
    ] {
        let error = params::parse(pairs.iter().copied()).unwrap_err().to_string();
        assert!(error.contains(reason), "{pairs:?}: {error}");
    }
}

#[test]
fn limits_apply_to_instances_and_to_the_atoms_of_units() {
    let text = with_rules(&[("A, B", &OPERATORS)]);
    let limited = |max_copies, max_atoms| {
        let read = ReadLimits { max_copies, max_atoms, ..ReadLimits::default() };
        meshed_with(&text, &[], &JobLimits { read, ..JobLimits::default() }).map(|product| product.report.atoms)
    };
    // 912 atoms are in the file, and 2,724 would be in the copies.
    assert_eq!(limited(3, 912), Ok(908));
    let error = limited(2, 912).unwrap_err();
    assert!(matches!(&error, JobError::Surface(error) if error.exceeded(Limit::Copies).is_some_and(|e| e.max == 2)));
    let overlapping = with_rules(&[("A, B", &OPERATORS), ("A", &OPERATORS[1..])]);
    let read = ReadLimits { max_atoms: 912, ..ReadLimits::default() };
    let error = meshed_with(&overlapping, &[], &JobLimits { read, ..JobLimits::default() }).unwrap_err();
    let JobError::Surface(SurfaceError::Limit(error)) = error else { panic!("{error}") };
    assert_eq!((error.limit, error.actual), (Limit::Atoms, Some(1362)));
    let mut far = OPERATORS[0];
    far[3] = 99_990.0;
    let error = meshed_with(&with_rules(&[("A", &[far])]), &[], &JobLimits::default()).unwrap_err();
    assert!(error.to_string().contains("beyond the range of coordinates"), "{error}");
}

#[test]
fn other_requests_are_rejected_with_the_reason() {
    let text = with_rules(&[("A", &[OPERATORS[0]]), ("B", &[REFLECTION])]);
    let error = meshed_with(&text, &[], &JobLimits::default()).unwrap_err().to_string();
    assert!(error.contains("not a rotation") && error.contains("assembly 1"), "{error}");
    // The reflection is part of an ordinary assembly.
    let selection = Selection { assembly: Some("1".into()), ..Selection::default() };
    assert_eq!(select(&read(text.as_bytes(), &ReadLimits::default()).unwrap(), &selection).unwrap().atoms.len(), 908);
    for (pairs, reason) in [
        (&[("instances", "true")][..], "false for the asymmetric unit"),
        (&[("instances", "true"), ("assembly", "asymmetric-unit")], "false for the asymmetric unit"),
        (&[("instances", "true"), ("assembly", "1"), ("context", "whole")], "false with context=whole"),
        (&[("instances", "true"), ("assembly", "1"), ("split", "chain")], "false with split=chain"),
        (&[("instances", "true"), ("assembly", "1"), ("format", "ply")], "one of the formats glb, gltf"),
        (&[("instances", "true"), ("assembly", "1"), ("format", "png")], "one of the formats glb, gltf"),
        (&[("instances", "yes")], "true or false"),
    ] {
        let error = params::parse(pairs.iter().copied()).unwrap_err().to_string();
        assert!(error.contains("`instances`") && error.contains(reason), "{pairs:?}: {error}");
    }
    let key = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    assert_ne!(key(&[("assembly", "1")]), key(&[("assembly", "1"), ("instances", "true")]));
    assert_eq!(key(&[]), key(&[("instances", "false")]));
    // Encoders of other formats reject the mesh.
    let product = meshed(&with_rules(&[("A", &OPERATORS)]), &[]);
    for format in [Format::Ply, Format::PlyText, Format::Stl, Format::Obj, Format::Vtp] {
        let error = Encoder::new(format, product.storage, &product.mesh, &product.meta()).unwrap_err();
        assert_eq!(error, FormatError::InstancesNotSupported { format: format.name() });
    }
}

#[test]
fn the_khronos_validator_accepts_instances() {
    let text = with_rules(&[("A, B", &OPERATORS), ("A", &OPERATORS[1..])]);
    let mut files = Files::new();
    for (name, pairs) in [
        ("plain", &[][..]),
        ("quantized", &[("compress", "quantize"), ("normals", "none")]),
        ("coloured", &[("color", "element"), ("atom_ids", "true"), ("units", "meter")]),
    ] {
        let product = meshed(&text, pairs);
        for format in [Format::Glb, Format::Gltf] {
            files.add(&format!("{name}.{format}"), &encode(format, &product));
        }
    }
    // Negative control: an accessor that exceeds its view.
    let product = meshed(&text, &[]);
    let glb = encode(Format::Glb, &product);
    let text = String::from_utf8_lossy(&glb[20..]).into_owned();
    let count = text.find("\"count\":3,").unwrap();
    let mut broken = glb.clone();
    broken[20 + count + 8] = b'9';
    files.add("broken.glb", &broken);
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    let (broken, good) = reports.split_last().unwrap();
    good.iter().for_each(tools::GltfReport::assert_clean);
    assert!(broken.errors > 0, "{broken:?}");
}
