//! Quantized glTF: decoded vertices are within half a step of the computed ones for every way of writing, and the
//! Khronos validator and trimesh read the files. Each comparison has a negative control.

use crate::tools;

use molmesh::formats::{Encoder, Format, FormatError, GlbSink, GlbSinkError, Meta, Packing, Step};
use molmesh::surface::{Mesh, SinkFailed};
use serde_json::{Value, json};
use tools::files::{Files, MemoryFile, encoded, write_parts};
use tools::readers::{Contents, Glb, accessor_of, accessor_offset, gltf_contents, split_glb, split_gltf};
use tools::shapes::{FAR, area_and_volume, dressed, icosphere, sphere_with_cavity, torus, triangle, two_spheres};

fn meta() -> Meta {
    Meta { name: Some("4PTI".into()), extras: [("kernel".to_owned(), "gaussian".into())].into_iter().collect() }
}

/// Returns the smallest step for a mesh.
fn step(mesh: &Mesh) -> Step {
    let largest = mesh.bounds().as_flattened().iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    Step::covering(f64::from(largest))
}

fn packed(format: Format, packing: Packing, mesh: &Mesh) -> Vec<u8> {
    let (encoder, mut bytes) = (Encoder::new(format, packing, mesh, &meta()).unwrap(), Vec::new());
    encoder.write(&mut bytes).unwrap();
    assert_eq!(encoder.encoded_len(), Some(bytes.len() as u64));
    bytes
}

fn quantized(format: Format, mesh: &Mesh) -> Vec<u8> {
    packed(format, Packing::Quantized(step(mesh)), mesh)
}

/// Closed surfaces with bodies and Euler characteristic, for all index types and columns.
fn cases() -> Vec<(&'static str, Mesh, u64, i64)> {
    let far = |mesh: Mesh| Mesh { centre: FAR, ..mesh };
    let mut glassy = dressed(icosphere(2, 3.0, [0.0; 3], false), 99);
    glassy.colors.as_mut().unwrap()[5][3] = 40;
    vec![
        ("icosphere", far(icosphere(3, 10.0, [0.0; 3], false)), 1, 2),
        ("two-spheres", far(two_spheres()), 2, 4),
        ("cavity", far(sphere_with_cavity()), 2, 4),
        ("torus-255", torus(15, 17), 1, 0),
        ("torus-65535", far(torus(255, 257)), 1, 0),
        ("torus-65536-dressed", dressed(torus(256, 256), 65_535), 1, 0),
        ("dressed-float-atoms", far(dressed(torus(20, 30), 1_000_000)), 1, 0),
        ("glassy", glassy, 1, 2),
        ("fine", icosphere(7, 20.0, [0.0; 3], false), 1, 2),
    ]
}

/// Returns the largest differences between a file and a mesh along any axis: of positions (in steps) and of normals.
fn worst(found: &Contents, mesh: &Mesh, step: Step) -> (f64, f64) {
    assert_eq!((found.positions.len(), found.normals.len()), (mesh.n_vertices(), mesh.n_vertices()));
    let most = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        let pairs = a.as_flattened().iter().zip(b.as_flattened());
        pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).fold(0.0, f64::max)
    };
    (most(&found.positions, &mesh.positions) / f64::from(step.length()), most(&found.normals, &mesh.normals))
}

