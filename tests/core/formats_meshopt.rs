//! Compressed GLB: three decoders get the quantized mesh, on any number of threads, and the Khronos validator accepts
//! the files. Each comparison has a negative control.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use molmesh::formats::{CompressedGlb, Format, FormatError, Meta, Normals, Packing, Pieces, Step, Storage};
use molmesh::pipeline::{self, Choice, JobError, JobLimits, Product, params, run};
use molmesh::surface::{CancelToken, Control, CpuBackend, Limit, Mesh, SurfaceError};
use serde_json::Value;

use crate::instances::{OPERATORS, with_rules};
use crate::tools;
use tools::files::Files;
use tools::meshopt::{EXTENSION, Triangle, decoded, number, triangles};
use tools::readers::split_glb;
use tools::shapes::{dressed, icosphere, torus};

const SAMPLE: &str = include_str!("../../samples/4pti.pdb");

/// Largest angle between a quantized normal and the decoded one, degrees.
const NORMAL_TOLERANCE: f64 = 1.2;

fn meshed_in(text: &str, pairs: &[(&str, &str)], control: &Control<'_>) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(text.as_bytes(), &options, &JobLimits::default(), &choice, control, &(), None)
}

/// Returns the GLB of a job with this value of `compress`.
fn file(text: &str, pairs: &[(&str, &str)], compress: &str) -> Vec<u8> {
    let pairs = [pairs, &[("compress", compress)]].concat();
    let product = meshed_in(text, &pairs, &Control::default()).unwrap();
    let (file, mut bytes) = (product.file(Format::Glb).unwrap(), Vec::new());
    file.write(&mut bytes).unwrap();
    assert_eq!(file.bytes(), Some(bytes.len() as u64));
    assert_eq!(product.pieces.is_some(), compress == "meshopt");
    bytes
}

