//! Strict readers read written files back, bit by bit if the format allows it. Lengths are known in advance. Invalid
//! meshes are rejected before the first byte.

#![expect(clippy::cast_possible_truncation, reason = "meshes are single precision")]

use crate::tools;

use std::io::{self, ErrorKind, Write};

use molmesh::formats::{Encoder, Format, FormatError, GlbSink, GlbSinkError, Meta, Packing, RandomAccess};
use molmesh::surface::{Exceeded, Limit, Mesh, MeshPart, MeshSink, PartRange};
use proptest::prelude::*;
use serde_json::{Value, json};
use tools::files::{MemoryFile, encoded, write_parts};
use tools::readers::{
    Contents, accessor_of, gltf_contents, ply_header, read_face, read_obj, read_ply, read_ply_text, read_stl,
    read_vert, read_vtp, split_glb, split_gltf, u32_at,
};
use tools::shapes::{FAR, dressed, icosphere, sphere_with_cavity, torus, triangle, two_spheres, union};

fn meta() -> Meta {
    let Value::Object(extras) = json!({
        "atoms": 454, "kernel": "gaussian", "resolution": 0.5, "closed": true, "radii": "Bondi; 2.0 Å elsewhere",
        "component_list": [{"area": 1.5}], "units": "not ours",
    }) else {
        unreachable!()
    };
    Meta { name: Some("4PTI".into()), extras }
}

fn encode(format: Format, mesh: &Mesh, meta: &Meta) -> Vec<u8> {
    encoded(format, mesh, meta)
}

fn encoder(format: Format, mesh: &Mesh) -> Result<Encoder<'_>, FormatError> {
    Encoder::new(format, Packing::of(mesh), mesh, &meta())
}

/// Meshes of all kinds, including the limits of the index types.
fn cases() -> Vec<(&'static str, Mesh)> {
    let far = |mesh: Mesh| Mesh { centre: FAR, ..mesh };
    let coloured = Mesh { atom_ids: None, ..dressed(icosphere(2, 3.0, [0.0; 3], false), 0) };
    let mut glassy = coloured.clone();
    glassy.colors.as_mut().unwrap()[7][3] = 100;
    vec![
        ("empty", far(Mesh::default())),
        ("empty with columns", dressed(Mesh::default(), 0)),
        ("one triangle", triangle()),
        ("icosphere", far(icosphere(3, 10.0, [0.0; 3], false))),
        ("two spheres", far(two_spheres())),
        ("sphere with cavity", sphere_with_cavity()),
        ("255 vertices", torus(15, 17)),
        ("256 vertices", torus(16, 16)),
        ("257 vertices, dressed", far(dressed(torus(257, 3), 500))),
        ("65535 vertices", torus(255, 257)),
        ("65536 vertices, dressed", far(dressed(torus(256, 256), 65_535))),
        ("large atom indices", dressed(torus(31, 7), 16_777_216)),
        ("coloured", coloured),
        ("translucent", glassy),
    ]
}

/// Returns vertices in the coordinates of the file, rounded once.
fn absolute(mesh: &Mesh) -> Vec<[f32; 3]> {
    let add = |p: &[f32; 3]| std::array::from_fn(|k| (mesh.centre[k] + f64::from(p[k])) as f32);
    mesh.positions.iter().map(add).collect()
}

