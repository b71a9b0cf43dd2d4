//! `molmesh render`: files, streams, summaries, errors.

use crate::cli_support;

use std::fs;
use std::path::Path;
use std::process::Output;

use cli_support::{Folder, assert_code, piped, rod, run, stderr, stdout};
use serde_json::Value;

fn render(input: &Path, output: &Path, more: &[&str]) -> Output {
    let (input, output) = (input.to_str().unwrap(), output.to_str().unwrap());
    run(["render", input, "-o", output, "--backend", "cpu"].iter().chain(more))
}

/// Returns width and height from the header of a PNG.
fn size(bytes: &[u8]) -> (u32, u32) {
    assert_eq!(bytes[..8], *b"\x89PNG\r\n\x1a\n");
    let number = |at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
    (number(16), number(20))
}

#[test]
fn writes_a_file_and_a_summary() {
    let folder = Folder::new();
    let (input, output) = (folder.file("rod.pdb", rod()), folder.path("rod.PNG"));
    let done = render(&input, &output, &["--width", "80", "--height", "60", "--view", "top", "--azimuth", "-30"]);
    assert_code(&done, 0);
    assert_eq!(size(&fs::read(&output).unwrap()), (80, 60));
    let summary = stderr(&done);
    for part in
        ["80 × 60, top view, azimuth -30°", "Å per pixel", "cpu: CPU rasterizer", "a backend other than the GPU", "png"]
    {
        assert!(summary.contains(part), "no `{part}` in\n{summary}");
    }
    assert!(summary.lines().count() <= 40, "one screen:\n{summary}");
    assert_eq!(stdout(&done), "");
}

#[test]
fn flags_change_the_picture_and_streams_equal_files() {
    let folder = Folder::new();
    let (input, output) = (folder.file("rod.pdb", rod()), folder.path("a.png"));
    let of = |more: &[&str]| {
        assert_code(&render(&input, &output, &[&["--quiet", "--width", "64", "--height", "64"], more].concat()), 0);
        fs::read(&output).unwrap()
    };
    let plain = of(&[]);
    assert_eq!(plain, of(&["--threads", "3"]), "the same on any number of threads");
    let through = piped(&["render", "-", "-o", "-", "-q", "--width", "64", "--height", "64"], rod().as_bytes());
    assert_code(&through, 0);
    assert_eq!((through.stdout == plain, stderr(&through)), (true, String::new()));
    let others = [
        &["--style", "gouraud"][..],
        &["--background", "white"],
        &["--view", "back"],
        &["--elevation", "45"],
        &["--surface", "soft-object"],
        &["--radius-scale", "1.2"],
    ];
    let mut all: Vec<_> = others.iter().map(|flags| of(flags)).collect();
    all.push(plain);
    all.sort();
    all.dedup();
    assert_eq!(all.len(), 7);
}

#[test]
fn report_names_the_renderer() {
    let folder = Folder::new();
    let (input, output) = (folder.file("rod.pdb", rod()), folder.path("a.png"));
    let done = render(&input, &output, &["--report", "json", "--quiet", "--background", "#102030"]);
    assert_code(&done, 0);
    let report: Value = serde_json::from_str(&stdout(&done)).unwrap();
    let picture = &report["picture"];
    assert_eq!((&picture["renderer"], &picture["background"]), (&"cpu".into(), &"#102030".into()));
    assert_eq!((&picture["width"], &report["output"]["format"]), (&512.into(), &"png".into()));
    assert!(picture["device"].as_str().unwrap().contains("thread") && picture["pixel"].as_f64().unwrap() > 0.0);
    assert!(report["timings_ms"]["draw"].is_number() && report["triangles"].as_u64().unwrap() > 100);
}

#[test]
fn rejects_mesh_formats_and_bad_sizes() {
    let folder = Folder::new();
    let input = folder.file("rod.pdb", rod());
    let glb = render(&input, &folder.path("a.glb"), &[]);
    assert_code(&glb, 2);
    assert!(stderr(&glb).contains("molmesh mesh writes meshes"), "{}", stderr(&glb));
    let wide = render(&input, &folder.path("a.png"), &["--width", "20000"]);
    assert_code(&wide, 2);
    assert!(stderr(&wide).contains("`width`") && stderr(&wide).contains("16384"), "{}", stderr(&wide));
    let mesh = run(["mesh", input.to_str().unwrap(), "-o", folder.path("a.png").to_str().unwrap()]);
    assert_code(&mesh, 2);
    assert!(stderr(&mesh).contains("molmesh render"), "{}", stderr(&mesh));
    assert_eq!(folder.entries(), ["rod.pdb"]);
}
