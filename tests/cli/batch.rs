//! Several inputs of `molmesh mesh`, `areas` and `render`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;

use crate::cli_support::{Folder, block, molmesh, piped, rod, run, stderr, stdout};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Returns the path of a sample.
fn sample(name: &str) -> String {
    format!("{ROOT}/samples/{name}")
}

fn text(path: &Path) -> String {
    path.to_str().unwrap().to_owned()
}

#[track_caller]
fn assert_exit(done: &Output, code: i32) {
    assert_eq!(done.status.code(), Some(code), "{}", stderr(done));
}

/// Returns the lines of a summary.
fn lines(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))).collect()
}

/// Returns the sorted paths of all files below `folder`, relative to it.
fn files(folder: &Path) -> Vec<String> {
    fn walk(at: &Path, root: &Path, found: &mut Vec<String>) {
        for entry in fs::read_dir(at).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(&path, root, found);
            } else {
                found.push(path.strip_prefix(root).unwrap().to_str().unwrap().to_owned());
            }
        }
    }
    let mut found = Vec::new();
    walk(folder, folder, &mut found);
    found.sort();
    found
}

/// Writes a folder with three structures, one of them in a subfolder and compressed, a broken one, and another file.
fn structures(folder: &Folder) -> PathBuf {
    let root = folder.path("structures");
    fs::create_dir_all(root.join("sub")).unwrap();
    fs::copy(sample("4pti.pdb"), root.join("4pti.pdb")).unwrap();
    fs::copy(sample("1crn.cif"), root.join("1crn.cif")).unwrap();
    fs::copy(format!("{ROOT}/tests/structures/1ubq.pdb.gz"), root.join("sub/1ubq.pdb.gz")).unwrap();
    fs::write(root.join("broken.pdb"), "no structure").unwrap();
    fs::write(root.join("README.md"), "not a structure").unwrap();
    root
}

#[test]
fn a_folder_gives_the_files_of_single_runs() {
    let folder = Folder::new();
    let root = structures(&folder);
    let mut of_jobs = Vec::new();
    for jobs in ["1", "2"] {
        let out = folder.path(&format!("out-{jobs}"));
        let summary = folder.path(&format!("{jobs}.jsonl"));
        let done = molmesh()
            .args(["mesh", &text(&root), "-o", &text(&out), "--resolution", "1", "--jobs", jobs, "--summary"])
            .arg(&summary)
            .output()
            .unwrap();
        assert_exit(&done, 9);
        assert_eq!(stdout(&done), "");
        let messages = stderr(&done);
        assert!(messages.contains("broken.pdb: "), "{messages}");
        assert!(messages.contains("4 files: 3 written, 0 skipped, 1 failed, in "), "{messages}");
        let last = "molmesh: 1 of 4 files failed: the structure or the map is rejected (1)";
        assert_eq!(messages.lines().last(), Some(last));
        assert_eq!(files(&out), ["1crn.glb", "4pti.glb", "sub/1ubq.glb"]);
        let lines = lines(&fs::read_to_string(summary).unwrap());
        let members = |name: &str| lines.iter().map(|line| line[name].clone()).collect::<Vec<_>>();
        assert_eq!(members("status"), ["written", "written", "failed", "written"]);
        assert_eq!(lines[2]["exit_code"], 4);
        assert!(lines[2]["error"].as_str().unwrap().contains("broken.pdb"), "{}", lines[2]);
        assert!(lines[3]["input"].as_str().unwrap().ends_with("sub/1ubq.pdb.gz"), "{}", lines[3]);
        assert_eq!(lines[1]["report"]["id"], "4PTI");
        assert!(lines[1]["report"]["output"]["bytes"].as_u64().unwrap() > 10_000 && lines[1]["seconds"].is_f64());
        of_jobs.push(out);
    }
    for (input, output) in [("1crn.cif", "1crn.glb"), ("4pti.pdb", "4pti.glb"), ("sub/1ubq.pdb.gz", "sub/1ubq.glb")] {
        let single = folder.path("single.glb");
        let done = run(["mesh", &text(&root.join(input)), "-o", &text(&single), "--resolution", "1", "-q"]);
        assert_exit(&done, 0);
        let expected = fs::read(single).unwrap();
        for out in &of_jobs {
            assert!(fs::read(out.join(output)).unwrap() == expected, "{}", out.join(output).display());
        }
    }
}

