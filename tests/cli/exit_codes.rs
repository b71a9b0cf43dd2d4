//! Every exit code of the help with its error message. A failure leaves no file.

use crate::cli_support;

use std::fs;
use std::path::Path;
#[cfg(target_os = "linux")]
use std::process::Command;

use cli_support::{Folder, assert_code, mesh, molmesh, pdb, piped, rod, run, stderr, stdout};

/// Runs a mesh that must fail with `code` and leave no file. Returns stderr.
#[track_caller]
fn fails(input: impl AsRef<[u8]>, flags: &[&str], code: i32) -> String {
    let folder = Folder::new();
    let input = folder.file("in.pdb", input);
    let done = mesh(&input, &folder.path("out.glb"), flags);
    assert_code(&done, code);
    assert_eq!(folder.entries(), ["in.pdb"], "{flags:?}");
    assert_eq!(stdout(&done), "", "{flags:?}");
    stderr(&done)
}

#[test]
fn bad_parameters_exit_with_2() {
    let cases: [(&[&str], &str); 18] = [
        (&["--resolution", "0"], "resolution"),
        (&["--resolution", "-1"], "resolution"),
        (&["--resolution", "fine"], "`fine`"),
        (&["--resolution", "NaN"], "resolution"),
        (&["--resolution", "0.000001"], "resolution"),
        (&["--surface", "sphere"], "gaussian, soft-object, inverse-square"),
        (&["--preset", "best"], "preset"),
        (&["--isovalue", "1e300"], "isovalue"),
        (&["--surface", "soft-object", "--smoothness", "2"], "smoothness"),
        (&["--paper-a", "1"], "paper_b"),
        (&["--altloc", "AB"], "altloc"),
        (&["--select", "everything"], "select"),
        (&["--threads", "0"], "threads"),
        (&["--compress", "zip"], "none, quantize, meshopt"),
        (&["--compress", "meshopt", "--format", "gltf"], "expected none, quantize for gltf, or one of the formats glb"),
        (&["--compress", "meshopt", "--format", "stl"], "parameter `compress`: `meshopt` is not allowed"),
        (&["--compress", "quantize", "--format", "stl"], "glb, gltf"),
        (&["--isovalue", "900000"], "isovalue"),
    ];
    let message = fails(rod(), &["--select", "polymer and (chain A or resi 1-)"], 2);
    let pointed = "\n    polymer and (chain A or resi 1-)\n                                 ^";
    assert!(message.contains("parameter `select`, character 30: found `1-`") && message.contains(pointed), "{message}");
    for (flags, part) in cases {
        let message = fails(rod(), flags, 2);
        assert!(message.contains(part), "{flags:?}: {message}");
    }
}

#[test]
fn bad_flags_exit_with_2() {
    let cases: [&[&str]; 6] = [
        &["mesh"],
        &["mesh", "a.pdb"],
        &["mesh", "a.pdb", "-o", "b.glb", "--no-such-flag"],
        &["mesh", "a.pdb", "-o", "b.glb", "--backend", "abacus"],
        &["mesh", "a.pdb", "-o", "b.glb", "--threads", "many"],
        &["fold"],
    ];
    for args in cases {
        let done = run(args);
        assert_eq!(done.status.code(), Some(2), "{args:?}");
        assert!(stderr(&done).starts_with("molmesh: "), "{args:?}: {}", stderr(&done));
        assert_eq!(stdout(&done), "", "{args:?}");
    }
    for (args, part) in [
        (&["mesh", "a.pdb", "-o", "b.glb", "--max-input-bytes", "64kb"][..], "or a size such as 64MiB"),
        (
            &["mesh", "a.pdb", "-o", "b.glb", "--max-atoms", "1MiB"],
            "'1MiB' for '--max-atoms <N>': expected a whole number",
        ),
        (&["render", "a.pdb", "-o", "b.png", "--units", "nanometer"], "'--units' is an option of `molmesh mesh`"),
        (&["areas", "a.pdb", "--width", "9"], "'--width' is an option of `molmesh mesh`, `molmesh render`"),
        (&["mesh", "a.pdb", "-o", "b.xyz"], "--format: glb, gltf, ply, ply-text, stl, obj, vtp, vert, face\n"),
        (
            &["mesh", "a.pdb", "-o", "b.glb", "--format", "xyz"],
            "expected one of glb, gltf, ply, ply-text, stl, obj, vtp, vert, face\n",
        ),
        (&["mesh", "a.pdb", "-o", "b.glb", "--format", "png"], "molmesh render writes pictures"),
        (&["serve", "--metrics-listen", "9090"], "expected an address such as 127.0.0.1:8080, or none"),
        (&["serve", "--listen", "none"], "`server.listen` is \"none\"; expected an address such as 127.0.0.1:8080\n"),
    ] {
        let done = run(args);
        assert_eq!(done.status.code(), Some(2), "{args:?}");
        assert!(stderr(&done).contains(part), "{args:?}: {}", stderr(&done));
    }
    let bare = molmesh().output().unwrap();
    assert_eq!(bare.status.code(), Some(2));
    assert!(stderr(&bare).contains("Usage: molmesh"));
}

