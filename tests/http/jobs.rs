//! Asynchronous jobs over HTTP: submission, status, cancellation, results; coalesced requests; fair scheduling.

use crate::http_support;

use std::io::{BufRead, BufReader, Write};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use http_support::{Fake, LONG, Mode, Reply, Running, SAMPLE, connect, sample, send, start, wait_for};
use serde_json::Value;

const LATER: (&str, &str) = ("prefer", "respond-async");

fn slow(ms: u64) -> Arc<Fake> {
    Fake::new(Mode::Slow(Duration::from_millis(ms)))
}

/// Submits an asynchronous job and returns its URL.
#[track_caller]
fn submit(server: &Running, path: &str, headers: &[(&str, &str)], body: &[u8]) -> String {
    let reply = server.post(path, &[&[LATER], headers].concat(), body);
    assert_eq!(reply.status, 202, "{}", String::from_utf8_lossy(&reply.body));
    assert_eq!(reply.header("preference-applied"), Some("respond-async"));
    let again = reply.header("retry-after").map(|seconds| seconds.parse::<u64>().unwrap());
    assert_eq!(again.is_some_and(|seconds| seconds >= 1), reply.json()["finished"].is_null());
    let location = reply.header("location").unwrap().to_owned();
    assert_eq!(location, format!("/v1/jobs/{}", reply.json()["jobID"].as_str().unwrap()));
    location
}

#[track_caller]
fn ended(server: &Running, job: &str, status: &str) -> Value {
    let reply = server.get(&format!("{job}?wait=20"));
    assert_eq!(reply.status, 200);
    let document = reply.json();
    assert_eq!(document["status"], status, "{document}");
    assert!(document["finished"].as_str().is_some_and(|t| t.ends_with('Z')), "{document}");
    document
}

fn result(server: &Running, job: &str) -> Reply {
    let reply = server.get(&format!("{job}/result"));
    assert_eq!(reply.status, 303, "{}", String::from_utf8_lossy(&reply.body));
    let result = server.get(reply.header("location").unwrap());
    assert_eq!((result.status, result.complete), (200, true));
    result
}

fn delete(server: &Running, path: &str) -> Reply {
    send(server.addr, "DELETE", path, &[], b"")
}

#[test]
fn an_asynchronous_job_has_the_bytes_of_a_synchronous_one() {
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let now = server.post("/v1/meshes?format=stl", &[], SAMPLE);
    let job = submit(&server, "/v1/meshes?format=stl", &[], &sample(1));
    let document = ended(&server, &job, "successful");
    assert_eq!((&document["progress"], &document["attempts"]), (&100.into(), &1.into()));
    assert_eq!(document["parameters"]["format"], "stl");
    let later = result(&server, &job);
    assert_eq!(later.body, now.body);
    assert_eq!(later.header("content-type"), Some("model/stl"));
    assert_eq!(later.header("molmesh-atoms"), now.header("molmesh-atoms"));
    let links = document["links"].as_array().unwrap();
    let report = links.iter().find(|l| l["rel"] == "describedby").unwrap()["href"].as_str().unwrap();
    assert_eq!(server.get(report).json()["atoms"], 454);
    // Ended jobs cannot be cancelled; unknown jobs are not found.
    delete(&server, &job).problem(409, "job-ended");
    for missing in ["/v1/jobs/00000000000000000000000000000000", "/v1/jobs/..%2f..%2fx", "/v1/jobs/x/result"] {
        server.get(missing).problem(404, "no-such-job");
    }
    server.get(&format!("{job}?wait=1000")).problem(400, "bad-parameter");
    server.get(&format!("{job}?wiat=1")).problem(400, "bad-parameter");
}

#[test]
fn a_request_that_exceeds_its_wait_becomes_a_job_and_its_work_continues() {
    let backend = slow(1_500);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let reply = server.post("/v1/meshes", &[("prefer", "wait=1")], SAMPLE);
    assert_eq!(reply.status, 202);
    assert_eq!(reply.header("preference-applied"), None);
    let job = reply.header("location").unwrap().to_owned();
    server.get(&format!("{job}/result")).problem(404, "no-result-yet");
    ended(&server, &job, "successful");
    assert_eq!(backend.started.load(Ordering::SeqCst), 1, "the work continued");
    assert!(!result(&server, &job).body.is_empty());
    // A report cannot be the result of a job, and a mesh in time is returned directly.
    for (path, wait) in [("/v1/report", "wait=0"), ("/v1/meshes", "wait=50")] {
        assert_eq!(server.post(path, &[("prefer", wait)], &sample(3)).status, 200, "{path} {wait}");
    }
}

