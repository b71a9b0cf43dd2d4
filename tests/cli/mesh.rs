//! Successful `molmesh mesh`: formats, stdin and stdout, reports, output files.

use crate::cli_support;

use std::fs;
use std::path::Path;

use cli_support::{Folder, assert_code, mesh, pdb, piped, rod, run, stderr, stdout};
use serde_json::Value;

/// Returns the first bytes of files of a format.
fn magic(format: &str) -> &'static [u8] {
    match format {
        "glb" => b"glTF",
        "gltf" => b"{",
        "ply" => b"ply\nformat binary_little_endian 1.0\n",
        "ply-text" => b"ply\nformat ascii 1.0\n",
        "stl" => b"molmesh",
        "obj" => b"#",
        "vtp" => b"<?xml version=\"1.0\"?>\n",
        "vert" | "face" => b"# molmesh ",
        other => panic!("no format {other}"),
    }
}

#[test]
fn extension_selects_the_format() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    for format in ["glb", "gltf", "ply", "stl", "obj", "vtp", "vert", "face"] {
        let output = folder.path(&format!("rod.{}", format.to_uppercase()));
        assert_code(&mesh(&input, &output, &[]), 0);
        let bytes = fs::read(&output).unwrap();
        assert!(bytes.starts_with(magic(format)), "{format}: {:?}", &bytes[..20]);
        assert!(bytes.len() > 1000, "{format}: {} bytes", bytes.len());
    }
}

#[test]
fn format_flag_overrides_the_extension() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let output = folder.path("rod.bin");
    assert_code(&mesh(&input, &output, &["--format", "ply"]), 0);
    assert!(fs::read(&output).unwrap().starts_with(magic("ply")));
    let output = folder.path("rod.ply");
    assert_code(&mesh(&input, &output, &["--format", "ply-text"]), 0);
    assert!(fs::read(&output).unwrap().starts_with(magic("ply-text")));
}

#[test]
fn stdout_gets_the_same_bytes_as_a_file() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let output = folder.path("rod.glb");
    assert_code(&mesh(&input, &output, &["--quiet"]), 0);
    let through = piped(&["mesh", "-", "-o", "-", "--quiet"], rod().as_bytes());
    assert_code(&through, 0);
    assert_eq!(through.stdout, fs::read(&output).unwrap());
    assert_eq!(stderr(&through), "");

    let ply = piped(&["mesh", "-", "-o", "-", "--format", "ply", "-q"], rod().as_bytes());
    assert!(ply.stdout.starts_with(magic("ply")));
}

/// A GLB file is written out of order while it is meshed; a GLB for a pipe is not.
#[test]
fn glb_is_the_same_in_a_file_and_in_a_pipe() {
    let folder = Folder::new();
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");
    // Vertices without a gradient, small and large buffers, 16-bit and 32-bit indices; then the longest possible
    // report.
    let long = folder.file("long.cif", long_report());
    let lone = folder.file("lone.xyz", "1\n\nC 0 0 0\n");
    for (input, resolution, radius_scale) in [
        (&*lone, "20", "0.4"),
        (Path::new(sample), "0.6", "1"),
        (Path::new(sample), "0.45", "1"),
        (Path::new(sample), "0.3", "1"),
        (&*long, "0.4", "1"),
    ] {
        let output = folder.path("out.glb");
        let args = ["--quiet", "--resolution", resolution, "--radius-scale", radius_scale];
        assert_code(&mesh(input, &output, &args), 0);
        let piped = run([&["mesh", input.to_str().unwrap(), "-o", "-"], &args[..]].concat());
        assert_code(&piped, 0);
        let file = fs::read(&output).unwrap();
        assert!(piped.stdout == file, "{resolution}: {} and {} bytes", piped.stdout.len(), file.len());
        let json_bytes = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
        let large = file.len() > 1 << 20;
        assert_eq!(json_bytes + 28 == 16_384, large, "{resolution}: {json_bytes} bytes of JSON");
        let text = file[20..20 + json_bytes].trim_ascii_end().len();
        assert!(input != long || (14_000..16_000).contains(&text), "{text}");
    }
}

