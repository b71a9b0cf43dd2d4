//! SIGINT and SIGTERM: exit code 130, and no file is left.
#![cfg(unix)]

use crate::cli_support;

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cli_support::{Folder, assert_code, block, molmesh};

fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([format!("-{name}"), child.id().to_string()]).status().unwrap();
    assert!(sent.success());
}

/// Waits until `folder` contains a file beside the input: the output is open and the job has started.
fn wait_for_work(folder: &Folder, child: &mut Child) {
    let start = Instant::now();
    while folder.entries().len() < 2 {
        assert!(child.try_wait().unwrap().is_none(), "the command ended before the interrupt");
        assert!(start.elapsed() < Duration::from_secs(20), "the job did not start");
        std::thread::sleep(Duration::from_millis(2));
    }
    std::thread::sleep(Duration::from_millis(100));
}

#[test]
fn interrupted_mesh_leaves_no_file() {
    for name in ["INT", "TERM"] {
        let folder = Folder::new();
        // Much more work than can finish during the test.
        let input = folder.file("block.pdb", block(20));
        let mut command = molmesh();
        command.arg("mesh").arg(&input).arg("-o").arg(folder.path("out.glb")).args(["--resolution", "0.03"]);
        command.args(["--max-grid-points", "1000000000000", "--max-mesh-bytes", "1000000000000"]);
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        wait_for_work(&folder, &mut child);
        let start = Instant::now();
        signal(&child, name);
        let done = child.wait_with_output().unwrap();
        assert_code(&done, 130);
        assert!(start.elapsed() < Duration::from_secs(20), "{:?} after the signal", start.elapsed());
        assert_eq!(folder.entries(), ["block.pdb"], "{name}");
    }
}

#[test]
fn reading_stdin_can_be_interrupted() {
    let folder = Folder::new();
    let mut child = molmesh()
        .args(["mesh", "-", "-o"])
        .arg(folder.path("out.glb"))
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let stdin = child.stdin.take();
    let start = Instant::now();
    while folder.entries().is_empty() {
        assert!(start.elapsed() < Duration::from_secs(20), "the job did not start");
        std::thread::sleep(Duration::from_millis(2));
    }
    signal(&child, "INT");
    let done = child.wait_with_output().unwrap();
    drop(stdin);
    assert_code(&done, 130);
    assert!(folder.entries().is_empty());
}