fn assert_gltf(name: &str, mesh: &Mesh, json: &Value, bin: &[u8]) {
    let found = gltf_contents(json, bin);
    let nothing = mesh.triangles.is_empty();
    let expected = Contents {
        translation: mesh.centre,
        positions: mesh.positions.to_vec(),
        normals: mesh.normals.to_vec(),
        triangles: mesh.triangles.to_vec(),
        atoms: mesh.atom_ids.as_deref().map(<[_]>::to_vec).filter(|_| !nothing),
        colors: found.colors.clone(),
    };
    assert!(found == expected, "{name}");
    assert_eq!(found.colors.is_some(), mesh.colors.is_some() && !nothing, "{name}");
    for (linear, srgb) in found.colors.iter().flatten().zip(mesh.colors.iter().flatten()) {
        assert_eq!(linear[3], 257 * u16::from(srgb[3]), "{name}");
        for (linear, srgb) in linear.iter().zip(&srgb[..3]) {
            let share = f64::from(*srgb) / 255.0;
            let expected = if share <= 0.040_45 { share / 12.92 } else { ((share + 0.055) / 1.055).powf(2.4) };
            assert!((f64::from(*linear) - 65_535.0 * expected).abs() <= 0.5, "{name}: {linear} for {srgb}");
        }
    }
    let asset = &json["asset"];
    assert_eq!(asset["version"], "2.0");
    assert_eq!(asset["generator"], "molmesh");
    assert_eq!((&asset["extras"]["units"], &asset["extras"]["unit_scale"]), (&json!("angstrom"), &json!(1.0)));
    assert_eq!((&asset["extras"]["atoms"], &asset["extras"]["kernel"]), (&json!(454), &json!("gaussian")));
    assert_eq!((&json["nodes"][0]["name"], &json["scene"]), (&json!("4PTI"), &json!(0)));
    if nothing {
        return;
    }
    assert_eq!(json["meshes"][0]["name"], "4PTI");
    let position = accessor_of(json, &json["meshes"][0]["primitives"][0]["attributes"]["POSITION"]);
    for (row, bound) in mesh.bounds().iter().zip(["min", "max"]) {
        // Converted through f32, because `serde_json` reads doubles to within one unit of the last place.
        let stored: Vec<f32> = position[bound].as_array().unwrap().iter().map(|v| v.as_f64().unwrap() as f32).collect();
        assert_eq!(stored, row, "{name}");
    }
    let material = &json["materials"][0];
    assert_eq!(
        (&material["doubleSided"], &material["pbrMetallicRoughness"]["metallicFactor"]),
        (&json!(false), &json!(0.0))
    );
    assert_eq!(material["alphaMode"], if name == "translucent" { "BLEND" } else { "OPAQUE" });
    let index_type = accessor_of(json, &json["meshes"][0]["primitives"][0]["indices"])["componentType"].as_u64();
    let smallest = match mesh.n_vertices() {
        ..=255 => 5121,
        256..=65_535 => 5123,
        _ => 5125,
    };
    assert_eq!(index_type, Some(smallest), "{name}");
}

#[test]
fn glb_and_gltf_round_trip_every_column() {
    for (name, mesh) in cases() {
        let glb = split_glb(&encode(Format::Glb, &mesh, &meta()));
        assert_gltf(name, &mesh, &glb.json, &glb.bin);
        let (json, bin) = split_gltf(&encode(Format::Gltf, &mesh, &meta()));
        assert_gltf(name, &mesh, &json, &bin);
        assert_eq!(bin, glb.bin[..bin.len()], "{name}: the same buffer");
    }
}

#[test]
fn atom_indices_are_16_bit_integers_or_exact_floats() {
    for (max_atom, component) in [(65_535, 5123), (65_536, 5126), (16_777_216, 5126)] {
        let glb = split_glb(&encode(Format::Glb, &dressed(torus(9, 5), max_atom), &meta()));
        let accessor = accessor_of(&glb.json, &glb.json["meshes"][0]["primitives"][0]["attributes"]["_ATOM"]);
        assert_eq!(accessor["componentType"], component, "{max_atom}");
    }
}

#[test]
fn ply_round_trips_every_column() {
    for (name, mesh) in cases() {
        let bytes = encode(Format::Ply, &mesh, &meta());
        let expected = Contents {
            translation: [0.0; 3],
            positions: absolute(&mesh),
            normals: mesh.normals.to_vec(),
            triangles: mesh.triangles.to_vec(),
            atoms: mesh.atom_ids.as_deref().map(<[_]>::to_vec),
            colors: mesh.colors.as_deref().map(|colors| colors.iter().map(|c| c.map(u16::from)).collect()),
        };
        assert!(read_ply(&bytes) == expected, "{name}");
        let (header, _) = ply_header(&bytes);
        for fact in ["comment units angstrom", "comment name 4PTI", "comment kernel gaussian", "comment atoms 454"] {
            assert!(header.iter().any(|line| line == fact), "{name}: {fact} in {header:#?}");
        }
    }
}