/// The step is known before the mesh, so a file written out of order has the same bytes as one written in order.
#[test]
fn quantized_glb_is_the_same_in_a_file_and_in_a_pipe() {
    let folder = Folder::new();
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");
    let long = folder.file("long.cif", long_report());
    for (input, resolution) in [(Path::new(sample), "0.6"), (Path::new(sample), "0.3"), (&long, "0.3")] {
        let output = folder.path("out.glb");
        let flags = ["--quiet", "--resolution", resolution, "--compress", "quantize"];
        assert_code(&mesh(input, &output, &flags), 0);
        let piped = run(["mesh", input.to_str().unwrap(), "-o", "-"].iter().chain(&flags));
        assert_code(&piped, 0);
        let file = fs::read(&output).unwrap();
        assert!(piped.stdout == file, "{resolution}: {} and {} bytes", piped.stdout.len(), file.len());
        let full = folder.path("full.glb");
        assert_code(&mesh(input, &full, &flags[..3]), 0);
        let saved = fs::metadata(full).unwrap().len() - file.len() as u64;
        let json_bytes = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
        let document = json(std::str::from_utf8(&file[20..20 + json_bytes]).unwrap());
        let vertices = document["asset"]["extras"]["vertices"].as_u64().unwrap();
        // The headers differ by a few words at most.
        assert!(saved.abs_diff(12 * vertices) < 1000, "{saved} bytes saved on {vertices} vertices");
        assert_eq!(json_bytes + 28 == 16_384, file.len() > 1 << 20, "{resolution}: {json_bytes} bytes of JSON");
    }
    let done = mesh(Path::new(sample), &folder.path("out.gltf"), &["--compress", "quantize"]);
    assert!(stderr(&done).contains("quantized in steps of 0.0009765625 Å"), "{}", stderr(&done));
}

/// Levels of detail, units and normals are known before the mesh and allow writing out of order; a limit on triangles
/// does not.
#[test]
fn stored_forms_are_the_same_in_a_file_and_in_a_pipe() {
    let folder = Folder::new();
    let sample = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb"));
    let mut seen = Vec::new();
    for flags in [
        &["--detail", "3"][..],
        &["--detail", "4", "--normals", "none"],
        &["--detail", "5", "--units", "nanometer", "--compress", "quantize"],
        &["--units", "meter", "--normals", "none", "--compress", "quantize"],
        &["--max-triangles", "9000"],
        &["--compress", "meshopt"],
        &["--compress", "meshopt", "--max-triangles", "9000", "--atom-ids"],
    ] {
        let output = folder.path("out.glb");
        assert_code(&mesh(sample, &output, &[flags, &["--quiet"]].concat()), 0);
        let piped = run(["mesh", sample.to_str().unwrap(), "-o", "-", "--quiet"].iter().chain(flags));
        assert_code(&piped, 0);
        let file = fs::read(&output).unwrap();
        assert!(piped.stdout == file, "{flags:?}: {} and {} bytes", piped.stdout.len(), file.len());
        assert!(!seen.contains(&file), "{flags:?} does not change the file");
        seen.push(file);
    }
}

#[test]
fn level_or_triangle_limit_sets_the_spacing() {
    let folder = Folder::new();
    let sample = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb"));
    let output = folder.path("out.ply");
    let report = |flags: &[&str]| {
        let done = mesh(sample, &output, &[flags, &["--report", "json"]].concat());
        assert_code(&done, 0);
        json(&stdout(&done))
    };
    let bounded = report(&["--max-triangles", "5000"]);
    assert!(bounded["triangles"].as_u64().is_some_and(|n| (4500..=5000).contains(&n)), "{bounded}");
    assert_eq!((&bounded["resolution_from"], &bounded["max_triangles"]), (&"max_triangles".into(), &5000.into()));
    assert!(bounded["tries"].as_u64().is_some_and(|n| n >= 2), "{bounded}");
    let level = report(&["--detail", "1"]);
    assert_eq!((&level["resolution"], &level["detail"]), (&1.4.into(), &1.into()));
    let summary = stderr(&mesh(sample, &output, &["--detail", "1", "--units", "nanometer", "--normals", "none"]));
    assert!(summary.contains("1.4 Å (detail 1)") && summary.contains("in nanometers, without normals"), "{summary}");

    fs::remove_file(&output).unwrap();
    let refused = mesh(sample, &output, &["--max-triangles", "20"]);
    assert_code(&refused, 5);
    assert!(stderr(&refused).contains("hint: raise the limit with --max-triangles"), "{}", stderr(&refused));
    for flags in [
        &["--detail", "1", "--resolution", "1"][..],
        &["--detail", "1", "--max-triangles", "1000"],
        &["--max-triangles", "1000", "--resolution", "1"],
        &["--detail", "7"],
        &["--units", "meter"],
        &["--normals", "flat"],
    ] {
        assert_code(&mesh(sample, &output, flags), 2);
    }
    assert!(!output.exists(), "a rejected request leaves no file");
}