/// Name, structure, parameters, and number of pieces of each mesh.
type Case = (&'static str, String, Vec<(&'static str, &'static str)>, usize);

fn cases() -> Vec<Case> {
    let sample = || SAMPLE.to_owned();
    vec![
        ("plain", sample(), vec![], 1),
        ("large", sample(), vec![("resolution", "0.3"), ("color", "element"), ("atom_ids", "true")], 2),
        ("bare", sample(), vec![("normals", "none"), ("resolution", "1"), ("units", "nanometer")], 1),
        ("tiny", sample(), vec![("resolution", "4"), ("surface", "vdw")], 1),
        ("smooth", sample(), vec![("color", "radial"), ("resolution", "1"), ("surface", "ses")], 1),
        ("parts", sample(), vec![("split", "residue-group"), ("select", "all"), ("atom_ids", "true")], 1),
        ("patch", sample(), vec![("context", "whole"), ("select", "resid 1-9"), ("resolution", "0.7")], 1),
        ("cavities", sample(), vec![("cavities", "drop"), ("surface", "ses"), ("resolution", "0.8")], 1),
        (
            "instances",
            with_rules(&[("A", &OPERATORS), ("B", &OPERATORS[..2])]),
            vec![("assembly", "1"), ("instances", "true"), ("color", "chain"), ("resolution", "1")],
            1,
        ),
    ]
}

/// Returns the triangles without their normals.
fn without_normals(mut all: Vec<Triangle>) -> Vec<Triangle> {
    all.iter_mut().flatten().for_each(|corner| corner.normal = [0; 3]);
    all
}

/// Largest angle between the normals of equal triangles, degrees.
fn largest_angle(found: &[Triangle], expected: &[Triangle]) -> f64 {
    let mut most = 0.0_f64;
    for (a, b) in found.as_flattened().iter().zip(expected.as_flattened()) {
        let [a, b] = [a, b].map(|corner| corner.normal.map(f64::from));
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let scale = (dot(a, a) * dot(b, b)).sqrt();
        if scale > 0.0 {
            most = most.max((dot(a, b) / scale).min(1.0).acos().to_degrees());
        }
    }
    most
}

/// Returns true if every directed edge between two positions has as many opposite ones.
fn is_closed(triangles: &[Triangle]) -> bool {
    let mut edges: BTreeMap<[[i16; 3]; 2], i64> = BTreeMap::new();
    for triangle in triangles {
        for k in 0..3 {
            let (from, to) = (triangle[k].position, triangle[(k + 1) % 3].position);
            // Rounding merges some vertices.
            *edges.entry([from.min(to), from.max(to)]).or_default() += from.cmp(&to) as i64;
        }
    }
    edges.values().all(|&n| n == 0)
}

#[test]
fn decoded_pieces_are_the_quantized_mesh() {
    for (name, text, pairs, pieces) in cases() {
        let plain = split_glb(&file(&text, &pairs, "quantize"));
        let packed = file(&text, &pairs, "meshopt");
        let (json, buffers) = decoded(&packed).unwrap();
        let [compressed, decoded] = buffers.each_ref().map(|buffer| &buffer[..]);
        let (found, expected) = (triangles(&json, &[compressed, decoded]), triangles(&plain.json, &[&plain.bin]));
        assert_eq!(found.len(), expected.len(), "{name}");
        let mut worst = 0.0_f64;
        for ((n, found), (_, expected)) in found.into_iter().zip(expected) {
            assert_eq!(n, pieces, "{name}");
            worst = worst.max(largest_angle(&found, &expected));
            let closed = is_closed(&found);
            assert_eq!(closed, name != "patch", "{name}");
            let (found, mut expected) = (without_normals(found), without_normals(expected));
            assert!(found == expected, "{name}");
            // Negative controls: a moved corner is found, and a mesh without a triangle is open.
            expected[0][2].position[0] ^= 1;
            assert!(found != expected && !is_closed(&found[1..]), "{name}");
        }
        assert!(worst < NORMAL_TOLERANCE, "{name}: {worst}");
        assert_eq!(worst > 0.0, name != "bare", "{name}");
        for key in ["nodes", "scenes", "scene", "asset", "materials"] {
            let same_but_indices = key == "nodes" && name == "instances";
            assert!(same_but_indices || json[key] == plain.json[key], "{name}: {key}");
        }
    }
}

#[test]
fn placements_of_instances_are_equal() {
    let (_, text, pairs, _) = cases().pop().unwrap();
    let plain = split_glb(&file(&text, &pairs, "quantize"));
    let packed = split_glb(&file(&text, &pairs, "meshopt"));
    let placements = |json: &Value, bin: &[u8]| -> Vec<Vec<u8>> {
        let nodes = json["nodes"].as_array().unwrap().iter();
        let attributes = nodes.filter_map(|node| node.pointer("/extensions/EXT_mesh_gpu_instancing/attributes"));
        let rows = |index: &Value| {
            let accessor = &json["accessors"][number(index)];
            let view = &json["bufferViews"][number(&accessor["bufferView"])];
            assert_eq!(number(&view["buffer"]), 0);
            let start = number(&view["byteOffset"]) + number(&accessor["byteOffset"]);
            let bytes = if accessor["type"] == "VEC3" { 12 } else { 16 };
            bin[start..start + bytes * number(&accessor["count"])].to_vec()
        };
        attributes.flat_map(|named| ["TRANSLATION", "ROTATION"].map(|name| rows(&named[name]))).collect()
    };
    let found = placements(&packed.json, &packed.bin);
    assert_eq!((found.len(), found[0].len()), (4, 3 * 12));
    assert_eq!(found, placements(&plain.json, &plain.bin));
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let (_, text, pairs, _) = &cases()[1];
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| file(text, pairs, "meshopt"))
    };
    let expected = on(1);
    assert!(expected == on(2) && expected == on(7));
    // Negative control: another mesh has other bytes.
    assert!(expected != file(text, &[pairs, &[("select", "all")][..]].concat(), "meshopt"));
}

/// Compresses a mesh, whose vertices are quantized with the smallest step.
fn pieces_of(mesh: &mut Mesh) -> Result<Pieces, FormatError> {
    let largest = mesh.bounds().as_flattened().iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    mesh.quantize(Step::covering(f64::from(largest)));
    Pieces::new(mesh, Packing::of(mesh), None, |_| Ok(()), |_| ())
}

fn compressed(mut mesh: Mesh) -> Vec<u8> {
    let pieces = pieces_of(&mut mesh).unwrap();
    let (file, mut bytes) = (CompressedGlb::new(&mesh, &pieces, &Meta::default()).unwrap(), Vec::new());
    file.write(&mut bytes).unwrap();
    assert_eq!(file.encoded_len(), bytes.len() as u64);
    bytes
}

/// Meshes of all index types and columns.
fn shapes() -> Vec<(&'static str, Mesh, usize)> {
    let fan = |n: u32| (0..n).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    // Separate triangles have more vertices than fit 16 bits.
    let mut soup = torus(256, 300);
    let corners: Vec<u32> = soup.triangles.as_flattened().to_vec();
    soup.positions = corners.iter().map(|&v| soup.positions[v as usize]).collect();
    soup.normals = corners.iter().map(|&v| soup.normals[v as usize]).collect();
    soup.triangles = fan(u32::try_from(corners.len() / 3).unwrap());
    vec![
        ("icosphere", icosphere(3, 10.0, [0.0; 3], false), 1),
        ("float-atoms", dressed(torus(20, 30), 1_000_000), 1),
        ("two-pieces", dressed(torus(256, 256), 65_535), 2),
        ("soup", soup, 2),
    ]
}

