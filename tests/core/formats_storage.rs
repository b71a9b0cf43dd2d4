//! Files without normals and in other units: only normals are omitted and only coordinates are scaled. The Khronos
//! validator and trimesh read the files. Each comparison has a negative control.

use crate::tools;

use molmesh::formats::{Encoder, Format, FormatError, GlbSink, Meta, Normals, Packing, Step, Storage, Units};
use molmesh::surface::Mesh;
use serde_json::{Value, json};
use tools::files::{FOR_TRIMESH, Files, MemoryFile, write_parts};
use tools::readers::{
    Contents, gltf_contents, read_face, read_obj, read_ply, read_ply_text, read_stl, read_vert, read_vtp, split_glb,
    split_gltf,
};
use tools::shapes::{FAR, area_and_volume, dressed, icosphere, torus, triangle, two_spheres};

fn meta() -> Meta {
    Meta { name: Some("4PTI".into()), extras: [("kernel".to_owned(), "gaussian".into())].into_iter().collect() }
}

/// Returns all ways in which a format can store a mesh within 32 Å of its centre.
fn ways(format: Format) -> Vec<Storage> {
    let packings = [Packing::Full, Packing::Quantized(Step::covering(31.0))];
    let mut ways = Vec::new();
    for packing in packings.into_iter().filter(|p| *p == Packing::Full || format.holds_quantized()) {
        for normals in Normals::ALL {
            for units in Units::ALL.into_iter().filter(|u| format.holds_units(*u)) {
                ways.push(Storage { packing, normals, units });
            }
        }
    }
    ways
}

fn encode(format: Format, storage: Storage, mesh: &Mesh) -> Vec<u8> {
    let (encoder, mut bytes) = (Encoder::new(format, storage, mesh, &meta()).unwrap(), Vec::new());
    encoder.write(&mut bytes).unwrap();
    let len = bytes.len() as u64;
    assert!(encoder.encoded_len().is_none_or(|planned| planned == len), "{format} {storage:?}");
    let bound = encoder.encoded_len_bound();
    assert!(bound >= len && bound < 2 * len + 200, "{format} {storage:?}: {len} of {bound}");
    bytes
}

fn contents(format: Format, bytes: &[u8]) -> Contents {
    match format {
        Format::Glb => {
            let glb = split_glb(bytes);
            gltf_contents(&glb.json, &glb.bin)
        }
        Format::Gltf => {
            let (json, bin) = split_gltf(bytes);
            gltf_contents(&json, &bin)
        }
        Format::Ply => read_ply(bytes),
        Format::PlyText => read_ply_text(bytes),
        Format::Obj => read_obj(bytes),
        Format::Vtp => read_vtp(bytes).0,
        Format::Vert => read_vert(bytes),
        Format::Face => Contents { triangles: read_face(bytes), ..Contents::default() },
        Format::Stl => {
            let corners = read_stl(bytes).into_iter().flat_map(|[_, a, b, c]| [a, b, c]).collect();
            Contents { positions: corners, ..Contents::default() }
        }
        Format::Png => unreachable!("a picture has no vertices to read back"),
    }
}

fn cases() -> Vec<(&'static str, Mesh)> {
    let far = |mesh: Mesh| Mesh { centre: FAR, ..mesh };
    vec![
        ("icosphere", icosphere(3, 10.0, [0.0; 3], false)),
        ("two-spheres", far(two_spheres())),
        ("dressed", dressed(torus(20, 30), 600)),
        ("large", icosphere(7, 20.0, [0.0; 3], false)),
        ("triangle", triangle()),
    ]
}

#[test]
fn without_normals_all_other_columns_are_unchanged() {
    for (name, mesh) in cases() {
        for format in Format::MESHES {
            for bare in ways(format).into_iter().filter(|w| w.normals == Normals::None) {
                let smooth = Storage { normals: Normals::Smooth, ..bare };
                let [with, without] = [smooth, bare].map(|storage| encode(format, storage, &mesh));
                if matches!(format, Format::Stl | Format::Vert | Format::Face) {
                    assert!(with == without, "{name} {format}: its normals are part of the format");
                    continue;
                }
                let (mut expected, found) = (contents(format, &with), contents(format, &without));
                assert_eq!(expected.normals.len(), mesh.n_vertices(), "{name} {format}");
                assert!(expected != found, "{name} {format}: control: the comparison includes normals");
                expected.normals.clear();
                assert!(expected == found, "{name} {format} {bare:?}");
                assert!(without.len() < with.len() || bare.packing != Packing::Full, "{name} {format}");
            }
        }
    }
    // Savings per vertex: 12 bytes, in quantized files 4.
    let mesh = icosphere(7, 20.0, [0.0; 3], false);
    let n = mesh.n_vertices();
    for (packing, saved) in [(Packing::Full, 12), (Packing::Quantized(Step::covering(31.0)), 4)] {
        let [with, without] = Normals::ALL
            .map(|normals| encode(Format::Glb, Storage { packing, normals, ..Storage::default() }, &mesh).len());
        assert_eq!(with - without, saved * n, "savings per vertex");
    }
}

