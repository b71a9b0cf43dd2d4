//! Accepted asynchronous jobs are completed although the server is killed repeatedly under load.

use crate::http_support;

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use http_support::{Fake, Mode, SAMPLE, sample, send, start, wait_for};
use molmesh::surface::CpuBackend;

/// Server process on a data folder.
pub(crate) struct Process {
    child: Child,
    pub(crate) addr: SocketAddr,
}

impl Process {
    /// Starts a process and waits until it prints its address.
    fn start(folder: &Path) -> Self {
        Self::spawn(Command::new(env!("CARGO_BIN_EXE_molmesh")), folder)
    }

    /// Starts `program` with the arguments of a service.
    pub(crate) fn spawn(mut program: Command, folder: &Path) -> Self {
        let mut child = program
            .args(["serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--data-dir"])
            .arg(folder)
            .args(["--set", "jobs.attempts=1000", "--set", "archive.url=none", "--set", "jobs.queue=500"])
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let addr = lines
            .by_ref()
            .map(Result::unwrap)
            .find_map(|line| {
                line.split_once("http://").and_then(|(_, rest)| {
                    rest.split(|c: char| c != '.' && c != ':' && !c.is_ascii_digit()).next()?.parse().ok()
                })
            })
            .expect("the banner contains the address");
        // Drains the pipe, which must not fill up.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, addr }
    }

    /// Kills the process (`kill -9`).
    pub(crate) fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Waits for the end of the process.
    pub(crate) fn wait(mut self) {
        self.child.wait().unwrap();
    }
}

/// Sends a request to a server that may be killed. Returns status, `Location` and the body if it is complete.
pub(crate) fn ask(
    addr: SocketAddr,
    method: &str,
    path: &str,
    headers: &str,
    body: &[u8],
) -> Option<(u16, Option<String>, Vec<u8>)> {
    let mut stream = TcpStream::connect(addr).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(30))).ok()?;
    let length = body.len();
    let head = format!(
        "{method} {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-length: {length}\r\n{headers}\r\n"
    );
    stream.write_all(head.as_bytes()).ok()?;
    stream.write_all(body).ok()?;
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).ok()?;
    let end = bytes.windows(4).position(|w| w == b"\r\n\r\n")?;
    let head = String::from_utf8_lossy(&bytes[..end]).to_ascii_lowercase();
    let field = |name: &str| head.lines().find_map(|l| l.strip_prefix(name)).map(|v| v.trim().to_owned());
    let status = head.split(' ').nth(1)?.parse().ok()?;
    let body = bytes[end + 4..].to_vec();
    let whole = field("content-length:").is_none_or(|length| length.parse() == Ok(body.len()));
    whole.then(|| (status, field("location:"), body))
}

/// Returns the request of a job by number: its own structure, one of a few grids.
fn job_request(n: usize) -> (String, Vec<u8>) {
    (format!("/v1/meshes?format=stl&resolution={}", [0.5, 0.6, 0.8][n % 3]), sample(n))
}