#[test]
fn meshes_of_other_origin_are_compressed() {
    for (name, mesh, pieces) in shapes() {
        let (n, has_atoms) = (mesh.n_triangles(), mesh.atom_ids.is_some());
        let (json, buffers) = decoded(&compressed(mesh)).unwrap();
        let all = triangles(&json, &buffers.each_ref().map(|buffer| &buffer[..]));
        assert_eq!((all.len(), all[0].0, all[0].1.len()), (1, pieces, n), "{name}");
        assert_eq!(all[0].1[0][0].atom.is_empty(), !has_atoms, "{name}");
        assert!(is_closed(&all[0].1), "{name}");
    }
    let empty = split_glb(&compressed(Mesh::default()));
    assert!(empty.bin.is_empty() && empty.json.get("buffers").is_none() && empty.json.get("meshes").is_none());
}

#[test]
fn broken_streams_are_errors_or_other_meshes() {
    let good = compressed(icosphere(3, 10.0, [0.0; 3], false));
    let glb = split_glb(&good);
    let expected = decoded(&good).unwrap().1;
    for view in glb.json["bufferViews"].as_array().unwrap() {
        let packed = &view["extensions"][EXTENSION];
        let start = glb.bin_at + number(&packed["byteOffset"]);
        let changed = |at: usize, bits: u8| {
            let mut bytes = good.clone();
            bytes[at] ^= bits;
            std::panic::catch_unwind(|| decoded(&bytes))
        };
        // The version in the header is checked by the test, the data by the decoder.
        assert!(changed(start, 0x80).is_err());
        let found = changed(start + number(&packed["byteLength"]) / 2, 0xff).unwrap();
        assert!(found.is_err() || found.unwrap().1 != expected);
    }
}

#[test]
fn meshes_that_cannot_be_compressed_are_rejected() {
    let mesh = icosphere(2, 10.0, [0.0; 3], false);
    let try_with = |mesh: &Mesh, storage: Storage| {
        Pieces::new(mesh, storage, None, |_| Ok::<_, FormatError>(()), |_| ()).map(|_| ()).unwrap_err()
    };
    let step = Step::covering(11.0);
    assert_eq!(try_with(&mesh, Packing::Quantized(step).into()), FormatError::NotQuantized);
    let mut small = mesh.clone();
    small.quantize(step);
    let other = Packing::Quantized(Step::covering(100.0));
    assert_eq!(try_with(&small, other.into()), FormatError::AlreadyQuantized { step: step.length() });
    let mut broken = small.clone();
    broken.triangles.edit()[5][1] = 1 << 20;
    let vertices = small.n_vertices() as u64;
    assert_eq!(
        try_with(&broken, Packing::of(&small).into()),
        FormatError::IndexOutOfRange { triangle: 5, index: 1 << 20, vertices }
    );
    let large = dressed(mesh, (1 << 24) + 1);
    let mut large = Mesh { centre: [0.0; 3], ..large };
    assert!(matches!(pieces_of(&mut large), Err(FormatError::Limit(error)) if error.limit == Limit::AtomIndex));
    // A position beyond the step.
    let mut beyond = icosphere(2, 10.0, [0.0; 3], false);
    beyond.quantize(Step::covering(2.0));
    let pieces = pieces_of(&mut beyond.clone());
    assert!(pieces.is_ok(), "the check of the range is that of the plan");
    let pieces = Pieces::new(&beyond, Packing::of(&beyond), None, |_| Ok::<_, FormatError>(()), |_| ()).unwrap();
    let refused = CompressedGlb::new(&beyond, &pieces, &Meta::default()).unwrap_err();
    assert!(matches!(refused, FormatError::OutOfQuantizationRange { .. }), "{refused}");
    // Control.
    assert!(
        Pieces::new(
            &small,
            Storage { normals: Normals::None, ..Packing::of(&small).into() },
            None,
            |_| Ok::<_, FormatError>(()),
            |_| ()
        )
        .is_ok()
    );
}

