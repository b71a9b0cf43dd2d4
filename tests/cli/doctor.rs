//! `molmesh doctor`: reports, exit codes, and a failure of every check.
#![cfg(unix)]

use crate::cli_support;

use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::process::Output;

use cli_support::{Folder, Service, molmesh, run, stderr, stdout};
use serde_json::Value;

/// Runs `doctor` for the CPU with data in `folder`, unless `more` has other values.
fn doctor(folder: &Folder, more: &[&str]) -> Output {
    let data = folder.path("data");
    let mut command = molmesh();
    command.arg("doctor").args(more);
    let defaults = [
        ("--report", "json"),
        ("--devices", "cpu"),
        ("--listen", "127.0.0.1:0"),
        ("--data-dir", data.to_str().unwrap()),
    ];
    for (flag, value) in defaults.iter().filter(|(flag, _)| !more.contains(flag)) {
        command.args([flag, value]);
    }
    command.output().unwrap()
}

/// Returns the state and the detail of a check.
#[track_caller]
fn check(done: &Output, name: &str) -> (String, String) {
    let document: Value = serde_json::from_slice(&done.stdout).unwrap_or_else(|e| panic!("{e}: {done:?}"));
    let checks = document["checks"].as_array().unwrap();
    let found = checks.iter().find(|c| c["name"] == name).unwrap_or_else(|| panic!("no {name} in {document:#}"));
    let text = |key: &str| found[key].as_str().unwrap().to_owned();
    assert_eq!(document["ok"].as_bool().unwrap(), done.status.success(), "{document:#}");
    (text("state"), text("detail"))
}

/// Asserts that a check failed with this text, and that the exit code and the line on stderr report it.
#[track_caller]
fn fails(done: &Output, name: &str, words: &str, code: i32) {
    let (state, detail) = check(done, name);
    assert!(state == "failed" && detail.contains(words), "{name} {state}: {detail}");
    assert_eq!(done.status.code(), Some(code), "{}", stderr(done));
    assert!(stderr(done).starts_with("molmesh: ") && stderr(done).contains(name), "{}", stderr(done));
}

/// Asserts that a check warns with this text, and that no check fails.
#[track_caller]
fn warns(done: &Output, name: &str, words: &str) {
    let (state, detail) = check(done, name);
    assert!(state == "warning" && detail.contains(words), "{name} {state}: {detail}");
    assert_eq!(done.status.code(), Some(0), "{}", stderr(done));
}

/// Returns an address without a listener.
fn closed_address() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