#[test]
fn vertices_round_trip_within_half_a_step_and_other_columns_exactly() {
    for (name, mesh, ..) in cases() {
        let step = step(&mesh);
        let glb = split_glb(&quantized(Format::Glb, &mesh));
        let (text, bin) = split_gltf(&quantized(Format::Gltf, &mesh));
        assert!(bin == glb.bin[..bin.len()], "{name}: the same buffer");
        let full = split_glb(&packed(Format::Glb, Packing::Full, &mesh));
        let expected = gltf_contents(&full.json, &full.bin);
        for found in [gltf_contents(&glb.json, &glb.bin), gltf_contents(&text, &bin)] {
            let (positions, normals) = worst(&found, &mesh, step);
            assert!(positions <= 0.5 && normals <= 0.5 / 127.0 + 1e-4, "{name}: {positions} steps, {normals}");
            // Coordinates of curved surfaces are spread between two steps, so an inexact decoder fails.
            assert!(positions > 0.4 || mesh.n_vertices() < 300, "{name}: {positions}");
            assert_eq!(found.translation.map(f64::to_bits), mesh.centre.map(f64::to_bits), "{name}");
            let same = |c: &Contents| (c.triangles.clone(), c.atoms.clone(), c.colors.clone());
            assert!(same(&found) == same(&expected), "{name}");
        }
        // Control: a vertex moved by two steps, and a normal with a different direction.
        let mut moved = glb.bin.clone();
        let attributes = &glb.json["meshes"][0]["primitives"][0]["attributes"];
        let at = accessor_offset(&glb.json, &attributes["POSITION"]) + 8 * 7 + 4;
        let z = i16::from_le_bytes([moved[at], moved[at + 1]]);
        moved[at..at + 2].copy_from_slice(&(z + if z < 0 { 2 } else { -2 }).to_le_bytes());
        let at = accessor_offset(&glb.json, &attributes["NORMAL"]) + 4 * 7;
        moved[at] = moved[at].wrapping_add(if moved[at].cast_signed() < 0 { 2 } else { 254 });
        let (positions, normals) = worst(&gltf_contents(&glb.json, &moved), &mesh, step);
        assert!(positions >= 1.5 && normals > 1.4 / 127.0, "{name}: {positions}, {normals}");
    }
}

#[test]
fn the_document_declares_the_quantization() {
    for (name, mesh, ..) in cases() {
        let Glb { json, bin, .. } = split_glb(&quantized(Format::Glb, &mesh));
        let length = step(&mesh).length();
        assert_eq!(json["asset"]["extras"]["quantization"], json!({ "step": length }), "{name}");
        assert_eq!(json["nodes"][0]["scale"], json!([length, length, length]), "{name}");
        assert_eq!(length.to_bits() & 0x007f_ffff, 0, "{name}: {length} is a power of two");
        let position = accessor_of(&json, &json["meshes"][0]["primitives"][0]["attributes"]["POSITION"]);
        let rows: Vec<[i64; 3]> = gltf_contents(&json, &bin)
            .positions
            .iter()
            .map(|p| {
                p.map(|v| {
                    #[expect(clippy::cast_possible_truncation, reason = "16-bit integer")]
                    let q = (v / length) as i64;
                    q
                })
            })
            .collect();
        for axis in 0..3 {
            let values = || rows.iter().map(|row| row[axis]);
            let bounds = [values().min(), values().max()];
            assert_eq!([&position["min"], &position["max"]].map(|b| b[axis].as_i64()), bounds, "{name}");
        }
        // Not quantized by default.
        let full = split_glb(&packed(Format::Glb, Packing::Full, &mesh)).json;
        let absent =
            [full.get("extensionsUsed"), full["nodes"][0].get("scale"), full["asset"]["extras"].get("quantization")];
        assert_eq!(absent, [None; 3]);
    }
}

/// Returns the mesh with vertices rounded to integers.
fn rounded(mesh: &Mesh) -> Mesh {
    let mut rounded = mesh.clone();
    assert!(rounded.quantize(step(mesh)));
    rounded
}