#[test]
fn memory_is_claimed_before_use_and_what_remains_is_that_of_the_pieces() {
    let mut mesh = torus(256, 256);
    mesh.quantize(Step::covering(100.0));
    let (held, calls) = (AtomicU64::new(0), AtomicU64::new(0));
    let grow_until = |most: u64| {
        held.store(0, Ordering::Relaxed);
        calls.store(0, Ordering::Relaxed);
        let grow = |bytes| {
            held.fetch_add(bytes, Ordering::Relaxed);
            if calls.fetch_add(1, Ordering::Relaxed) < most {
                Ok(())
            } else {
                Err(JobError::Surface(SurfaceError::Cancelled))
            }
        };
        Pieces::new(&mesh, Packing::of(&mesh), None, grow, |bytes| {
            held.fetch_sub(bytes, Ordering::Relaxed);
        })
    };
    let pieces = grow_until(u64::MAX).unwrap();
    assert_eq!((held.load(Ordering::Relaxed), calls.load(Ordering::Relaxed)), (pieces.bytes(), 4));
    for most in 0..4 {
        assert_eq!(grow_until(most).map(|_| ()), Err(JobError::Surface(SurfaceError::Cancelled)), "{most}");
    }
}

#[test]
fn a_cancelled_job_is_not_compressed() {
    struct CancelAtEncode(CancelToken);
    impl pipeline::ProgressSink for CancelAtEncode {
        fn progress(&self, stage: &'static str, _fraction: f64) {
            if stage == "encode" {
                self.0.cancel();
            }
        }
    }
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    for (compress, stops) in [("meshopt", true), ("quantize", false)] {
        let options = params::parse([("resolution", "1"), ("compress", compress)]).unwrap().options;
        let control = Control::default();
        let sink = CancelAtEncode(control.cancel.clone());
        let done = run(SAMPLE.as_bytes(), &options, &JobLimits::default(), &choice, &control, &sink, None);
        assert_eq!(matches!(done, Err(JobError::Surface(SurfaceError::Cancelled))), stops, "{compress}");
    }
}

/// Writes the files of all cases and shapes.
fn written() -> Files {
    let mut files = Files::new();
    for (name, text, pairs, _) in cases() {
        files.add(&format!("{name}.glb"), &file(&text, &pairs, "meshopt"));
    }
    for (name, mesh, _) in shapes() {
        files.add(&format!("{name}-shape.glb"), &compressed(mesh));
    }
    files
}

#[test]
fn the_gltf_validator_accepts_compressed_files() {
    let mut files = written();
    let n = files.paths.len();
    let broken = String::from_utf8_lossy(&compressed(icosphere(2, 10.0, [0.0; 3], false))).into_owned();
    assert!(broken.contains("\"count\":"));
    let mut bytes = compressed(icosphere(2, 10.0, [0.0; 3], false));
    let at = bytes.windows(12).position(|text| text == b"\"byteStride\"").unwrap() + 13;
    bytes[at] = b'6';
    files.add("broken.glb", &bytes);
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    for report in &reports[..n] {
        report.assert_clean();
        // The validator does not know the extension, so it sees no use of the first buffer.
        let codes: Vec<&str> = report.codes.keys().map(String::as_str).collect();
        assert_eq!(codes, ["UNSUPPORTED_EXTENSION", "UNUSED_OBJECT"], "{report:#?}");
    }
    // Negative control: a stride that is no multiple of 4.
    assert!(reports[n].errors > 0, "{:#?}", reports[n]);
}

#[test]
fn decoders_of_browsers_get_the_same_bytes() {
    let mut files = written();
    let n = files.paths.len();
    let mut bytes = compressed(icosphere(2, 10.0, [0.0; 3], false));
    let glb = split_glb(&bytes);
    bytes[glb.bin_at] ^= 0x80;
    files.add("broken.glb", &bytes);
    let Some(results) = tools::decode_meshopt(&files.paths) else { return };
    for (path, result) in files.paths.iter().zip(&results).take(n) {
        assert_eq!(result.error, None, "{}", path.display());
        let (json, [_, expected]) = decoded(&std::fs::read(path).unwrap()).unwrap();
        let mut found = std::fs::read(format!("{}.decoded", path.display())).unwrap();
        assert_eq!(found.len(), expected.len());
        for view in json["bufferViews"].as_array().unwrap() {
            let rows = number(&view["byteOffset"])..number(&view["byteOffset"]) + number(&view["byteLength"]);
            if view["extensions"][EXTENSION].get("filter").is_some() {
                // The last digit of a decoded normal depends on the processor's reciprocal square root.
                for (found, expected) in found[rows.clone()].iter_mut().zip(&expected[rows]) {
                    let close = found.cast_signed().abs_diff(expected.cast_signed()) <= 1;
                    *found = if close { *expected } else { *found };
                }
            }
        }
        assert!(found == expected, "{}", path.display());
    }
    assert!(results[n].error.is_some());
}