#[test]
fn stl_contains_corners_and_normals_of_all_triangles() {
    for (name, mesh) in cases() {
        let positions = absolute(&mesh);
        let records = read_stl(&encode(Format::Stl, &mesh, &meta()));
        assert_eq!(records.len(), mesh.n_triangles(), "{name}");
        for ([normal, corners @ ..], triangle) in records.iter().zip(&mesh.triangles) {
            assert_eq!(*corners, triangle.map(|v| positions[v as usize]), "{name}");
            let length = normal.iter().map(|v| v * v).sum::<f32>().sqrt();
            assert!((length - 1.0).abs() < 1e-6, "{name}: {normal:?}");
            // Face normals of these shapes point to the same side as the vertex normals at their corners.
            let at = mesh.normals[triangle[0] as usize];
            assert!((0..3).map(|k| at[k] * normal[k]).sum::<f32>() > 0.2, "{name}");
        }
    }
}

#[test]
fn text_formats_round_trip_coordinates_to_their_decimals() {
    for (name, mesh) in cases() {
        let found = read_obj(&encode(Format::Obj, &mesh, &meta()));
        assert_eq!(found.triangles[..], mesh.triangles[..], "{name}");
        let close = |found: &[[f32; 3]], expected: &[[f32; 3]]| {
            assert_eq!(found.len(), expected.len(), "{name}");
            for (f, e) in found.as_flattened().iter().zip(expected.as_flattened()) {
                // Half a unit of the last decimal, and rounding of 1000.25 to a float by the reader.
                assert!((f64::from(*f) - f64::from(*e)).abs() < 0.5e-4 + 3.1e-5, "{name}: {f} for {e}");
            }
        };
        close(&found.positions, &absolute(&mesh));
        close(&found.normals, &mesh.normals);
        let ply = read_ply_text(&encode(Format::PlyText, &mesh, &meta()));
        let binary = read_ply(&encode(Format::Ply, &mesh, &meta()));
        close(&ply.positions, &binary.positions);
        close(&ply.normals, &binary.normals);
        assert_eq!((&ply.triangles, &ply.colors), (&binary.triangles, &binary.colors), "{name}");
        assert_eq!(ply.atoms, binary.atoms, "{name}");
        let opaque = |[r, g, b, _]: &[u8; 4]| [*r, *g, *b, 255].map(u16::from);
        let colors = mesh.colors.as_deref().filter(|colors| !colors.is_empty());
        assert_eq!(found.colors, colors.map(|colors| colors.iter().map(opaque).collect::<Vec<_>>()), "{name}");
    }
}

#[test]
fn msms_files_hold_vertices_with_their_spheres_and_triangles() {
    for (name, mesh) in cases() {
        let vert = read_vert(&encode(Format::Vert, &mesh, &meta()));
        let text = read_ply_text(&encode(Format::PlyText, &mesh, &meta()));
        assert_eq!((&vert.positions, &vert.normals), (&text.positions, &text.normals), "{name}");
        // Spheres count from 1; 0 stands for none.
        let expected =
            mesh.atom_ids.as_ref().map_or(vec![0; mesh.n_vertices()], |ids| ids.iter().map(|i| i + 1).collect());
        assert_eq!(vert.atoms, Some(expected), "{name}");
        assert_eq!(read_face(&encode(Format::Face, &mesh, &meta())), mesh.triangles[..], "{name}");
        // The other orientation is the control.
        let mut turned = mesh.clone();
        turned.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        let same = read_face(&encode(Format::Face, &turned, &meta())) == mesh.triangles[..];
        assert_eq!(same, mesh.triangles.is_empty(), "{name}");
    }
}