/// Returns a structure with more components than a report lists, and with the longest title.
fn long_report() -> String {
    let names = ["group_PDB", "id", "type_symbol", "label_atom_id", "label_comp_id", "label_asym_id", "label_seq_id"];
    let columns = names.into_iter().chain(["Cartn_x", "Cartn_y", "Cartn_z", "occupancy"]);
    let columns: Vec<String> = columns.map(|name| format!("_atom_site.{name}\n")).collect();
    let atom = |i: i32| format!("ATOM {i} C C1 ALA A 1 {} {} {} 1\n", i % 5 * 13, i / 5 % 5 * 13, i / 25 * 13);
    let (columns, atoms) = (columns.concat(), (0..125).map(atom).collect::<Vec<_>>().concat());
    let title = "\u{1f600}".repeat(1500);
    format!("data_{}\n_struct.title '{title}'\nloop_\n{columns}{atoms}", "L".repeat(200))
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|e| panic!("{e} in {text}"))
}

#[test]
fn json_report_has_its_fields() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let output = folder.path("rod.glb");
    let done = mesh(&input, &output, &["--report", "json"]);
    assert_code(&done, 0);
    assert_eq!(stderr(&done), "", "the report is on stdout");
    let report = json(&stdout(&done));
    for field in ["vertices", "triangles", "bricks", "grid_points"] {
        assert!(report[field].as_u64().unwrap() > 0, "{field}: {report}");
    }
    assert_eq!(report["atoms"], 10);
    assert_eq!([&report["closed"], &report["manifold"], &report["oriented"]], [&Value::Bool(true); 3]);
    assert_eq!((&report["euler"], &report["components"]), (&2.into(), &1.into()));
    assert_eq!((&report["surface"], &report["resolution"]), (&"gaussian".into(), &0.5.into()));
    // The start of a GPU would take longer than this job.
    assert_eq!(report["backend"], "cpu");
    assert_eq!(report["backend_reason"], "auto: a GPU is not expected to be faster");
    assert!(report["area"].as_f64().unwrap() > 100.0 && report["volume"].as_f64().unwrap() > 50.0, "{report}");
    for stage in ["read", "field", "emit", "measure", "encode", "write"] {
        assert!(report["timings_ms"][stage].as_f64().is_some_and(|ms| ms >= 0.0), "{stage}: {report}");
    }
    assert_eq!(report["output"]["format"], "glb");
    assert_eq!(report["output"]["file"], output.to_str().unwrap());
    assert_eq!(report["output"]["bytes"], fs::metadata(&output).unwrap().len());
}

#[test]
fn json_report_moves_to_stderr_if_the_mesh_is_on_stdout() {
    let done = piped(&["mesh", "-", "-o", "-", "--report", "json"], rod().as_bytes());
    assert_code(&done, 0);
    assert!(done.stdout.starts_with(magic("glb")));
    let report = json(&stderr(&done));
    assert_eq!(report["output"]["file"], "stdout");
    assert_eq!(report["output"]["bytes"], done.stdout.len());
}

