//! Parts of a mesh: names, other readers, equality with the meshes of the parts alone, and limits.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use molmesh::formats::{Encoder, Format, FormatError};
use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{Choice, JobError, JobLimits, PartReport, Product, Report, estimate, run};
use molmesh::structure::{ReadLimits, Split, read_with};
use molmesh::surface::{
    Control, CpuBackend, Exceeded, Limit, MemoryMeter, Mesh, OutOfMemory, SurfaceError, SurfaceLimits, Validation,
};
use serde::Deserialize;

use crate::tools;
use crate::tools::files::Files;

/// Two copies of a protein as chains A and B, which touch, each with a water and an ion.
pub(crate) fn dimer() -> String {
    let text = include_str!("../../samples/4pti.pdb");
    let mut lines = Vec::new();
    for (chain, shift) in [('A', 0.0), ('B', 14.0)] {
        for line in text.lines().filter(|line| line.starts_with("ATOM")) {
            let x: f64 = line[30..38].trim().parse().unwrap();
            lines.push(format!("{}{chain}{}{:8.3}{}", &line[..21], &line[22..30], x + shift, &line[38..]));
        }
        let het = |name: &str, element: &str, residue: &str, x: f64| {
            format!(
                "HETATM 9999 {name:<4} {residue:>3} {chain} 900    {x:8.3}{:8.3}{:8.3}  1.00 10.00          {element:>2}",
                62.0, 62.0
            )
        };
        lines.push(het(" O", "O", "HOH", shift));
        lines.push(het("ZN", "ZN", "ZN", shift + 30.0));
    }
    lines.push("END".to_owned());
    lines.join("\n") + "\n"
}

fn meshed_with(text: &str, pairs: &[(&str, &str)], limits: &JobLimits) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(text.as_bytes(), &options, limits, &choice, &Control::default(), &(), None)
}

fn meshed(text: &str, pairs: &[(&str, &str)]) -> Product {
    meshed_with(text, pairs, &JobLimits::default()).unwrap()
}

fn names(report: &Report) -> Vec<&str> {
    report.parts.iter().map(|part| part.name.as_str()).collect()
}

fn encode(format: Format, product: &Product) -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder = Encoder::new(format, product.storage, &product.mesh, &product.meta()).unwrap();
    encoder.write(&mut bytes).unwrap();
    assert!(bytes.len() as u64 <= encoder.encoded_len_bound());
    assert!(encoder.encoded_len().is_none_or(|len| len == bytes.len() as u64));
    bytes
}

/// Returns one part of a mesh as a mesh.
fn part(mesh: &Mesh, n: usize) -> Mesh {
    let range = &mesh.parts[n];
    let first = u32::try_from(range.vertices.start).unwrap();
    Mesh {
        centre: mesh.centre,
        positions: range.vertices.clone().map(|v| mesh.position(v)).collect(),
        normals: mesh.normals[range.vertices.clone()].iter().copied().collect(),
        triangles: mesh.triangles[range.triangles.clone()].iter().map(|t| t.map(|v| v - first)).collect(),
        atom_ids: mesh.atom_ids.as_ref().map(|ids| ids[range.vertices.clone()].iter().copied().collect()),
        ..Mesh::default()
    }
}

/// Returns the largest distance between corresponding vertices of two meshes; infinite if the triangles differ.
fn distance(a: &Mesh, b: &Mesh) -> f64 {
    if a.triangles != b.triangles || a.n_vertices() != b.n_vertices() {
        return f64::INFINITY;
    }
    let at = |mesh: &Mesh, v: usize, k: usize| mesh.centre[k] + f64::from(mesh.position(v)[k]);
    (0..a.n_vertices()).flat_map(|v| [0, 1, 2].map(|k| (at(a, v, k) - at(b, v, k)).abs())).fold(0.0, f64::max)
}