#[test]
fn vtp_has_the_columns_of_ply_and_the_part_of_each_triangle() {
    for (name, mesh) in cases() {
        let (vtp, parts) = read_vtp(&encode(Format::Vtp, &mesh, &meta()));
        let ply = read_ply(&encode(Format::Ply, &mesh, &meta()));
        assert!(vtp == ply && parts.is_none(), "{name}");
    }
    let (first, second) = (icosphere(1, 3.0, [0.0; 3], false), icosphere(0, 1.0, [9.0, 0.0, 0.0], false));
    let mut mesh = union(&first, &second);
    let ranges = [
        (0..first.n_vertices(), 0..first.n_triangles()),
        (first.n_vertices()..mesh.n_vertices(), first.n_triangles()..mesh.n_triangles()),
    ];
    mesh.parts = ranges.map(|(vertices, triangles)| PartRange { vertices, triangles, ..PartRange::default() }).into();
    let (_, parts) = read_vtp(&encode(Format::Vtp, &mesh, &meta()));
    let expected = [vec![0; first.n_triangles()], vec![1; second.n_triangles()]].concat();
    assert_eq!(parts, Some(expected));
}

#[test]
fn lengths_are_known_before_writing() {
    for (name, mesh) in cases() {
        for format in Format::MESHES {
            let len = encode(format, &mesh, &meta()).len() as u64;
            let encoder = encoder(format, &mesh).unwrap();
            let (exact, bound) = (encoder.encoded_len(), encoder.encoded_len_bound());
            if matches!(format, Format::PlyText | Format::Obj | Format::Vert | Format::Face) {
                assert_eq!(exact, None);
                assert!(len <= bound && bound <= len + len / 2, "{name}: {len} bytes, bound {bound}");
            } else {
                assert_eq!((exact, bound), (Some(len), len), "{name} as {format}");
            }
        }
    }
}

#[test]
fn a_glb_written_out_of_order_has_the_same_bytes() {
    let plain = cases().into_iter().filter(|(_, mesh)| mesh.colors.is_none() && mesh.atom_ids.is_none());
    let mut large = 0;
    for (name, mesh) in plain {
        let in_order = encode(Format::Glb, &mesh, &meta());
        large += usize::from(in_order.len() > 1 << 20);
        for n_parts in [1, 3] {
            let file = MemoryFile(vec![0xee; in_order.len()].into());
            let sink = GlbSink::new(&file);
            write_parts(&sink, &mesh, n_parts);
            let len = sink.finish(&meta(), mesh.centre, mesh.bounds()).unwrap();
            drop(sink);
            let placed = file.into_bytes();
            assert_eq!(len, in_order.len() as u64, "{name}");
            assert!(placed == in_order, "{name} in {n_parts}");
        }
    }
    assert!(large > 0, "no large buffer");
}

/// File on a full disk.
struct Full;

impl RandomAccess for Full {
    fn write_all_at(&self, _: &[u8], _: u64) -> io::Result<()> {
        Err(ErrorKind::StorageFull.into())
    }
}

#[test]
fn oversized_headers_are_rejected_and_write_errors_are_kept() {
    let mesh = torus(255, 257);
    let file = MemoryFile::default();
    let sink = GlbSink::new(&file);
    write_parts(&sink, &mesh, 2);
    let mut long = meta();
    long.extras.insert("title".to_owned(), json!("x".repeat(20_000)));
    assert!(sink.finish(&long, mesh.centre, mesh.bounds()).is_err());
    assert!(matches!(sink.failure(), Some(GlbSinkError::HeadTooLong { bytes: 32_768 })));

    let sink = GlbSink::new(&Full);
    sink.begin(mesh.n_vertices(), mesh.n_triangles()).unwrap();
    assert!(sink.part(&MeshPart::whole(&mesh)).is_err());
    assert!(matches!(sink.failure(), Some(GlbSinkError::Io(e)) if e.kind() == ErrorKind::StorageFull));

    let sink = GlbSink::new(&Full);
    assert!(sink.begin(90_000_000, 180_000_000).is_err());
    assert!(matches!(sink.failure(), Some(GlbSinkError::Format(FormatError::Limit(_)))));
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    // More vertices and triangles than one task handles.
    let mesh = dressed(icosphere(7, 20.0, [0.0; 3], false), 100_000);
    for format in Format::MESHES {
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| encode(format, &mesh, &meta()))
        };
        let once = with(1);
        assert!(once == with(2) && once == with(7) && once == encode(format, &mesh, &meta()), "{format}");
    }
}

