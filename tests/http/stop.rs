//! The end of a service, step by step: notice, drain, cut; and what is on record of jobs that were left.

use crate::http_support;

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use http_support::{Fake, Mode, Running, SAMPLE, connect, read_reply, sample, start, wait_for};
use molmesh::config::Config;
use molmesh::http::Stop;
use serde_json::Value;

/// Longer than any test.
const NEVER_MS: u64 = 3_600_000;

fn patient(config: &mut Config) {
    (config.server.termination_notice_ms, config.server.drain_timeout_ms) = (Some(NEVER_MS), NEVER_MS);
    config.jobs.deadline_ms = NEVER_MS;
}

/// Sends the head of an upload and a part of its body.
fn begin(server: &Running) -> TcpStream {
    let mut stream = connect(server.addr);
    let head = format!("POST /v1/meshes HTTP/1.1\r\nhost: t\r\ncontent-length: {}\r\n\r\n", SAMPLE.len());
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&SAMPLE[..1000]).unwrap();
    stream
}

/// Promises a job and gives its id.
fn promise(server: &Running, n: usize) -> String {
    let reply = server.post("/v1/meshes", &[("prefer", "respond-async")], &sample(n));
    assert_eq!(reply.status, 202, "{}", String::from_utf8_lossy(&reply.body));
    reply.json()["jobID"].as_str().unwrap().to_owned()
}

/// What is on record of a job.
fn record(server: &Running, id: &str) -> Value {
    let bytes = std::fs::read(server.dir.path().join(format!("store/jobs/{id}.json"))).unwrap();
    serde_json::from_slice(&bytes).unwrap()
}

#[test]
fn notice_is_given_while_everything_is_served() {
    let server = start(Fake::new(Mode::Octahedra), patient);
    // Open before the notice, used during it.
    let mut old = connect(server.addr);
    old.write_all(b"GET /livez HTTP/1.1\r\nhost: t\r\n\r\n").unwrap();
    let mut some = [0; 12];
    old.read_exact(&mut some).unwrap();
    server.order(Stop::Notice);
    wait_for("it is not ready", || server.get("/readyz").status == 503);
    let problem = server.get("/readyz").problem(503, "not-ready");
    let failing: Vec<_> = problem["checks"].as_array().unwrap().iter().filter(|c| c["ok"] == false).collect();
    assert!(failing.len() == 1 && failing[0]["name"] == "accepting", "{problem}");
    // New connections, new jobs, promises: all as before.
    for n in 0..3 {
        assert_eq!(server.post("/v1/meshes", &[], &sample(n)).status, 200);
    }
    let job = promise(&server, 9);
    wait_for("the promise is kept", || server.get(&format!("/v1/jobs/{job}?wait=20")).json()["status"] == "successful");
    // An answer is the last one on its connection, so that its client turns elsewhere.
    old.write_all(b"GET /version HTTP/1.1\r\nhost: t\r\n\r\n").unwrap();
    let mut rest = String::new();
    old.read_to_string(&mut rest).unwrap();
    assert!(rest.contains("\"name\":\"molmesh\"") && rest.contains("connection: close\r\n"), "{rest}");
    assert!(server.join(), "drained");
}

#[test]
fn the_notice_has_an_end_and_can_be_none() {
    for termination_notice_ms in [Some(1), None] {
        let mut server = start(Fake::new(Mode::Octahedra), |c| c.server.termination_notice_ms = termination_notice_ms);
        server.order(Stop::Notice);
        assert!(server.wait(), "{termination_notice_ms:?}");
    }
}

#[test]
fn what_has_begun_is_answered_and_what_was_let_in_as_well() {
    let mut server = start(Fake::new(Mode::Octahedra), patient);
    let mut upload = begin(&server);
    wait_for("the upload has begun", || server.metric("molmesh_memory_held_bytes", &[]) > 0.0);
    server.order(Stop::Drain);
    wait_for("the listener is gone", || TcpStream::connect(server.addr).is_err());
    upload.write_all(&SAMPLE[1000..]).unwrap();
    let reply = read_reply(&mut upload, false);
    assert_eq!((reply.status, reply.complete, reply.header("connection")), (200, true, Some("close")));
    assert!(server.wait(), "drained");
}