#[test]
fn summary_fits_a_screen_and_has_no_colour_without_a_terminal() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let done = mesh(&input, &folder.path("rod.glb"), &[]);
    let text = stderr(&done);
    assert_eq!(stdout(&done), "");
    assert!(text.lines().count() <= 25, "{text}");
    assert!(!text.contains('\x1b'), "{text}");
    let expected = [
        "10 of 10",
        "bricks",
        "vertices",
        "watertight (by edge checksum), oriented, manifold by construction, Euler number 2",
        "1 component",
        "Å²",
        "Å³",
    ];
    for part in expected.iter().chain(&["cpu: ", "field", "encode", "rod.glb (glb, "]) {
        assert!(text.contains(part), "no `{part}` in\n{text}");
    }
}

#[test]
fn output_does_not_depend_on_the_number_of_threads() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let bytes = ["1", "2", "7"].map(|threads| {
        let output = folder.path(&format!("{threads}.glb"));
        assert_code(&mesh(&input, &output, &["--threads", threads, "--resolution", "0.3"]), 0);
        fs::read(output).unwrap()
    });
    assert_eq!(bytes[0], bytes[1]);
    assert_eq!(bytes[0], bytes[2]);
}

#[test]
fn reference_backend_has_the_same_topology() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let [cpu, reference] = ["cpu", "reference"].map(|backend| {
        let done = mesh(&input, &folder.path("x.glb"), &["--backend", backend, "--report", "json"]);
        assert_code(&done, 0);
        json(&stdout(&done))
    });
    assert_eq!((&cpu["backend"], &reference["backend"]), (&"cpu".into(), &"reference".into()));
    for field in ["vertices", "triangles", "euler", "components"] {
        assert_eq!(cpu[field], reference[field], "{field}");
    }
    assert_eq!(cpu["backend_reason"], "requested");
}

#[test]
fn parameters_reach_the_mesh() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let report = |flags: &[&str]| {
        let done = mesh(&input, &folder.path("x.glb"), &[flags, &["--report", "json"]].concat());
        assert_code(&done, 0);
        json(&stdout(&done))
    };
    assert_eq!(report(&["--surface", "soft-object"])["surface"], "soft-object");
    assert_eq!(report(&["--preset", "vdw-like"])["isovalue"], 1.06);
    let [fine, coarse] = ["0.25", "1"].map(|r| report(&["--resolution", r])["triangles"].as_u64().unwrap());
    assert!(fine > 10 * coarse, "{fine} {coarse}");
    let [plain, more] = ["0", "1.0"].map(|o| report(&["--radius-offset", o])["volume"].as_f64().unwrap());
    assert!(more > 1.5 * plain, "{plain} {more}");
    assert!(report(&["--radius-offset", "-0.2"])["volume"].as_f64().unwrap() < plain);
    let raw = ["--surface", "inverse-square", "--paper-c", "0.9", "--paper-b", "3", "--isovalue", "0.3"];
    assert_eq!(report(&raw)["surface"], "inverse-square");
}

#[test]
fn atom_ids_are_stored_on_request() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let output = folder.path("x.gltf");
    assert_code(&mesh(&input, &output, &[]), 0);
    assert!(!fs::read_to_string(&output).unwrap().contains("_ATOM"));
    assert_code(&mesh(&input, &output, &["--atom-ids"]), 0);
    assert!(fs::read_to_string(&output).unwrap().contains("_ATOM"));
}

#[test]
fn replaced_file_keeps_its_permissions() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let output = folder.file("rod.glb", "old");
    #[cfg(unix)]
    fs::set_permissions(&output, std::os::unix::fs::PermissionsExt::from_mode(0o640)).unwrap();
    assert_code(&mesh(&input, &output, &[]), 0);
    assert!(fs::read(&output).unwrap().starts_with(magic("glb")));
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        assert_eq!(fs::metadata(&output).unwrap().permissions().mode() & 0o777, 0o640);
    }
    assert_eq!(folder.entries(), ["rod.glb", "rod.pdb"]);
}

#[cfg(unix)]
#[test]
fn links_are_followed_and_devices_are_not_replaced() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let target = folder.file("target.glb", "old");
    let link = folder.path("link.glb");
    std::os::unix::fs::symlink(&target, &link).unwrap();
    assert_code(&mesh(&input, &link, &[]), 0);
    assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    assert!(fs::read(&target).unwrap().starts_with(magic("glb")));

    assert_code(&mesh(&input, std::path::Path::new("/dev/null"), &["--format", "glb"]), 0);
    assert!(!fs::metadata("/dev/null").unwrap().is_file());
}