/// Writer that counts calls and fails after a number of bytes.
struct Meter {
    room: usize,
    calls: Vec<usize>,
}

impl Write for Meter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if bytes.len() > self.room {
            return Err(ErrorKind::StorageFull.into());
        }
        self.room -= bytes.len();
        self.calls.push(bytes.len());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn columns_are_written_whole_and_conversions_in_large_blocks() {
    let mesh = icosphere(7, 20.0, [0.0; 3], false);
    for format in Format::MESHES {
        let mut meter = Meter { room: usize::MAX, calls: Vec::new() };
        encoder(format, &mesh).unwrap().write(&mut meter).unwrap();
        let (total, largest) = (meter.calls.iter().sum::<usize>(), *meter.calls.iter().max().unwrap());
        if format == Format::Glb {
            assert!(
                meter.calls.contains(&(12 * mesh.n_vertices())) && meter.calls.contains(&(12 * mesh.n_triangles()))
            );
        } else {
            assert!(largest <= 1 << 20, "{format}: {largest} bytes at once");
            assert!(meter.calls.len() <= 8 + total / (400 << 10), "{format}: {:?}", meter.calls);
        }
    }
}

#[test]
fn a_full_disk_is_an_error_at_every_offset() {
    let mesh = dressed(torus(20, 20), 900);
    for format in Format::MESHES {
        let whole = encode(format, &mesh, &meta()).len();
        for room in [0, 10, 500, whole / 2, whole - 1] {
            let mut meter = Meter { room, calls: Vec::new() };
            let error = encoder(format, &mesh).unwrap().write(&mut meter).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::StorageFull, "{format} after {room} bytes");
        }
        encoder(format, &mesh).unwrap().write(&mut Meter { room: whole, calls: Vec::new() }).unwrap();
    }
}

#[test]
fn invalid_meshes_are_rejected_by_the_formats_that_rely_on_their_values() {
    let good = dressed(torus(4, 5), 9);
    let broken = |change: fn(&mut Mesh)| {
        let mut mesh = good.clone();
        change(&mut mesh);
        mesh
    };
    let (all, indexed) = (Format::MESHES, [Format::Glb, Format::Gltf, Format::Stl]);
    let cases: [(&str, &[Format], Mesh); 9] = [
        ("20 positions but 19 normals", &all, broken(|m| m.normals.edit().truncate(19))),
        ("20 positions but 0 normals", &all, broken(|m| m.normals.edit().clear())),
        ("20 positions but 21 atom_ids", &all, broken(|m| m.atom_ids.as_mut().unwrap().edit().push(3))),
        ("20 positions but 1 colors", &all, broken(|m| m.colors = Some(vec![[0; 4]].into()))),
        ("triangle 7 refers to vertex 20, but the mesh has 20", &indexed, broken(|m| m.triangles[7][1] = 20)),
        ("refers to vertex 4294967295", &indexed, broken(|m| m.triangles[0][0] = u32::MAX)),
        ("position 3 holds NaN", &all, broken(|m| m.positions[3][2] = f32::NAN)),
        (
            "normal 4 holds inf",
            &[Format::PlyText, Format::Obj, Format::Vert],
            broken(|m| m.normals[4][0] = f32::INFINITY),
        ),
        ("centre 1 holds inf", &all, broken(|m| m.centre[1] = f64::INFINITY)),
    ];
    for format in Format::MESHES {
        for (words, rejecting, mesh) in &cases {
            match encoder(format, mesh) {
                Ok(_) => assert!(!rejecting.contains(&format), "{format}: {words}"),
                Err(error) => {
                    assert!(rejecting.contains(&format) && error.to_string().contains(words), "{format}: {error}");
                }
            }
        }
    }
}

