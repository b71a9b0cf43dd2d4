//! Checks of the documentation: the first block of the README has the two commands, the shell and Python blocks of all
//! pages run, and the page of errors lists every error type.
//!
//! Blocks marked `sh` and `python` run; blocks marked `console` (docker, kubectl, make, endless commands) do not.
#![cfg(unix)]

use crate::cli_support;
use crate::tools;

use std::path::{Path, PathBuf};
use std::process::Command;

use cli_support::{Folder, Service};
use serde_json::Value;

/// Address of the service in the documentation.
const ADDRESS: &str = "127.0.0.1:8080";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns README.md and the pages below `docs` with their texts, sorted by path.
fn pages() -> Vec<(PathBuf, String)> {
    let mut folders = vec![root().join("docs")];
    let mut paths = vec![root().join("README.md")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "md") {
                paths.push(path);
            }
        }
    }
    paths.sort();
    let read = |path: PathBuf| {
        let text = std::fs::read_to_string(&path).unwrap();
        (path.strip_prefix(root()).unwrap().to_owned(), text)
    };
    paths.into_iter().map(read).collect()
}

/// Returns all blocks of `language` in a page as one script with continued lines joined. Empty if there are none.
fn script(page: &str, language: &str) -> String {
    let start = format!("```{language}");
    let mut lines = page.lines();
    let mut found = String::new();
    while lines.any(|line| line == start) {
        for line in lines.by_ref().take_while(|line| *line != "```") {
            match line.strip_suffix('\\') {
                Some(continued) => found.push_str(continued),
                None => found.extend([line, "\n"]),
            }
        }
    }
    found
}

/// Returns the files that a script writes: words after `-o` and `>` that are plain names.
fn outputs(script: &str) -> Vec<&str> {
    let words: Vec<&str> = script.split_whitespace().collect();
    let written = words.windows(2).filter(|w| ["-o", ">"].contains(&w[0])).map(|w| w[1]);
    written.filter(|name| name.contains('.') && !name.contains(['"', '$'])).collect()
}

/// Returns true if `bytes` are a problem document.
fn is_problem(bytes: &[u8]) -> bool {
    let document = serde_json::from_slice::<Value>(bytes).unwrap_or_default();
    document["type"].as_str().is_some_and(|kind| kind.starts_with("/problems/"))
}

/// Returns true if the content of a file matches its name. Problem documents require a matching name.
fn agrees_with_name(name: &str, bytes: &[u8]) -> bool {
    let extension = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default();
    let well_formed = match extension {
        "glb" => bytes.starts_with(b"glTF\x02\x00\x00\x00"),
        "ply" => bytes.starts_with(b"ply\nformat binary_little_endian 1.0\n"),
        "obj" => bytes.starts_with(b"#") && bytes.windows(3).any(|w| w == b"\nf "),
        "png" => bytes.starts_with(b"\x89PNG\r\n\x1a\n"),
        "json" | "gltf" => serde_json::from_slice::<Value>(bytes).is_ok_and(|v| v.is_object()),
        "txt" => !bytes.is_empty(),
        "vert" | "face" => bytes.starts_with(b"# molmesh ") && String::from_utf8_lossy(bytes).lines().count() > 100,
        "csv" => {
            let text = String::from_utf8_lossy(bytes);
            let mut columns = text.lines().map(|line| line.split(',').count());
            columns.next().is_some_and(|n| n > 1 && columns.clone().count() > 0 && columns.all(|other| other == n))
        }
        "dx" => bytes.starts_with(b"object 1 class gridpositions"),
        // Four bytes an atom, the last of which is opaque.
        "bin" => !bytes.is_empty() && bytes.len().is_multiple_of(4) && bytes.chunks(4).all(|color| color[3] == 255),
        // 80 bytes of header, a count, 50 bytes for each triangle.
        "stl" => {
            bytes.len() > 84 && {
                let n = u32::from_le_bytes([bytes[80], bytes[81], bytes[82], bytes[83]]) as usize;
                n > 0 && bytes.len() == 84 + 50 * n
            }
        }
        _ => false,
    };
    well_formed && is_problem(bytes) == name.contains("problem")
}

/// Creates a folder with the samples.
fn folder_with_samples() -> Folder {
    let folder = Folder::new();
    std::os::unix::fs::symlink(root().join("samples"), folder.path("samples")).unwrap();
    folder
}

/// Runs the `sh` blocks of a page with the built binary and checks the files that they write.
fn run(service: &Service, script: &str) -> Result<(), String> {
    for line in script.lines().filter(|line| line.contains("curl ")) {
        if !line.contains(ADDRESS) || !line.contains("--fail-with-body") {
            return Err(format!("{line}: needs {ADDRESS} and --fail-with-body"));
        }
    }
    let folder = folder_with_samples();
    let binary = Path::new(env!("CARGO_BIN_EXE_molmesh")).parent().unwrap();
    let path = std::env::join_paths(
        [binary.to_owned()].into_iter().chain(std::env::split_paths(&std::env::var_os("PATH").unwrap())),
    );
    let done = Command::new("sh")
        .args(["-euc", &script.replace(ADDRESS, &service.addr)])
        .current_dir(folder.path(""))
        .env("PATH", path.unwrap())
        .env("NODEVICE_SELECT", "1")
        .env("MOLMESH__ARCHIVE__URL", "none")
        .output()
        .unwrap();
    if !done.status.success() {
        return Err(format!("{}: {}", done.status, String::from_utf8_lossy(&done.stderr)));
    }
    for name in outputs(script) {
        let bytes = std::fs::read(folder.path(name)).map_err(|error| format!("{name}: {error}"))?;
        if !agrees_with_name(name, &bytes) {
            return Err(format!("{name}: {}", String::from_utf8_lossy(&bytes[..bytes.len().min(400)])));
        }
    }
    Ok(())
}

