//! Tests of the `molmesh-bench` binary.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

#[path = "../../tests/archive_support/mod.rs"]
mod archive_support;

use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use archive_support::{Remote, ok, status};
use serde_json::Value;

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");

fn command() -> Command {
    Command::new(env!("CARGO_BIN_EXE_molmesh-bench"))
}

/// Runs the program and checks its exit code. Returns its standard output and standard error.
fn run(code: i32, command: &mut Command) -> [String; 2] {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let said = [stdout, stderr].map(|bytes| String::from_utf8(bytes).unwrap());
    assert_eq!(status.code(), Some(code), "{said:?}");
    said
}

fn results(out: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(out.join("paper.json")).unwrap()).unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_small_run_writes_consistent_tables_and_figures() {
    let folder = tempfile::tempdir().unwrap();
    let [out, figures, page] = ["out", "figures", "page.md"].map(|name| folder.path().join(name));
    let flags = ["--device", "cpu", "--only", "110d", "--kernels", "soft-object", "--runs", "1", "--growth", "1000"];
    let [said, _] = run(0, command().args(["paper", "--reference-limit", "60", "--out"]).arg(&out).args(flags));
    assert!(said.contains("| 110D *(substitute)* | soft-object | 120 |") && said.contains("all equal"), "{said}");
    assert_eq!(said, fs::read_to_string(out.join("paper.md")).unwrap());
    let results = results(&out);
    let row = &results["rows"][0];
    assert_eq!((&row["id"], &row["atoms"], &row["substitute"]), (&"110D".into(), &120.into(), &true.into()));
    assert_eq!((&row["source"], &row["cpu"]["paper_seconds"]), (&"substitute: generated".into(), &0.45.into()));
    for side in [&row["cpu"], &row["gpu"]] {
        let off = side["cubes"].as_f64().unwrap() / side["paper_cubes"].as_f64().unwrap() - 1.0;
        assert!(off.abs() < 0.01, "{side}");
    }
    let [reference, cpu] = ["baseline", "ours"].map(|which| &row["cpu"][which]["timed"]["triangles"]);
    assert!(reference.as_u64().unwrap() > 10_000 && reference == cpu, "{row}");
    let gpu = &row["gpu"]["ours"];
    assert!(gpu["timed"].is_null() && gpu["not_run"].as_str().unwrap().contains("no GPU"), "{gpu}");
    let series = results["growth"]["series"].as_array().unwrap();
    let points: Vec<usize> = series.iter().map(|series| series["points"].as_array().unwrap().len()).collect();
    assert_eq!(points, [3, 3, 0, 0], "{series:?}");
    // Figures and a page from the stored results.
    fs::write(&page, "<!-- measured: table-1 -->\n<!-- end -->\n<!-- measured: table-2 --><!-- end -->").unwrap();
    run(0, command().arg("figures").arg(&out).arg("--out").arg(&figures).arg("--page").arg(&page));
    let page = fs::read_to_string(page).unwrap();
    assert!(page.contains("| 110D *(substitute)*") && page.contains("Not run."), "{page}");
    let svg = fs::read_to_string(figures.join("growth-cpu.svg")).unwrap();
    assert!(svg.contains("sequential reference ∝ n^") && svg.contains("</svg>"), "{svg}");
    assert!(!figures.join("growth-gpu.svg").exists());
}

#[test]
fn runs_beyond_the_limit_are_skipped() {
    let flags = ["--only", "1BIJ", "--kernels", "gaussian", "--programs", "reference", "--reference-limit", "0.5"];
    let [said, _] = run(0, command().args(["paper", "--device", "cpu"]).args(flags));
    assert!(said.contains("not run: about ") && said.contains("| 1BIJ *(substitute)* |"), "{said}");
}