#[test]
fn unknown_output_formats_exit_with_2() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    for name in ["out", "out.pdf", "out.glb.gz"] {
        let done = mesh(&input, &folder.path(name), &[]);
        assert_code(&done, 2);
        assert!(stderr(&done).contains("hint: name the format with --format"), "{}", stderr(&done));
    }
    assert_code(&mesh(&input, &folder.path("out.glb"), &["--format", "pdf"]), 2);
    let packed = mesh(&input, &folder.path("out.ply"), &["--compress", "quantize"]);
    assert_code(&packed, 2);
    assert!(stderr(&packed).contains("`quantize` is not allowed; expected none for ply"), "{}", stderr(&packed));
    assert_eq!(folder.entries(), ["in.pdb"]);
}

#[test]
fn unreadable_inputs_exit_with_3() {
    let folder = Folder::new();
    let done = mesh(&folder.path("nowhere.pdb"), &folder.path("out.glb"), &[]);
    assert_code(&done, 3);
    assert!(stderr(&done).contains("nowhere.pdb: no such file or directory"), "{}", stderr(&done));
    fs::create_dir(folder.path("folder")).unwrap();
    assert_code(&mesh(&folder.path("folder"), &folder.path("out.glb"), &[]), 3);
    assert_eq!(folder.entries(), ["folder"]);
}

#[test]
fn invalid_structures_exit_with_4() {
    for bytes in [&b""[..], b"\n\n", b"hello", b"\x00\x01\x02\xff", b"END\n", b"HEADER    X\nREMARK   1\nEND\n"] {
        fails(bytes, &[], 4);
    }
    fails(rod().replace("   0.250", "     nan"), &[], 4);
    fails(pdb(&[[0.0; 3]]).replace("   0.000   0.000", " 9999999   0.000"), &[], 4);
    let message = fails(rod(), &["--chains", "Z"], 4);
    assert!(message.contains('Z') && message.contains('A'), "{message}");
    let message = fails(rod(), &["--model", "7"], 4);
    assert!(message.contains("model 7"), "{message}");
    let message = fails(rod(), &["--select", "water"], 4);
    assert!(message.contains("polymer"), "the error lists the content of the file: {message}");
    assert_code(&piped(&["mesh", "-", "-o", "-"], b"nothing"), 4);
}

#[test]
fn exceeded_limits_exit_with_5_and_are_named() {
    let message = fails(rod(), &["--max-atoms", "9"], 5);
    assert!(message.contains('9') && message.contains("hint: raise the limit with --max-atoms"), "{message}");
    let message = fails(rod(), &["--max-grid-points", "20_000", "--resolution", "0.1"], 5);
    assert!(message.contains("limit is 20000") && message.contains("hint: try --resolution "), "{message}");
    let message = fails(rod(), &["--max-grid-points", "100"], 5);
    let hint = "hint: raise the limit with --max-grid-points";
    assert!(message.contains("limit is 100") && message.contains(hint), "{message}");
    let message = fails(rod(), &["--max-mesh-bytes", "1000"], 5);
    assert!(message.contains("limit is 1000") && message.contains("hint: try --resolution "), "{message}");
    let message = fails(rod(), &["--max-input-bytes", "100"], 5);
    assert!(message.contains("100 bytes"), "{message}");
    let message = fails(rod().repeat(200), &["--max-input-bytes", "64KiB"], 5);
    assert!(message.contains("65536 bytes"), "{message}");
    assert_code(&piped(&["mesh", "-", "-o", "-", "--max-input-bytes", "100"], rod().as_bytes()), 5);
}