/// One run writes the mesh, the table and the picture that three commands write.
#[test]
fn a_run_gives_mesh_areas_and_picture() {
    let folder = Folder::new();
    let (input, out) = (sample("1crn.cif"), folder.path("out"));
    let shape = ["--surface", "sas", "--resolution", "1"];
    let picture = ["--width", "96", "--height", "64", "--background", "white"];
    let single = |command: &str, output: &str, flags: &[&str]| {
        let output = folder.path(output);
        assert_exit(&run([&[command, &input, "-o", &text(&output), "-q"], flags].concat()), 0);
        fs::read(output).unwrap()
    };
    let table = single("areas", "a.csv", &["--surface", "sas", "--by", "chain"]);
    let image = single("render", "a.png", &[&shape[..], &picture].concat());
    for compress in ["none", "quantize", "meshopt"] {
        let flags = [&shape[..], &["--compress", compress]].concat();
        let mesh = single("mesh", "a.glb", &flags);
        let more = [&flags[..], &picture, &["--areas=chain", "--picture", "--report", "json"]].concat();
        let done = run([&["mesh", &input, "-o", &text(&out)], &more[..]].concat());
        assert_exit(&done, 0);
        assert_eq!(files(&out), ["1crn.csv", "1crn.glb", "1crn.png"]);
        assert!(fs::read(out.join("1crn.glb")).unwrap() == mesh, "{compress}");
        assert!(fs::read(out.join("1crn.csv")).unwrap() == table, "{compress}");
        assert!(fs::read(out.join("1crn.png")).unwrap() == image, "{compress}");
        let report = &lines(&stdout(&done))[0]["report"];
        for (member, format) in [("output", "glb"), ("area_table", "csv"), ("picture_file", "png")] {
            assert_eq!(report[member]["format"], format, "{report}");
        }
        assert_eq!(report["picture"]["width"], 96);
    }
    for (flags, part) in [
        (&["--areas"][..], "`--areas` needs exact areas"),
        (&["--areas=model", "--surface", "ses"], "parameter `by`"),
        (&["--width", "9"], "`--width` needs `--picture`"),
        (&["--picture", "--width", "0"], "parameter `width`"),
        (&["--picture", "--tile", "0/0/0/0"], "leave out `--tile`"),
        (&["--table", "x.csv"], "--areas"),
    ] {
        let done = run([&["mesh", &input, "-o", &text(&out)], flags].concat());
        assert_exit(&done, 2);
        assert!(stderr(&done).contains(part), "{flags:?}: {}", stderr(&done));
    }
}

#[test]
fn pictures_of_several_inputs_are_those_of_single_runs() {
    let folder = Folder::new();
    let (out, single) = (folder.path("out"), folder.path("single.png"));
    let flags = ["--resolution", "1", "--width", "64", "--height", "64", "-q"];
    let inputs = [sample("1crn.cif"), sample("4pti.pdb")];
    let done = run([&["render", &inputs[0], &inputs[1], "-o", &text(&out), "--jobs", "2"], &flags[..]].concat());
    assert_exit(&done, 0);
    assert_eq!(stderr(&done), "");
    assert_eq!(files(&out), ["1crn.png", "4pti.png"]);
    for (input, output) in inputs.iter().zip(files(&out)) {
        assert_exit(&run([&["render", input, "-o", &text(&single)], &flags[..]].concat()), 0);
        assert!(fs::read(out.join(&output)).unwrap() == fs::read(&single).unwrap(), "{output}");
    }
}

/// Returns the rows of the tables of single runs under one header, with the inputs in the first column.
fn joined(inputs: &[String]) -> String {
    let mut text = String::new();
    for input in inputs {
        let table = stdout(&run(["areas", input, "--surface", "sas", "-q"]));
        for (number, row) in table.lines().enumerate() {
            match (number, text.is_empty()) {
                (0, true) => text = format!("input,{row}\n"),
                (0, false) => {}
                _ => text.extend([input.as_str(), ",", row, "\n"]),
            }
        }
    }
    text
}