#[test]
#[cfg(target_os = "linux")]
fn all_programs_create_the_same_triangles_on_a_software_device() {
    let folder = tempfile::tempdir().unwrap();
    let [data, out] = ["data", "out"].map(|name| folder.path().join(name));
    fs::create_dir(&data).unwrap();
    fs::write(data.join("pdb4pti.ent"), SAMPLE).unwrap();
    let flags = ["--device", "software", "--only", "4PTI", "--kernels", "gaussian", "--programs", "cpu,paper,gpu"];
    let paths = [data.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let [said, _] =
        run(0, command().args(["paper", "--runs", "1", "--growth", "100"]).args(flags).arg("--data").args(paths));
    assert!(said.contains("GPU: none; its programs ran on software") && !said.contains("substitute"), "{said}");
    assert!(said.contains("3 comparisons of numbers of triangles on the same grid: all equal"), "{said}");
    assert!(said.contains("454 (381)"), "{said}");
    let results = results(&out);
    assert_eq!(results["rows"][0]["source"], "file pdb4pti.ent");
    assert!(results["rows"][0]["gpu"]["ours"]["timed"]["device_bytes"].as_u64().unwrap() > 0);
    let stages = results["roofline"][0]["stages"].as_array().unwrap();
    let stage = |program: &str, name: &str| stages.iter().find(|s| s["program"] == program && s["stage"] == name);
    assert!(stage("gpu", "emit").unwrap()["bytes"].as_f64().unwrap() > 0.0, "{stages:?}");
    assert_eq!(stage("paper", "scan").unwrap()["workgroup_bytes"], 2048);
}

#[test]
#[cfg(target_os = "linux")]
fn stages_jobs_and_callers_are_measured_on_a_software_device() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("gpu.json");
    let measure = |flags: &[&str]| {
        let [said, _] = run(0, command().arg("gpu").args(flags).arg("--json").arg(&json));
        (said, serde_json::from_str::<Value>(&fs::read_to_string(&json).unwrap()).unwrap())
    };
    let (said, results) =
        measure(&["--device", "software", "--only", "ball", "--atoms", "200", "--runs", "1", "--check"]);
    let measured = &results["cases"][0]["measured"];
    assert_eq!((&measured["atoms"], &measured["check"]["closed"]), (&200.into(), &true.into()), "{said}");
    let stages = measured["stages"].as_array().unwrap();
    assert!(results["rates"].is_null() || stages.len() == 8 && said.contains("emit"), "{said}");
    let (said, results) = measure(&["--device", "software", "--jobs", "2"]);
    let rates = results["jobs"].as_array().unwrap();
    assert!(rates.len() == 4 && rates.iter().all(|rate| rate["triangles"] == rates[0]["triangles"]), "{said}");
    let (said, results) = measure(&["--devices", "software", "--pool", "2", "--callers", "1", "--atoms", "600"]);
    let rates = results["pool"].as_array().unwrap();
    assert!(rates.len() == 1 && rates[0]["jobs"] == 2, "{said}");
    let (said, results) =
        measure(&["--devices", "software", "--spread", "--only", "ball", "--atoms", "200", "--runs", "1"]);
    assert!(results["spread"].as_array().unwrap().iter().all(|row| row["same"] == true), "{said}");
}

#[test]
fn invalid_arguments_are_rejected_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("none");
    let missing = missing.to_str().unwrap();
    for (flags, code, why) in [
        (&["paper", "--programs", "cpu,quick"][..], 2, "quick"),
        (&["paper", "--kernels", "cubic"], 2, "cubic"),
        (&["paper", "--only", "9XYZ"], 2, "not in the paper's tables"),
        (&["paper", "--runs", "0"], 2, "--runs"),
        (&["paper", "--growth", "10"], 2, "100 atoms"),
        (&["paper", "--reference-limit=-1"], 2, "seconds"),
        (&["paper", "--device", "77"], 1, "77"),
        (&["paper", "--data", missing], 1, "none"),
        (&["gpu", "--jobs", "0"], 2, "--jobs"),
        (&["figures", missing], 1, "none"),
        (&["fetch", "--only", "9XYZ", "--data", missing], 2, "not in the paper's tables"),
        (&["fetch", "--data", missing, "--set", "archive.url=none"], 2, "archive.url"),
        (&["fetch", "--data", missing, "--set", "archive.url"], 2, "KEY=VALUE"),
    ] {
        let [stdout, stderr] = run(code, command().args(flags));
        assert!(stderr.contains(why) && stdout.is_empty(), "{flags:?}: {stderr}");
    }
    assert_eq!(names(folder.path()), Vec::<String>::new(), "nothing was created");
    let other = folder.path().join("other.json");
    fs::write(&other, "{\"cases\": []}").unwrap();
    let [_, stderr] = run(1, command().arg("figures").arg(&other).args(["--out", missing]));
    assert!(stderr.contains("is not a result of"), "{stderr}");
}