#[test]
fn all_checks_pass() {
    let folder = Folder::new();
    let done = doctor(&folder, &["--set", "jobs.queue=7"]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    for name in ["config", "log", "memory", "volume", "devices", "listen", "store", "records", "archive"] {
        let (state, detail) = check(&done, name);
        assert!(
            state == "ok" || ["memory", "volume"].contains(&name) && state == "warning",
            "{name} {state}: {detail}"
        );
    }
    let document: Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(document["molmesh"]["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(document["molmesh"]["gpu"], cfg!(feature = "gpu"));
    assert!(document["molmesh"]["compiler"].as_str().unwrap().starts_with("rustc "), "{document:#}");
    assert!(document["molmesh"]["target"].as_str().unwrap().contains(std::env::consts::ARCH));
    assert!(document["machine"]["cores"].as_u64().unwrap() >= 1);
    assert_eq!((&document["config"]["jobs"]["queue"], &document["backend"]["name"]), (&7.into(), &"cpu".into()));
    assert_eq!(document["sources"]["jobs"]["queue"]["source"], "command line");
    // The command leaves no files, and existing folders stay.
    assert_eq!(folder.entries(), Vec::<String>::new());
    std::fs::create_dir_all(folder.path("data/store/results")).unwrap();
    assert_eq!(doctor(&folder, &[]).status.code(), Some(0));
    assert!(folder.path("data/store/results").is_dir());
}

#[test]
fn stores_larger_than_the_volume_are_a_warning() {
    let folder = Folder::new();
    let done = doctor(&folder, &["--set", "store.max_bytes=8000000GiB"]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    let (state, detail) = check(&done, "volume");
    assert_eq!(state, "warning", "{detail}");
    assert!(detail.contains("8000000GiB store.max_bytes") && detail.contains("exceed the volume of"), "{detail}");
}

#[test]
fn text_has_all_sections_and_checks() {
    let folder = Folder::new();
    let data = folder.path("data");
    let done = run([
        "doctor",
        "--devices",
        "cpu",
        "--listen",
        "127.0.0.1:0",
        "--set",
        "limits.atoms=5",
        "--data-dir",
        data.to_str().unwrap(),
    ]);
    let text = stdout(&done);
    for part in [
        "build", "cores", "vectors", "memory", "auto", "radii", "server", "limits", "jobs", "devices", "archive",
        "store",
    ] {
        assert!(text.lines().any(|line| line.trim_start().starts_with(part)), "no `{part}` in\n{text}");
    }
    for part in ["atoms 5*", "body_bytes 256MiB,", "ok      store: ", "ok      devices: "] {
        assert!(text.contains(part), "no `{part}` in\n{text}");
    }
    assert!(text.lines().all(|line| line.chars().count() < 200), "{text}");
}

#[test]
fn addresses_in_use_fail() {
    let folder = Folder::new();
    let service = Service::start(&Folder::new(), &["--devices", "cpu"]);
    fails(&doctor(&folder, &["--listen", &service.addr]), "listen", &service.addr, 1);
    fails(&doctor(&folder, &["--metrics-listen", &service.addr]), "metrics_listen", "server.metrics_listen", 1);
}

#[test]
fn unusable_store_fails() {
    let folder = Folder::new();
    let file = folder.file("data", "not a folder");
    fails(&doctor(&folder, &[]), "store", file.to_str().unwrap(), 1);
    assert_eq!(folder.entries(), ["data"]);
}

#[test]
fn a_damaged_secret_and_quarantined_records_fail() {
    let folder = Folder::new();
    let store = folder.path("data/store");
    std::fs::create_dir_all(store.join("quarantine")).unwrap();
    std::fs::write(store.join("secret"), [7; 32]).unwrap();
    // Only job records need an operator.
    std::fs::write(store.join("quarantine/structure"), "").unwrap();
    assert_eq!(doctor(&folder, &[]).status.code(), Some(0), "the control");
    std::fs::write(store.join("quarantine/1.json"), "").unwrap();
    fails(&doctor(&folder, &[]), "records", "1 job records cannot be read", 1);
    std::fs::write(store.join("secret"), "short").unwrap();
    fails(&doctor(&folder, &[]), "store", "a secret has 32 bytes, this one has 5", 1);
}

#[test]
fn an_unreachable_broker_fails() {
    let folder = Folder::new();
    let store = format!("store.url=file://{}", folder.path("store").display());
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = silent.local_addr().unwrap().to_string();
    for (address, timeout, words) in [(closed_address(), "30", "broker.url"), (silent, "0.5", "within 500 ms")] {
        let broker = format!("broker.url=nats://{address}");
        fails(&doctor(&folder, &["--timeout", timeout, "--set", &store, "--set", &broker]), "broker", words, 1);
    }
}

/// Runs `doctor` for a bucket at `endpoint`.
fn doctor_with_bucket(endpoint: &str, timeout: &str, store_timeout: &str) -> Output {
    let endpoint = format!("store.endpoint=http://{endpoint}");
    let sets = ["store.url=s3://bucket/p", "store.allow_http=true", "store.access_key_id=id", &endpoint, store_timeout];
    let sets = sets.into_iter().chain(["store.secret_access_key=hush"]).flat_map(|set| ["--set", set]);
    doctor(&Folder::new(), &["--timeout", timeout].into_iter().chain(sets).collect::<Vec<_>>())
}

#[test]
fn unreachable_store_fails_without_showing_its_key() {
    // Accepts connections and sends nothing.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = silent.local_addr().unwrap().to_string();
    for (endpoint, timeout, words) in
        [(closed_address(), "30", "s3://bucket/p"), (silent, "0.5", "does not answer within 500 ms")]
    {
        let done = doctor_with_bucket(&endpoint, timeout, "store.timeout_ms=30000");
        fails(&done, "store", words, 1);
        assert!(!stdout(&done).contains("hush") && !stderr(&done).contains("hush"), "{}", stdout(&done));
    }
}

#[test]
fn a_store_that_does_not_respond_fails_in_bounded_time() {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = silent.local_addr().unwrap().to_string();
    let done = doctor_with_bucket(&endpoint, "120", "store.timeout_ms=200");
    fails(&done, "store", "s3://bucket", 1);
}

#[test]
fn invalid_log_filter_fails() {
    fails(&doctor(&Folder::new(), &["--set", "log.filter=molmesh=loud"]), "log", "molmesh=loud", 1);
}

#[test]
fn missing_backend_fails() {
    fails(&doctor(&Folder::new(), &["--backend", "gpu", "--devices", "77"]), "devices", "no backend `gpu`", 6);
    let usage = doctor(&Folder::new(), &["--backend", "gpu"]);
    assert_eq!(usage.status.code(), Some(2), "{}", stderr(&usage));
}

#[test]
fn invalid_configuration_is_bad_usage() {
    let folder = Folder::new();
    for more in
        [&["--set", "limits.atomz=1"][..], &["--config", "/no/such/file"], &["--timeout", "0"], &["--report", "xml"]]
    {
        let done = doctor(&folder, more);
        assert_eq!((done.status.code(), stdout(&done).as_str()), (Some(2), ""), "{more:?}: {}", stderr(&done));
    }
}

#[test]
fn budgets_above_the_memory_are_a_warning() {
    let (state, detail) = check(&doctor(&Folder::new(), &["--set", "limits.memory_bytes=1000000GiB"]), "memory");
    let known = cfg!(target_os = "linux");
    assert_eq!(state, if known { "warning" } else { "ok" }, "{detail}");
    assert!(detail.contains("1000000GiB limits.memory_bytes"), "{detail}");
}

#[test]
fn readable_secrets_are_a_warning() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = Folder::new();
    let secret = folder.file("secret", "hush");
    std::fs::set_permissions(&secret, std::fs::Permissions::from_mode(0o644)).unwrap();
    let done = doctor(&folder, &["--set", &format!("store.secret_access_key_file={}", secret.display())]);
    warns(&done, "warnings", "mode 644");
    assert!(!stdout(&done).contains("hush"));
}

#[test]
fn archive_folder_is_checked() {
    let folder = Folder::new();
    let pdb = folder.path("pdb");
    let check_archive = |folder: &Folder| doctor(folder, &["--archive", pdb.to_str().unwrap()]);
    warns(&check_archive(&folder), "archive", "cannot be listed");
    std::fs::create_dir_all(pdb.join("pt")).unwrap();
    warns(&check_archive(&folder), "archive", "contains no entry");
    for name in ["pt/4pti.cif.gz", "1crn.cif", "1crn.pdb", "notes.txt"] {
        std::fs::write(pdb.join(name), "").unwrap();
    }
    let (state, detail) = check(&check_archive(&folder), "archive");
    assert!(state == "ok" && detail.contains("2 entries"), "{state}: {detail}");
    // A link that leads out of the folder is not an entry.
    std::fs::remove_file(pdb.join("1crn.cif")).unwrap();
    std::fs::remove_file(pdb.join("1crn.pdb")).unwrap();
    std::os::unix::fs::symlink("/etc/hostname", pdb.join("1crn.cif")).unwrap();
    warns(&check_archive(&folder), "archive", "1crn");
    let file = folder.file("file", "");
    warns(&doctor(&folder, &["--archive", file.to_str().unwrap()]), "archive", "cannot be listed");
}

#[test]
fn a_store_that_is_a_symbolic_link_is_a_warning() {
    let folder = Folder::new();
    let (data, target) = (folder.path("data"), folder.path("elsewhere"));
    std::fs::create_dir_all(&data).unwrap();
    assert_eq!(check(&doctor(&folder, &[]), "store").0, "ok", "the control");
    std::fs::remove_dir_all(data.join("store")).ok();
    std::fs::create_dir_all(&target).unwrap();
    std::os::unix::fs::symlink(&target, data.join("store")).unwrap();
    warns(&doctor(&folder, &[]), "store", "symbolic link");
}

#[test]
fn remote_archive_is_checked() {
    let folder = Folder::new();
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    let addr = server.local_addr().unwrap();
    // The path contains the status of the response.
    std::thread::spawn(move || {
        for mut stream in server.incoming().map_while(Result::ok) {
            let mut head = [0; 4096];
            let n = stream.read(&mut head).unwrap_or(0);
            let head = String::from_utf8_lossy(&head[..n]).into_owned();
            let status = head.split('/').nth(1).unwrap_or("500").to_owned();
            drop(stream.write_all(
                format!("HTTP/1.1 {status} x\r\ncontent-length: 0\r\nconnection: close\r\n\r\n").as_bytes(),
            ));
        }
    });
    let ask = |url: &str| doctor(&folder, &["--timeout", "20", "--set", &format!("archive.url={url}")]);
    for status in ["200", "404"] {
        let done = ask(&format!("http://{addr}/{status}/{{id}}"));
        let (state, detail) = check(&done, "remote");
        assert!(state == "ok" && detail.contains(status), "{state}: {detail}");
    }
    warns(&ask(&format!("http://{addr}/503/{{id}}")), "remote", "503");
    warns(&ask(&format!("http://{}/{{id}}", closed_address())), "remote", "failed");
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("archive.url=http://{}/{{id}}", silent.local_addr().unwrap());
    warns(&doctor(&folder, &["--timeout", "0.3", "--set", &url]), "remote", "no answer within 300 ms");
    // Without a remote archive there is no such check.
    let document: Value = serde_json::from_slice(&doctor(&folder, &[]).stdout).unwrap();
    assert!(document["checks"].as_array().unwrap().iter().all(|check| check["name"] != "remote"));
}
