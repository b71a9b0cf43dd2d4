//! `molmesh tileset`: files, reports and errors.

use crate::cli_support;
use crate::tools;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use cli_support::{Folder, assert_code, molmesh, stderr, stdout};
use serde_json::Value;

/// Returns all files with an extension in a folder and its subfolders, relative to it.
fn files(folder: &Path, extension: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|other| other == extension) {
                found.push(path.strip_prefix(folder).unwrap().to_owned());
            }
        }
    }
    found.sort();
    found
}

/// Runs `molmesh tileset` on the sample.
fn tileset(output: &Path, more: &[&str]) -> Output {
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");
    molmesh().args(["tileset", sample, "-o"]).arg(output).args(more).output().unwrap()
}

/// Returns the JSON of a GLB.
fn json_of(glb: &[u8]) -> Value {
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&glb[20..20 + length]).unwrap()
}

#[test]
fn a_tileset_has_the_files_that_its_documents_list() {
    let folder = Folder::new();
    let output = folder.path("tiles");
    let made = tileset(&output, &["--resolution", "0.25", "--color", "element", "--report", "json"]);
    assert_code(&made, 0);
    let report: Value = serde_json::from_str(&stdout(&made)).unwrap();
    let levels = report["levels"].as_array().unwrap();
    assert_eq!(levels.last().unwrap()["spacing"], 0.25);
    let glbs = files(&output, "glb");
    let subtrees = files(&output, "subtree");
    let bytes: u64 = ["glb", "subtree", "json"]
        .iter()
        .flat_map(|kind| files(&output, kind))
        .map(|path| fs::metadata(output.join(path)).unwrap().len())
        .sum();
    assert_eq!(report["files"], glbs.len() + subtrees.len() + 1);
    assert_eq!(report["bytes"], bytes);
    assert_eq!(levels.iter().map(|level| level["tiles"].as_u64().unwrap()).sum::<u64>(), glbs.len() as u64);
    let paths: Vec<PathBuf> = glbs.iter().map(|path| output.join(path)).collect();
    for valid in tools::gltf_validate(&paths).unwrap_or_default() {
        valid.assert_clean();
    }
    let Some(walked) = tools::walk_tileset(&[output.join("tileset.json")]) else { return };
    let tools::WalkedTileset { error: None, tiles } = &walked[0] else { panic!("{:?}", walked[0].error) };
    let mut contents: Vec<PathBuf> = tiles.iter().filter_map(|tile| tile.content.as_ref().map(PathBuf::from)).collect();
    contents.sort();
    assert_eq!(contents, glbs);
    for tile in tiles {
        let Some(content) = &tile.content else { continue };
        assert!(content.starts_with(&format!("{}/", tile.level)), "{content}");
        // The axes of the tileset are x, -z and y of the mesh, whose centre is that of the tile.
        let json = json_of(&fs::read(output.join(content)).unwrap());
        let centre: Vec<f64> =
            json["nodes"][0]["translation"].as_array().unwrap().iter().filter_map(Value::as_f64).collect();
        let expected = [tile.bounds[0], tile.bounds[2], -tile.bounds[1]];
        assert!((0..3).all(|k| (centre[k] - expected[k]).abs() < 1e-4), "{content}: {centre:?} {expected:?}");
        let side = 64.0 * levels[tile.level]["spacing"].as_f64().unwrap();
        assert!((tile.bounds[3] - 0.5 * side).abs() < 1e-9, "{content}");
    }
}