#[test]
fn a_part_has_the_mesh_of_its_atoms_alone() {
    let text = dimer();
    for surface in ["gaussian", "ses"] {
        let own = [("surface", surface), ("select", "all"), ("resolution", "0.8"), ("atom_ids", "true")];
        let both = meshed(&text, &[&own[..], &[("split", "chain")]].concat());
        let alone = ["A", "B"].map(|chain| meshed(&text, &[&own[..], &[("chains", chain)]].concat()));
        assert_eq!(names(&both.report), ["A", "B"]);
        for (n, alone) in alone.iter().enumerate() {
            let part = part(&both.mesh, n);
            assert!(distance(&part, &alone.mesh) < 1e-5, "{surface} {n}: {}", distance(&part, &alone.mesh));
            assert_eq!(part.atom_ids, alone.mesh.atom_ids, "indices of atoms of the file");
            let PartReport { atoms, vertices, triangles, area, volume, .. } = &both.report.parts[n];
            let (of, report) = (&alone.report, &both.report);
            assert_eq!((*atoms, *vertices, *triangles), (of.atoms, of.vertices, of.triangles));
            let [volume, alone] = [volume, &of.volume].map(|volume| volume.unwrap());
            assert!((area / of.area - 1.0).abs() < 1e-6 && (volume / alone - 1.0).abs() < 1e-6);
            assert!(report.closed && report.oriented && report.manifold);
        }
        // Negative controls: the other chain, and one mesh of both chains.
        assert!(distance(&part(&both.mesh, 0), &alone[1].mesh).is_infinite());
        let whole = meshed(&text, &own);
        assert!(whole.report.parts.is_empty() && whole.mesh.parts.is_empty());
        assert!(whole.report.area < 0.99 * both.report.area, "the chains touch");
        let sum = |count: fn(&Report) -> u64| alone.iter().map(|product| count(&product.report)).sum::<u64>();
        let report = &both.report;
        assert_eq!((report.triangles, report.vertices), (sum(|r| r.triangles), sum(|r| r.vertices)));
        assert_eq!((report.grid_points, report.components), (sum(|r| r.grid_points), sum(|r| r.components)));
        assert_eq!(report.euler, alone.iter().map(|product| product.report.euler).sum::<i64>());
        let voids = |report: &Report| {
            let mut all: Vec<_> = report.void_list.iter().map(|v| v.center.map(|c| (c * 1e3).round() as i64)).collect();
            all.sort_unstable();
            all
        };
        let mut expected = [voids(&alone[0].report), voids(&alone[1].report)].concat();
        expected.sort_unstable();
        let near = |a: &[i64; 3], b: &[i64; 3]| (0..3).all(|k| (a[k] - b[k]).abs() <= 1);
        assert!(voids(report).iter().zip(&expected).all(|(a, b)| near(a, b)), "{surface}");
    }
}

#[test]
fn every_rule_names_its_parts() {
    let text = dimer();
    let of = |pairs: &[(&str, &str)]| {
        let report = meshed(&text, &[&[("resolution", "1")], pairs].concat()).report;
        assert_eq!(report.parts.iter().map(|part| part.atoms).sum::<u64>(), report.atoms);
        assert_eq!(report.parts.iter().map(|part| part.triangles).sum::<u64>(), report.triangles);
        let area: f64 = report.parts.iter().map(|part| part.area).sum();
        assert!((area / report.area - 1.0).abs() < 1e-6);
        names(&report).join(" ")
    };
    assert_eq!(of(&[("split", "chain")]), "A B");
    assert_eq!(of(&[("split", "residue-group"), ("select", "all")]), "polymer water ion");
    let cif = include_str!("../../samples/1crn.cif");
    let crambin = meshed(cif, &[("split", "entity"), ("resolution", "1"), ("select", "all")]).report;
    assert_eq!(names(&crambin), ["1"]);
    let copies = meshed(cif, &[("split", "chain"), ("resolution", "1"), ("assembly", "1")]).report;
    assert_eq!(names(&copies), ["A-1"]);
    // PDB files have no entities.
    let error = meshed_with(&text, &[("split", "entity")], &JobLimits::default()).unwrap_err();
    assert!(error.to_string().contains("expected none, chain or residue-group"), "{error}");
}

#[test]
fn bad_values_name_the_valid_ones() {
    let error = params::parse([("split", "atom")]).unwrap_err();
    assert!(matches!(error, ParamError::BadValue { name: "split", .. }), "{error}");
    assert!(error.to_string().contains("none, chain, entity, residue-group, pocket"), "{error}");
    let key = |value| params::canonical(&params::parse([("split", value)]).unwrap().options);
    let none = params::canonical(&params::parse::<&str, &str>([]).unwrap().options);
    let keys = ["none", "chain", "entity", "residue-group"].map(key);
    assert_eq!(keys[0], none);
    assert!((1..4).all(|n| !keys[..n].contains(&keys[n])), "{keys:?}");
}

