//! The viewer and the examples in a real browser: scripts of `tests/browser` drive Chromium against the built server.
#![cfg(unix)]

use crate::access_support;
use crate::cli_support;
use crate::tools;

use std::path::{Path, PathBuf};
use std::process::Command;

use cli_support::{Folder, Service};

/// Finds Chromium under the names of its executable in distributions.
fn chromium() -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let mut places = std::env::split_paths(&path).flat_map(|folder| names.map(|name| folder.join(name)));
    places.find(|place| place.is_file())
}

/// Starts a service with the samples as its archive and with a limit that a fine resolution exceeds.
fn service(folder: &Folder, more: &[&str]) -> Service {
    let samples = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples");
    let all = ["--devices", "cpu", "--archive", samples.to_str().unwrap(), "--set", "limits.grid_points=4000000"];
    Service::start(folder, &[&all, more].concat())
}

/// Runs a script of `tests/browser` against a service. Panics with its output if it fails.
fn drive(script: &str, more: &[&str], variables: &[(&str, &str)]) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    if !molmesh::http::has_viewer() {
        return tools::missing("the viewer (make web, then build again)").unwrap_or_default();
    }
    let modules = root.join("target/test-tools/node");
    let Some(chromium) = chromium().filter(|_| modules.join(".stamp").is_file()) else {
        return tools::missing("Chromium, or its driver,").unwrap_or_default();
    };
    let folder = Folder::new();
    let service = service(&folder, more);
    let done = Command::new("node")
        .arg(root.join("tests/browser").join(script))
        .env("MOLMESH_URL", format!("http://{}", service.addr))
        .env("MOLMESH_MODULES", modules.join("node_modules"))
        .env("MOLMESH_CHROMIUM", chromium)
        .env("MOLMESH_ROOT", root)
        .envs(variables.iter().copied())
        .output()
        .unwrap();
    let output = [done.stdout, done.stderr].concat();
    let output = String::from_utf8_lossy(&output);
    assert!(done.status.success() && output.contains("ok "), "{script}:\n{output}");
}

#[test]
fn page_works() {
    drive("page.mjs", &[], &[]);
}

/// Tests of the page's state, which need the packages of the page but no browser.
#[test]
fn state_of_the_page_follows_its_requests() {
    let web = Path::new(env!("CARGO_MANIFEST_DIR")).join("web");
    if !web.join("node_modules/.stamp").is_file() {
        return tools::missing("the packages of the viewer (make web)").unwrap_or_default();
    }
    let done = Command::new("node").arg("--test").arg(web.join("test/view.test.mjs")).output().unwrap();
    let output = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{output}");
}

#[test]
fn surfaces_are_coloured_and_recoloured() {
    drive("colors.mjs", &[], &[]);
}

#[test]
fn display_follows_its_controls_and_its_address() {
    drive("display.mjs", &[], &[]);
}

#[test]
fn open_surfaces_and_instances_are_drawn() {
    drive("open.mjs", &[], &[]);
}

#[test]
fn failed_request_keeps_the_previous_surface() {
    drive("previous.mjs", &[], &[]);
}

#[test]
fn component_polls_jobs_and_shows_its_fallback() {
    drive("component.mjs", &[], &[]);
}

#[test]
fn page_polls_long_jobs() {
    // The finest mesh of the script must be within the limit.
    drive("jobs.mjs", &["--set", "limits.grid_points=200000000"], &[]);
}

#[test]
fn page_asks_for_a_required_key() {
    let keys = access_support::Keys::new(&[("page", "mesh,read", "")]);
    let set = format!("access.keys_file={}", keys.path().display());
    drive("keys.mjs", &["--set", &set], &[("MOLMESH_KEY", keys.text("page"))]);
}

#[test]
fn page_without_webgl_shows_a_message_and_a_picture() {
    drive("no_webgl.mjs", &[], &[]);
}

#[test]
fn large_surfaces_are_shown_in_tiles() {
    drive("tiles.mjs", &[], &[]);
}

#[test]
fn other_viewers_load_all_glb_variants() {
    drive("variants.mjs", &[], &[]);
}

#[test]
fn examples_work_from_another_origin() {
    drive("examples.mjs", &[], &[]);
}

#[test]
fn python_example_agrees_with_the_report() {
    let Some(python) = tools::python_interpreter() else {
        return tools::missing("the Python for examples/measure.py").unwrap_or_default();
    };
    let folder = Folder::new();
    let service = service(&folder, &[]);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let run = |file: &Path| {
        let server = format!("http://{}", service.addr);
        let script = root.join("examples/measure.py");
        Command::new(&python).arg(script).arg(file).arg(server).env("PYTHONDONTWRITEBYTECODE", "1").output().unwrap()
    };
    let done = run(&root.join("samples/1crn.cif"));
    let output = String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{output}{}", String::from_utf8_lossy(&done.stderr));
    assert!(output.contains("closed True, the service says true"), "{output}");
    let mut n = 0;
    for line in output.lines().filter(|line| !line.starts_with("closed")) {
        let numbers: Vec<f64> = line.split([' ', ',']).filter_map(|word| word.parse().ok()).collect();
        let [ours, theirs] = numbers[..] else { panic!("{line}") };
        assert!((ours - theirs).abs() <= 2e-3 * theirs, "{line}");
        n += 1;
    }
    assert_eq!(n, 3, "{output}");
    // The example shows the error message of the service.
    let poem = folder.file("poem.txt", "Whose woods these are I think I know");
    let refused = run(&poem);
    assert!(!refused.status.success());
    assert!(String::from_utf8_lossy(&refused.stderr).contains("The structure cannot be read"));
}

#[test]
fn notices_cover_the_dependencies_of_the_viewer() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let lock: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(root.join("web/package-lock.json")).unwrap()).unwrap();
    let notices = std::fs::read_to_string(root.join("deploy/notices.py")).unwrap();
    let mit = ["MIT", "Permission is hereby granted"];
    for (package, kept, [license, phrase]) in [
        ("three", "three.txt", mit),
        ("meshoptimizer", "meshoptimizer.txt", mit),
        ("3d-tiles-renderer", "3d-tiles-renderer.txt", ["Apache-2.0", "Apache License"]),
    ] {
        assert_eq!(lock["packages"][format!("node_modules/{package}")]["license"], license, "{package}");
        let text = std::fs::read_to_string(root.join("web/licences").join(kept)).unwrap();
        assert!(text.contains(phrase), "{kept}");
        assert!(notices.contains(kept), "{kept}");
    }
}