#[test]
fn areas_of_several_inputs_are_one_table_or_one_file_each() {
    let folder = Folder::new();
    let (out, all) = (folder.path("out"), folder.path("all.csv"));
    let inputs = [sample("4pti.pdb"), sample("1crn.cif")];
    let expected = joined(&inputs);
    assert!(expected.lines().count() > 90, "{expected}");
    let flags = ["areas", &inputs[0], &inputs[1], "--surface", "sas"];
    // To stdout, with the summary on stderr.
    let done = run([&flags[..], &["--jobs", "2", "--report", "json"]].concat());
    assert_exit(&done, 0);
    assert_eq!(stdout(&done), expected);
    assert_eq!(lines(&stderr(&done)).len(), 2);
    assert_exit(&run([&flags[..], &["-o", &text(&all), "-q"]].concat()), 0);
    assert_eq!(fs::read_to_string(&all).unwrap(), expected);
    // A table for each input; a joined table is complete if inputs are skipped.
    let more = ["-o", &text(&out), "--table", &text(&all), "--skip-existing"];
    for (counts, is_new) in [("2 written, 0 skipped", true), ("1 written, 1 skipped", false)] {
        fs::remove_file(&all).unwrap();
        let done = run([&flags[..], &more].concat());
        assert_exit(&done, 0);
        assert!(stderr(&done).contains(counts), "{}", stderr(&done));
        assert_eq!(fs::read_to_string(&all).unwrap(), expected);
        assert_eq!(files(&out), ["1crn.csv", "4pti.csv"]);
        if is_new {
            fs::remove_file(out.join("1crn.csv")).unwrap();
        }
    }
    for flags in [&["--skip-existing"][..], &["-o", "x.csv", "--table", "y.csv"], &["--jobs", "0"]] {
        let done = run([&["areas", &inputs[0], &inputs[1], "--surface", "sas"], flags].concat());
        assert_exit(&done, 2);
        assert_eq!(stdout(&done), "", "{flags:?}");
    }
}

#[test]
fn a_broken_input_leaves_no_rows() {
    let folder = Folder::new();
    let broken = folder.file("broken.pdb", "no structure");
    let missing = folder.path("missing.pdb");
    let good = sample("1crn.cif");
    let done = run(["areas", &text(&broken), &good, &text(&missing), "--surface", "sas", "-q"]);
    assert_exit(&done, 9);
    assert_eq!(stdout(&done), joined(&[good]));
    let reasons = "2 of 3 files failed: the input cannot be read (1), the structure or the map is rejected (1)\n";
    assert!(stderr(&done).ends_with(reasons), "{}", stderr(&done));
    assert!(stderr(&done).contains("missing.pdb: no such file"), "{}", stderr(&done));
}

#[test]
fn lists_are_read_from_files_and_stdin() {
    let folder = Folder::new();
    let out = folder.path("out");
    let list = format!("{}\n\n{}\r\n", sample("1crn.cif"), sample("4pti.pdb"));
    let flags = ["--format", "ply-text", "--resolution", "2", "-q"];
    let done = piped(&[&["mesh", "--list", "-", "-o", &text(&out)], &flags[..]].concat(), list.as_bytes());
    assert_exit(&done, 0);
    assert_eq!(files(&out), ["1crn.ply", "4pti.ply"]);
    assert!(fs::read(out.join("1crn.ply")).unwrap().starts_with(b"ply\nformat ascii"));
    fs::remove_dir_all(&out).unwrap();
    let file = folder.file("list.txt", list);
    assert_exit(&run([&["mesh", "--list", &text(&file), "-o", &text(&out)], &flags[..]].concat()), 0);
    assert_eq!(files(&out), ["1crn.ply", "4pti.ply"]);
    let empty = folder.file("empty.txt", "\n");
    assert_exit(&run(["mesh", "--list", &text(&empty), "-o", &text(&out)]), 3);
}