#[test]
fn only_gltf_rejects_atom_indices_beyond_exact_floats() {
    let mesh = dressed(torus(4, 5), 16_777_217);
    for format in Format::MESHES {
        let encoder = encoder(format, &mesh);
        match format {
            Format::Glb | Format::Gltf => {
                assert_eq!(encoder.unwrap_err(), Exceeded::new(Limit::AtomIndex, 16_777_216).error());
            }
            _ => assert!(encoder.is_ok()),
        }
    }
}

#[test]
fn vertices_without_triangles_give_an_empty_but_valid_gltf() {
    let mesh = Mesh { triangles: Vec::new().into(), ..torus(4, 5) };
    let glb = split_glb(&encode(Format::Glb, &mesh, &meta()));
    assert_eq!(gltf_contents(&glb.json, &glb.bin).positions.len(), 0);
    assert_eq!(read_ply(&encode(Format::Ply, &mesh, &meta())).positions.len(), 20);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Names and extras come from untrusted files and must be escaped.
    #[test]
    fn all_names_and_extras_are_escaped(name in "\\PC{0,40}|[ -~\r\n\t\"\\\\]{0,300}", key in ".{0,12}", text in ".{0,400}") {
        let mesh = triangle();
        let meta = Meta { name: Some(name.clone()), extras: [(key.clone(), Value::from(text.clone()))].into_iter().collect() };
        let glb = split_glb(&encode(Format::Glb, &mesh, &meta));
        prop_assert_eq!(glb.json["nodes"][0]["name"].as_str().unwrap_or(""), name);
        if !["units", "unit_scale", "centre"].contains(&key.as_str()) {
            prop_assert_eq!(glb.json["asset"]["extras"][&key].as_str().unwrap(), text);
        }
        let (json, bin) = split_gltf(&encode(Format::Gltf, &mesh, &meta));
        prop_assert_eq!(&gltf_contents(&json, &bin).positions[..], &mesh.positions[..]);
        prop_assert_eq!(&read_ply(&encode(Format::Ply, &mesh, &meta)).positions[..], &mesh.positions[..]);
        prop_assert_eq!(&read_obj(&encode(Format::Obj, &mesh, &meta)).positions[..], &mesh.positions[..]);
        let stl = encode(Format::Stl, &mesh, &meta);
        prop_assert_eq!((stl.len(), u32_at(&stl, 80), stl[..80].is_ascii()), (134, 1, true));
    }
}

#[test]
fn invalid_meshes_never_panic() {
    for n in [4, 300] {
        let mut far_index = torus(n, 300);
        far_index.triangles[1][1] = u32::MAX;
        let mut long_normal = torus(n, 300);
        long_normal.normals[1] = [f32::NAN, f32::MAX, f32::INFINITY];
        let mut not_finite = torus(n, 300);
        not_finite.positions[1][2] = f32::NAN;
        let mut short = torus(n, 300);
        short.normals.edit().pop();
        for format in Format::MESHES {
            let refused = |mesh: &Mesh| {
                let encoder = encoder(format, mesh);
                if let Ok(encoder) = &encoder {
                    encoder.write(&mut io::sink()).unwrap();
                }
                encoder.is_err()
            };
            let narrow = matches!(format, Format::Glb | Format::Gltf) && n == 4;
            assert_eq!(refused(&far_index), narrow || format == Format::Stl, "{format}");
            let of_text = matches!(format, Format::PlyText | Format::Obj | Format::Vert);
            assert_eq!(refused(&long_normal), of_text, "{format}");
            assert!(refused(&not_finite) && refused(&short), "{format}");
        }
    }
}