#[test]
fn a_wait_is_limited_by_the_deadline() {
    let server = start(slow(30_000), |c| (c.jobs.deadline_ms, c.server.drain_timeout_ms) = (200, 1));
    assert_eq!(server.post("/v1/meshes", &[("prefer", "wait=100000")], SAMPLE).status, 202);
}

#[test]
fn a_request_without_a_preference_is_answered_in_time_or_rejected() {
    let backend = slow(30_000);
    let server = start(Arc::clone(&backend) as _, |c| (c.jobs.deadline_ms, c.server.drain_timeout_ms) = (400, 1));
    let refused = |path| server.post(path, &[], SAMPLE).problem(504, "deadline")["detail"].as_str().unwrap().to_owned();
    let detail = refused("/v1/meshes");
    assert!(detail.contains("`Prefer: respond-async`"), "{detail}");
    wait_for("its work to be cancelled", || backend.cancelled.load(Ordering::SeqCst) == 1);
    // A report has no asynchronous form to recommend.
    let detail = refused("/v1/report");
    assert!(!detail.contains("Prefer"), "{detail}");
    wait_for("its work to be cancelled", || backend.cancelled.load(Ordering::SeqCst) == 2);
    // A shared job continues.
    let job = submit(&server, "/v1/meshes", &[], SAMPLE);
    wait_for("the job to run", || backend.started.load(Ordering::SeqCst) == 3);
    refused("/v1/meshes");
    assert_eq!(server.get(&job).json()["status"], "running");
    assert_eq!((backend.started.load(Ordering::SeqCst), backend.cancelled.load(Ordering::SeqCst)), (3, 2));
    delete(&server, &job);
    wait_for("the job to be cancelled", || backend.cancelled.load(Ordering::SeqCst) == 3);
}

#[test]
fn failures_are_reported_as_for_synchronous_requests() {
    let backend = Fake::new(Mode::GridTooLarge);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let now = server.post("/v1/meshes", &[], SAMPLE).problem(422, "grid-too-large");
    let job = submit(&server, "/v1/meshes", &[("x-request-id", "mine-44")], SAMPLE);
    let document = ended(&server, &job, "failed");
    assert_eq!(document["problem"]["type"], "/problems/grid-too-large");
    assert_eq!(document["problem"]["instance"], "mine-44");
    for path in ["/result", "/events"] {
        server.get(&format!("{job}{path}?wait=1")).problem(400, "bad-parameter");
    }
    send(server.addr, "DELETE", &format!("{job}?now"), &[], b"").problem(400, "bad-parameter");
    let told = server.get(&format!("{job}/result")).problem(422, "grid-too-large");
    for member in ["detail", "limit", "actual", "suggested_resolution"] {
        assert_eq!(told[member], now[member], "{member}");
    }
    let job = submit(&server, "/v1/meshes", &[], b"HEADER\nnot a structure");
    ended(&server, &job, "failed");
    server.get(&format!("{job}/result")).problem(422, "no-atoms");
}

#[test]
fn queued_and_running_jobs_are_cancelled() {
    let backend = slow(30_000);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    let running = submit(&server, "/v1/meshes", &[], &sample(1));
    wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
    let waiting = submit(&server, "/v1/meshes", &[], &sample(2));
    assert_eq!(server.get(&waiting).json()["status"], "accepted");
    for job in [&waiting, &running] {
        let start = Instant::now();
        let reply = delete(&server, job);
        assert_eq!((reply.status, reply.json()["status"].as_str()), (200, Some("dismissed")));
        server.get(&format!("{job}/result")).problem(410, "job-dismissed");
        assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
    }
    let start = Instant::now();
    wait_for("the work stops", || backend.cancelled.load(Ordering::SeqCst) == 1);
    assert!(start.elapsed() < Duration::from_secs(10));
    assert_eq!(backend.started.load(Ordering::SeqCst), 1, "the queued job never ran");
    assert_eq!(delete(&server, &running).status, 200, "cancelling twice succeeds");
}

