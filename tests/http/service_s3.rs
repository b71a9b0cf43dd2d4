//! The service with its store on S3: asynchronous jobs, stored results, and behaviour while S3 is unavailable.

use crate::http_support;
use crate::store_support;

use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};

use http_support::{Fake, Mode, Reply, SAMPLE, log_lines, sample, send, start, wait_for};
use molmesh::store::{Folder, Store};
use molmesh::surface::{Backend, CpuBackend, ReferenceBackend};
use serde_json::Value;
use store_support::Service;

const LATER: (&str, &str) = ("prefer", "respond-async");

#[track_caller]
fn get(addr: SocketAddr, path: &str) -> Reply {
    send(addr, "GET", path, &[], b"")
}

/// Submits an asynchronous job and returns its URL.
#[track_caller]
fn submit(addr: SocketAddr, path: &str, body: &[u8]) -> String {
    let reply = send(addr, "POST", path, &[LATER], body);
    assert_eq!(reply.status, 202, "{}", String::from_utf8_lossy(&reply.body));
    reply.header("location").unwrap().to_owned()
}

/// Waits for a job to succeed and returns its document.
#[track_caller]
fn successful(addr: SocketAddr, job: &str) -> Value {
    let mut document = Value::Null;
    wait_for("the job's end", || {
        let reply = get(addr, &format!("{job}?wait=5"));
        assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
        document = reply.json();
        document["finished"].is_string()
    });
    assert_eq!(document["status"], "successful", "{document}");
    document
}

/// Returns the URL of a job's result, and the result.
#[track_caller]
fn result(addr: SocketAddr, job: &str) -> (String, Reply) {
    successful(addr, job);
    let way = get(addr, &format!("{job}/result"));
    assert_eq!(way.status, 303, "{}", String::from_utf8_lossy(&way.body));
    let address = way.header("location").unwrap().to_owned();
    let reply = get(addr, &address);
    assert_eq!((reply.status, reply.complete), (200, true), "{address}");
    (address, reply)
}

/// Asserts that ranges of a result are served with a strong `ETag`.
#[track_caller]
fn in_parts(addr: SocketAddr, address: &str, whole: &Reply) {
    let etag = whole.header("etag").unwrap();
    assert!(etag.starts_with('"') && etag.len() == 66, "{etag}");
    let length = whole.body.len();
    for (range, from, to) in [("bytes=100-299", 100, 300), ("bytes=-50", length - 50, length)] {
        let part = send(addr, "GET", address, &[("range", range), ("if-range", etag)], b"");
        let expected = format!("bytes {from}-{}/{length}", to - 1);
        assert_eq!((part.status, part.header("content-range")), (206, Some(&*expected)));
        assert_eq!((part.header("etag"), part.body == whole.body[from..to]), (Some(etag), true), "{range}");
    }
    let other = send(addr, "GET", address, &[("range", "bytes=0-9"), ("if-range", "\"other\"")], b"");
    assert_eq!((other.status, other.body == whole.body), (200, true));
    let beyond = [("range", &*format!("bytes={length}-"))];
    send(addr, "GET", address, &beyond, b"").problem(416, "range-not-satisfiable");
    assert_eq!(send(addr, "GET", address, &[("if-none-match", etag)], b"").status, 304);
}

/// Server process with its store on S3, and its output.
struct Process {
    child: Child,
    addr: SocketAddr,
    log: Arc<Mutex<String>>,
}

fn command(name: &str, service: &Service, prefix: &str, data_dir: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_molmesh"));
    command
        .args([name, "--listen", "127.0.0.1:0", "--backend", "reference", "--data-dir"])
        .arg(data_dir)
        .args(["--set", "archive.url=none", "--set", "jobs.workers=1", "--set", "jobs.attempts=1000"])
        .args(["--set", "server.metrics_listen=none", "--set", "log.filter=debug", "--set", "store.allow_http=true"])
        .args(["--set", &format!("store.url=s3://meshes/{prefix}"), "--set", "store.region=us-east-1"])
        .args(["--set", &format!("store.endpoint={}", service.access.endpoint)])
        .env("AWS_ACCESS_KEY_ID", &service.access.id)
        .env("AWS_SECRET_ACCESS_KEY", &service.access.secret)
        .stderr(Stdio::piped())
        .stdout(Stdio::null());
    command
}