/// Returns an assembly of two units, the sample at two placements and its first 300 atoms as chain B at a third one.
fn assembly() -> String {
    let placed = |serial: usize, shift: f64| {
        (1..4).map(move |k| {
            let row: [f64; 3] = std::array::from_fn(|i| f64::from(u8::from(i + 1 == k)));
            format!("REMARK 350   BIOMT{k} {serial:>3}{:>10.6}{:>10.6}{:>10.6}{shift:>15.5}\n", row[0], row[1], row[2])
        })
    };
    let mut text = "REMARK 350 BIOMOLECULE: 2\nREMARK 350 APPLY THE FOLLOWING TO CHAINS: A\n".to_owned();
    text.extend(placed(1, 0.0).chain(placed(2, 50.0)));
    text.push_str("REMARK 350 APPLY THE FOLLOWING TO CHAINS: B\n");
    text.extend(placed(3, -75.5));
    let sample = include_str!("../../samples/4pti.pdb");
    let atoms = || sample.lines().filter(|line| line.starts_with("ATOM"));
    text.extend(atoms().map(|line| format!("{line}\n")));
    text.push_str("HETATM 9001 NA    NA A 901     200.300 -81.700   3.100  1.00 20.00          NA\n");
    text.push_str("HETATM 9002 NA    NA A 902    -600.100  77.300  51.900  1.00 20.00          NA\n");
    text.extend(atoms().take(300).map(|line| format!("{}B{}\n", &line[..21], &line[22..])));
    text
}

#[test]
fn a_tileset_of_instances_repeats_the_tilesets_of_units() {
    let folder = Folder::new();
    let (input, output) = (folder.path("assembly.pdb"), folder.path("new/tiles"));
    fs::write(&input, assembly()).unwrap();
    let run = |more: &[&str]| {
        let all = ["--assembly", "2", "--instances", "--resolution", "0.5"];
        molmesh().arg("tileset").arg(&input).arg("-o").arg(&output).args(all).args(more).output().unwrap()
    };
    let made = run(&["--report", "json"]);
    assert_code(&made, 0);
    let report: Value = serde_json::from_str(&stdout(&made)).unwrap();
    let units = report["units"].as_array().unwrap();
    let facts = |name: &str| units.iter().map(|unit| unit[name].clone()).collect::<Vec<_>>();
    assert_eq!((facts("name"), facts("atoms")), (vec!["A".into(), "B".into()], vec![454.into(), 300.into()]));
    assert_eq!((facts("instances"), &report["levels"]), (vec![2.into(), 1.into()], &Value::Array(Vec::new())));
    let documents = files(&output, "json");
    assert_eq!(documents, ["tileset.json", "unit-1/tileset.json", "unit-2/tileset.json"].map(PathBuf::from));
    let glbs = files(&output, "glb");
    let root = json_of(&fs::read(output.join("0/0/0/0.glb")).unwrap());
    assert!(root["extensionsUsed"].as_array().unwrap().contains(&"EXT_mesh_gpu_instancing".into()));
    let all = [documents, glbs.clone(), files(&output, "subtree")].concat();
    assert_eq!(report["files"], all.len());
    let bytes: u64 = all.iter().map(|path| fs::metadata(output.join(path)).unwrap().len()).sum();
    assert_eq!(report["bytes"], bytes);
    // Every instance contains every tile of its unit.
    let Some(walked) = tools::walk_tileset(&[output.join("tileset.json")]) else { return };
    let tools::WalkedTileset { error: None, tiles } = &walked[0] else { panic!("{:?}", walked[0].error) };
    for (unit, instances) in [("unit-1", 2), ("unit-2", 1)] {
        let own: Vec<&PathBuf> = glbs.iter().filter(|path| path.starts_with(unit)).collect();
        assert!(own.len() > 2, "{own:?}");
        for path in own {
            let n = tiles.iter().filter(|tile| tile.content.as_ref().is_some_and(|content| path.ends_with(content)));
            assert!(n.count() >= instances, "{path:?}");
        }
    }
    let contents = tiles.iter().filter(|tile| tile.content.is_some()).count();
    let of_unit = |unit: &str| glbs.iter().filter(|path| path.starts_with(unit)).count();
    assert_eq!(contents, 2 * of_unit("unit-1") + of_unit("unit-2"));
    // The text names the units; a command that fails removes their folders.
    fs::remove_dir_all(&output).unwrap();
    let text = run(&[]);
    assert!(stderr(&text).contains("A: 454 atoms, 2 instances"), "{}", stderr(&text));
    fs::remove_dir_all(folder.path("new")).unwrap();
    assert_ne!(run(&["--max-grid-points", "100000"]).status.code(), Some(0));
    assert!(!folder.path("new").exists());
    // Two sodium ions far apart: no grid point of a coarse mesh lies in one of them.
    let ions = run(&["--select", "ion", "--report", "json"]);
    assert_code(&ions, 0);
    let report: Value = serde_json::from_str(&stdout(&ions)).unwrap();
    assert_eq!((&report["atoms"], &report["left_out"]["total"]), (&2.into(), &754.into()));
}