#[test]
fn a_drain_that_is_cut_short_says_so() {
    let backend = Fake::new(Mode::Slow(Duration::from_hours(1)));
    let mut server = start(Arc::clone(&backend) as _, patient);
    let mut upload = begin(&server);
    upload.write_all(&SAMPLE[1000..]).unwrap();
    wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
    server.order(Stop::Drain);
    wait_for("the listener is gone", || TcpStream::connect(server.addr).is_err());
    server.order(Stop::Now);
    assert!(!server.wait(), "a request was cut off");
    wait_for("the job is cancelled", || backend.cancelled.load(Ordering::SeqCst) == 1);
}

#[test]
fn promised_jobs_are_left_for_the_next_start_and_no_attempt_is_counted() {
    let backend = Fake::new(Mode::Slow(Duration::from_hours(1)));
    let mut server = start(Arc::clone(&backend) as _, |c| {
        (c.jobs.workers, c.server.drain_timeout_ms) = (1, 100);
    });
    let jobs = [promise(&server, 1), promise(&server, 2)];
    wait_for("the first one runs", || backend.started.load(Ordering::SeqCst) == 1);
    wait_for("that is on record", || record(&server, &jobs[0])["attempts"] == 1);
    server.order(Stop::Drain);
    assert!(server.wait(), "no request was cut off");
    for job in &jobs {
        let record = record(&server, job);
        assert_eq!((&record["status"], &record["attempts"]), (&"accepted".into(), &0.into()), "{record}");
    }
    assert_eq!(backend.started.load(Ordering::SeqCst), 1, "what waited is not begun");
}

#[test]
fn a_promised_job_that_runs_is_finished_if_there_is_time() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(500)));
    let mut server = start(Arc::clone(&backend) as _, |c| {
        patient(c);
        c.jobs.workers = 1;
    });
    let jobs = [promise(&server, 1), promise(&server, 2)];
    wait_for("the first one runs", || backend.started.load(Ordering::SeqCst) == 1);
    server.order(Stop::Drain);
    assert!(server.wait());
    let [first, second] = jobs.map(|job| record(&server, &job));
    assert_eq!((&first["status"], &second["status"]), (&"successful".into(), &"accepted".into()), "{first} {second}");
}

#[test]
fn a_promise_that_is_asked_for_while_the_service_drains_is_given() {
    let mut server = start(Fake::new(Mode::Octahedra), patient);
    let mut upload = connect(server.addr);
    let head = format!(
        "POST /v1/meshes HTTP/1.1\r\nhost: t\r\nprefer: respond-async\r\ncontent-length: {}\r\n\r\n",
        SAMPLE.len()
    );
    upload.write_all(head.as_bytes()).unwrap();
    upload.write_all(&SAMPLE[..1000]).unwrap();
    wait_for("the upload has begun", || server.metric("molmesh_memory_held_bytes", &[]) > 0.0);
    server.order(Stop::Drain);
    wait_for("the listener is gone", || TcpStream::connect(server.addr).is_err());
    upload.write_all(&SAMPLE[1000..]).unwrap();
    let reply = read_reply(&mut upload, false);
    assert_eq!((reply.status, reply.complete), (202, true), "{}", String::from_utf8_lossy(&reply.body));
    let id = reply.json()["jobID"].as_str().unwrap().to_owned();
    assert!(server.wait());
    let record = record(&server, &id);
    assert_eq!((&record["status"], &record["attempts"]), (&"accepted".into(), &0.into()), "{record}");
}

#[test]
fn by_default_an_end_takes_less_than_twenty_five_seconds() {
    let server = Config::default().server;
    // A second for what is cancelled comes behind.
    assert!(server.termination_notice() + server.drain_timeout() + Duration::from_secs(2) <= Duration::from_secs(25));
}