impl Process {
    fn start(service: &Service, prefix: &str, data_dir: &Path) -> Self {
        let mut child = command("serve", service, prefix, data_dir).spawn().unwrap();
        let log: Arc<Mutex<String>> = Arc::default();
        let (lines, kept) = (BufReader::new(child.stderr.take().unwrap()).lines(), Arc::clone(&log));
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                *kept.lock().unwrap() += &(line + "\n");
            }
        });
        let mut addr = None;
        wait_for("the banner", || {
            let log = log.lock().unwrap();
            addr = log.lines().find_map(|line| {
                let (_, rest) = line.trim_start().strip_prefix("viewer")?.split_once("http://")?;
                rest.split(|c: char| c != '.' && c != ':' && !c.is_ascii_digit()).next()?.parse().ok()
            });
            assert!(addr.is_some() || child.try_wait().unwrap().is_none(), "the process ended: {log}");
            addr.is_some()
        });
        Self { child, addr: addr.unwrap(), log }
    }

    /// Kills the process (`kill -9`) and returns its output.
    fn kill(mut self) -> String {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.log.lock().unwrap().clone()
    }
}

/// Returns true if a job's record is open.
fn any_open(service: &Service, prefix: &str, data_dir: &Path) -> bool {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    runtime.block_on(async {
        let store = Store::open(&service.config(prefix), data_dir).await.unwrap();
        let mut open = false;
        for (name, _) in store.list(Folder::Jobs).await.unwrap() {
            let record = store.get(&name).await.unwrap().unwrap();
            open |= serde_json::from_slice::<Value>(&record.bytes).unwrap()["finished_ms"].is_null();
        }
        open
    })
}

#[test]
fn the_start_and_doctor_accept_the_same_stores() {
    let unconditional = "it replaced an object; the store must support conditional writes";
    for (options, refusal) in
        [(&[][..], None), (&["--unlisted"][..], None), (&["--unconditional"][..], Some(unconditional))]
    {
        let (service, folder) = (Service::start(options), tempfile::tempdir().unwrap());
        let mut doctor = command("doctor", &service, "kind", &folder.path().join("doctor"));
        let done = doctor.args(["--report", "json"]).stdout(Stdio::piped()).output().unwrap();
        let document: Value = serde_json::from_slice(&done.stdout).unwrap_or_else(|e| panic!("{e}: {done:?}"));
        let check = document["checks"].as_array().unwrap().iter().find(|check| check["name"] == "store").unwrap();
        let found = check["detail"].as_str().unwrap();
        assert_eq!(check["state"], if refusal.is_some() { "failed" } else { "ok" }, "{options:?}: {found}");
        if let Some(text) = refusal {
            let started = command("serve", &service, "kind", folder.path()).output().unwrap();
            let log = String::from_utf8(started.stderr).unwrap();
            assert_eq!((started.status.code(), done.status.code()), (Some(1), Some(1)), "{log}");
            assert!(found.contains(text) && log.contains(text), "{found}\n{log}");
        } else {
            let log = Process::start(&service, "kind", folder.path()).kill();
            let warns = log.contains("leftovers of crashed processes were not removed");
            assert_eq!(warns, options.contains(&"--unlisted"), "{log}");
        }
    }
}