#[test]
fn a_command_that_fails_removes_its_files() {
    let folder = Folder::new();
    let output = folder.path("tiles");
    let empty = tileset(&output, &["--isovalue", "1000"]);
    assert_code(&empty, 2);
    assert!(stderr(&empty).contains("isovalue 1000"), "{}", stderr(&empty));
    assert!(!output.exists());
    // Some tiles exceed the limit.
    let too_small = tileset(&output, &["--max-grid-points", "600000", "--resolution", "0.25"]);
    assert_ne!(too_small.status.code(), Some(0));
    assert!(!output.exists(), "{}", stderr(&too_small));
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");
    assert_code(&molmesh().args(["tileset", sample, "-o", "-"]).output().unwrap(), 2);
    assert!(!Path::new("-").exists());
}

#[test]
fn a_folder_with_files_and_parameters_of_whole_meshes_are_rejected() {
    let folder = Folder::new();
    let output = folder.path("tiles");
    fs::create_dir(&output).unwrap();
    let other = output.join("notes.txt");
    fs::write(&other, "mine").unwrap();
    let full = tileset(&output, &[]);
    assert_code(&full, 2);
    assert!(stderr(&full).contains("is not empty"), "{}", stderr(&full));
    assert_eq!(fs::read_dir(&output).unwrap().count(), 1);
    fs::remove_file(other).unwrap();
    for more in [
        &["--split", "chain"][..],
        &["--cavities", "keep"],
        &["--simplify", "0.1"],
        &["--quality", "high"],
        &["--max-triangles", "1000"],
        &["--color", "depth"],
        &["--color", "element", "--color-blend", "smooth"],
        &["--validation", "exact"],
        &["--exact", "--surface", "ses"],
        &["--paper-b", "1", "--paper-a", "1"],
    ] {
        let refused = tileset(&output, more);
        assert_code(&refused, 2);
        assert!(stderr(&refused).contains("tile"), "{more:?}: {}", stderr(&refused));
        assert!(!output.join("tileset.json").exists());
    }
}

/// Returns the paths and contents of all files of a tileset.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let paths = ["glb", "subtree", "json"].into_iter().flat_map(|kind| files(folder, kind));
    paths.map(|path| (path.clone(), fs::read(folder.join(path)).unwrap())).collect()
}

/// Runs `molmesh tileset` on several files with an index on disk.
fn streamed(inputs: &[&Path], output: &Path, scratch: &Path, more: &[&str]) -> Output {
    molmesh()
        .arg("tileset")
        .args(inputs)
        .arg("-o")
        .arg(output)
        .arg("--scratch")
        .arg(scratch)
        .args(more)
        .output()
        .unwrap()
}