#[test]
fn equal_names_and_wrong_outputs_are_rejected_before_work_starts() {
    let folder = Folder::new();
    let input = folder.file("1crn.pdb", rod());
    let (sample, out) = (sample("1crn.cif"), folder.path("out"));
    let file = folder.file("file", "");
    for (args, part) in [
        (vec!["mesh", &sample, &text(&input), "-o", &text(&out)], "would both be written to"),
        (vec!["mesh", &sample, &sample, "-o", &text(&out)], "would both be written to"),
        (vec!["mesh", &sample, "-", "-o", &text(&out)], "stdin is a single structure"),
        (vec!["mesh", &sample, &text(&input), "-o", "-"], "several files cannot be written to stdout"),
        (vec!["mesh", &sample, &text(&input), "-o", "out.glb"], "`out.glb` is the name of a file"),
        (vec!["mesh", &sample, "-o", &text(&file), "--jobs", "2"], "is not a folder"),
        (vec!["mesh", &sample, "-o", &text(&out), "--jobs", "2", "--atoms", "a.csv"], "`--atoms` names the table"),
        (vec!["mesh", &sample, "-o", &text(&out), "--summary", &sample], "is the input"),
        (vec!["mesh", &sample, "-o", &text(&out), "--jobs", "1025"], "parameter `jobs`"),
        (vec!["mesh", &sample, "-o", &text(&out), "--jobs", "2", "--resolution", "0"], "resolution"),
    ] {
        let args: Vec<String> = args.into_iter().map(str::to_owned).collect();
        let done = run(&args);
        assert_exit(&done, 2);
        assert!(stderr(&done).contains(part), "{args:?}: {}", stderr(&done));
        assert!(!out.exists(), "{args:?}");
    }
    assert_eq!(folder.entries(), ["1crn.pdb", "file"]);
}

/// Different names of one file are found, also if it does not exist yet.
#[test]
fn outputs_that_are_the_same_file_are_rejected() {
    let folder = Folder::new();
    let (sample, out) = (sample("1crn.cif"), text(&folder.path("out")));
    folder.file("list.txt", &sample);
    folder.file("map.dx", "map");
    let (sample, whole) = (sample.as_str(), format!("{out}/1crn.csv"));
    let (same, input) = ("two outputs are written to", "is the input");
    let cases: [(&[&str], &str); 6] = [
        (&[sample, "--areas", "--table", "./out/1crn.csv"], same),
        (&[sample, "--areas", "--table", &whole], same),
        (&[sample, "--areas", "--table", "out/x.csv", "--summary", "./out/x.csv"], same),
        (&["--list", "list.txt", "--summary", "list.txt"], input),
        (&["--list", "list.txt", "--areas", "--table", "list.txt"], input),
        (&[sample, "--color", "map", "--map", "map.dx", "--summary", "./map.dx"], input),
    ];
    let in_folder = |args: &[&str]| {
        let mut command = molmesh();
        command.current_dir(folder.path("")).args(["mesh", "-o", "out", "--surface", "sas", "--resolution", "2"]);
        command.args(args).output().unwrap()
    };
    for (args, part) in cases {
        let done = in_folder(args);
        assert_exit(&done, 2);
        assert!(stderr(&done).contains(part), "{args:?}: {}", stderr(&done));
        assert_eq!(folder.entries(), ["list.txt", "map.dx"], "{args:?}");
    }
    assert_eq!(fs::read_to_string(folder.path("list.txt")).unwrap(), sample);
    assert_eq!(fs::read_to_string(folder.path("map.dx")).unwrap(), "map");
    // Through links to a folder and to a file.
    #[cfg(unix)]
    {
        use std::os::unix::fs::symlink;

        symlink(".", folder.path("link")).unwrap();
        let done = in_folder(&[sample, "--areas", "--table", "link/out/1crn.csv"]);
        assert!(done.status.code() == Some(2) && stderr(&done).contains(same), "{}", stderr(&done));
        fs::create_dir(&out).unwrap();
        folder.file("out/4pti.glb", "old");
        symlink("4pti.glb", folder.path("out/1crn.glb")).unwrap();
        let done = in_folder(&[sample, &self::sample("4pti.pdb")]);
        assert!(done.status.code() == Some(2) && stderr(&done).contains("would both be"), "{}", stderr(&done));
        assert_eq!(fs::read_to_string(folder.path("out/4pti.glb")).unwrap(), "old");
    }
}