#[test]
fn structures_are_fetched_once_and_replace_substitutes() {
    let gz = {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(SAMPLE).unwrap();
        encoder.finish().unwrap()
    };
    let answer = ok(&gz);
    let remote = Remote::start(move |asked, _| if asked.path.contains("1bk2") { status(404) } else { answer.clone() });
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    let fetch = |only: &str| {
        let set = format!("archive.url={}", remote.url("/d/{id}.pdb.gz"));
        let [said, _] = run(0, command().args(["fetch", "--only", only, "--set", &set, "--data"]).arg(&data));
        said
    };
    let said = fetch("110D,1BK2,2INS");
    assert!(said.contains("1BK2: entry 1bk2 is not in the archive"), "{said}");
    assert_eq!((names(&data), remote.count()), (vec!["110d.pdb.gz".to_owned(), "2ins.pdb.gz".to_owned()], 3));
    assert_eq!(fs::read(data.join("2ins.pdb.gz")).unwrap(), gz);
    let said = fetch("110D,2INS");
    assert!(said.contains("exists") && remote.count() == 3, "{said}");
    let paper = ["paper", "--only", "2INS", "--kernels", "gaussian", "--programs", "cpu", "--runs", "1", "--data"];
    let [said, progress] = run(0, command().args(paper).arg(&data));
    assert!(progress.contains("file 2ins.pdb.gz") && !said.contains("substitute"), "{said}\n{progress}");
}

#[test]
fn network_errors_suggest_copying_the_files() {
    // No server listens at this address any more.
    let addr = Remote::saying(status(404)).addr;
    let folder = tempfile::tempdir().unwrap();
    let url = format!("archive.url=http://{addr}/{{id}}.cif");
    let flags = ["fetch", "--set", &url, "--data"];
    let [_, stderr] = run(1, command().args(flags).arg(folder.path()));
    assert!(stderr.contains("cannot be connected to") && stderr.contains("copy the files"), "{stderr}");
    assert_eq!(names(folder.path()), Vec::<String>::new(), "no file remains");
}

#[test]
fn whole_requests_are_measured() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("service.json");
    // The product's binary lies in the same folder once the workspace is built.
    let binary = Path::new(env!("CARGO_BIN_EXE_molmesh-bench")).with_file_name("molmesh");
    assert!(binary.is_file(), "build the workspace first: {}", binary.display());
    let flags = ["--backends", "cpu", "--requests", "2", "--clients", "2", "--seconds", "1", "--json"];
    let [said, _] = run(
        0,
        command().args(["service", "--binary"]).arg(&binary).args(flags).arg(&json).args([
            "--",
            "--set",
            "jobs.workers=2",
        ]),
    );
    assert!(said.contains("| backend |") && said.contains("\n| cpu |"), "{said}");
    let results: Value = serde_json::from_str(&fs::read_to_string(&json).unwrap()).unwrap();
    let row = &results["rows"][0];
    let [times, known] = ["milliseconds", "known_structure_milliseconds"].map(|name| &row[name][0]);
    let median = |times: &Value, part: &str| times[part]["median"].as_f64().unwrap();
    for (times, parts) in [(times, ["total", "field", "emit"]), (known, ["total", "field", "encode"])] {
        assert!(parts.iter().all(|part| median(times, part) > 0.0), "{times}");
        assert!(median(times, "request") >= median(times, "total"), "{times}");
    }
    assert!(row["meshes_per_second"][0].as_f64().unwrap() > 0.0, "{row}");
    // A service that does not start is an error with its messages.
    let [_, error] = run(1, command().args(["service", "--backends", "none", "--binary"]).arg(&binary));
    assert!(error.contains("did not start") && error.contains("none"), "{error}");
}