#[test]
fn units_scale_coordinates_and_nothing_else() {
    for (name, mesh) in cases() {
        for format in [Format::Ply, Format::PlyText, Format::Obj, Format::Stl, Format::Vtp] {
            let [plain, nano] = [Units::Angstrom, Units::Nanometer]
                .map(|units| contents(format, &encode(format, Storage { units, ..Storage::default() }, &mesh)));
            // The last decimal of text is 1e-4 Å; floats far from the origin have 6e-5 Å.
            let worst = |scale: f64| {
                let pairs = plain.positions.as_flattened().iter().zip(nano.positions.as_flattened());
                pairs.map(|(a, b)| (f64::from(*a) - scale * f64::from(*b)).abs()).fold(0.0, f64::max)
            };
            assert!(worst(10.0) < 2e-4, "{name} {format}: {}", worst(10.0));
            assert!(worst(10.01) > 2e-4, "{name} {format}: control: a wrong factor");
            assert!((&plain.normals, &plain.triangles) == (&nano.normals, &nano.triangles), "{name} {format}");
            assert!((&plain.atoms, &plain.colors) == (&nano.atoms, &nano.colors), "{name} {format}");
        }
        for storage in ways(Format::Glb) {
            let plain = Storage { units: Units::Angstrom, ..storage };
            let [expected, found] = [plain, storage].map(|s| split_glb(&encode(Format::Glb, s, &mesh)));
            assert!(expected.bin == found.bin, "{name}: the buffer stays in Å");
            let step = storage.packing.step().map_or(1.0, |step| f64::from(step.length()));
            let node = &found.json["nodes"][0];
            let numbers =
                |value: &Value| -> Vec<f64> { value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect() };
            let near = |found: &[f64], expected: [f64; 3]| {
                // `serde_json` may read the last bit inexactly.
                let off = |(a, b): (&f64, f64)| (a - b).abs() > 1e-15 * b.abs();
                assert!(!found.iter().zip(expected).any(off), "{name} {storage:?}: {found:?} {expected:?}");
            };
            let scale = node.get("scale").map_or(vec![1.0; 3], numbers);
            near(&scale, [step * storage.units.scale(); 3]);
            near(&numbers(&node["translation"]), mesh.centre.map(|v| v * storage.units.scale()));
            let extras = &found.json["asset"]["extras"];
            assert_eq!(extras["units"], storage.units.name());
            assert_eq!(extras["unit_scale"], storage.units.length());
            assert_eq!(extras["centre"], json!(mesh.centre));
        }
    }
}

#[test]
fn files_declare_their_units() {
    let mesh = icosphere(1, 3.0, [0.0; 3], false);
    for units in [Units::Angstrom, Units::Nanometer] {
        for format in [Format::Ply, Format::PlyText, Format::Stl, Format::Obj, Format::Vtp] {
            let bytes = encode(format, Storage { units, ..Storage::default() }, &mesh);
            let head = String::from_utf8_lossy(&bytes[..bytes.len().min(400)]).into_owned();
            let declaration = if format == Format::Stl { "units=" } else { "units " };
            assert!(head.contains(&format!("{declaration}{}", units.name())), "{format}: {head}");
        }
    }
}

#[test]
fn metres_require_a_format_with_a_node() {
    let mesh = triangle();
    let meters = Storage { units: Units::Meter, ..Storage::default() };
    for format in Format::MESHES {
        let refusal = Encoder::new(format, meters, &mesh, &meta()).err();
        let expected = FormatError::UnitsNotSupported { format: format.name(), units: "meter" };
        let node = matches!(format, Format::Glb | Format::Gltf);
        assert_eq!(refusal, (!node).then_some(expected), "{format}");
    }
}

#[test]
fn a_glb_written_out_of_order_has_the_same_bytes() {
    let mut large = 0;
    for (name, mesh) in cases().into_iter().filter(|(_, m)| m.colors.is_none() && m.atom_ids.is_none()) {
        for storage in ways(Format::Glb) {
            let in_order = encode(Format::Glb, storage, &mesh);
            large += usize::from(in_order.len() > 1 << 20);
            let place = |told: bool| {
                let file = MemoryFile(vec![0xee; in_order.len()].into());
                let sink = GlbSink::new(&file);
                if told {
                    sink.set_storage(storage);
                }
                write_parts(&sink, &mesh, 3);
                let len = sink.finish(&meta(), mesh.centre, mesh.bounds()).unwrap();
                drop(sink);
                file.into_bytes().into_iter().take(usize::try_from(len).unwrap()).collect::<Vec<_>>()
            };
            assert!(place(true) == in_order, "{name} {storage:?}");
            assert_eq!(place(false) == in_order, storage == Storage::default(), "{name} {storage:?}");
        }
    }
    assert!(large > 0, "no large buffer");
}

