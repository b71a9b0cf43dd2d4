//! Checks of written files by the Khronos glTF validator and trimesh. Each checker must also detect faults in broken
//! files.

use crate::tools;

use molmesh::formats::{Format, Meta};
use molmesh::surface::Mesh;
use tools::files::{FOR_TRIMESH, Files, encoded};
use tools::readers::{accessor_offset, ply_header, split_glb};
use tools::shapes::{
    FAR, area_and_volume, dressed, icosphere, sphere_with_cavity, torus, triangle, two_spheres, union,
};

/// Adds a mesh in a format to the files.
fn add(files: &mut Files, name: &str, format: Format, mesh: &Mesh) {
    // Two formats share an extension.
    files.add(&format!("{name}-{format}.{}", format.extension()), &encode(format, mesh));
}

fn encode(format: Format, mesh: &Mesh) -> Vec<u8> {
    let extras = [("kernel".to_owned(), "gaussian, 2.0 Å".into())].into_iter().collect();
    let meta = Meta { name: Some("a 名".into()), extras };
    encoded(format, mesh, &meta)
}

/// Closed surfaces with their number of bodies and Euler characteristic.
fn closed() -> Vec<(&'static str, Mesh, u64, i64)> {
    let far = |mesh: Mesh| Mesh { centre: FAR, ..mesh };
    let mut glassy = dressed(icosphere(2, 3.0, [0.0; 3], false), 99);
    glassy.colors.as_mut().unwrap()[5][3] = 40;
    vec![
        ("icosphere", far(icosphere(3, 10.0, [0.0; 3], false)), 1, 2),
        ("two-spheres", far(two_spheres()), 2, 4),
        ("cavity", far(sphere_with_cavity()), 2, 4),
        ("torus-255", torus(15, 17), 1, 0),
        ("torus-256", far(torus(16, 16)), 1, 0),
        ("torus-65535", far(torus(255, 257)), 1, 0),
        ("torus-65536-dressed", dressed(torus(256, 256), 65_535), 1, 0),
        ("dressed-float-atoms", far(dressed(torus(20, 30), 1_000_000)), 1, 0),
        ("glassy", glassy, 1, 2),
    ]
}

#[test]
fn the_gltf_validator_accepts_written_files() {
    let mut files = Files::new();
    let mut expected = Vec::new();
    let mut meshes: Vec<(&str, Mesh)> = closed().into_iter().map(|(name, mesh, ..)| (name, mesh)).collect();
    meshes.extend([("triangle", triangle()), ("large", icosphere(7, 20.0, [0.0; 3], false))]);
    for format in [Format::Glb, Format::Gltf] {
        for (name, mesh) in &meshes {
            add(&mut files, name, format, mesh);
            expected.push((mesh.n_vertices() as u64, mesh.n_triangles() as u64));
        }
        add(&mut files, "empty", format, &Mesh { centre: FAR, ..Mesh::default() });
        expected.push((0, 0));
    }
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    for (report, expected) in reports.iter().zip(expected) {
        report.assert_clean();
        // Accepted remarks: the unused node of an empty file, and the name of the custom attribute.
        assert_eq!((report.infos, report.hints), (u64::from(expected.0 == 0), 0), "{report:#?}");
        assert_eq!((report.vertices, report.triangles), expected, "{report:#?}");
    }
}

#[test]
fn the_gltf_validator_detects_faults() {
    let mesh = torus(15, 17); // 255 vertices, indices of one byte
    let good = encode(Format::Glb, &mesh);
    let glb = split_glb(&good);
    let primitive = &glb.json["meshes"][0]["primitives"][0];
    let position = glb.bin_at + accessor_offset(&glb.json, &primitive["attributes"]["POSITION"]);
    let normal = glb.bin_at + accessor_offset(&glb.json, &primitive["attributes"]["NORMAL"]);
    let index = glb.bin_at + accessor_offset(&glb.json, &primitive["indices"]);
    let mut files = Files::new();
    let mut expected: Vec<&[&str]> = Vec::new();
    let mut broken = |name: &str, codes: &'static [&'static str], change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = good.clone();
        change(&mut bytes);
        files.add(name, &bytes);
        expected.push(codes);
    };
    broken("nan.glb", &["ACCESSOR_INVALID_FLOAT"], &|b| b[position..position + 4].fill(0xff));
    broken("beyond-max.glb", &["ACCESSOR_MAX_MISMATCH", "ACCESSOR_ELEMENT_OUT_OF_MAX_BOUND"], &|b| {
        b[position + 3] = 0x42;
    });
    broken("normal.glb", &["ACCESSOR_VECTOR3_NON_UNIT"], &|b| b[normal + 3] = 0x42);
    broken("restart.glb", &["ACCESSOR_INDEX_PRIMITIVE_RESTART"], &|b| b[index] = 255);
    broken("version.glb", &["GLB_INVALID_VERSION"], &|b| b[4] = 3);
    broken("length.glb", &["GLB_LENGTH_MISMATCH", "GLB_UNEXPECTED_END_OF_CHUNK_DATA"], &|b| {
        b.truncate(b.len() - 4);
    });
    broken("json.glb", &["INVALID_JSON"], &|b| b[20] = b'[');
    let Some(reports) = tools::gltf_validate(&files.paths) else { return };
    for (report, codes) in reports.iter().zip(expected) {
        assert!(report.errors > 0, "{report:#?}");
        assert!(codes.iter().any(|code| report.codes.contains_key(*code)), "{codes:?}: {report:#?}");
    }
    let mut nonsense = Files::new();
    nonsense.add("nonsense.glb", b"HEADER    HYDROLASE");
    let report = &tools::gltf_validate(&nonsense.paths).unwrap()[0];
    assert!(report.error.is_some() || report.errors > 0, "{report:#?}");
}

