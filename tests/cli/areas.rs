//! `molmesh areas`.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::cli_support::{Folder, assert_code, run, stderr, stdout};

const SAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

#[test]
fn the_table_of_areas_has_the_sum_of_the_report() {
    let folder = Folder::new();
    let table = folder.path("4pti.csv");
    let flags = ["areas", SAMPLE, "--surface", "sas", "-o", table.to_str().unwrap()];
    let done = run([&flags[..], &["--report", "json"]].concat());
    assert_code(&done, 0);
    let report = json(&stdout(&done));
    let text = fs::read_to_string(&table).unwrap();
    assert_eq!(report["output"]["bytes"], text.len());
    assert_eq!(
        (&report["output"]["format"], &report["atoms"], &report["probe"]),
        (&"csv".into(), &454.into(), &1.4.into())
    );
    assert_eq!(report["left_out"]["total"], 60);
    let mut rows = text.lines();
    assert_eq!(rows.next().unwrap(), "residue_name,residue_number,insertion_code,chain,model,atoms,area");
    let area: f64 = rows.map(|row| row.rsplit(',').next().unwrap().parse::<f64>().unwrap()).sum();
    assert!((area - report["exact"]["area"].as_f64().unwrap()).abs() < 0.01, "{area} {report}");
    // The report of a mesh has the same measures.
    let mesh = folder.path("4pti.glb");
    let flags_of_mesh = ["mesh", SAMPLE, "-o", mesh.to_str().unwrap(), "--surface", "sas", "--exact"];
    let meshed = run([&flags_of_mesh[..], &["--resolution", "1.5", "--report", "json"]].concat());
    assert_eq!(json(&stdout(&meshed))["exact"], report["exact"]);
    let done = run(flags);
    assert!(stdout(&done).is_empty());
    assert!(
        stderr(&done).contains("exact      area 3,977") && stderr(&done).contains("4pti.csv (csv, "),
        "{}",
        stderr(&done)
    );
}

#[test]
fn the_table_is_written_to_stdout_and_the_report_to_stderr() {
    let done = run(["areas", SAMPLE, "--surface", "ses", "--by", "chain"]);
    assert_code(&done, 0);
    assert!(
        stdout(&done).starts_with("chain,model,atoms,area,contact,toroidal,concave\nA,1,454,"),
        "{}",
        stdout(&done)
    );
    assert!(stderr(&done).contains("stdout (csv, "), "{}", stderr(&done));
    assert!(stderr(&run(["areas", SAMPLE, "--surface", "ses", "--quiet"])).is_empty());
    let reported = run(["areas", SAMPLE, "--surface", "vdw", "--report", "json"]);
    assert_eq!(json(&stderr(&reported))["surface"], "vdw");
    assert!(json(&stderr(&reported))["probe"].is_null());
}

#[test]
fn a_selection_that_no_grid_point_hits_has_an_area() {
    let folder = Folder::new();
    let input = folder.file("one.xyz", "1\n\nC 4 4 4\n");
    let mesh = folder.path("one.glb");
    let path = input.to_str().unwrap();
    let flags = ["mesh", path, "-o", mesh.to_str().unwrap(), "--surface", "ses", "--resolution", "8"];
    assert_code(&run(flags), 2);
    let done = run(["areas", path, "--surface", "ses", "--report", "json"]);
    assert_code(&done, 0);
    let area = json(&stderr(&done))["exact"]["area"].as_f64().unwrap();
    assert!((area - 4.0 * std::f64::consts::PI * 1.7_f64.powi(2)).abs() < 1e-3, "{area}");
}

#[test]
fn areas_buried_between_chains_are_listed_for_both_sides() {
    let folder = Folder::new();
    let two = |chain: char, x: f64| {
        format!("ATOM      1  C   ALA {chain}   1    {x:8.3}   0.000   0.000  1.00  0.00           C\n")
    };
    let input = folder.file("two.pdb", two('A', 0.0) + &two('B', 2.0));
    let flags = ["areas", input.to_str().unwrap(), "--surface", "vdw", "--by", "chain", "--interface", "A,B"];
    let done = run([&flags[..], &["--report", "json"]].concat());
    assert_code(&done, 0);
    assert!(stdout(&done).starts_with("chain,model,atoms,area,alone,buried\nA,1,1,"), "{}", stdout(&done));
    let report = json(&stderr(&done));
    // Each sphere loses a cap whose height is 0.7 Å.
    let cap = 2.0 * std::f64::consts::PI * 1.7 * 0.7;
    let buried = report["interface"]["area"].as_f64().unwrap();
    assert!((buried - cap).abs() < 1e-3 && report["exact"].is_null(), "{report}");
    assert!(stderr(&run(flags)).contains("interface  7.48 Å²"), "{}", stderr(&run(flags)));
}

#[test]
fn wrong_flags_and_selections_are_named() {
    let folder = Folder::new();
    let none = folder.path("none/areas.csv");
    for (flags, code) in [
        (&["areas", SAMPLE][..], 2),
        (&["areas", SAMPLE, "--surface", "gaussian"], 2),
        (&["areas", SAMPLE, "--surface", "sas", "--by", "model"], 2),
        (&["areas", SAMPLE, "--surface", "sas", "--model", "all"], 2),
        (&["areas", SAMPLE, "--surface", "sas", "--interface", "A"], 2),
        (&["areas", SAMPLE, "--surface", "sas", "--threads", "1025"], 2),
        (&["areas", SAMPLE, "--surface", "sas", "--interface", "A,Z"], 4),
        (&["areas", SAMPLE, "--surface", "sas", "--select", "chain Z"], 4),
        (&["areas", SAMPLE, "--surface", "sas", "-o", SAMPLE], 2),
        (&["areas", SAMPLE, "--surface", "sas", "-o", none.to_str().unwrap()], 7),
        (&["areas", SAMPLE, "--surface", "sas", "--max-candidates", "10"], 5),
        (&["areas", "none.pdb", "--surface", "sas"], 3),
    ] {
        let done = run(flags);
        assert_eq!(done.status.code(), Some(code), "{flags:?}: {}", stderr(&done));
        assert!(stdout(&done).is_empty(), "{flags:?}");
    }
    assert!(!Path::new(&none).exists());
}