#[test]
fn suggested_resolution_is_accepted() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let limit = ["--max-grid-points", "50000"];
    let done = mesh(&input, &folder.path("out.glb"), &[limit[0], limit[1], "--resolution", "0.1"]);
    assert_code(&done, 5);
    let message = stderr(&done);
    let suggested = message.split("--resolution ").nth(1).unwrap().split(',').next().unwrap();
    assert_code(&mesh(&input, &folder.path("out.glb"), &[limit[0], limit[1], "--resolution", suggested]), 0);
}

#[test]
fn missing_backends_exit_with_6() {
    let message = fails(rod(), &["--backend", "gpu", "--devices", "77"], 6);
    assert!(message.contains("no backend `gpu`") && message.contains("GPU"), "{message}");
}

#[test]
fn unwritable_outputs_exit_with_7() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let done = mesh(&input, &folder.path("no/such/folder/out.glb"), &[]);
    assert_code(&done, 7);
    assert!(stderr(&done).contains("hint: the directory must exist"), "{}", stderr(&done));
    fs::create_dir(folder.path("out.glb")).unwrap();
    assert_code(&mesh(&input, &folder.path("out.glb"), &[]), 7);
    assert_eq!(folder.entries(), ["in.pdb", "out.glb"]);
}

#[cfg(target_os = "linux")]
#[test]
fn full_disk_exits_with_7() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let done = mesh(&input, Path::new("/dev/full"), &["--format", "glb"]);
    assert_code(&done, 7);
    assert!(stderr(&done).contains("no space left"), "{}", stderr(&done));
}

/// A disk of 16 MB is filled while a file is replaced: the old file stays, and nothing else.
#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_becomes_full_keeps_the_old_file() {
    let folder = Folder::new();
    let (disk, input) = (folder.path("disk"), folder.file("in.pdb", cli_support::block(12)));
    fs::create_dir(&disk).unwrap();
    let isolated = |script: &str, args: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["-m", "sh", "-c", &format!("mount -t tmpfs -o size=16m tmpfs \"$0\" && {script}")]).arg(&disk);
        command.args(args).output()
    };
    if !isolated("true", &[]).is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "a disk can be mounted only by root");
        return eprintln!("SKIPPED: a full disk: mounting needs root and unshare");
    }
    // Prints the content of the disk after the command.
    let script = "printf old > \"$0/$1\" && head -c \"$2\" /dev/zero > \"$0/other\" && shift 2 && \"$@\"; code=$?; \
                  cd \"$0\" && ls -A && head -c 99 out.*; exit $code";
    for (command, output, filled, resolution, code) in [
        ("mesh", "out.stl", "0", "0.1", 7),
        ("mesh", "out.glb", "0", "0.1", 7),
        ("mesh", "out.obj", "0", "0.1", 7),
        ("render", "out.png", "16740000", "1", 7),
        // Control: the disk is large enough.
        ("mesh", "out.stl", "0", "2", 0),
        ("render", "out.png", "1000", "1", 0),
    ] {
        let path = disk.join(output).into_os_string().into_string().unwrap();
        let program = [env!("CARGO_BIN_EXE_molmesh"), command, input.to_str().unwrap(), "-o", &path];
        let args = [&[output, filled][..], &program, &["--backend", "cpu", "--resolution", resolution]].concat();
        let done = isolated(script, &args).unwrap();
        assert_eq!(done.status.code(), Some(code), "{output}: {}", stderr(&done));
        let left = String::from_utf8_lossy(&done.stdout);
        assert!(left.starts_with(&format!("other\n{output}\n")), "{output}: {left}");
        if code == 7 {
            assert_eq!(left, format!("other\n{output}\nold"));
            assert!(stderr(&done).contains("no space left"), "{output}: {}", stderr(&done));
        }
    }
}

