//! `molmesh bench paper`, `bench fetch` and `bench figures`, through the binary.
#![cfg(all(feature = "cli", feature = "server", feature = "gpu"))]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

mod archive_support;
mod cli_support;

use std::fs;
use std::io::Write as _;

use archive_support::{Remote, ok, status};
use cli_support::{Folder, assert_code, molmesh, run, stderr, stdout};
use serde_json::Value;

const SAMPLE: &[u8] = include_bytes!("../samples/4pti.pdb");

fn text(folder: &Folder, name: &str) -> String {
    fs::read_to_string(folder.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// The lines of a CSV without quotes in it, by column.
fn table(csv: &str) -> Vec<std::collections::BTreeMap<&str, &str>> {
    let mut lines = csv.lines();
    let head: Vec<&str> = lines.next().unwrap().split(',').collect();
    lines.map(|line| head.iter().copied().zip(line.split(',')).collect()).collect()
}

#[test]
fn a_small_run_writes_tables_that_agree_and_figures_can_be_drawn_from_it() {
    let folder = Folder::new();
    let (out, figures) = (folder.path("out"), folder.path("figures"));
    let (out, figures) = (out.to_str().unwrap(), figures.to_str().unwrap());
    let flags = ["--device", "cpu", "--only", "110d", "--kernels", "soft-object", "--runs", "1", "--growth", "1000"];
    let done = run([&["bench", "paper", "--out", out, "--reference-limit", "60"][..], &flags].concat());
    assert_code(&done, 0);
    let said = stdout(&done);
    assert!(said.contains("stand-in: made up") && said.contains("not run: no device"), "{said}");
    let results: Value = serde_json::from_str(&text(&folder, "out/paper.json")).unwrap();
    let row = &results["rows"][0];
    assert_eq!((&row["id"], &row["atoms"], &row["stand_in"]), (&"110D".into(), &120.into(), &true.into()));
    assert_eq!(row["cpu"]["paper_seconds"], 0.45);
    assert_eq!(row["gpu"]["ours"]["timed"], Value::Null);
    let csv = text(&folder, "out/paper.csv");
    let lines = table(&csv);
    let programs: Vec<&str> = lines.iter().map(|line| line["program"]).collect();
    assert_eq!(programs, ["reference", "cpu", "paper", "gpu"], "{csv}");
    for line in &lines {
        assert_eq!((line["id"], line["stand_in"], line["source"]), ("110D", "true", "stand-in: made up"), "{csv}");
        let off = line["cubes"].parse::<f64>().unwrap() / line["paper_cubes"].parse::<f64>().unwrap() - 1.0;
        assert!(off.abs() < 0.01, "{csv}");
    }
    let triangles = |i: usize| lines[i]["triangles"].parse::<u64>().unwrap_or(0);
    assert!(triangles(0) > 10_000 && triangles(0) == triangles(1) && triangles(2) == 0, "{csv}");
    let json = &row["cpu"]["baseline"]["timed"];
    assert_eq!(json["triangles"], triangles(0));
    assert_eq!(json["seconds"]["median"].as_f64(), lines[0]["seconds_median"].parse().ok());
    let page = text(&folder, "out/paper.md");
    assert!(page.contains("| 110D *(stand-in)* | soft-object | 120 |") && page.contains("all equal"), "{page}");
    let growth = text(&folder, "out/growth.csv");
    let sizes: Vec<(&str, &str)> = table(&growth).iter().map(|line| (line["program"], line["atoms"])).collect();
    assert_eq!(sizes[..4], [("reference", "100"), ("reference", "300"), ("reference", "1000"), ("cpu", "100")]);
    assert_eq!(sizes.len(), 8, "{growth}");
    // Figures and a page from the file that was written.
    let page =
        folder.file("page.md", "<!-- measured: table-1 -->\n<!-- end -->\n<!-- measured: table-2 --><!-- end -->");
    let done = run(["bench", "figures", out, "--out", figures, "--page", page.to_str().unwrap()]);
    assert_code(&done, 0);
    let page = text(&folder, "page.md");
    assert!(page.contains("| 110D *(stand-in)*") && page.contains("Not run."), "{page}");
    let svg = text(&folder, "figures/growth-cpu.svg");
    assert!(svg.contains("sequential reference ∝ n^") && svg.contains("</svg>"), "{svg}");
    assert!(!folder.path("figures/growth-gpu.svg").exists());
}

#[test]
fn what_takes_too_long_is_told_and_not_begun() {
    let done = run([
        "bench",
        "paper",
        "--device",
        "cpu",
        "--only",
        "1BIJ",
        "--kernels",
        "gaussian",
        "--programs",
        "reference",
        "--reference-limit",
        "0.5",
    ]);
    assert_code(&done, 0);
    let said = stdout(&done);
    assert!(said.contains("reference not run: about ") && said.contains("stand-in: made up"), "{said}");
}

#[test]
#[cfg(target_os = "linux")]
fn on_a_software_device_all_programs_make_the_same_triangles() {
    let folder = Folder::new();
    let data = folder.path("data");
    fs::create_dir(&data).unwrap();
    fs::write(data.join("pdb4pti.ent"), SAMPLE).unwrap();
    let out = folder.path("out");
    let flags = ["--only", "4PTI", "--kernels", "gaussian", "--programs", "cpu,paper,gpu", "--runs", "1"];
    let paths = ["--data", data.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let done = run([&["bench", "paper", "--device", "software", "--growth", "100"][..], &flags, &paths].concat());
    assert_code(&done, 0);
    let said = stdout(&done);
    assert!(said.contains("SOFTWARE") && !said.contains("DIFFER") && !said.contains("stand-in"), "{said}");
    assert!(said.contains("file pdb4pti.ent; the paper counts 381 atoms"), "{said}");
    let page = text(&folder, "out/paper.md");
    assert!(page.contains("3 comparisons of numbers of triangles on the same grid: all equal"), "{page}");
    assert!(page.contains("454 (381)"), "{page}");
    let results: Value = serde_json::from_str(&text(&folder, "out/paper.json")).unwrap();
    assert!(results["rows"][0]["gpu"]["ours"]["timed"]["device_bytes"].as_u64().unwrap() > 0);
    let stages = results["roofline"][0]["stages"].as_array().unwrap();
    assert!(
        stages.iter().any(|s| s["stage"] == "emit") && stages.iter().any(|s| s["program"] == "paper"),
        "{stages:?}"
    );
}

#[test]
fn bad_requests_are_refused_before_anything_runs() {
    let folder = Folder::new();
    let missing = folder.path("none");
    let missing = missing.to_str().unwrap();
    for (flags, code, why) in [
        (&["paper", "--programs", "cpu,quick"][..], 2, "quick"),
        (&["paper", "--kernels", "cubic"], 2, "cubic"),
        (&["paper", "--only", "9XYZ"], 2, "not in the paper's tables"),
        (&["paper", "--runs", "0"], 2, "0 runs"),
        (&["paper", "--growth", "10"], 2, "100 atoms"),
        (&["paper", "--reference-limit=-1"], 2, "seconds"),
        (&["paper", "--device", "77"], 6, "77"),
        (&["paper", "--data", missing], 3, "none"),
        (&["figures", missing], 3, "none"),
        (&["fetch", "--only", "9XYZ", "--data", missing], 2, "not in the paper's tables"),
        (&["fetch", "--data", missing], 2, "archive.url"),
    ] {
        let done = run([&["bench"], flags].concat());
        assert_eq!(done.status.code(), Some(code), "{flags:?}: {}", stderr(&done));
        assert!(stderr(&done).contains(why) && stdout(&done).is_empty(), "{flags:?}: {}", stderr(&done));
    }
    assert_eq!(folder.entries(), Vec::<String>::new(), "nothing was made");
    let other = folder.file("other.json", "{\"cases\": []}");
    let done = run(["bench", "figures", other.to_str().unwrap(), "--out", missing]);
    assert_code(&done, 2);
    assert!(stderr(&done).contains("holds no results"), "{}", stderr(&done));
}

#[test]
fn structures_are_fetched_once_and_used_from_then_on() {
    let gz = {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(SAMPLE).unwrap();
        encoder.finish().unwrap()
    };
    let answer = ok(&gz);
    let remote = Remote::start(move |asked, _| if asked.path.contains("1bk2") { status(404) } else { answer.clone() });
    let folder = Folder::new();
    let data = folder.path("data");
    let fetch = |only: &str| {
        let mut command = molmesh();
        command.env("MOLMESH__ARCHIVE__URL", remote.url("/d/{id}.pdb.gz"));
        command.args(["bench", "fetch", "--only", only, "--data"]).arg(&data).output().unwrap()
    };
    let done = fetch("110D,1BK2,2INS");
    assert_code(&done, 0);
    assert!(stdout(&done).contains("1BK2: entry 1bk2 is not in the archive"), "{}", stdout(&done));
    let mut names: Vec<_> =
        fs::read_dir(&data).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    assert_eq!((names, remote.count()), (vec!["110d.pdb.gz".to_owned(), "2ins.pdb.gz".to_owned()], 3));
    assert_eq!(fs::read(data.join("2ins.pdb.gz")).unwrap(), gz);
    let done = fetch("110D,2INS");
    assert_code(&done, 0);
    assert!(stdout(&done).contains("is there") && remote.count() == 3, "{}", stdout(&done));
    // The user's own file replaces the stand-in.
    let paper = ["bench", "paper", "--only", "2INS", "--kernels", "gaussian", "--programs", "cpu", "--runs", "1"];
    let done = molmesh().args(paper).arg("--data").arg(&data).output().unwrap();
    assert_code(&done, 0);
    let said = stdout(&done);
    assert!(said.contains("file 2ins.pdb.gz") && !said.contains("stand-in"), "{said}");
}

#[test]
fn without_a_network_it_is_said_what_to_do() {
    // Nobody listens there any more.
    let addr = Remote::saying(status(404)).addr;
    let folder = Folder::new();
    let mut command = molmesh();
    command.env("MOLMESH__ARCHIVE__URL", format!("http://{addr}/{{id}}.cif")).env("MOLMESH__ARCHIVE__BACKOFF_MS", "1");
    let done = command.args(["bench", "fetch", "--data"]).arg(folder.path("data")).output().unwrap();
    assert_code(&done, 1);
    let said = stderr(&done);
    assert!(said.contains("cannot be connected to") && said.contains("by hand"), "{said}");
    assert_eq!(fs::read_dir(folder.path("data")).unwrap().count(), 0, "nothing is left behind");
}