#[test]
fn trimesh_measures_the_same_surface_in_every_format() {
    let mut files = Files::new();
    let mut expected = Vec::new();
    for (name, mesh, bodies, euler) in closed() {
        for format in FOR_TRIMESH {
            add(&mut files, name, format, &mesh);
            expected.push((format, mesh.clone(), bodies, euler));
        }
    }
    let Some(reports) = tools::trimesh(&files.paths) else { return };
    for (report, (format, mesh, bodies, euler)) in reports.iter().zip(expected) {
        report.assert_proper();
        let counts = (report.vertices, report.faces, report.bodies, report.euler);
        assert_eq!(counts, (mesh.n_vertices() as u64, mesh.n_triangles() as u64, bodies, euler), "{report:#?}");
        assert_eq!((report.welded, report.unused_vertices), (format == Format::Stl, 0));
        let (area, volume) = area_and_volume(&mesh);
        // Coordinates far from the origin are rounded to 6e-5 Å, in text to 5e-5 Å: a few parts in 1e5 of these shapes.
        assert!((report.area / area - 1.0).abs() < 5e-5, "{area}: {report:#?}");
        assert!((report.volume / volume - 1.0).abs() < 5e-5, "{volume}: {report:#?}");
        for (found, bound) in report.bounds.iter().zip(mesh.bounds()) {
            for k in 0..3 {
                let expected = mesh.centre[k] + f64::from(bound[k]);
                let exact = matches!(format, Format::Glb | Format::Gltf);
                let tolerance = if exact { 1e-12 } else { 1.2e-4 };
                assert!((found[k] - expected).abs() < tolerance, "{expected}: {report:#?}");
            }
        }
        let stl = format == Format::Stl;
        assert_eq!((report.max_normal_error.is_none(), report.min_face_normal_dot.is_some()), (stl, stl));
        assert!(report.max_normal_error.is_none_or(|e| e < if format.is_text() && format != Format::Gltf {
            1e-4
        } else {
            1e-6
        }));
        assert!(report.min_normal_dot.is_none_or(|d| d > 0.9), "{report:#?}");
        assert!(report.min_face_normal_dot.is_none_or(|d| d > 0.99), "{report:#?}");
        if matches!(format, Format::Glb | Format::Gltf) && mesh.atom_ids.is_some() {
            assert_eq!(report.attributes, ["_ATOM"]);
        }
    }
}

#[test]
fn vtk_reads_the_same_surface_colours_and_atoms() {
    let mut files = Files::new();
    let meshes: Vec<Mesh> = closed().into_iter().map(|(_, mesh, ..)| mesh).chain([triangle()]).collect();
    for (n, mesh) in meshes.iter().enumerate() {
        add(&mut files, &n.to_string(), Format::Vtp, mesh);
    }
    let good = encode(Format::Vtp, &meshes[0]);
    let cut = good.iter().position(|&b| b == b'_').unwrap();
    files.add("truncated.vtp", &good[..good.len() / 2]);
    files.add("broken.vtp", &good[..cut / 2]);
    let Some(reports) = tools::vtp(&files.paths) else { return };
    for (report, mesh) in reports.iter().zip(&meshes) {
        assert_eq!(report.error, None);
        assert_eq!((report.points, report.triangles), (mesh.n_vertices() as u64, mesh.n_triangles() as u64));
        assert!(report.normals);
        let colors = mesh.colors.as_ref().map(|colors| colors.to_vec());
        assert_eq!(report.scalars.as_deref(), colors.as_ref().map(|_| "RGBA"));
        assert_eq!((&report.colors, &report.atoms), (&colors, &mesh.atom_ids.as_ref().map(|ids| ids.to_vec())));
        let (area, volume) = area_and_volume(mesh);
        assert!((report.area / area - 1.0).abs() < 5e-5, "{area}: {}", report.area);
        let open = mesh.n_triangles() == 1;
        assert_eq!(report.bad_edges, if open { 3 } else { 0 });
        assert!(open || (report.volume / volume - 1.0).abs() < 5e-4, "{volume}: {}", report.volume);
        for (found, bound) in report.bounds.iter().zip(mesh.bounds()) {
            for k in 0..3 {
                assert!((found[k] - (mesh.centre[k] + f64::from(bound[k]))).abs() < 1.2e-4);
            }
        }
    }
    for broken in &reports[meshes.len()..] {
        assert!(broken.error.is_some() || broken.points != meshes[0].n_vertices() as u64, "{broken:?}");
    }
}