#[test]
fn the_gltf_validator_accepts_written_files() {
    let (mut files, mut expected) = (Files::new(), Vec::new());
    for (name, mesh) in cases() {
        for format in [Format::Glb, Format::Gltf] {
            for (n, storage) in ways(format).into_iter().enumerate() {
                files.add(&format!("{name}-{n}.{format}"), &encode(format, storage, &mesh));
                expected.push((mesh.n_vertices() as u64, mesh.n_triangles() as u64));
            }
        }
    }
    // Control: a missing accessor of normals.
    let mesh = icosphere(1, 3.0, [0.0; 3], false);
    let bare = Storage { normals: Normals::None, ..Storage::default() };
    let (mut document, bin) = split_gltf(&encode(Format::Gltf, bare, &mesh));
    document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = json!(0);
    assert!(!bin.is_empty());
    files.add("broken.gltf", document.to_string().as_bytes());
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    let (broken, good) = reports.split_last().unwrap();
    for (report, expected) in good.iter().zip(&expected) {
        report.assert_clean();
        assert_eq!((report.infos, report.hints), (0, 0), "{report:#?}");
        assert_eq!((report.vertices, report.triangles), *expected, "{report:#?}");
    }
    assert!(broken.errors > 0, "{broken:#?}");
}

#[test]
fn trimesh_reads_scaled_surfaces_with_and_without_normals() {
    let (mut files, mut expected) = (Files::new(), Vec::new());
    for (name, mesh) in cases().into_iter().filter(|(name, _)| *name != "triangle" && *name != "large") {
        for format in FOR_TRIMESH {
            // Trimesh drops triangles of 1e-20 m², so only the validator and the document check metres.
            for (n, storage) in ways(format).into_iter().enumerate().filter(|(_, w)| w.units != Units::Meter) {
                files.add(&format!("{name}-{n}-{format}.{}", format.extension()), &encode(format, storage, &mesh));
                expected.push((format, storage, mesh.clone()));
            }
        }
    }
    let Some(reports) = tools::trimesh(&files.paths) else { return };
    for (report, (format, storage, mesh)) in reports.iter().zip(expected) {
        let quantized = storage.packing != Packing::Full;
        // The length of 8-bit normals is exact to 0.68 %.
        let exact = report.max_normal_error.filter(|error| !quantized || *error > 0.0068);
        tools::TrimeshReport { max_normal_error: exact, ..report.clone() }.assert_proper();
        assert_eq!(
            (report.vertices, report.faces),
            (mesh.n_vertices() as u64, mesh.n_triangles() as u64),
            "{report:#?}"
        );
        let scale = storage.units.scale();
        let (area, volume) = area_and_volume(&mesh);
        let tolerance = if quantized { 1e-3 } else { 1e-4 };
        assert!((report.area / (area * scale * scale) - 1.0).abs() < tolerance, "{area}: {report:#?}");
        assert!((report.volume / (volume * scale.powi(3)) - 1.0).abs() < tolerance, "{volume}: {report:#?}");
        let off = |scale: f64| {
            let pairs = report.bounds.iter().zip(mesh.bounds());
            let worst = |(found, bound): (&[f64; 3], [f32; 3])| {
                (0..3).map(|k| (found[k] - scale * (mesh.centre[k] + f64::from(bound[k]))).abs()).fold(0.0, f64::max)
            };
            pairs.map(worst).fold(0.0, f64::max)
        };
        assert!(off(scale) < 6e-4 * scale, "{storage:?}: {report:#?}");
        // Control: bounds in the other unit differ clearly.
        let other = if storage.units == Units::Angstrom { Units::Nanometer } else { Units::Angstrom };
        assert!(off(other.scale()) > 0.1, "{report:#?}");
        let with = storage.normals == Normals::Smooth && format != Format::Stl;
        assert_eq!(report.max_normal_error.is_some(), with, "{storage:?}: {report:#?}");
        assert_eq!(report.min_face_normal_dot.is_some(), format == Format::Stl, "{report:#?}");
        assert!(report.min_normal_dot.is_none_or(|dot| dot > 0.9), "{report:#?}");
        assert!(report.min_face_normal_dot.is_none_or(|dot| dot > 0.99), "{report:#?}");
    }
}