#[test]
fn version_and_doctor_write_to_stdout() {
    let version = run(["version"]);
    assert_code(&version, 0);
    let gpu = if cfg!(feature = "gpu") { "" } else { " (without GPU support)" };
    assert_eq!(stdout(&version), format!("molmesh {}{gpu}\n", env!("CARGO_PKG_VERSION")));
    let doctor = cli_support::doctor(&[]);
    assert_code(&doctor, 0);
    let text = stdout(&doctor);
    for part in ["cpu", "reference", "gpu", "auto", "limits", "cores", "vectors"] {
        assert!(text.contains(part), "no `{part}` in\n{text}");
    }
}

#[test]
fn report_lists_at_most_100_voids() {
    // A lattice of atoms with a void in each of its 6³ cells: more than the report lists.
    let at = |i: usize| [i % 7, i / 7 % 7, i / 49].map(|c| 3.2 * f64::from(u32::try_from(c).unwrap()));
    let folder = Folder::new();
    let input = folder.file("lattice.pdb", pdb(&(0..343).map(at).collect::<Vec<_>>()));
    let done = mesh(&input, &folder.path("lattice.glb"), &["--report", "json", "--resolution", "0.3"]);
    assert_code(&done, 0);
    let report = json(&stdout(&done));
    assert!(report["voids"].as_u64().unwrap() > 100, "{}", report["voids"]);
    assert_eq!(report["void_list"].as_array().unwrap().len(), 100);
    for void in report["void_list"].as_array().unwrap() {
        assert!(void["volume"].as_f64().unwrap() > 0.0 && void["area"].as_f64().unwrap() > 0.0, "{void}");
        let center = void["center"].as_array().unwrap();
        assert!(center.iter().all(|c| (0.0..20.0).contains(&c.as_f64().unwrap())), "{void}");
    }
}

#[test]
fn hostile_titles_do_not_reach_the_terminal() {
    let folder = Folder::new();
    let title = "<img src=x onerror=alert(1)> \u{1b}[2J\u{1b}]0;owned\u{7}\u{9b}31m red";
    let row = "_atom_site.Cartn_x 1\n_atom_site.Cartn_y 2\n_atom_site.Cartn_z 3\n_atom_site.type_symbol C\n";
    let cif = folder.file("in.cif", format!("data_x\n_entry.id 1ABC\n_struct.title\n;{title}\n;\n{row}"));
    let old = folder.file("in.pdb", format!("TITLE     {title}\n{}", rod()));
    for input in [cif, old] {
        let text = mesh(&input, &folder.path("out.glb"), &[]);
        assert_code(&text, 0);
        let report = mesh(&input, &folder.path("out.glb"), &["--report", "json"]);
        assert_code(&report, 0);
        for shown in [stderr(&text), stdout(&report)] {
            assert!(shown.contains("<img src=x onerror=alert(1)>"), "the title is shown as it is: {shown}");
            assert!(!shown.chars().any(|c| c.is_control() && c != '\n'), "{shown:?}");
        }
    }
}

#[test]
fn the_table_of_atoms_has_the_row_of_every_index() {
    let folder = Folder::new();
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");
    let (output, table) = (folder.path("4pti.ply"), folder.path("4pti.csv"));
    let flags = ["--format", "ply-text", "--atom-ids", "--atoms", table.to_str().unwrap(), "--resolution", "1"];
    let done = mesh(Path::new(sample), &output, &flags);
    assert_code(&done, 0);
    assert!(stderr(&done).contains("4pti.csv (csv, "), "{}", stderr(&done));
    let rows: Vec<String> = fs::read_to_string(&table).unwrap().lines().map(str::to_owned).collect();
    assert_eq!(rows[0], "index,name,element,residue_name,residue_number,insertion_code,chain,model,kind");
    assert_eq!(rows[1], "0,N,N,ARG,1,,A,1,protein");
    let text = fs::read_to_string(&output).unwrap();
    let (header, records) = text.split_once("end_header\n").unwrap();
    assert!(header.contains("property uint atom"));
    let vertices = records.lines().filter(|line| line.split(' ').count() == 7);
    let ids: Vec<usize> = vertices.map(|line| line.rsplit(' ').next().unwrap().parse().unwrap()).collect();
    assert!(ids.len() > 1000 && ids.iter().all(|id| rows[id + 1].starts_with(&format!("{id},"))));
    assert!(ids.iter().all(|id| rows[id + 1].ends_with(",protein")), "water is not meshed");
}