#[test]
fn accepted_jobs_survive_fifty_kills_without_loss() {
    let folder = tempfile::tempdir().unwrap();
    let accepted: Arc<Mutex<BTreeMap<usize, String>>> = Arc::default();
    let mut next = 0;
    let mut state = 88_172_645_463_325_252_u64;
    let mut random = |below: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state % below
    };
    for _ in 0..50 {
        let server = Process::start(folder.path());
        let stop = AtomicBool::new(false);
        let (addr, first) = (server.addr, next);
        next += 1000;
        std::thread::scope(|scope| {
            for client in 0..2 {
                let (accepted, stop) = (Arc::clone(&accepted), &stop);
                scope.spawn(move || {
                    let mut n = first + client;
                    while !stop.load(Ordering::SeqCst) {
                        let (path, body) = job_request(n);
                        let answer = ask(addr, "POST", &path, "prefer: respond-async\r\n", &body);
                        if let Some((202, Some(location), _)) = answer {
                            accepted.lock().unwrap().insert(n, location);
                        }
                        n += 2;
                        std::thread::sleep(Duration::from_millis(15));
                    }
                });
            }
            std::thread::sleep(Duration::from_millis(20 + random(180)));
            server.kill();
            stop.store(true, Ordering::SeqCst);
        });
    }
    let accepted = std::mem::take(&mut *accepted.lock().unwrap());
    assert!(accepted.len() >= 50, "{} jobs were accepted", accepted.len());
    let server = Process::start(folder.path());
    // Expected bytes come from a server that was not killed.
    let reference = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let expected: Vec<Vec<u8>> = (0..3).map(|n| reference.post(&job_request(n).0, &[], SAMPLE).body).collect();
    assert!(expected[0] != expected[1] && expected[1] != expected[2]);
    let deadline = Instant::now() + Duration::from_mins(2);
    for (n, job) in &accepted {
        let path = format!("{job}?wait=20");
        let status = loop {
            let (code, _, body) = ask(server.addr, "GET", &path, "", b"").expect("a response");
            assert_eq!(code, 200, "job {n} is lost: {}", String::from_utf8_lossy(&body));
            let status = serde_json::from_slice::<serde_json::Value>(&body).unwrap();
            if !["accepted", "running"].contains(&status["status"].as_str().unwrap()) {
                break status;
            }
            assert!(Instant::now() < deadline, "job {n} never ends: {status}");
        };
        assert_eq!(status["status"], "successful", "job {n}: {status}");
        let (code, location, _) = ask(server.addr, "GET", &format!("{job}/result"), "", b"").unwrap();
        assert_eq!(code, 303);
        let (code, _, bytes) = ask(server.addr, "GET", &location.unwrap(), "", b"").unwrap();
        assert_eq!((code, bytes == expected[n % 3]), (200, true), "job {n}");
    }
    // Every stored object is complete: objects are published after their last byte.
    for entry in std::fs::read_dir(folder.path().join("store/results")).unwrap().map(Result::unwrap) {
        if entry.path().extension().is_some_and(|e| e == "stl") {
            let bytes = std::fs::read(entry.path()).unwrap();
            assert!(expected.contains(&bytes), "{} is a half-written result", entry.path().display());
        }
    }
    server.kill();
}

#[test]
fn a_job_that_repeatedly_crashes_the_process_fails() {
    let folder = tempfile::tempdir().unwrap();
    let jobs = folder.path().join("store/jobs");
    let backend = Fake::new(Mode::Slow(Duration::from_secs(30)));
    let keep = |c: &mut molmesh::config::Config| folder.path().clone_into(&mut c.server.data_dir);
    let mut location = String::new();
    for attempt in 1..=3 {
        let server = start(Arc::clone(&backend) as _, |c| {
            keep(c);
            c.server.drain_timeout_ms = 1;
        });
        if attempt == 1 {
            let reply = server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE);
            assert_eq!(reply.status, 202);
            reply.header("location").unwrap().clone_into(&mut location);
        }
        wait_for("the job to run", || backend.started.load(Ordering::SeqCst) == attempt);
        let path = std::fs::read_dir(&jobs).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(&path).unwrap();
        let record: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!(record["attempts"], attempt, "the attempt is recorded before the job starts");
        assert!(server.join(), "no request is cut off");
        // A stop takes the attempt back; a process killed by the job leaves the record unchanged.
        std::fs::write(&path, bytes).unwrap();
    }
    backend.set(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, keep);
    let document = server.get(&format!("{location}?wait=5")).json();
    assert_eq!(
        (&document["status"], &document["problem"]["type"]),
        (&"failed".into(), &"/problems/job-abandoned".into())
    );
    assert_eq!(backend.started.load(Ordering::SeqCst), 3, "no fourth attempt");
    server.get(&format!("{location}/result")).problem(500, "job-abandoned");
}