#[test]
fn integer_vertices_are_written_unchanged() {
    for (name, mesh, ..) in cases() {
        let small = rounded(&mesh);
        for format in [Format::Glb, Format::Gltf] {
            let expected = quantized(format, &mesh);
            assert!(packed(format, Packing::Quantized(step(&mesh)), &small) == expected, "{name} {format}");
            // The integers are detected from the mesh.
            assert!(encoded(format, &small, &meta()) == expected, "{name} {format}");
        }
        if mesh.colors.is_none() && mesh.atom_ids.is_none() {
            for n_parts in [1, 3] {
                let placed = placed(Packing::Quantized(step(&mesh)), &small, n_parts).unwrap();
                assert!(placed == quantized(Format::Glb, &mesh), "{name} in {n_parts}");
            }
        }
        let mut moved = small.clone();
        moved.quantized.as_mut().unwrap().positions[7 % mesh.n_vertices()][1] ^= 1;
        assert!(quantized_as(&moved, &mesh) != quantized(Format::Glb, &mesh), "{name}: one moved vertex");
    }
}

/// Returns the GLB of an integer mesh with the step of the original mesh.
fn quantized_as(small: &Mesh, mesh: &Mesh) -> Vec<u8> {
    packed(Format::Glb, Packing::Quantized(step(mesh)), small)
}

#[test]
fn integer_vertices_are_neither_rounded_nor_widened() {
    let mesh = icosphere(2, 10.0, [0.0; 3], false);
    let small = rounded(&mesh);
    let own = FormatError::AlreadyQuantized { step: step(&mesh).length() };
    let other = Packing::Quantized(Step::covering(40.0));
    for format in [Format::Glb, Format::Gltf] {
        for packing in [Packing::Full, other] {
            assert_eq!(Encoder::new(format, packing, &small, &meta()).unwrap_err(), own);
        }
    }
    for format in [Format::Ply, Format::Stl, Format::Obj] {
        let refusal = FormatError::QuantizationNotSupported { format: format.name() };
        assert_eq!(Encoder::new(format, Packing::of(&small), &small, &meta()).unwrap_err(), refusal);
        assert_eq!(Encoder::new(format, Packing::Full, &small, &meta()).unwrap_err(), own);
    }
    for packing in [Packing::Full, other] {
        let file = MemoryFile::default();
        let sink = GlbSink::new(&file);
        sink.set_storage(packing);
        write_parts(&sink, &small, 1);
        assert!(matches!(sink.failure(), Some(GlbSinkError::Format(FormatError::AlreadyQuantized { .. }))));
    }
    assert!(Encoder::new(Format::Glb, Packing::of(&small), &small, &meta()).is_ok());
}

#[test]
fn integers_out_of_range_and_nan_are_rejected() {
    let mesh = icosphere(2, 10.0, [0.0; 3], false);
    let sizes = [f32::NAN, f32::INFINITY, 40.0, -40.0];
    for (row, bad) in sizes.into_iter().enumerate() {
        let mut broken = mesh.clone();
        broken.positions[20 * row][row % 3] = bad;
        assert!(broken.quantize(step(&mesh)));
        let packing = Packing::of(&broken);
        for format in [Format::Glb, Format::Gltf] {
            let refusal = Encoder::new(format, packing, &broken, &meta()).unwrap_err();
            assert!(matches!(refusal, FormatError::OutOfQuantizationRange { .. }), "{bad}: {refusal}");
        }
        let refusal = placed(packing, &broken, 2);
        assert!(
            matches!(refusal, Err(GlbSinkError::Format(FormatError::OutOfQuantizationRange { .. }))),
            "{bad}: {refusal:?}"
        );
    }
}

#[test]
fn quantized_vertices_take_half_the_bytes() {
    let mesh = torus(300, 300);
    let [full, small] = [Packing::Full, Packing::Quantized(step(&mesh))].map(|p| packed(Format::Glb, p, &mesh).len());
    assert_eq!(full - small, 12 * mesh.n_vertices(), "the buffers begin at the same offset");
    assert_eq!(small, 16_384 + 12 * mesh.n_vertices() + 12 * mesh.n_triangles());
}

#[test]
fn an_empty_mesh_needs_no_extension() {
    let packing = Packing::Quantized(Step::covering(10.0));
    let json = split_glb(&packed(Format::Glb, packing, &Mesh::default())).json;
    assert_eq!((json.get("extensionsUsed"), json["nodes"][0].get("scale")), (None, None));
}