/// Starts a service with the samples as its archive.
fn service(folder: &Folder) -> Service {
    Service::start(folder, &["--archive", root().join("samples").to_str().unwrap()])
}

/// Returns the rows that are missing in a page's table of errors.
fn missing_rows(page: &str, types: &Value) -> Vec<String> {
    let row = |kind: &Value| {
        let slug = kind["type"].as_str().unwrap().trim_start_matches("/problems/");
        format!("| `{slug}` | {} |", kind["status"])
    };
    types.as_array().unwrap().iter().map(row).filter(|row| !page.contains(row)).collect()
}

#[test]
fn the_first_block_of_the_readme_has_the_two_commands() {
    let read = |name: &str| std::fs::read_to_string(root().join(name)).unwrap();
    let readme = read("README.md");
    let block = readme.lines().skip_while(|line| !line.starts_with("```")).skip(1);
    let code: Vec<&str> = block.take_while(|line| *line != "```").collect();
    assert_eq!(code, ["make run", "make test"]);
    assert!(read(".ci/run").lines().any(|line| line == code[1]), "CI runs another command");
    assert!(read("Makefile").lines().any(|line| line.starts_with("run: ")), "there is no target for {}", code[0]);
}

#[test]
fn every_shell_block_runs() {
    let folder = Folder::new();
    let service = service(&folder);
    let mut ran = Vec::new();
    for (path, page) in pages() {
        let script = script(&page, "sh");
        if !script.is_empty() {
            run(&service, &script).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            assert!(!outputs(&script).is_empty(), "{}: no file to check", path.display());
            ran.push(path.to_str().unwrap().to_owned());
        }
    }
    for page in ["README.md", "docs/start/cli.md", "docs/start/web.md", "docs/api/meshes.md", "docs/api/jobs.md"] {
        assert!(ran.iter().any(|path| path == page), "{page} has no block that runs: {ran:?}");
    }
    // Controls: an error of the service, a failing command, a file whose content does not match its name.
    let url = format!("http://{ADDRESS}/v1/pdb/4pti");
    assert!(run(&service, &format!("curl -s --fail-with-body {url}/surface.glb -o a.glb\n")).is_ok());
    assert!(run(&service, &format!("curl -s --fail-with-body {url}/surface.xyz -o a.glb\n")).is_err());
    assert!(run(&service, "molmesh mesh nowhere.pdb -o a.glb\n").is_err());
    assert!(run(&service, &format!("curl -s --fail-with-body {url}/surface.ply -o a.glb\n")).is_err());
    assert!(run(&service, &format!("curl -s {url}/surface.glb -o a.glb\n")).is_err());
}

#[test]
fn the_python_examples_run() {
    let Some(python) = tools::python_interpreter() else {
        tools::missing::<()>("the Python of the examples");
        return;
    };
    let folder = Folder::new();
    let service = service(&folder);
    let (_, page) = pages().into_iter().find(|(path, _)| path.ends_with("start/python.md")).unwrap();
    let program = script(&page, "python").replace(ADDRESS, &service.addr);
    assert!(program.lines().count() > 40, "{program}");
    let here = folder_with_samples();
    let python =
        |program: &str| Command::new(&python).args(["-c", program]).current_dir(here.path("")).output().unwrap();
    let done = python(&program);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(agrees_with_name("4pti.glb", &std::fs::read(here.path("4pti.glb")).unwrap()));
    // Control: an unknown parameter.
    assert!(!python(&program.replace("max_triangles=", "max_triangle=")).status.success());
}

#[test]
fn the_page_of_errors_lists_every_type() {
    let folder = Folder::new();
    let service = service(&folder);
    let address = format!("http://{}/problems", service.addr);
    let reply = Command::new("curl").args(["-sS", "--fail-with-body", &address]).output().unwrap();
    let types: Value = serde_json::from_slice(&reply.stdout).unwrap();
    assert!(types.as_array().unwrap().len() > 40, "{types}");
    let page = std::fs::read_to_string(root().join("docs/api/errors.md")).unwrap();
    assert_eq!(missing_rows(&page, &types), Vec::<String>::new());
    // Control: a different status.
    assert_eq!(missing_rows(&page.replace("| `deadline` | 504 |", "| `deadline` | 503 |"), &types).len(), 1);
}

#[test]
fn control_blocks_and_files_are_distinguished() {
    let page =
        "```sh\ncurl -o a.glb \\\n  http://x\nls\n```\n```console\ncurl no\n```\n```sh\ncurl http://y > b.ply\n```\n";
    let script = script(page, "sh");
    assert_eq!(script, "curl -o a.glb   http://x\nls\ncurl http://y > b.ply\n");
    assert_eq!(outputs(&script), ["a.glb", "b.ply"]);
    assert_eq!(outputs("molmesh mesh - -o - --quiet; x -o \"m/$n.glb\""), [""; 0]);
    let problem = b"{\"type\":\"/problems/deadline\"}";
    assert!(agrees_with_name("problem.json", problem) && agrees_with_name("a.json", b"{\"type\":\"process\"}"));
    assert!(!agrees_with_name("a.json", problem) && !agrees_with_name("problem.json", b"{}"));
    assert!(!agrees_with_name("a.glb", problem) && !agrees_with_name("a.stl", &[0; 84]));
    assert!(!agrees_with_name("a.unknown", b"x") && !agrees_with_name("a.txt", b""));
}