#[test]
fn idempotency_keys_survive_a_restart_and_ids_are_not_guessable() {
    let folder = tempfile::tempdir().unwrap();
    let keep = |c: &mut molmesh::config::Config| folder.path().clone_into(&mut c.server.data_dir);
    let headers = [("prefer", "respond-async"), ("idempotency-key", "upload-1")];
    let submit = |server: &http_support::Running| {
        let reply = server.post("/v1/meshes?format=stl", &headers, SAMPLE);
        assert_eq!(reply.status, 202);
        reply.header("location").unwrap().to_owned()
    };
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, keep);
    // Concurrent requests are one job.
    let jobs: Vec<String> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..6).map(|_| scope.spawn(|| submit(&server))).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    assert!(jobs.iter().all(|job| *job == jobs[0]), "{jobs:?}");
    let ended = server.get(&format!("{}?wait=20", jobs[0])).json();
    assert_eq!(ended["status"], "successful");
    assert!(server.join());
    let server = start(Arc::clone(&backend) as _, keep);
    assert_eq!(submit(&server), jobs[0]);
    assert_eq!(server.get(&jobs[0]).json()["attempts"], ended["attempts"], "the job does not run again");
    // The id depends on the store, not on client and key alone.
    let elsewhere = start(backend as _, |_| {});
    assert_ne!(submit(&elsewhere), jobs[0]);
}

#[test]
fn a_restart_resumes_open_jobs_only() {
    let folder = tempfile::tempdir().unwrap();
    let keep = |c: &mut molmesh::config::Config| {
        folder.path().clone_into(&mut c.server.data_dir);
        c.server.drain_timeout_ms = 1;
        c.jobs.workers = 1;
    };
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, keep);
    let later = [("prefer", "respond-async")];
    let submit = |server: &http_support::Running, n: usize| {
        let reply = server.post("/v1/meshes?format=stl", &later, &sample(n));
        assert_eq!(reply.status, 202);
        reply.header("location").unwrap().to_owned()
    };
    let done = submit(&server, 0);
    assert_eq!(server.get(&format!("{done}?wait=5")).json()["status"], "successful");
    backend.set(Mode::Slow(Duration::from_secs(30)));
    let open: Vec<String> = (1..4).map(|n| submit(&server, n)).collect();
    let dismissed = submit(&server, 4);
    assert_eq!(http_support::send(server.addr, "DELETE", &dismissed, &[], b"").status, 200);
    wait_for("one to run", || backend.started.load(Ordering::SeqCst) == 2);
    assert!(server.join(), "no request is cut off");
    backend.set(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, keep);
    for job in &open {
        assert_eq!(server.get(&format!("{job}?wait=5")).json()["status"], "successful");
        let result = server.get(&format!("{job}/result"));
        assert_eq!(server.get(result.header("location").unwrap()).status, 200);
    }
    assert_eq!(server.get(&done).json()["status"], "successful");
    assert_eq!(server.get(&dismissed).json()["status"], "dismissed");
    assert_eq!(backend.started.load(Ordering::SeqCst), 5, "exactly three jobs were resumed");
    assert!(server.metric("molmesh_jobs_recovered_total", &[]) >= 3.0);
}

#[test]
fn open_jobs_are_limited() {
    let backend = Fake::new(Mode::Held);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.records = 2);
    let later = [("prefer", "respond-async")];
    let submit = |n: usize| server.post("/v1/meshes?format=stl", &later, &sample(n));
    let jobs: Vec<String> = (0..2).map(|n| submit(n).header("location").unwrap().to_owned()).collect();
    for n in [0, 2] {
        let problem = submit(n).problem(503, "too-many-jobs");
        assert_eq!(problem["limit"], 2, "{problem}");
    }
    assert!(server.metric("molmesh_requests_rejected_total", &["reason=\"too-many-jobs\""]) >= 2.0);
    backend.set(Mode::Octahedra);
    for job in &jobs {
        assert_eq!(server.get(&format!("{job}?wait=20")).json()["status"], "successful");
    }
    // An ended job makes room for the next one.
    wait_for("a record to end", || submit(2).status == 202);
    let mut left: Vec<u16> = jobs.iter().map(|job| server.get(job).status).collect();
    left.sort_unstable();
    assert_eq!(left, [200, 404]);
}