#[test]
fn meshes_with_creases_state_how_much_of_the_area_they_lack() {
    let folder = Folder::new();
    let sample = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb"));
    for (surface, resolution, part) in
        [("sas", "0.5", Some(6.0)), ("vdw", "1", Some(16.0)), ("ses", "1", None), ("gaussian", "1", None)]
    {
        let flags = ["--surface", surface, "--resolution", resolution];
        let exact = if surface == "gaussian" { &[][..] } else { &["--exact"] };
        let output = folder.path("4pti.glb");
        let json_of = |more: &[&str]| {
            let done = mesh(sample, &output, &[&flags[..], more, &["--report", "json"]].concat());
            assert_code(&done, 0);
            json(&stdout(&done))
        };
        let (report, measured) = (json_of(&[]), json_of(exact));
        assert_eq!(report["area_deficit_percent"].as_f64(), part, "{surface}");
        assert!(exact.is_empty() || measured["area_deficit_percent"].is_null(), "{surface}");
        // It was measured with the default radii and probe, at spacings up to 2 Å, on whole meshes.
        let mut others = vec!["--radius-scale 0.5", "--radius-offset 0.1", "--simplify 0.1", "--resolution 2.5"];
        others.extend((surface == "sas").then_some("--probe 3"));
        for other in others.into_iter().filter(|_| part.is_some()) {
            let other: Vec<&str> = other.split(' ').collect();
            let surface = if other[0] == "--resolution" { &flags[..2] } else { &flags[..] };
            let done = mesh(sample, &output, &[surface, &other, &["--report", "json"]].concat());
            assert!(json(&stdout(&done))["area_deficit_percent"].is_null(), "{other:?}");
        }
        if let Some(part) = part {
            let [area, exact] = [&measured["area"], &measured["exact"]["area"]].map(|v| v.as_f64().unwrap());
            let found = 100.0 * (1.0 - area / exact);
            assert!(found < part && found > 0.2 * part, "{surface}: {found} {part}");
        }
        let text = stderr(&mesh(sample, &output, &flags));
        assert_eq!(text.contains("below the exact area; see --exact"), part.is_some(), "{text}");
    }
}

#[test]
fn the_advice_about_too_many_triangles_names_a_larger_error_only_where_it_helps() {
    let folder = Folder::new();
    let sample = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb"));
    for (error, helps) in [("0.1", true), ("0.5", false), ("1", false)] {
        let failed = mesh(sample, &folder.path("4pti.glb"), &["--simplify", error, "--max-triangles", "10"]);
        assert_code(&failed, 5);
        let text = stderr(&failed);
        assert_eq!(text.contains("a larger simplify"), helps, "{error}: {text}");
        assert!(text.contains("a coarser resolution"), "{error}: {text}");
    }
}

#[test]
fn the_table_of_atoms_and_the_mesh_are_written_together() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let files = || fs::read_dir(input.parent().unwrap()).unwrap().count();
    let path = |name: &str| folder.path(name).to_str().unwrap().to_owned();
    let output = folder.path("rod.glb");
    for (table, code) in [(path("rod.glb"), 2), (path("rod.pdb"), 2), (path("none/rod.csv"), 7)] {
        let failed = mesh(&input, &output, &["--atoms", &table]);
        assert_code(&failed, code);
        assert_eq!(files(), 1, "{table}");
    }
    assert_code(&mesh(&input, &output, &["--atoms", &path("rod.csv"), "--max-grid-points", "10"]), 5);
    assert_eq!(files(), 1, "a failed job leaves no file");
    assert_code(&run(["mesh", &path("rod.pdb"), "-o", "-", "--atoms", "-"]), 2);
    let table = run(["mesh", &path("rod.pdb"), "-o", &path("rod.glb"), "--atoms", "-", "--quiet"]);
    assert_code(&table, 0);
    assert!(stdout(&table).starts_with("index,name,"));
    let report =
        run(["mesh", &path("rod.pdb"), "-o", &path("rod.glb"), "--atoms", &path("rod.csv"), "--report", "json"]);
    assert_eq!(json(&stdout(&report))["atom_table"]["format"], "csv");
    assert_eq!(files(), 3);
}