#[test]
fn identical_concurrent_requests_are_coalesced() {
    let backend = slow(500);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let replies: Vec<Reply> = std::thread::scope(|scope| {
        let server = &server;
        let glb = (0..4).map(|_| scope.spawn(move || server.post("/v1/meshes?format=glb", &[], SAMPLE)));
        let stl = (0..4).map(|_| scope.spawn(move || server.post("/v1/meshes?format=stl", &[], SAMPLE)));
        let clients: Vec<_> = glb.chain(stl).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    assert!(replies.iter().all(|r| r.status == 200 && r.complete));
    assert_eq!(backend.started.load(Ordering::SeqCst), 1);
    assert!(server.metric("molmesh_jobs_submitted_total", &["dedup=\"yes\""]) >= 7.0);
    // Control: other parameters start another job.
    assert_eq!(server.post("/v1/meshes?resolution=0.9", &[], SAMPLE).status, 200);
    assert_eq!(backend.started.load(Ordering::SeqCst), 2);
}

#[test]
fn asynchronous_jobs_join_running_work() {
    let backend = slow(3_000);
    let server = start(Arc::clone(&backend) as _, |_| {});
    std::thread::scope(|scope| {
        let waiting = scope.spawn(|| server.post("/v1/meshes", &[], SAMPLE));
        wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
        let jobs: Vec<String> = (0..4).map(|_| submit(&server, "/v1/meshes", &[], SAMPLE)).collect();
        assert_eq!(backend.finished.load(Ordering::SeqCst), 0, "no request waits for the job");
        for job in &jobs {
            assert_eq!(server.get(job).json()["attempts"], 1, "its start is recorded");
            ended(&server, job, "successful");
            assert!(!result(&server, job).body.is_empty());
        }
        assert_eq!(waiting.join().unwrap().status, 200);
    });
    assert_eq!(backend.started.load(Ordering::SeqCst), 1);
}

#[test]
fn a_coalesced_job_survives_a_client_that_disconnects() {
    let backend = slow(500);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let mut first_client = connect(server.addr);
    let head = format!("POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", SAMPLE.len());
    first_client.write_all(head.as_bytes()).unwrap();
    first_client.write_all(SAMPLE).unwrap();
    wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
    std::thread::scope(|scope| {
        let second_client = scope.spawn(|| server.post("/v1/meshes", &[], SAMPLE));
        std::thread::sleep(Duration::from_millis(100));
        drop(first_client);
        assert_eq!(second_client.join().unwrap().status, 200);
    });
    assert_eq!((backend.started.load(Ordering::SeqCst), backend.cancelled.load(Ordering::SeqCst)), (1, 0));
}

#[test]
fn an_idempotency_key_maps_many_requests_to_one_job() {
    let backend = slow(200);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let key = [("idempotency-key", "upload-1")];
    let first = submit(&server, "/v1/meshes", &key, SAMPLE);
    assert_eq!(submit(&server, "/v1/meshes", &key, SAMPLE), first);
    ended(&server, &first, "successful");
    assert_eq!(submit(&server, "/v1/meshes", &key, SAMPLE), first);
    let both = [LATER, key[0]];
    // Parameters are compared by value.
    let other = [("idempotency-key", "upload-2")];
    let second = submit(&server, "/v1/meshes?resolution=0.70&format=glb", &other, SAMPLE);
    assert_eq!(submit(&server, "/v1/meshes?format=glb&resolution=0.7", &other, SAMPLE), second);
    ended(&server, &second, "successful");
    server.post("/v1/meshes", &[LATER, key[0], other[0]], SAMPLE).problem(400, "bad-request");
    server.post("/v1/meshes?resolution=0.7", &both, SAMPLE).problem(422, "other-request");
    server.post("/v1/meshes", &both, &sample(1)).problem(422, "other-request");
    // Without a key every request is a separate job.
    assert_eq!(backend.started.load(Ordering::SeqCst), 2);
    let (a, b) = (submit(&server, "/v1/meshes", &[], SAMPLE), submit(&server, "/v1/meshes", &[], SAMPLE));
    assert_ne!(a, b);
    // A stored result is not computed again.
    assert_eq!(ended(&server, &a, "successful")["attempts"], 0);
    assert_eq!(backend.started.load(Ordering::SeqCst), 2);
}

/// Returns the events of a stream until it ends: id (`None` for that of the end), name, document.
fn events(server: &Running, path: &str, last: Option<&str>) -> Vec<(Option<u64>, String, Value)> {
    let mut stream = connect(server.addr);
    let last = last.map_or(String::new(), |id| format!("last-event-id: {id}\r\n"));
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\naccept: text/event-stream\r\n{last}\r\n"
    )
    .unwrap();
    let (mut found, mut id, mut name) = (Vec::new(), None, String::new());
    for line in BufReader::new(stream).lines() {
        let line = line.unwrap();
        if let Some(text) = line.strip_prefix("id: ") {
            id = if text == "end" { None } else { Some(text.parse().unwrap()) };
        } else if let Some(text) = line.strip_prefix("event: ") {
            text.clone_into(&mut name);
        } else if let Some(text) = line.strip_prefix("data: ") {
            found.push((id, name.clone(), serde_json::from_str(text).unwrap()));
        }
    }
    found
}

#[test]
fn events_start_with_a_snapshot_and_end_with_the_job() {
    let backend = slow(400);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    let first = submit(&server, "/v1/meshes", &[], &sample(1));
    let job = submit(&server, "/v1/meshes", &[], &sample(2));
    let path = format!("{job}/events");
    let seen = events(&server, &path, None);
    assert_eq!(seen[0].1, "accepted", "{seen:?}");
    assert_eq!(seen.last().unwrap().1, "successful");
    assert!(seen.iter().any(|(_, name, _)| name == "running"), "{seen:?}");
    let (end, before) = seen.split_last().unwrap();
    assert!(end.0.is_none() && before.windows(2).all(|pair| pair[0].0.unwrap() < pair[1].0.unwrap()), "{seen:?}");
    let fraction = |e: &(Option<u64>, String, Value)| e.2["fraction"].as_f64().unwrap();
    assert!(seen.windows(2).all(|pair| fraction(&pair[0]) <= fraction(&pair[1])), "{seen:?}");
    // Reconnecting returns new events only, and 204 after the last one.
    let again = events(&server, &path, Some(&before[0].0.unwrap().to_string()));
    assert_eq!((again.len(), again[0].0), (1, None));
    let over = send(server.addr, "GET", &path, &[("last-event-id", "end")], b"");
    assert_eq!(over.status, 204);
    ended(&server, &first, "successful");
    server.get("/v1/jobs/00000000000000000000000000000000/events").problem(404, "no-such-job");
}

#[test]
fn event_streams_and_polls_end_with_the_service() {
    let backend = slow(30_000);
    let mut server = start(Arc::clone(&backend) as _, |c| c.server.drain_timeout_ms = 10_000);
    let job = submit(&server, "/v1/meshes", &[], SAMPLE);
    let (addr, path) = (server.addr, format!("{job}?wait=30"));
    let events_path = format!("{job}/events");
    let poll = std::thread::spawn(move || send(addr, "GET", &path, &[], b"").status);
    let listen = std::thread::spawn(move || send(addr, "GET", &events_path, &[], b"").status);
    std::thread::sleep(Duration::from_millis(200));
    let begin = Instant::now();
    server.stop();
    assert_eq!((poll.join().unwrap(), listen.join().unwrap()), (200, 200));
    assert!(begin.elapsed() < Duration::from_secs(8), "{:?}", begin.elapsed());
}

#[test]
fn synchronous_requests_precede_asynchronous_jobs_which_still_run() {
    let backend = slow(500);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    let jobs: Vec<String> = (0..6).map(|n| submit(&server, "/v1/meshes", &[], &sample(n))).collect();
    assert_eq!(server.post("/v1/meshes", &[], &sample(100)).status, 200);
    // The next job may also have ended before the count is read.
    let finished = backend.finished.load(Ordering::SeqCst);
    assert!(finished <= 4, "{finished} of 7 were done");
    for job in jobs {
        ended(&server, &job, "successful");
    }
}

#[test]
fn a_job_that_would_wait_too_long_is_rejected_immediately() {
    let backend = slow(400);
    let server = start(Arc::clone(&backend) as _, |c| {
        c.jobs.workers = 1;
        c.jobs.deadline_ms = 2_000;
        c.jobs.queue = 1_000;
    });
    // The service measures the duration of jobs.
    for n in 0..12 {
        assert_eq!(server.post(LONG, &[], &sample(n)).status, 200);
    }
    // 12 s of work, of which 2 s fit into the deadline.
    let replies: Vec<_> = std::thread::scope(|scope| {
        let post = |n| {
            scope.spawn({
                let server = &server;
                move || server.post(LONG, &[], &sample(n))
            })
        };
        let posted: Vec<_> = (20..50).map(post).collect();
        posted.into_iter().map(|reply| reply.join().unwrap()).collect()
    });
    assert!(replies.iter().any(|reply| reply.status == 200));
    // Others were accepted, but did not begin or end in time.
    let is_immediate = |reply: &&Reply| {
        let ends_late = |problem: Value| problem["detail"].as_str().unwrap().contains("must end within");
        reply.status == 503 && ends_late(reply.problem(503, "queue-full"))
    };
    let rejected = replies.iter().find(is_immediate).expect("a request is rejected because of the work ahead");
    assert!(rejected.header("retry-after").unwrap().parse::<u64>().unwrap() >= 1);
}
