//! Shutdown step by step: notice, drain, immediate stop; records of unfinished jobs.

use crate::http_support;

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use http_support::{Fake, Mode, Running, SAMPLE, connect, read_reply, sample, start, wait_for};
use molmesh::config::Config;
use molmesh::http::Stop;
use serde_json::Value;

/// Longer than any test.
const NEVER_MS: u64 = 3_600_000;

fn with_long_timeouts(config: &mut Config) {
    (config.server.termination_notice_ms, config.server.drain_timeout_ms) = (Some(NEVER_MS), NEVER_MS);
    config.jobs.deadline_ms = NEVER_MS;
}

/// Sends the head of an upload and part of its body.
fn begin(server: &Running) -> TcpStream {
    let mut stream = connect(server.addr);
    let head = format!("POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", SAMPLE.len());
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&SAMPLE[..1000]).unwrap();
    stream
}

/// Submits an asynchronous job and returns its id.
fn submit(server: &Running, n: usize) -> String {
    let reply = server.post("/v1/meshes", &[("prefer", "respond-async")], &sample(n));
    assert_eq!(reply.status, 202, "{}", String::from_utf8_lossy(&reply.body));
    reply.json()["jobID"].as_str().unwrap().to_owned()
}

/// Reads the record of a job.
fn record(server: &Running, id: &str) -> Value {
    let read = |end: &str| std::fs::read(server.dir.path().join(format!("store/jobs/{id}{end}")));
    let bytes = read(".ended.json").or_else(|_| read(".json")).unwrap();
    serde_json::from_slice(&bytes).unwrap()
}

#[test]
fn all_requests_are_served_during_the_notice() {
    let server = start(Fake::new(Mode::Octahedra), with_long_timeouts);
    // Opened before the notice, used during it.
    let mut old = connect(server.addr);
    old.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    let mut some = [0; 12];
    old.read_exact(&mut some).unwrap();
    server.request_stop(Stop::Notice);
    wait_for("it is not ready", || server.get("/readyz").status == 503);
    let problem = server.get("/readyz").problem(503, "not-ready");
    let failing: Vec<_> = problem["checks"].as_array().unwrap().iter().filter(|c| c["ok"] == false).collect();
    assert!(failing.len() == 1 && failing[0]["name"] == "accepting", "{problem}");
    // New connections and jobs are accepted.
    for n in 0..3 {
        assert_eq!(server.post("/v1/meshes", &[], &sample(n)).status, 200);
    }
    let job = submit(&server, 9);
    wait_for("the asynchronous job ends", || {
        server.get(&format!("/v1/jobs/{job}?wait=20")).json()["status"] == "successful"
    });
    // Each response closes its connection, so that the client reconnects elsewhere.
    old.write_all(b"GET /version HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    let mut rest = String::new();
    old.read_to_string(&mut rest).unwrap();
    assert!(rest.contains("\"name\":\"molmesh\"") && rest.contains("connection: close\r\n"), "{rest}");
    assert!(server.join(), "drained");
}

#[test]
fn the_notice_is_limited_and_optional() {
    for termination_notice_ms in [Some(1), None] {
        let mut server = start(Fake::new(Mode::Octahedra), |c| c.server.termination_notice_ms = termination_notice_ms);
        server.request_stop(Stop::Notice);
        assert!(server.wait(), "{termination_notice_ms:?}");
    }
}

#[test]
fn requests_that_started_before_the_drain_are_answered() {
    let mut server = start(Fake::new(Mode::Octahedra), with_long_timeouts);
    let mut upload = begin(&server);
    wait_for("the upload has begun", || server.metric("molmesh_memory_held_bytes", &[]) > 0.0);
    server.request_stop(Stop::Drain);
    wait_for("the listener is closed", || TcpStream::connect(server.addr).is_err());
    upload.write_all(&SAMPLE[1000..]).unwrap();
    let reply = read_reply(&mut upload, false);
    assert_eq!((reply.status, reply.complete, reply.header("connection")), (200, true, Some("close")));
    assert!(server.wait(), "drained");
}

#[test]
fn an_interrupted_drain_is_reported() {
    let backend = Fake::new(Mode::Slow(Duration::from_hours(1)));
    let mut server = start(Arc::clone(&backend) as _, with_long_timeouts);
    let mut upload = begin(&server);
    upload.write_all(&SAMPLE[1000..]).unwrap();
    wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
    server.request_stop(Stop::Drain);
    wait_for("the listener is closed", || TcpStream::connect(server.addr).is_err());
    server.request_stop(Stop::Now);
    assert!(!server.wait(), "a request was cut off");
    wait_for("the job is cancelled", || backend.cancelled.load(Ordering::SeqCst) == 1);
}

#[test]
fn asynchronous_jobs_resume_at_the_next_start_without_a_counted_attempt() {
    let backend = Fake::new(Mode::Slow(Duration::from_hours(1)));
    let mut server = start(Arc::clone(&backend) as _, |c| {
        (c.jobs.workers, c.server.drain_timeout_ms) = (1, 100);
    });
    let jobs = [submit(&server, 1), submit(&server, 2)];
    wait_for("the first one runs", || backend.started.load(Ordering::SeqCst) == 1);
    wait_for("its start is recorded", || record(&server, &jobs[0])["attempts"] == 1);
    server.request_stop(Stop::Drain);
    assert!(server.wait(), "no request was cut off");
    for job in &jobs {
        let record = record(&server, job);
        assert_eq!((&record["status"], &record["attempts"]), (&"accepted".into(), &0.into()), "{record}");
    }
    assert_eq!(backend.started.load(Ordering::SeqCst), 1, "the queued job was started");
}

#[test]
fn a_running_asynchronous_job_is_finished_within_the_drain() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(500)));
    let mut server = start(Arc::clone(&backend) as _, |c| {
        with_long_timeouts(c);
        c.jobs.workers = 1;
    });
    let jobs = [submit(&server, 1), submit(&server, 2)];
    wait_for("the first one runs", || backend.started.load(Ordering::SeqCst) == 1);
    server.request_stop(Stop::Drain);
    assert!(server.wait());
    let [first, second] = jobs.map(|job| record(&server, &job));
    assert_eq!((&first["status"], &second["status"]), (&"successful".into(), &"accepted".into()), "{first} {second}");
}