/// Part as read by trimesh.
#[derive(Debug, Deserialize)]
struct Read {
    name: String,
    watertight: bool,
    faces: u64,
    unused: u64,
    area: f64,
    volume: f64,
}

#[test]
fn other_readers_see_closed_parts_with_their_names() {
    let text = dimer();
    let ways: [(&str, &[(&str, &str)]); 3] = [
        ("plain", &[("split", "chain")]),
        ("quantized", &[("split", "chain"), ("compress", "quantize"), ("validation", "exact")]),
        ("colored", &[("split", "residue-group"), ("color", "element"), ("atom_ids", "true"), ("normals", "none")]),
    ];
    let (mut files, mut expected) = (Files::new(), Vec::new());
    for (name, pairs) in ways {
        let product = meshed(&text, &[&[("select", "all"), ("resolution", "0.7")], pairs].concat());
        assert_eq!(product.mesh.quantized.is_some(), name == "quantized");
        for format in [Format::Glb, Format::Gltf, Format::Obj] {
            if format != Format::Obj || name != "quantized" {
                files.add(&format!("{name}.{format}"), &encode(format, &product));
                expected.push((format, product.report.clone()));
            }
        }
    }
    // Negative control: a part that lacks a triangle.
    let mut broken = meshed(&text, &[("split", "chain"), ("resolution", "1")]);
    let last = broken.mesh.n_triangles() - 1;
    broken.mesh.triangles = broken.mesh.triangles[..last].iter().copied().collect();
    broken.mesh.parts[1].triangles.end = last;
    files.add("broken.glb", &encode(Format::Glb, &broken));
    let gltf: Vec<_> = files.paths.iter().filter(|path| path.extension().unwrap() != "obj").collect();
    if let Some(reports) = tools::gltf_validate(&gltf) {
        for report in &reports {
            report.assert_clean();
        }
    }
    let Some(read) = tools::python::<Vec<Read>>("check_parts.py", &files.paths) else { return };
    let (broken, good) = read.split_last().unwrap();
    assert_eq!(broken.iter().map(|part| part.watertight).collect::<Vec<_>>(), [true, false]);
    for (read, (format, report)) in good.iter().zip(expected) {
        let mut parts = report.parts;
        parts.sort_by(|a, b| a.name.cmp(&b.name));
        assert_eq!(read.len(), parts.len(), "{format} {read:?}");
        for (read, part) in read.iter().zip(parts) {
            assert!(read.watertight, "{format} {read:?}");
            // trimesh prefixes groups with the name of the object.
            let name = read.name.strip_prefix("surface_").unwrap_or(&read.name);
            assert_eq!((name, read.faces), (part.name.as_str(), part.triangles), "{format}");
            // Groups of OBJ share the vertices of the file.
            assert!(read.unused == 0 || format == Format::Obj, "{format} {read:?}");
            assert!((read.area / part.area - 1.0).abs() < 1e-4, "{format} {read:?} {part:?}");
            assert!((read.volume / part.volume.unwrap() - 1.0).abs() < 1e-4, "{format} {read:?} {part:?}");
        }
    }
}

#[test]
fn formats_without_parts_hold_all_triangles() {
    let product = meshed(&dimer(), &[("split", "chain"), ("resolution", "1")]);
    let n = product.mesh.n_triangles();
    assert_eq!(encode(Format::Stl, &product).len(), 84 + 50 * n);
    let mut plain = product.clone();
    plain.mesh.parts = Vec::new();
    assert_eq!(encode(Format::Ply, &product), encode(Format::Ply, &plain));
}

#[test]
fn parts_that_share_vertices_are_rejected() {
    let mut product = meshed(&dimer(), &[("split", "chain"), ("resolution", "1")]);
    let check = |product: &Product| Encoder::new(Format::Glb, product.storage, &product.mesh, &product.meta()).err();
    assert_eq!(check(&product), None);
    let part = |name: &str| Some(FormatError::BadPart { part: name.into() });
    let end = product.mesh.parts[1].triangles.end;
    product.mesh.parts[1].triangles.end = end - 1;
    assert_eq!(check(&product), part("B"));
    product.mesh.parts[1].triangles.end = end + 1;
    assert_eq!(check(&product), part("B"));
    product.mesh.parts[1].triangles.end = end;
    product.mesh.triangles[end - 1][0] = 0;
    assert_eq!(check(&product), part("B"));
}