#[test]
fn asynchronous_jobs_on_s3_survive_kill() {
    let service = Service::start(&["--guarded"]);
    let folder = tempfile::tempdir().unwrap();
    let query = "/v1/meshes?format=stl&resolution=1";
    let mut log = String::new();
    let mut jobs: Vec<(usize, String)> = Vec::new();
    // The jobs of a round occupy the only worker for much longer than the kill takes; one open job suffices.
    let open = (0..5).any(|round| {
        // Processes share nothing but S3.
        let data_dir = folder.path().join(round.to_string());
        let server = Process::start(&service, "killed", &data_dir);
        for n in 3 * round..3 * round + 3 {
            jobs.push((n, submit(server.addr, query, &sample(n))));
        }
        log += &server.kill();
        any_open(&service, "killed", folder.path())
    });
    assert!(open, "no job was open");
    let server = Process::start(&service, "killed", &folder.path().join("last"));
    let reference = start(Arc::new(ReferenceBackend), |_| {});
    let (_, expected) = result(reference.addr, &submit(reference.addr, query, &sample(jobs[0].0)));
    let mut etags = Vec::new();
    for (n, job) in &jobs {
        let (address, reply) = result(server.addr, job);
        assert!(reply.body == expected.body, "job {n} has different bytes than with a local store");
        etags.push(reply.header("etag").unwrap().to_owned());
        if *n == jobs[0].0 {
            assert_eq!(reply.header("etag"), expected.header("etag"));
            in_parts(server.addr, &address, &reply);
        }
    }
    etags.dedup();
    assert_eq!(etags.len(), jobs.len(), "every input has its own result");
    log += &server.kill();
    // The log names the location but not the credentials.
    assert!(log.contains("s3://meshes/killed") && log.contains("DEBUG"), "{log}");
    assert!(!log.contains(&service.access.secret), "the secret is in the log");
}

#[test]
fn s3_and_a_local_store_have_the_same_objects() {
    let service = Service::start(&[]);
    let on_s3 = |c: &mut molmesh::config::Config| {
        c.store = service.config("same");
        c.store.memory_bytes = 0;
    };
    let backend = || -> Arc<dyn Backend> { Arc::new(CpuBackend::new(None).unwrap()) };
    let (server, reference) = (start(backend(), on_s3), start(backend(), |_| {}));
    let upload = |addr| send(addr, "POST", "/v1/structures", &[], SAMPLE);
    let created = upload(server.addr);
    assert_eq!((created.status, upload(server.addr).status, upload(reference.addr).status), (201, 200, 201));
    let structure = created.header("location").unwrap();
    assert!(server.join());
    // Another process on the same bucket.
    let server = start(backend(), on_s3);
    let mut seen = Vec::new();
    // The last result is stored as a multipart upload.
    for file in [
        "surface.glb?resolution=1",
        "surface.stl?resolution=1",
        "surface.ply?resolution=0.7",
        "surface.stl?resolution=0.24",
    ] {
        let path = format!("{structure}/{file}");
        let (fresh, expected) = (get(server.addr, &path), get(reference.addr, &path));
        assert_eq!((fresh.status, fresh.complete, expected.status), (200, true, 200), "{file}");
        assert!(fresh.body == expected.body && fresh.header("etag") == expected.header("etag"), "{file}");
        let address = fresh.header("content-location").unwrap();
        let kept = get(server.addr, address);
        assert_eq!((kept.status, kept.body == expected.body), (200, true), "{file}");
        in_parts(server.addr, address, &kept);
        let again = get(server.addr, &path);
        assert!(again.header("server-timing").unwrap().starts_with("cache;desc=hit"), "{file}");
        assert!(again.body == expected.body, "{file}");
        seen.push(kept.body);
    }
    assert!(seen.last().unwrap().len() > 8 << 20, "{}", seen.last().unwrap().len());
    seen.dedup();
    assert_eq!(seen.len(), 4, "four different files");
}