#[test]
fn a_skipped_table_of_other_options_is_the_named_cause() {
    let folder = Folder::new();
    let (out, all) = (text(&folder.path("out")), text(&folder.path("all.csv")));
    let (first, second) = (sample("1crn.cif"), sample("4pti.pdb"));
    assert_exit(&run(["areas", &first, "-o", &format!("{out}/"), "--surface", "sas", "-q"]), 0);
    let flags = ["--surface", "sas", "--by", "chain", "--skip-existing", "-q"];
    let done = run([&["areas", &first, &second, "-o", &out, "--table", &all], &flags[..]].concat());
    assert_exit(&done, 9);
    let messages = stderr(&done);
    assert!(messages.contains("4pti.pdb` has other columns than those before it"), "{messages}");
    assert!(messages.contains("run without --skip-existing"), "{messages}");
}

/// A pipe has no earlier lines to wait for.
#[cfg(unix)]
#[test]
fn a_continued_summary_may_be_a_pipe() {
    use std::process::{Command, Stdio};

    let folder = Folder::new();
    let (out, pipe) = (text(&folder.path("out")), folder.path("pipe"));
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let reader = Command::new("cat").arg(&pipe).stdout(Stdio::piped()).spawn().unwrap();
    let input = sample("1crn.cif");
    let flags = ["--resolution", "2", "-q", "--skip-existing", "--summary", &text(&pipe)];
    assert_exit(&run([&["mesh", &input, "-o", &out], &flags[..]].concat()), 0);
    let read = reader.wait_with_output().unwrap();
    let lines = lines(&stdout(&read));
    assert!(lines.len() == 1 && lines[0]["status"] == "written", "{lines:?}");
}

/// A new name with an extension and an existing file are one table; a name that ends in a slash is a folder.
#[test]
fn the_name_of_an_output_tells_a_table_from_a_folder() {
    let folder = Folder::new();
    let inputs = [sample("1crn.cif"), sample("4pti.pdb")];
    let expected = joined(&inputs);
    let flags = ["areas", &inputs[0], &inputs[1], "--surface", "sas", "-q"];
    folder.file("plain", "old");
    for name in ["areas.txt", "areas.txt", "plain"] {
        let output = folder.path(name);
        assert_exit(&run([&flags[..], &["-o", &text(&output)]].concat()), 0);
        assert_eq!(fs::read_to_string(output).unwrap(), expected, "{name}");
    }
    if cfg!(target_os = "linux") {
        let done = run([&flags[..], &["-o", "/dev/stdout"]].concat());
        assert_exit(&done, 0);
        assert_eq!(stdout(&done), expected);
    }
    let new = format!("{}/", text(&folder.path("new.csv")));
    assert_exit(&run([&flags[..], &["-o", &new]].concat()), 0);
    assert_eq!(files(Path::new(&new)), ["1crn.csv", "4pti.csv"]);
    let new = format!("{}/", text(&folder.path("new.glb")));
    assert_exit(&run(["mesh", &inputs[0], "-o", &new, "--resolution", "2", "-q"]), 0);
    assert_eq!(files(Path::new(&new)), ["1crn.glb"]);
    assert_eq!(folder.entries(), ["areas.txt", "new.csv", "new.glb", "plain"]);
}

#[test]
fn an_existing_folder_receives_a_single_input() {
    let folder = Folder::new();
    let out = folder.path("out");
    fs::create_dir(&out).unwrap();
    assert_exit(&run(["mesh", &sample("1crn.cif"), "-o", &text(&out), "--resolution", "2", "-q"]), 0);
    assert_eq!(files(&out), ["1crn.glb"]);
    let new = format!("{}/", text(&folder.path("new")));
    assert_exit(&run(["mesh", &sample("1crn.cif"), "-o", &new, "--resolution", "2", "-q"]), 0);
    assert_eq!(files(Path::new(&new)), ["1crn.glb"]);
}