/// Starts a process with a disk of 16 MB of its own at `disk`, which is or lies in its data folder. Returns `None` if
/// no disk can be mounted.
#[expect(clippy::print_stdout, reason = "the list of skipped tests contains this line")]
fn start_on_small_disk(folder: &Path, disk: &Path) -> Option<Process> {
    let mount = r#"mount -t tmpfs -o size=16m tmpfs "$0""#;
    let isolated = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["-m", "sh", "-c", script]).arg(disk);
        command
    };
    if !isolated(mount).output().is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "a disk can be mounted only by root");
        println!("SKIPPED: a full disk: mounting needs root and unshare");
        return None;
    }
    let mut program = isolated(&format!("{mount} && exec \"$@\""));
    program.arg(env!("CARGO_BIN_EXE_molmesh"));
    Some(Process::spawn(program, folder))
}

#[test]
fn a_full_disk_evicts_objects_and_is_reported_as_a_full_store() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = start_on_small_disk(folder.path(), folder.path()) else { return };
    let filled = |n: usize, bytes: usize| {
        let mut text = sample(n);
        while text.len() < bytes {
            text.extend_from_slice(b"REMARK 999 FILLS THE DISK\n");
        }
        text
    };
    // Seven uploads of 4 MB each: the oldest ones are evicted.
    let mut last = None;
    for n in 0..7 {
        let (status, location, _) = ask(server.addr, "POST", "/v1/structures", "", &filled(n, 4 << 20)).unwrap();
        assert_eq!(status, 201, "upload {n}");
        last = location;
    }
    // An upload that never fits is no failure of the store, and evicts nothing.
    let (status, _, body) = ask(server.addr, "POST", "/v1/structures", "", &filled(7, 17 << 20)).unwrap();
    let problem: serde_json::Value = serde_json::from_slice(&body).unwrap();
    assert_eq!((status, problem["type"].as_str()), (503, Some("/problems/store-full")), "{problem}");
    assert_eq!(ask(server.addr, "GET", &last.unwrap(), "", b"").unwrap().0, 200);
    // Every announced result is kept.
    for n in 20..26 {
        let mut stream = TcpStream::connect(server.addr).unwrap();
        let body = sample(n);
        let head = "POST /v1/meshes?format=stl&resolution=0.5 HTTP/1.1\r\nhost: localhost\r\nconnection: close";
        write!(stream, "{head}\r\ncontent-length: {}\r\n\r\n", body.len()).unwrap();
        stream.write_all(&body).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8_lossy(&answer[..end]).to_ascii_lowercase();
        assert!(head.starts_with("http/1.1 200"), "{head}");
        if let Some(place) = head.lines().find_map(|line| line.strip_prefix("content-location: ")) {
            assert_eq!(ask(server.addr, "GET", place, "", b"").unwrap().0, 200, "{place}");
        }
    }
    // Jobs are accepted, and their results stored.
    for n in 10..14 {
        let (path, _) = job_request(n);
        let answer = ask(server.addr, "POST", &path, "prefer: respond-async\r\n", &filled(n, 2 << 20)).unwrap();
        let (202, Some(job), _) = answer else { panic!("job {n}: {answer:?}") };
        let (_, _, body) = ask(server.addr, "GET", &format!("{job}?wait=50"), "", b"").unwrap();
        let state: serde_json::Value = serde_json::from_slice(&body).unwrap();
        assert_eq!(state["status"], "successful", "{state}");
        let (code, location, _) = ask(server.addr, "GET", &format!("{job}/result"), "", b"").unwrap();
        assert_eq!((code, ask(server.addr, "GET", &location.unwrap(), "", b"").unwrap().0), (303, 200));
    }
    server.kill();
}

/// Copies a folder, as a killed process leaves it.
fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let to = to.join(entry.file_name());
        if entry.file_type().unwrap().is_dir() {
            copy(&entry.path(), &to);
        } else {
            drop(std::fs::copy(entry.path(), to));
        }
    }
}