#[test]
fn asynchronous_jobs_survive_an_s3_outage() {
    let mut service = Service::start(&["--guarded"]);
    let fake = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&fake) as _, |c| {
        c.store = service.config("away");
        c.store.memory_bytes = 0;
        c.jobs.workers = 2;
        c.jobs.save_retry_ms = 600_000;
    });
    let addr = server.addr;
    let mesh = |n| send(addr, "POST", "/v1/meshes?format=stl", &[], &sample(n));

    // Existing objects: a structure and a result.
    let structure = send(addr, "POST", "/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let before = get(addr, &format!("{structure}/surface.stl"));
    let kept = before.header("content-location").unwrap().to_owned();
    assert_eq!((before.status, get(addr, &kept).status), (200, 200));

    // Two jobs run when S3 becomes unavailable: a synchronous and an asynchronous one.
    fake.set(Mode::Held);
    let started = fake.started.load(Ordering::SeqCst);
    let accepted = submit(addr, "/v1/meshes?format=stl", &sample(1));
    let waiting = std::thread::spawn(move || send(addr, "POST", "/v1/meshes?format=stl", &[], &sample(2)));
    wait_for("both jobs", || fake.started.load(Ordering::SeqCst) == started + 2);
    service.away();
    fake.set(Mode::Octahedra);
    let reply = waiting.join().unwrap();
    assert_eq!((reply.status, reply.complete, reply.body == before.body), (200, true, true));
    wait_for("an attempt to keep the result", || !log_lines("the store rejected a write; retrying").is_empty());
    assert_eq!(get(addr, &accepted).json()["status"], "running");

    // Requests that need the store are rejected with a message for clients; others succeed.
    let refused = || {
        [
            send(addr, "POST", "/v1/meshes?format=stl", &[LATER], &sample(3)),
            send(addr, "POST", "/v1/structures", &[], &sample(4)),
            get(addr, &structure),
            get(addr, &format!("{structure}/surface.stl?resolution=2")),
            get(addr, &kept),
        ]
    };
    for reply in refused() {
        reply.problem(503, "store-failed");
        assert!(reply.header("retry-after").is_some_and(|seconds| seconds.parse::<u64>().unwrap() >= 1), "{reply:?}");
        let text = reply.text();
        assert!(!text.contains("s3://") && !text.contains(&service.access.endpoint), "{text}");
    }
    let reply = mesh(5);
    assert_eq!((reply.status, reply.complete, reply.body == before.body), (200, true, true));
    assert_eq!((get(addr, "/livez").status, get(addr, "/readyz").status), (200, 200));
    assert!(server.metric("molmesh_store_errors_total", &[]) >= 1.0);

    // S3 returns: the asynchronous job succeeds without meshing again.
    let made = fake.finished.load(Ordering::SeqCst);
    service.back();
    let document = successful(addr, &accepted);
    assert_eq!((&document["attempts"], fake.finished.load(Ordering::SeqCst)), (&1.into(), made));
    let (address, reply) = result(addr, &accepted);
    assert!(reply.body == before.body);
    in_parts(addr, &address, &reply);
    assert_eq!(refused().map(|reply| reply.status), [202, 201, 200, 200, 200]);

    // S3 fails permanently: no new jobs or processes start.
    let place = service.config("away");
    let access = service.access.clone();
    let elsewhere = tempfile::tempdir().unwrap();
    let mut starting = command("serve", &service, "away", elsewhere.path());
    drop(service);
    send(addr, "POST", "/v1/meshes?format=stl", &[LATER], &sample(6)).problem(503, "store-failed");
    let refused = starting.output().unwrap();
    let output = String::from_utf8(refused.stderr).unwrap();
    assert!(!refused.status.success() && output.contains("store.url"), "{output}");
    assert!(output.contains(place.url.as_deref().unwrap()) && !output.contains(&access.secret), "{output}");
    assert!(!log_lines("s3://meshes/away").is_empty(), "the log does not name the location");
    assert!(log_lines(&access.secret).is_empty(), "the secret is in the log");
}