#[test]
fn parts_without_a_surface_are_reported_and_not_written() {
    // A coarse grid has no point inside the ion.
    let pairs = [("split", "residue-group"), ("select", "protein,ion"), ("resolution", "4")];
    let product = meshed(&dimer(), &pairs);
    let triangles: Vec<u64> = product.report.parts.iter().map(|part| part.triangles).collect();
    assert!(triangles[0] > 0 && triangles[1] == 0 && product.report.parts[1].atoms == 2, "{triangles:?}");
    let bytes = encode(Format::Glb, &product);
    let json = tools::readers::split_glb(&bytes).json;
    assert_eq!(json["nodes"].as_array().unwrap().len(), 2);
    assert_eq!((&json["nodes"][1]["name"], json["meshes"].as_array().unwrap().len()), (&"polymer".into(), 1));
}

#[test]
fn a_limit_on_triangles_is_that_of_all_parts() {
    let product = meshed(&dimer(), &[("split", "chain"), ("max_triangles", "8000")]);
    assert!((4000..=8000).contains(&product.report.triangles), "{}", product.report.triangles);
    assert_eq!(names(&product.report), ["A", "B"]);
    let fixed = meshed(&dimer(), &[("split", "chain"), ("resolution", &product.report.resolution.to_string())]);
    assert_eq!(fixed.mesh, product.mesh);
}

#[test]
fn the_number_of_parts_is_limited() {
    let limited = |max_parts| {
        let limits = JobLimits { read: ReadLimits { max_parts, ..ReadLimits::default() }, ..JobLimits::default() };
        meshed_with(&dimer(), &[("split", "chain"), ("resolution", "2")], &limits)
    };
    assert_eq!(limited(2).unwrap().report.parts.len(), 2);
    let error = limited(1).unwrap_err();
    assert_eq!(error, Split::Chain.too_many_parts(&ReadLimits { max_parts: 1, ..ReadLimits::default() }).into());
}

#[test]
fn limits_of_meshing_apply_to_all_parts_together() {
    let text = dimer();
    let usual = meshed(&text, &[("split", "chain"), ("resolution", "0.8")]);
    let one = meshed(&text, &[("chains", "B"), ("resolution", "0.8")]);
    let surface = SurfaceLimits::default();
    let with = |surface, h: &str| {
        meshed_with(&text, &[("split", "chain"), ("resolution", h)], &JobLimits { surface, ..JobLimits::default() })
    };
    // Each part fits, both together do not.
    let grid_points = usual.report.grid_points;
    assert!(one.report.grid_points < grid_points - 1);
    assert!(with(SurfaceLimits { max_grid_points: grid_points, ..surface }, "0.8").is_ok());
    let few = SurfaceLimits { max_grid_points: grid_points - 1, ..surface };
    let error = with(few, "0.8").unwrap_err();
    let JobError::Surface(SurfaceError::Limit(error)) = error else { panic!("{error}") };
    assert_eq!((error.limit, error.max), (Limit::GridPoints, grid_points - 1));
    assert!(error.actual.unwrap() >= grid_points, "{error}");
    assert!(with(few, &error.suggested_resolution.unwrap().to_string()).is_ok(), "{error}");
    let bytes = usual.mesh.bytes();
    assert!(one.mesh.bytes() < bytes - 1);
    assert!(with(SurfaceLimits { max_mesh_bytes: bytes, ..surface }, "0.8").is_ok());
    let few = SurfaceLimits { max_mesh_bytes: bytes - 1, ..surface };
    let error = with(few, "0.8").unwrap_err();
    let JobError::Surface(SurfaceError::Limit(error)) = error else { panic!("{error}") };
    assert_eq!((error.limit, error.max), (Limit::MeshBytes, bytes - 1));
    assert!(with(few, &error.suggested_resolution.unwrap().to_string()).is_ok(), "{error}");
    let few = SurfaceLimits { max_candidates: 3000, ..surface };
    let error = with(few, "0.8").unwrap_err();
    let JobError::Surface(SurfaceError::Limit(error)) = error else { panic!("{error}") };
    assert_eq!((error.limit, error.max), (Limit::Candidates, 3000));
    assert!(error.actual.unwrap() > 3000, "{error}");
    assert!(with(few, &error.suggested_resolution.unwrap().to_string()).is_ok(), "{error}");
}