#[test]
fn asynchronous_jobs_are_accepted_during_the_drain() {
    let mut server = start(Fake::new(Mode::Octahedra), with_long_timeouts);
    let mut upload = connect(server.addr);
    let head = format!(
        "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nprefer: respond-async\r\ncontent-length: {}\r\n\r\n",
        SAMPLE.len()
    );
    upload.write_all(head.as_bytes()).unwrap();
    upload.write_all(&SAMPLE[..1000]).unwrap();
    wait_for("the upload has begun", || server.metric("molmesh_memory_held_bytes", &[]) > 0.0);
    server.request_stop(Stop::Drain);
    wait_for("the listener is closed", || TcpStream::connect(server.addr).is_err());
    upload.write_all(&SAMPLE[1000..]).unwrap();
    let reply = read_reply(&mut upload, false);
    assert_eq!((reply.status, reply.complete), (202, true), "{}", String::from_utf8_lossy(&reply.body));
    let id = reply.json()["jobID"].as_str().unwrap().to_owned();
    assert!(server.wait());
    let record = record(&server, &id);
    assert_eq!((&record["status"], &record["attempts"]), (&"accepted".into(), &0.into()), "{record}");
}

/// Folder of the store that is replaced by a file until this is dropped, so that every operation on it fails.
struct Blocked([PathBuf; 2]);

impl Blocked {
    fn new(server: &Running, folder: &str) -> Self {
        let paths = ["", ".aside"].map(|end| server.dir.path().join(format!("store/{folder}{end}")));
        std::fs::rename(&paths[0], &paths[1]).unwrap();
        std::fs::write(&paths[0], b"").unwrap();
        Self(paths)
    }
}

impl Drop for Blocked {
    fn drop(&mut self) {
        std::fs::remove_file(&self.0[0]).unwrap();
        std::fs::rename(&self.0[1], &self.0[0]).unwrap();
    }
}

/// Starts a server with one asynchronous job whose result is being stored, which fails until the folder is free again.
fn storing(change: impl FnOnce(&mut Config)) -> (Running, String, Blocked) {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(500)));
    let server = start(Arc::clone(&backend) as _, |config| {
        with_long_timeouts(config);
        config.jobs.save_retry_ms = NEVER_MS;
        change(config);
    });
    let job = submit(&server, 1);
    wait_for("the start is recorded", || record(&server, &job)["attempts"] == 1);
    let blocked = Blocked::new(&server, "results");
    wait_for("the result is being stored", || server.get(&format!("/v1/jobs/{job}")).json()["stage"] == "encode");
    (server, job, blocked)
}

#[test]
fn a_result_is_stored_within_the_drain() {
    let (mut server, job, blocked) = storing(|_| {});
    server.request_stop(Stop::Drain);
    std::thread::sleep(Duration::from_millis(1500));
    drop(blocked);
    let stopped = server.stopped();
    assert!(stopped.is_orderly() && stopped.jobs_finished == 1 && stopped.jobs_returned == 0, "{stopped:?}");
    let record = record(&server, &job);
    assert_eq!((&record["status"], &record["attempts"]), (&"successful".into(), &1.into()), "{record}");
    let result = server.dir.path().join(format!("store/results/{}.glb", record["result"].as_str().unwrap()));
    assert!(result.exists(), "{}", result.display());
}

#[test]
fn a_job_whose_result_is_not_stored_in_time_returns_to_the_queue() {
    for (drain_timeout_ms, cut) in [(100, false), (NEVER_MS, true)] {
        let (mut server, job, blocked) = storing(|config| config.server.drain_timeout_ms = drain_timeout_ms);
        server.request_stop(Stop::Drain);
        if cut {
            wait_for("the listener is closed", || TcpStream::connect(server.addr).is_err());
            server.request_stop(Stop::Now);
        }
        let stopped = server.stopped();
        assert!(stopped.is_orderly() && stopped.jobs_finished == 0 && stopped.jobs_returned == 1, "{stopped:?}");
        let record = record(&server, &job);
        assert_eq!((&record["status"], &record["attempts"]), (&"accepted".into(), &0.into()), "{record}");
        drop(blocked);
    }
}

#[test]
fn a_job_that_cannot_be_recorded_is_reported() {
    let (mut server, _, results) = storing(|config| config.server.drain_timeout_ms = 100);
    let records = Blocked::new(&server, "jobs");
    server.request_stop(Stop::Drain);
    let stopped = server.stopped();
    assert!(!stopped.is_orderly() && stopped.requests_finished && stopped.jobs_unrecorded == 1, "{stopped:?}");
    drop((results, records));
}

#[test]
fn a_shutdown_takes_at_most_25_seconds_by_default() {
    let server = Config::default().server;
    // The limit includes one second for cancelled requests.
    assert!(server.termination_notice_ms.unwrap_or_default() + server.drain_timeout_ms + 2000 <= 25_000);
}