/// An interrupt leaves whole files only, and a second run makes the missing ones.
#[cfg(unix)]
#[test]
fn an_interrupted_batch_is_continued() {
    use std::process::{Command, Stdio};
    use std::time::{Duration, Instant};

    let folder = Folder::new();
    let (out, summary) = (folder.path("out"), folder.path("all.jsonl"));
    // The first input takes much longer than the test.
    let inputs = [folder.file("b.pdb", block(20)), folder.file("a.pdb", rod()), folder.file("c.pdb", block(20))];
    let flags = ["--resolution", "0.04", "--max-grid-points", "1000000000000", "--max-mesh-bytes", "1000000000000"];
    let mut command = molmesh();
    command.arg("mesh").args(&inputs).arg("-o").arg(&out).args(flags).arg("--summary").arg(&summary);
    command.args(["--jobs", "2", "--surface", "ses", "--areas", "--table"]).arg(folder.path("all.csv"));
    let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
    let start = Instant::now();
    while !out.join("a.glb").exists() {
        assert!(child.try_wait().unwrap().is_none(), "the command ended before the interrupt");
        assert!(start.elapsed() < Duration::from_mins(2), "the first file is not written");
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(100));
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let done = child.wait_with_output().unwrap();
    assert_exit(&done, 130);
    assert!(stderr(&done).contains("interrupted; no partial file remains"), "{}", stderr(&done));
    assert_eq!(files(&out), ["a.csv", "a.glb"]);
    assert!(!folder.path("all.csv").exists());
    let whole = fs::read(out.join("a.glb")).unwrap();

    let mut command = molmesh();
    command.arg("mesh").args(&inputs).arg("-o").arg(&out).args(["--resolution", "2", "--skip-existing", "-q"]);
    assert_exit(&command.arg("--summary").arg(&summary).output().unwrap(), 0);
    assert_eq!(files(&out), ["a.csv", "a.glb", "b.glb", "c.glb"]);
    assert!(fs::read(out.join("a.glb")).unwrap() == whole, "the file is not written again");
    let lines = lines(&fs::read_to_string(&summary).unwrap());
    let status: Vec<_> = lines.iter().map(|line| line["status"].as_str().unwrap()).collect();
    assert_eq!(status, ["written", "written", "skipped", "written"]);
}

/// A full disk ends the batch, and the files written before are whole and listed.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_ends_the_batch() {
    use std::process::Command;

    let folder = Folder::new();
    let disk = folder.path("disk");
    fs::create_dir(&disk).unwrap();
    let inputs = [folder.file("a.pdb", rod()), folder.file("b.pdb", block(12)), folder.file("c.pdb", rod())];
    let isolated = |script: &str, args: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["-m", "sh", "-c", &format!("mount -t tmpfs -o size=16m tmpfs \"$0\" && {script}")]).arg(&disk);
        command.args(args).output()
    };
    if !isolated("true", &[]).is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "a disk can be mounted only by root");
        return eprintln!("SKIPPED: a full disk: mounting needs root and unshare");
    }
    let out = text(&disk.join("out"));
    let inputs = inputs.map(|input| text(&input));
    let mut args = vec![env!("CARGO_BIN_EXE_molmesh"), "mesh"];
    args.extend(inputs.iter().map(String::as_str));
    args.extend(["-o", &out, "--backend", "cpu", "--resolution", "0.1", "--format", "stl"]);
    let done = isolated("\"$@\"; code=$?; ls -A \"$0/out\"; exit $code", &args).unwrap();
    assert_exit(&done, 7);
    assert_eq!(stdout(&done), "a.stl\n");
    let messages = stderr(&done);
    assert!(messages.contains(&format!("wrote {out}/a.stl\n")) && messages.contains("no space left"), "{messages}");
    assert!(messages.contains("1 written, 0 skipped, 0 failed") && !messages.contains("c.pdb"), "{messages}");
}