#[test]
fn estimates_count_every_part() {
    let text = dimer();
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse([("split", "chain"), ("resolution", "0.8"), ("compress", "quantize")]).unwrap().options;
    let (limits, control) = (JobLimits::default(), Control::default());
    let read = |control: &Control<'_>| read_with(text.as_bytes(), &limits.read, control).map(Box::new);
    let made = run(text.as_bytes(), &options, &limits, &choice, &control, &(), None).unwrap().report;
    let expected = estimate(read, &options, &limits, &choice, &control).unwrap();
    let mesh = expected.mesh.unwrap();
    assert_eq!((mesh.grid_points, expected.box_cells), (made.grid_points, made.box_cells));
    let ratio = mesh.triangles as f64 / made.triangles as f64;
    assert!((0.8..1.25).contains(&ratio), "{ratio}");
    let few =
        JobLimits { surface: SurfaceLimits { max_grid_points: made.grid_points - 1, ..limits.surface }, ..limits };
    let refused = estimate(read, &options, &few, &choice, &control).unwrap().mesh.unwrap_err();
    assert!(refused.exceeded(Limit::GridPoints).is_some(), "{refused}");
}

/// Meter that counts bytes.
#[derive(Debug, Default)]
struct Meter(AtomicI64);

impl MemoryMeter for Meter {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.0.fetch_add(bytes as i64, Ordering::Relaxed);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.0.fetch_sub(bytes as i64, Ordering::Relaxed);
    }
}

#[test]
fn memory_of_the_joined_mesh_stays_counted() {
    let text = dimer();
    let held = |pairs: &[(&str, &str)]| {
        let (backend, meter) = (CpuBackend::new(Some(1)).unwrap(), Arc::new(Meter::default()));
        let choice = Choice { backend: &backend, reason: "" };
        let options = params::parse(pairs.iter().copied()).unwrap().options;
        assert_eq!(options.validation, Validation::Checksum);
        let control = Control { memory: meter.clone(), ..Control::default() };
        let product = run(text.as_bytes(), &options, &JobLimits::default(), &choice, &control, &(), None).unwrap();
        (meter.0.load(Ordering::Relaxed), product.mesh.bytes() as i64, product.report.atoms as i64)
    };
    let (whole, bytes, _) = held(&[("resolution", "1")]);
    let (split, parts, atoms) = held(&[("resolution", "1"), ("split", "chain")]);
    assert_eq!(split - parts, whole - bytes + 16 * atoms);
}

/// Three models of the first residues of a protein, numbered 1, 2 and 7. The second one is stretched along x, and the
/// last one lacks the last atoms.
fn ensemble() -> String {
    let text = include_str!("../../samples/4pti.pdb");
    let atoms: Vec<&str> = text.lines().filter(|line| line.starts_with("ATOM")).take(60).collect();
    let model = |number: usize, stretch: f64, n: usize| {
        let atom = |line: &&str| {
            let x: f64 = line[30..38].trim().parse().unwrap();
            format!("{}{:8.3}{}\n", &line[..30], stretch * x, &line[38..])
        };
        format!("MODEL     {number:>4}\n{}ENDMDL\n", atoms[..n].iter().map(atom).collect::<String>())
    };
    format!("{}{}{}END\n", model(1, 1.0, 60), model(2, 1.2, 60), model(7, 1.0, 50))
}