#[test]
fn vertices_out_of_range_and_other_formats_are_rejected() {
    let mesh = icosphere(2, 10.0, [0.0; 3], false);
    let small = Packing::Quantized(Step::covering(9.0 / 2.0));
    for format in [Format::Glb, Format::Gltf] {
        let refusal = Encoder::new(format, small, &mesh, &meta()).unwrap_err();
        assert!(matches!(refusal, FormatError::OutOfQuantizationRange { .. }), "{refusal}");
    }
    for format in [Format::Ply, Format::Stl, Format::Obj] {
        let refusal = Encoder::new(format, Packing::Quantized(step(&mesh)), &mesh, &meta()).unwrap_err();
        assert_eq!(refusal, FormatError::QuantizationNotSupported { format: format.name() });
        assert!(Encoder::new(format, Packing::Full, &mesh, &meta()).is_ok());
    }
    assert!(matches!(placed(small, &mesh, 2), Err(GlbSinkError::Format(FormatError::OutOfQuantizationRange { .. }))));
}

/// Returns the GLB of a mesh that is written out of order.
fn placed(packing: Packing, mesh: &Mesh, n_parts: usize) -> Result<Vec<u8>, GlbSinkError> {
    let file = MemoryFile::default();
    let sink = GlbSink::new(&file);
    sink.set_storage(packing);
    write_parts(&sink, mesh, n_parts);
    let len = sink.finish(&meta(), mesh.centre, mesh.bounds()).map_err(|SinkFailed| sink.failure().unwrap())?;
    drop(sink);
    let bytes = file.into_bytes();
    assert_eq!(len, bytes.len() as u64);
    Ok(bytes)
}

#[test]
fn a_glb_written_out_of_order_has_the_same_bytes() {
    let mut large = 0;
    for (name, mesh, ..) in cases() {
        if mesh.colors.is_some() || mesh.atom_ids.is_some() {
            continue;
        }
        let in_order = quantized(Format::Glb, &mesh);
        large += usize::from(in_order.len() > 1 << 20);
        for n_parts in [1, 3] {
            let placed = placed(Packing::Quantized(step(&mesh)), &mesh, n_parts).unwrap();
            assert!(placed == in_order, "{name} in {n_parts}");
        }
        assert!(placed(Packing::Full, &mesh, 3).unwrap() != in_order, "{name}: the sink does not pack by default");
    }
    assert!(large > 0, "no large buffer");
}

#[test]
fn the_gltf_validator_accepts_written_files() {
    let (mut files, mut expected) = (Files::new(), Vec::new());
    let meshes = cases().into_iter().map(|(name, mesh, ..)| (name, mesh));
    for (name, mesh) in meshes.chain([("triangle", triangle())]) {
        for format in [Format::Glb, Format::Gltf] {
            files.add(&format!("{name}.{format}"), &quantized(format, &mesh));
            expected.push((mesh.n_vertices() as u64, mesh.n_triangles() as u64));
        }
    }
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    for (report, expected) in reports.iter().zip(expected) {
        report.assert_clean();
        assert_eq!((report.infos, report.hints), (0, 0), "{report:#?}");
        assert_eq!((report.vertices, report.triangles), expected, "{report:#?}");
    }
}