#[cfg(unix)]
#[test]
fn closed_pipe_exits_with_7() {
    use std::process::Stdio;
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let mut child = molmesh();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let child = child.arg("mesh").arg(input).args(["-o", "-", "--resolution", "0.1"]).stdout(writer);
    assert_code(&child.stderr(Stdio::piped()).spawn().unwrap().wait_with_output().unwrap(), 7);
}

#[test]
fn failure_keeps_the_old_file() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", "no structure");
    let output = folder.file("out.glb", "old");
    assert_code(&mesh(&input, &output, &[]), 4);
    assert_eq!(fs::read(&output).unwrap(), b"old");
    assert_eq!(folder.entries(), ["in.pdb", "out.glb"]);
}

#[test]
fn unreachable_service_exits_with_1() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}/readyz", listener.local_addr().unwrap());
    drop(listener);
    assert_code(&run(["healthcheck", "--url", &url, "--timeout", "1"]), 1);
    assert_code(&run(["healthcheck", "--url", "ftp://x"]), 2);
    assert_code(&run(["healthcheck", "--timeout=-1"]), 2);
}

#[cfg(unix)]
#[test]
fn the_output_never_replaces_the_input() {
    let folder = Folder::new();
    let input = folder.file("a.ply", rod());
    let (link, hard, picture) = (folder.path("link.ply"), folder.path("hard.ply"), folder.path("a.png"));
    std::os::unix::fs::symlink(&input, &link).unwrap();
    fs::hard_link(&input, &hard).unwrap();
    fs::hard_link(&input, &picture).unwrap();
    let render = |output: &Path| molmesh().arg("render").arg(&input).arg("-o").arg(output).output().unwrap();
    let redirected = |output: &Path| {
        let stdin = fs::File::open(&input).unwrap();
        molmesh().args(["mesh", "-", "-o"]).arg(output).stdin(stdin).output().unwrap()
    };
    for done in [
        mesh(&input, &input, &[]),
        mesh(&input, &link, &[]),
        mesh(&link, &input, &[]),
        mesh(&input, &hard, &[]),
        redirected(&input),
        redirected(&link),
        render(&picture),
    ] {
        assert_code(&done, 2);
        assert!(stderr(&done).contains("is the input"), "{}", stderr(&done));
        assert_eq!(fs::read_to_string(&input).unwrap(), rod());
    }
    // A copy is another file.
    let copy = folder.file("copy.ply", rod());
    assert_code(&mesh(&input, &copy, &[]), 0);
    assert!(fs::read(&copy).unwrap().starts_with(b"ply"));
    assert_eq!(folder.entries(), ["a.ply", "a.png", "copy.ply", "hard.ply", "link.ply"]);
}

/// Runs the binary with a terminal as stdout and stderr. Returns the exit code and what the terminal received.
#[cfg(target_os = "linux")]
fn on_a_terminal(args: &str) -> (Option<i32>, Vec<u8>) {
    let line = format!("{} {args}", env!("CARGO_BIN_EXE_molmesh"));
    let command = ["-q", "-e", "-c", &line, "/dev/null"];
    let done = std::process::Command::new("script").args(command).stdin(std::process::Stdio::null()).output();
    let done = done.expect("`script` of util-linux");
    (done.status.code(), done.stdout)
}

#[cfg(target_os = "linux")]
#[test]
fn binary_files_are_not_written_to_a_terminal() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let input = input.display();
    for args in [
        format!("mesh {input} -o -"),
        format!("mesh {input} -o - --format stl"),
        format!("mesh {input} -o /dev/tty --format ply"),
        format!("render {input} -o -"),
    ] {
        let (code, shown) = on_a_terminal(&args);
        let shown = String::from_utf8(shown).unwrap();
        assert_eq!(code, Some(2), "{args}: {shown}");
        assert!(shown.contains("is a terminal, and") && shown.contains("hint:"), "{args}: {shown}");
    }
    let (code, shown) = on_a_terminal(&format!("mesh {input} -o - --format obj --quiet"));
    assert_eq!(code, Some(0));
    assert!(String::from_utf8_lossy(&shown).contains("\r\nv "), "text formats may be shown");
}