#[test]
#[cfg(target_os = "linux")]
fn two_hundred_joined_jobs_are_recovered_in_a_small_process() {
    const JOBS: usize = 200;
    const BUDGET: u64 = 48 << 20;
    let input = [SAMPLE, &b"REMARK 999 PADDING\n".repeat(5_000_000 / 19)].concat();
    let server = start(Fake::new(Mode::Held), |c| c.jobs.workers = 1);
    let upload = server.post("/v1/structures", &[], &input).json();
    let path = format!("/v1/structures/{}/surface.stl?resolution=2", upload["digest"].as_str().unwrap());
    let jobs: Vec<String> = (0..JOBS)
        .map(|_| {
            let reply = send(server.addr, "GET", &path, &[("prefer", "respond-async")], b"");
            assert_eq!(reply.status, 202);
            reply.header("location").unwrap().to_owned()
        })
        .collect();
    let folder = tempfile::tempdir().unwrap();
    copy(&server.dir.path().join("store"), &folder.path().join("store"));
    let begun = Instant::now();
    let mut program = Command::new(env!("CARGO_BIN_EXE_molmesh"));
    program.env("MOLMESH_LIMITS__MEMORY_BYTES", BUDGET.to_string());
    let process = Process::spawn(program, folder.path());
    for job in &jobs {
        let (_, _, body) = ask(process.addr, "GET", &format!("{job}?wait=20"), "", b"").unwrap();
        let state: serde_json::Value = serde_json::from_slice(&body).unwrap();
        assert_eq!(state["status"], "successful", "{state}");
    }
    // The time of one job, and of two records for each job, 64 at a time.
    assert!(begun.elapsed() < Duration::from_secs(30), "{:?}", begun.elapsed());
    let status = std::fs::read_to_string(format!("/proc/{}/status", process.child.id())).unwrap();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap().trim().trim_end_matches(" kB");
    // Program, threads and caches take less than the budget again.
    let peak = 1024 * peak.parse::<u64>().unwrap();
    assert!(peak < 3 * BUDGET, "the process took {peak} bytes; all inputs take {}", JOBS * input.len());
    process.kill();
}

#[test]
fn a_store_that_becomes_read_only_is_reported_and_used_again_when_it_recovers() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    std::fs::create_dir(&store).unwrap();
    let Some(server) = start_on_small_disk(folder.path(), &store) else { return };
    let remount = |options: &str| {
        let mut command = Command::new("nsenter");
        command.args([&format!("--target={}", server.child.id()), "--mount", "mount", "-o", options]);
        command.arg(&store).status().unwrap().success()
    };
    let request = |method: &str, path: &str, headers: &str, body: &[u8]| {
        let (status, _, body) = ask(server.addr, method, path, headers, body).unwrap();
        let document: serde_json::Value = serde_json::from_slice(&body).unwrap_or_default();
        (status, document["type"].as_str().unwrap_or_default().to_owned(), document)
    };
    let upload = |n: usize| request("POST", "/v1/structures", "", &sample(n)).0;
    let ready = || request("GET", "/readyz", "", b"");
    wait_for("the first mesh", || ready().0 == 200);
    assert_eq!(upload(1), 201);
    // The upload may still be renamed or synced.
    wait_for("no file is open", || remount("remount,ro"));
    let later = "prefer: respond-async\r\n";
    for (path, headers) in [("/v1/structures", ""), ("/v1/meshes?format=stl", later)] {
        let (status, kind, document) = request("POST", path, headers, &sample(2));
        assert_eq!((status, &*kind), (503, "/problems/store-failed"), "{path}: {document}");
    }
    assert_eq!(request("POST", "/v1/meshes?format=stl", "", &sample(3)).0, 200, "a mesh needs no store");
    wait_for("the failure is detected", || ready().0 == 503);
    let checks = ready().2["checks"].as_array().unwrap().clone();
    let failed: Vec<_> =
        checks.iter().filter(|check| check["ok"] == false).map(|check| check["name"].clone()).collect();
    assert_eq!(failed, ["store"]);
    assert!(remount("remount,rw"));
    wait_for("the store is used again", || ready().0 == 200);
    assert_eq!((upload(1), upload(2)), (200, 201), "what was stored is still there");
    server.kill();
}