#[test]
fn all_models_have_the_meshes_of_each_model_alone() {
    let pdb = ensemble();
    let xyz = "2\nfirst\nC 0 0 0\nC 1.5 0 0\n1\nsecond\nO 9 0 0\n";
    let near = "select=byres within 4 of resi 3";
    for (text, numbers, select) in [
        (pdb.as_str(), vec!["1", "2", "7"], "select=polymer"),
        (&pdb, vec!["1", "2", "7"], near),
        (xyz, vec!["1", "2"], "select=all"),
    ] {
        let own = [("resolution", "0.8"), ("atom_ids", "true"), select.split_once('=').unwrap()];
        let all = meshed(text, &[&own[..], &[("model", "all")]].concat());
        let expected: Vec<String> = numbers.iter().map(|number| format!("model {number}")).collect();
        assert_eq!(names(&all.report), expected);
        assert_eq!((all.report.models, all.mesh.parts.len()), (Some(numbers.len() as u64), numbers.len()));
        for (n, number) in numbers.iter().enumerate() {
            let alone = meshed(text, &[&own[..], &[("model", number)]].concat());
            let part = part(&all.mesh, n);
            assert!(distance(&part, &alone.mesh) < 1e-5, "{select} {number}: {}", distance(&part, &alone.mesh));
            assert_eq!(part.atom_ids, alone.mesh.atom_ids, "indices of atoms of the file");
            assert_eq!((all.report.parts[n].atoms, alone.report.models), (alone.report.atoms, None));
            // Negative control: the other model.
            let other = (n + 1) % numbers.len();
            assert!(distance(&self::part(&all.mesh, other), &alone.mesh) > 0.1);
        }
        let left: u64 = numbers
            .iter()
            .map(|number| meshed(text, &[&own[..], &[("model", number)]].concat()).report.left_out)
            .map(|left_out| left_out.total - left_out.other_models)
            .sum();
        assert_eq!(all.report.left_out.total, left);
        let obj = String::from_utf8(encode(Format::Obj, &all)).unwrap();
        assert_eq!(obj.lines().filter(|line| line.starts_with("g model_")).count(), numbers.len());
    }
}

#[test]
fn gemmi_counts_the_atoms_of_each_model() {
    let mut files = Files::new();
    files.add("ensemble.pdb", ensemble().as_bytes());
    let Some(python) = tools::python_interpreter().or_else(|| tools::missing("gemmi")) else { return };
    let output = Command::new(python).arg("tests/tools/gemmi_dump.py").arg(&files.paths[0]).output().unwrap();
    let output = String::from_utf8(output.stdout).unwrap();
    let first = output.lines().next().unwrap();
    let expected: Vec<u64> = first.split(' ').skip(1).map(|n| n.parse().unwrap()).collect();
    let all = meshed(&ensemble(), &[("model", "all"), ("resolution", "2"), ("select", "all")]);
    assert_eq!(all.report.parts.iter().map(|part| part.atoms).collect::<Vec<_>>(), expected);
    assert_eq!(expected, [60, 60, 50], "negative control: the last model is shorter");
}

#[test]
fn all_models_exclude_other_parts_and_are_limited() {
    let refused = |pairs: &[(&str, &str)]| {
        let ParamError::BadValue { name, expected, .. } = params::parse(pairs.iter().copied()).unwrap_err() else {
            panic!("{pairs:?}")
        };
        (name, expected)
    };
    let (name, expected) = refused(&[("model", "all"), ("split", "chain")]);
    assert_eq!((name, expected.as_str()), ("split", "none with model=all, which makes one part of each model"));
    let (name, expected) = refused(&[("assembly", "1"), ("model", "all")]);
    assert_eq!(name, "assembly");
    assert!(expected.starts_with("asymmetric-unit with model=all"), "{expected}");
    for bad in ["ALL", "1,2", "1.5", "", "-"] {
        let (name, expected) = refused(&[("model", bad)]);
        assert_eq!((name, expected.as_str()), ("model", "the number of a model of the file, or all"), "{bad}");
    }
    // Defaults do not conflict, and the keys of one model and of all differ.
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    let all = canonical(&[("model", "all")]);
    assert_eq!(all, canonical(&[("model", "all"), ("split", "none"), ("assembly", "asymmetric-unit")]));
    assert_ne!(all, canonical(&[]));
    let limited = |max_parts| {
        let limits = JobLimits { read: ReadLimits { max_parts, ..ReadLimits::default() }, ..JobLimits::default() };
        meshed_with(&ensemble(), &[("model", "all"), ("resolution", "2")], &limits)
    };
    assert_eq!(limited(3).unwrap().report.parts.len(), 3);
    let error = limited(2).unwrap_err();
    assert_eq!(error, Split::Model.too_many_parts(&ReadLimits { max_parts: 2, ..ReadLimits::default() }).into());
    let few = JobLimits { read: ReadLimits { max_atoms: 169, ..ReadLimits::default() }, ..JobLimits::default() };
    let error = meshed_with(&ensemble(), &[("model", "all")], &few).unwrap_err();
    assert_eq!(error, JobError::from(SurfaceError::from(Box::new(Exceeded::new(Limit::Atoms, 169)))));
}