#[test]
fn a_map_colours_the_mesh() {
    let folder = Folder::new();
    let sample = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb"));
    let [map, bad, output] = ["map.dx", "bad.dx", "out.ply"].map(|name| folder.path(name));
    let mut text = "object 1 class gridpositions counts 2 2 2\norigin -50 -50 -50\n".to_owned();
    text += "delta 120 0 0\ndelta 0 120 0\ndelta 0 0 120\n";
    text += "object 3 class array type double rank 0 items 8 data follows\n-1 -1 -1 -1\n1 1 1 1\n";
    fs::write(&map, &text).unwrap();
    fs::write(&bad, text.replace("\n1 1 1 1\n", "\n1 1 x 1\n")).unwrap();
    let [map, bad] = [map.to_str().unwrap(), bad.to_str().unwrap()];
    let with = |flags: &[&str]| mesh(sample, &output, &[&["--resolution", "1.5", "--report", "json"], flags].concat());
    let done = with(&["--color", "map", "--map", map, "--color-offset", "0.5"]);
    assert_code(&done, 0);
    let color = &json(&stdout(&done))["color"];
    assert_eq!((&color["map"]["format"], &color["map"]["offset"]), (&"dx".into(), &0.5.into()));
    assert_eq!((&color["map"]["vertices_outside"], &color["palette"]), (&0.into(), &"red-white-blue".into()));
    assert!(String::from_utf8_lossy(&fs::read(&output).unwrap()).contains("property uchar red"));
    for (flags, code, words) in [
        (&["--color", "map"][..], 2, "`--color map` needs `--map FILE`"),
        (&["--color", "chain", "--map", map], 2, "`--map` needs `--color map`"),
        (&["--color", "map", "--map", bad], 4, "bad.dx: the map cannot be read: line 8: found `x`"),
        (&["--color", "map", "--map", map, "--max-map-points", "7"], 5, "map.dx: the map has 8 points"),
        (&["--color", "map", "--map", "none.dx"], 3, "cannot read none.dx"),
        (&["--color-offset", "2"], 2, "no value without color=map"),
    ] {
        let done = with(flags);
        assert_code(&done, code);
        assert!(stderr(&done).contains(words), "{flags:?}: {}", stderr(&done));
    }
}

#[test]
fn patches_and_instances_are_described() {
    let folder = Folder::new();
    let input = std::path::Path::new("samples/4pti.pdb");
    let patch = mesh(input, &folder.path("patch.glb"), &["--context", "whole", "--select", "resi 10-20"]);
    assert_code(&patch, 0);
    let text = stderr(&patch);
    for part in ["open along the cut (by exact edge matching), oriented", "atoms; the mesh is cut out of the surface"] {
        assert!(text.contains(part), "no `{part}` in\n{text}");
    }
    assert!(!text.contains("volume") && !text.contains("watertight"), "{text}");
    let flags = ["--assembly", "1", "--instances", "--resolution", "1"];
    let repeated = mesh(input, &folder.path("repeated.glb"), &flags);
    assert_code(&repeated, 0);
    let text = stderr(&repeated);
    assert!(text.contains("1 of 1 distinct units, not joined; sums: 454 atoms"), "{text}");
    // Other formats, and requests without an assembly, are refused before any work.
    for (name, flags) in [("repeated.ply", &flags[..]), ("alone.glb", &flags[2..])] {
        let refused = mesh(input, &folder.path(name), flags);
        assert_code(&refused, 2);
        assert!(stderr(&refused).contains("parameter `instances`: `true` is not allowed"), "{}", stderr(&refused));
    }
    assert_eq!(folder.entries(), ["patch.glb", "repeated.glb"]);
}