/// Includes a negative control: the files of another structure.
#[test]
fn an_index_on_disk_gives_the_same_files_and_is_removed() {
    let folder = Folder::new();
    let [scratch, memory, disk] = ["scratch", "memory", "disk"].map(|name| folder.path(name));
    fs::create_dir(&scratch).unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples");
    let more = ["--resolution", "0.5", "--color", "chain", "--atom-ids", "--report", "json"];
    let of_assembly = [&more[..], &["--assembly", "1"]].concat();
    let mut all = Vec::new();
    for (name, more) in [("4pti.pdb", &of_assembly[..]), ("1crn.cif", &of_assembly), ("1crn.cif", &more)] {
        let input = root.join(name);
        let made = molmesh().arg("tileset").arg(&input).arg("-o").arg(&memory).args(more).output().unwrap();
        assert_code(&made, 0);
        let streamed = streamed(&[&input], &disk, &scratch, more);
        assert_code(&streamed, 0);
        assert_eq!(stdout(&streamed), stdout(&made));
        assert!(contents(&disk) == contents(&memory), "{name}");
        assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0);
        all.push(contents(&memory));
        for folder in [&memory, &disk] {
            fs::remove_dir_all(folder).unwrap();
        }
    }
    assert!(all[0] != all[1]);
    // Two files are one structure.
    let text = fs::read_to_string(root.join("1crn.cif")).unwrap();
    let rows: Vec<&str> = text.lines().filter(|line| line.starts_with("ATOM")).collect();
    let (head, _) = text.split_once(rows[0]).unwrap();
    let file = |name: &str, rows: &[&str]| folder.file(name, format!("{head}{}\n", rows.join("\n")));
    let parts = [file("1.cif", &rows[..100]), file("2.cif", &rows[100..])];
    assert_code(&streamed(&[&parts[0], &parts[1]], &disk, &scratch, &more), 0);
    assert!(contents(&disk) == all[2]);
}

#[test]
fn files_and_parameters_that_cannot_be_streamed_are_rejected() {
    let folder = Folder::new();
    let (scratch, output) = (folder.path("scratch"), folder.path("tiles"));
    fs::create_dir(&scratch).unwrap();
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/4pti.pdb");
    let run = |more: &[&str]| streamed(&[&sample], &output, &scratch, more);
    for (more, expected) in [
        (&["--select", "polymer and within 5 of water"][..], "`select`"),
        (&["--assembly", "1", "--instances"], "`instances`"),
        (&["--detail", "3"], "`detail`"),
        (&["--color", "bfactor"], "`color_range`"),
        (&["--color", "plddt"], "`color`"),
        (&["--check"], "--check"),
    ] {
        let refused = run(more);
        assert_code(&refused, 2);
        let text = stderr(&refused);
        assert!(text.contains(expected) && text.contains("--scratch"), "{more:?}: {text}");
    }
    let several = streamed(&[&sample, &sample], &output, &scratch, &["--assembly", "1"]);
    assert_code(&several, 2);
    assert!(stderr(&several).contains("`assembly`"), "{}", stderr(&several));
    assert_code(&run(&["--assembly", "9"]), 4);
    assert_code(&run(&["--chains", "Q"]), 4);
    assert_code(&run(&["--max-atoms", "100"]), 5);
    assert_code(&run(&["--isovalue", "1000"]), 2);
    let missing = folder.path("missing.cif");
    let missing = streamed(&[&sample, &missing], &output, &scratch, &[]);
    assert_code(&missing, 3);
    assert!(stderr(&missing).contains("missing.cif"), "{}", stderr(&missing));
    // The message names the file at fault.
    let broken = folder.file("broken.cif", "data_x\n");
    let broken = streamed(&[&sample, &broken], &output, &scratch, &[]);
    assert_code(&broken, 4);
    assert!(stderr(&broken).contains("broken.cif"), "{}", stderr(&broken));
    let other = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/1crn.cif");
    let without = streamed(&[&other, &sample], &output, &scratch, &["--color", "entity"]);
    assert_code(&without, 4);
    assert!(stderr(&without).contains("4pti.pdb: parameter `color`"), "{}", stderr(&without));
    assert_code(&streamed(&[&sample], &output, &folder.path("none"), &[]), 7);
    let several = molmesh().arg("tileset").args([&sample, &sample]).arg("-o").arg(&output).output().unwrap();
    assert_code(&several, 2);
    assert!(stderr(&several).contains("--scratch"), "{}", stderr(&several));
    assert!(!output.exists());
    assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0);
}