#[test]
fn the_gltf_validator_detects_faults() {
    let good = quantized(Format::Glb, &torus(15, 17));
    let glb = split_glb(&good);
    let attributes = &glb.json["meshes"][0]["primitives"][0]["attributes"];
    let [position, normal] =
        ["POSITION", "NORMAL"].map(|name| glb.bin_at + accessor_offset(&glb.json, &attributes[name]));
    let undeclared = String::from_utf8_lossy(&good[..glb.bin_at]).find("KHR_mesh_quantization").unwrap();
    let (mut files, mut expected) = (Files::new(), Vec::new());
    let mut broken = |name: &str, code: &'static str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = good.clone();
        change(&mut bytes);
        files.add(name, &bytes);
        expected.push(code);
    };
    broken("beyond-max.glb", "ACCESSOR_ELEMENT_OUT_OF_MAX_BOUND", &|b| b[position + 1] = 0x7f);
    broken("normal.glb", "ACCESSOR_VECTOR3_NON_UNIT", &|b| b[normal..normal + 3].fill(30));
    broken("undeclared.glb", "MESH_PRIMITIVE_ATTRIBUTES_ACCESSOR_INVALID_FORMAT", &|b| {
        // Both members that name the extension.
        for at in
            [undeclared, undeclared + 1 + String::from_utf8_lossy(&b[undeclared + 1..glb.bin_at]).find("KHR_").unwrap()]
        {
            b[at] = b'X';
        }
    });
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    for (report, code) in reports.iter().zip(expected) {
        assert!(report.errors > 0 && report.codes.contains_key(code), "{code}: {report:#?}");
    }
}

#[test]
fn trimesh_measures_the_same_surface() {
    let (mut files, mut expected) = (Files::new(), Vec::new());
    for (name, mesh, bodies, euler) in cases() {
        for format in [Format::Glb, Format::Gltf] {
            files.add(&format!("{name}.{format}"), &quantized(format, &mesh));
            expected.push((mesh.clone(), bodies, euler));
        }
    }
    // Negative control: a distant vertex and a reversed normal.
    let mesh = icosphere(3, 10.0, [0.0; 3], false);
    let mut wrong = quantized(Format::Glb, &mesh);
    let glb = split_glb(&wrong);
    let attributes = &glb.json["meshes"][0]["primitives"][0]["attributes"];
    let [position, normal] =
        ["POSITION", "NORMAL"].map(|name| glb.bin_at + accessor_offset(&glb.json, &attributes[name]));
    wrong[position..position + 6].fill(0);
    (normal..normal + 3).for_each(|at| wrong[at] = wrong[at].wrapping_neg());
    files.add("wrong.glb", &wrong);
    let Some(mut reports) = tools::trimesh(&files.paths) else { return };
    let wrong = reports.pop().unwrap();
    for (report, (mesh, bodies, euler)) in reports.iter().zip(expected) {
        assert_eq!(report.error, None, "{report:#?}");
        assert!(report.watertight && report.winding_consistent && report.is_volume, "{report:#?}");
        let faults = [report.nan_count, report.duplicate_faces, report.degenerate_faces, report.bad_edges];
        assert_eq!(faults, [0; 4], "{report:#?}");
        let counts = (report.vertices, report.faces, report.bodies, report.euler);
        assert_eq!(counts, (mesh.n_vertices() as u64, mesh.n_triangles() as u64, bodies, euler), "{report:#?}");
        let (area, volume) = area_and_volume(&mesh);
        assert!((report.area / area - 1.0).abs() < 1e-4 && (report.volume / volume - 1.0).abs() < 1e-4, "{report:#?}");
        let half = 0.5 * f64::from(step(&mesh).length()) + 1e-9;
        for (found, bound) in report.bounds.iter().zip(mesh.bounds()) {
            let near = |k: usize| (found[k] - mesh.centre[k] - f64::from(bound[k])).abs() <= half;
            assert!((0..3).all(near), "{report:#?}");
        }
        assert!(report.max_normal_error.unwrap() < 0.006_74 && report.min_normal_dot.unwrap() > 0.9, "{report:#?}");
        let attributes: &[Value] = &report.attributes.iter().map(|a| Value::from(a.as_str())).collect::<Vec<_>>();
        assert_eq!(attributes == [json!("_ATOM")], mesh.atom_ids.is_some());
    }
    assert!(wrong.min_normal_dot.unwrap() < -0.9, "{wrong:#?}");
    let (area, _) = area_and_volume(&mesh);
    assert!((wrong.area / area - 1.0).abs() > 1e-3, "{wrong:#?}");
}
