//! The static executable, without GPU support. `make test` builds it with the profile of the tests.
#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "tests fail by panicking")]

use crate::cli_support;
use crate::tools;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::SystemTime;

use cli_support::{Folder, Service, assert_code, mesh, molmesh, prepared, stderr, stdout};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Returns the time of the newest change below `path`.
fn changed(path: &Path) -> SystemTime {
    let own = fs::metadata(path).unwrap();
    let below =
        if own.is_dir() { fs::read_dir(path).unwrap().map(|e| changed(&e.unwrap().path())).max() } else { None };
    // The time of a folder changes with the names of its entries.
    below.map_or(own.modified().unwrap(), |below| below.max(own.modified().unwrap()))
}

/// Returns the static executable, if it is newer than the sources.
fn tool() -> Option<PathBuf> {
    let root = Path::new(ROOT);
    let tool = root.join(format!("target/{}-unknown-linux-musl/debug/molmesh", std::env::consts::ARCH));
    let built = fs::metadata(&tool).and_then(|meta| meta.modified()).ok();
    let sources = ["src", "crates", "Cargo.toml", "Cargo.lock"].map(|name| changed(&root.join(name))).into_iter().max();
    if built.is_some() && built >= sources {
        return Some(tool);
    }
    let why = if built.is_some() { "is older than the sources" } else { "does not exist" };
    tools::skip(&format!("{} {why}; make static-if-possible builds it", tool.display()))
}

fn run(tool: &Path, args: &[&str]) -> Output {
    Command::new(tool).args(args).current_dir(ROOT).output().unwrap()
}

/// Returns the types of the program headers of a 64-bit little-endian ELF file.
fn segments(elf: &[u8]) -> Vec<u32> {
    assert_eq!(&elf[..6], b"\x7fELF\x02\x01");
    let word = |at: usize| u32::from_le_bytes(elf[at..at + 4].try_into().unwrap());
    let half = |at: usize| usize::from(u16::from_le_bytes(elf[at..at + 2].try_into().unwrap()));
    let first = usize::try_from(u64::from_le_bytes(elf[32..40].try_into().unwrap())).unwrap();
    (0..half(56)).map(|i| word(first + i * half(54))).collect()
}

#[test]
fn needs_no_loader() {
    const PT_LOAD: u32 = 1;
    const PT_INTERP: u32 = 3;
    let Some(tool) = tool() else { return };
    let static_one = segments(&fs::read(&tool).unwrap());
    assert!(static_one.contains(&PT_LOAD) && !static_one.contains(&PT_INTERP), "{static_one:?}");
    // Control: the usual executable has a loader.
    assert!(segments(&fs::read(env!("CARGO_BIN_EXE_molmesh")).unwrap()).contains(&PT_INTERP));
}

#[test]
fn writes_the_same_bytes_as_the_usual_executable() {
    let Some(tool) = tool() else { return };
    let folder = Folder::new();
    let (ours, theirs) = (folder.path("static"), folder.path("usual"));
    for sample in ["4pti.pdb", "1crn.cif"] {
        for (format, more) in [
            ("glb", &["--resolution", "0.5"][..]),
            ("glb", &["--surface", "soft-object", "--threads", "3"]),
            ("glb", &["--compress", "quantize", "--ligands", "--waters"]),
            ("glb", &["--compress", "meshopt", "--color", "chain", "--atom-ids"]),
            ("ply", &["--surface", "inverse-square", "--atom-ids", "--resolution", "1"]),
            ("stl", &["--validation", "exact"]),
            ("obj", &["--normals", "none"]),
            ("obj", &["--units", "nanometer"]),
        ] {
            let input = Path::new(ROOT).join("samples").join(sample);
            let mut flags = vec!["--backend", "cpu", "--quiet", "--format", format];
            flags.extend(more);
            assert_code(&mesh(&input, &theirs, &flags), 0);
            let mut args = vec!["mesh", input.to_str().unwrap(), "-o", ours.to_str().unwrap()];
            args.extend(flags);
            assert_code(&run(&tool, &args), 0);
            assert!(fs::read(&ours).unwrap() == fs::read(&theirs).unwrap(), "{sample} {format} {more:?}");
        }
    }
}

#[test]
fn renders_and_rejects_like_the_usual_executable() {
    let Some(tool) = tool() else { return };
    let folder = Folder::new();
    let (ours, theirs) = (folder.path("static.png"), folder.path("usual.png"));
    let draw = |to: &Path| -> Vec<String> {
        let to = to.to_str().unwrap();
        let args = ["render", "samples/4pti.pdb", "-o", to, "--backend", "cpu", "--width", "64", "--height", "48"];
        args.map(str::to_owned).to_vec()
    };
    assert_code(&Command::new(&tool).args(draw(&ours)).current_dir(ROOT).output().unwrap(), 0);
    assert_code(&molmesh().args(draw(&theirs)).current_dir(ROOT).output().unwrap(), 0);
    let drawn = fs::read(&ours).unwrap();
    assert!(drawn.starts_with(b"\x89PNG") && drawn == fs::read(&theirs).unwrap());

    let broken =
        folder.file("broken.pdb", "ATOM      1  CA  ALA A   1       x.xxx   0.250  -0.750  1.00  0.00           C\n");
    let output = folder.path("broken.glb");
    let refused = run(&tool, &["mesh", broken.to_str().unwrap(), "-o", output.to_str().unwrap()]);
    assert_code(&refused, 4);
    assert_eq!(stderr(&refused), stderr(&mesh(&broken, &output, &[])));
}

#[test]
fn serves_without_gpu_support() {
    let Some(tool) = tool() else { return };
    let version = run(&tool, &["version"]);
    assert_code(&version, 0);
    assert_eq!(stdout(&version), concat!("molmesh ", env!("CARGO_PKG_VERSION"), " (without GPU support)\n"));

    let folder = Folder::new();
    let data = folder.path("doctor");
    let flags = ["--report", "json", "--listen", "127.0.0.1:0", "--data-dir", data.to_str().unwrap()];
    let doctor = prepared(Command::new(&tool)).arg("doctor").args(flags).output().unwrap();
    assert_code(&doctor, 0);
    let document: serde_json::Value = serde_json::from_slice(&doctor.stdout).unwrap();
    assert_eq!((&document["molmesh"]["gpu"], &document["backend"]["name"]), (&false.into(), &"cpu".into()));
    let (code, log) = Service::start_as(prepared(Command::new(&tool)), &folder, &[]).stop("TERM");
    assert_eq!(code, Some(0), "{log}");

    let output = folder.path("4pti.glb");
    let gpu = run(&tool, &["mesh", "samples/4pti.pdb", "-o", output.to_str().unwrap(), "--backend", "gpu"]);
    assert_code(&gpu, 6);
    assert!(stderr(&gpu).contains("this build has no GPU support"), "{}", stderr(&gpu));
}