#[test]
fn trimesh_reads_empty_and_tiny_files() {
    let mut files = Files::new();
    for format in FOR_TRIMESH {
        add(&mut files, "triangle", format, &triangle());
    }
    for format in [Format::Glb, Format::Gltf, Format::Stl] {
        add(&mut files, "empty", format, &Mesh::default());
    }
    let Some(reports) = tools::trimesh(&files.paths) else { return };
    for (report, path) in reports.iter().zip(&files.paths) {
        assert_eq!(report.error, None, "{report:#?}");
        let tiny = path.file_stem().unwrap().to_string_lossy().starts_with("triangle-");
        assert_eq!((report.empty, report.faces), (!tiny, u64::from(tiny)), "{report:#?}");
        if tiny {
            assert!(!report.watertight && report.bad_edges == 3 && (report.area - 1.0).abs() < 1e-6, "{report:#?}");
        }
    }
}

/// Name of a fault, its cause, and the expected result of trimesh.
type Fault = (&'static str, fn(&mut Mesh), fn(&tools::TrimeshReport) -> bool);

const FAULTS: [Fault; 9] = [
    ("flipped triangle", |m| m.triangles[7].swap(0, 1), |r| !r.winding_consistent && !r.is_volume),
    (
        "missing triangle",
        |m| m.triangles = m.triangles[1..].iter().copied().collect(),
        |r| !r.watertight && r.bad_edges == 3,
    ),
    ("triangle twice", |m| m.triangles.edit().extend_from_within(7..8), |r| r.duplicate_faces == 1 && r.bad_edges == 3),
    ("pinched triangle", |m| m.triangles[7][1] = m.triangles[7][0], |r| r.degenerate_faces == 1 && !r.watertight),
    ("inside out", |m| m.triangles.iter_mut().for_each(|t| t.swap(0, 1)), |r| r.volume < 0.0 && !r.is_volume),
    ("loose vertex", |m| *m = with_loose_vertex(m), |r| r.unused_vertices == 1 && r.euler == 2),
    ("inward normal", |m| m.normals[3] = m.normals[3].map(|v| -v), |r| r.min_normal_dot.unwrap() < -0.9),
    ("short normal", |m| m.normals[3] = m.normals[3].map(|v| 0.9 * v), |r| r.max_normal_error.unwrap() > 0.09),
    ("second body", |m| *m = union(m, &icosphere(0, 1.0, [9.0, 0.0, 0.0], false)), |r| r.bodies == 2 && r.euler == 4),
];

fn with_loose_vertex(mesh: &Mesh) -> Mesh {
    let mut mesh = mesh.clone();
    mesh.positions.edit().push([0.5; 3]);
    mesh.normals.edit().push([0.0, 0.0, 1.0]);
    mesh
}

#[test]
fn trimesh_detects_faults() {
    let mut files = Files::new();
    for (name, break_it, _) in FAULTS {
        let mut mesh = icosphere(2, 4.0, [0.0; 3], false);
        break_it(&mut mesh);
        for format in [Format::Glb, Format::Ply] {
            add(&mut files, name, format, &mesh);
        }
    }
    let Some(reports) = tools::trimesh(&files.paths) else { return };
    for (reports, (name, _, seen)) in reports.chunks(2).zip(FAULTS) {
        for report in reports {
            assert_eq!(report.error, None);
            assert!(seen(report), "{name}: {report:#?}");
        }
    }
    // `assert_proper` must reject every fault of the surface itself.
    for report in reports.chunks(2).take(5).flatten() {
        assert!(std::panic::catch_unwind(|| report.assert_proper()).is_err(), "{report:#?}");
    }
}

#[test]
fn trimesh_detects_corrupted_bytes() {
    let mesh = icosphere(2, 4.0, [0.0; 3], false);
    let mut files = Files::new();
    let mut ply = encode(Format::Ply, &mesh);
    let (_, data) = ply_header(&ply);
    ply[data + 24..data + 28].fill(0xff);
    files.add("nan.ply", &ply);
    let mut stl = encode(Format::Stl, &mesh);
    stl[84 + 11] ^= 0x80; // sign of z of the first normal
    stl[84 + 50 + 12 + 3] ^= 0x01; // exponent of x of a corner
    files.add("bits.stl", &stl);
    files.add("short.stl", &stl[..stl.len() - 25]);
    let glb = encode(Format::Glb, &mesh);
    files.add("short.glb", &glb[..glb.len() / 2]);
    files.add("nonsense.obj", b"f 1//1 2//2 3//3\n");
    let Some(reports) = tools::trimesh(&files.paths) else { return };
    let [nan, bits, short_stl, short_glb, nonsense] = &reports[..] else { panic!("{reports:#?}") };
    assert_eq!((&nan.error, nan.nan_count), (&None, 1), "{nan:#?}");
    assert!(bits.min_face_normal_dot.unwrap() < 0.9 && !bits.watertight, "{bits:#?}");
    for broken in [short_stl, short_glb, nonsense] {
        assert!(broken.error.is_some() || broken.empty, "{broken:#?}");
    }
}
