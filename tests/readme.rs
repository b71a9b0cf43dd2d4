//! The README is true: it opens with the two commands, and its curl lines work as they stand.
#![cfg(all(unix, feature = "cli", feature = "server"))]
#![expect(clippy::unwrap_used, reason = "tests say what they expect by panicking")]

mod cli_support;

use std::path::{Path, PathBuf};
use std::process::Command;

use cli_support::{Folder, Service};

const README: &str = include_str!("../README.md");
/// The address that the README speaks of.
const ADDRESS: &str = "127.0.0.1:8080";

/// The curl lines of all blocks marked `sh`, continued lines joined.
fn curl_lines(text: &str) -> Vec<String> {
    let blocks = text.split("```sh\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    blocks
        .flat_map(|block| block.replace("\\\n", " ").lines().map(str::trim).map(str::to_owned).collect::<Vec<_>>())
        .filter(|line| line.starts_with("curl "))
        .collect()
}

/// Files that a line writes: what stands behind `-o` and `>`.
fn outputs(line: &str) -> Vec<&str> {
    let words: Vec<&str> = line.split_whitespace().collect();
    words.windows(2).filter(|w| ["-o", ">"].contains(&w[0])).map(|w| w[1]).collect()
}

/// Whether `bytes` are what the file's name says.
fn is_what_it_says(name: &str, bytes: &[u8]) -> bool {
    let extension = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default();
    match extension {
        "glb" => bytes.starts_with(b"glTF\x02\x00\x00\x00"),
        "ply" => bytes.starts_with(b"ply\nformat binary_little_endian 1.0\n"),
        "obj" => bytes.starts_with(b"#") && bytes.windows(3).any(|w| w == b"\nf "),
        "json" | "gltf" => serde_json::from_slice::<serde_json::Value>(bytes).is_ok_and(|v| v.is_object()),
        // 80 bytes of anything, a count, 50 bytes a triangle.
        "stl" => {
            bytes.len() > 84 && {
                let n = u32::from_le_bytes([bytes[80], bytes[81], bytes[82], bytes[83]]) as usize;
                n > 0 && bytes.len() == 84 + 50 * n
            }
        }
        _ => false,
    }
}

#[test]
fn it_opens_with_the_two_commands() {
    let code: Vec<&str> = README.lines().filter(|l| !l.starts_with("```") && !l.is_empty()).take(2).collect();
    assert_eq!(code, ["make run", "make test"]);
}

#[test]
fn every_curl_line_works() {
    let folder = Folder::new();
    let samples = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples");
    let service = Service::start(&folder, &["--archive", samples.to_str().unwrap()]);
    std::os::unix::fs::symlink(&samples, folder.path("samples")).unwrap();
    let lines = curl_lines(README);
    assert!(lines.len() >= 8, "{lines:#?}");
    for line in lines {
        assert!(line.contains(ADDRESS), "{line}");
        let here = line.replace(ADDRESS, &service.addr);
        let done = Command::new("sh").args(["-euc", &here]).current_dir(folder.path("")).output().unwrap();
        assert!(done.status.success(), "{line}: {}", String::from_utf8_lossy(&done.stderr));
        let written = outputs(&line);
        assert!(!written.is_empty(), "{line} writes nothing that could be looked at");
        for name in written {
            let path: PathBuf = folder.path(name);
            let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{line}: {name}: {e}"));
            let start = String::from_utf8_lossy(&bytes[..bytes.len().min(400)]).into_owned();
            assert!(is_what_it_says(name, &bytes), "{line}: {name} begins with {start}");
            // A problem is JSON as well, and belongs into the file of that name only.
            assert_eq!(
                start.contains("\"status\":4") || start.contains("\"status\": 4"),
                name.contains("problem"),
                "{line}: {start}"
            );
            std::fs::remove_file(path).unwrap();
        }
    }
}

#[test]
fn control_lines_and_files_are_told_apart() {
    let text = "```sh\ncurl -o a.glb \\\n  http://x\nls\n```\n```\ncurl no\n```\n```sh\ncurl http://y > b.ply\n```";
    let lines = curl_lines(text);
    assert_eq!(lines.len(), 2);
    assert_eq!((outputs(&lines[0]), outputs(&lines[1])), (vec!["a.glb"], vec!["b.ply"]));
    let problem = b"{\"type\":\"about:blank\"}";
    assert!(
        !is_what_it_says("a.glb", problem) && !is_what_it_says("a.stl", problem) && is_what_it_says("a.json", problem)
    );
    assert!(!is_what_it_says("a.txt", problem) && !is_what_it_says("a.stl", &[0; 84]));
}
