//! Failures and shutdown: panics, errors, disconnecting clients, the warm-up, the drain.

use crate::http_support;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use http_support::{Fake, Mode, Running, SAMPLE, carbons, connect, log_lines, sample, start, start_cold, wait_for};

fn running(backend: &Arc<Fake>) -> Running {
    start(Arc::clone(backend) as _, |_| {})
}

/// Sends an upload without waiting for the response.
fn begin(server: &Running, body: &[u8]) -> TcpStream {
    let mut stream = connect(server.addr);
    let head = format!("POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len());
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(body).unwrap();
    stream
}

#[test]
fn a_panic_gives_a_500_without_details_and_keeps_the_workers() {
    let backend = Fake::new(Mode::Panic);
    let server = running(&backend);
    let panics = || server.metric("molmesh_panics_total", &["component=\"job\""]);
    let before = panics();
    for n in 0..6 {
        let reply = server.post("/v1/meshes", &[("x-request-id", &format!("panic-{n}"))], SAMPLE);
        let problem = reply.problem(500, "internal");
        assert!(!reply.text().contains("panic of a test"), "{problem}");
    }
    assert!(panics() >= before + 6.0);
    let lines = log_lines("panic-3");
    assert!(lines.iter().any(|line| line.contains("ERROR") && line.contains("panic of a test")), "{lines:?}");
    backend.set(Mode::Octahedra);
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    assert!(server.join());
}

#[test]
fn errors_of_the_backend_contain_their_numbers() {
    let backend = Fake::new(Mode::GridTooLarge);
    let server = running(&backend);
    let problem = server.post("/v1/meshes?resolution=0.2", &[], SAMPLE).problem(422, "grid-too-large");
    assert_eq!((&problem["limit"], &problem["actual"]), (&100.into(), &1000.into()));
    assert_eq!((&problem["resolution"], &problem["suggested_resolution"]), (&0.2.into(), &1.1.into()));
    backend.set(Mode::NoSurface);
    assert_eq!(server.post("/v1/meshes?isovalue=99", &[], SAMPLE).problem(422, "no-surface")["isovalue"], 99.0);
}

#[test]
fn an_invalid_mesh_is_an_internal_error() {
    let backend = Fake::new(Mode::Broken);
    let server = running(&backend);
    let reply = server.post("/v1/meshes", &[("x-request-id", "broken-mesh")], SAMPLE);
    reply.problem(500, "internal");
    assert!(log_lines("broken-mesh").iter().any(|line| line.contains("ERROR")));
}

#[test]
fn a_disconnecting_client_cancels_its_job() {
    let backend = Fake::new(Mode::Slow(Duration::from_secs(30)));
    let server = running(&backend);
    let stream = begin(&server, SAMPLE);
    wait_for("the job to run", || backend.started.load(Ordering::SeqCst) == 1);
    let start = Instant::now();
    stream.shutdown(Shutdown::Both).unwrap();
    drop(stream);
    wait_for("the job to be cancelled", || backend.cancelled.load(Ordering::SeqCst) == 1);
    assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
    wait_for("the log", || !log_lines("the client left before the response").is_empty());
    assert!(server.metric("http_server_request_duration_seconds_count", &["status=\"none\""]) >= 1.0);
    assert!(server.metric("molmesh_jobs_finished_total", &["dismissed"]) >= 1.0);
    backend.set(Mode::Octahedra);
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
}

#[test]
fn a_queued_job_of_a_disconnected_client_never_runs() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(400)));
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    // Both take long, so the first keeps its worker.
    let first = begin(&server, &carbons(20_000));
    wait_for("the first job to run", || backend.started.load(Ordering::SeqCst) == 1);
    let second = begin(&server, &carbons(20_001));
    std::thread::sleep(Duration::from_millis(100));
    drop(second);
    wait_for("the first job to end", || backend.finished.load(Ordering::SeqCst) == 1);
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(backend.started.load(Ordering::SeqCst), 1);
    drop(first);
}

#[test]
fn disconnecting_during_the_response_frees_the_mesh() {
    let backend = Fake::new(Mode::Octahedra);
    let server = running(&backend);
    let mut stream = begin(&server, &carbons(60_000));
    let mut some = [0; 1000];
    stream.read_exact(&mut some).unwrap();
    drop(stream);
    wait_for("the mesh to be freed", || server.metric("molmesh_memory_held_bytes", &[]) < 1e6);
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
}

#[test]
fn ready_only_after_the_first_mesh() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(500)));
    backend.also_warm.store(true, Ordering::SeqCst);
    let server = start_cold(Arc::clone(&backend) as _, |_| {});
    wait_for("the listener", || server.get("/livez").status == 200);
    assert_eq!(server.get("/readyz").problem(503, "not-ready")["detail"], "the first mesh is being computed");
    wait_for("the first mesh", || server.get("/readyz").status == 200);

    for mode in [Mode::Panic, Mode::NoSurface] {
        let broken = Fake::new(mode);
        broken.also_warm.store(true, Ordering::SeqCst);
        let server = start_cold(Arc::clone(&broken) as _, |_| {});
        wait_for("the warm-up to fail", || {
            let reply = server.get("/readyz");
            reply.status == 503 && reply.text().contains("the first mesh failed")
        });
        assert_eq!(server.get("/livez").status, 200);
    }
}

#[test]
fn a_drain_finishes_running_and_queued_jobs() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(500)));
    let mut server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    let statuses = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..2)
            .map(|n| {
                let addr = server.addr;
                scope.spawn(move || http_support::send(addr, "POST", "/v1/meshes", &[], &sample(n)))
            })
            .collect();
        wait_for("one to run", || backend.started.load(Ordering::SeqCst) == 1);
        wait_for("one to wait", || server.metric("molmesh_queue_depth", &[]) >= 1.0);
        let idle = connect(server.addr);
        // A request that has started is finished, even if its body is incomplete.
        let mut slow = connect(server.addr);
        let head = format!("POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", SAMPLE.len());
        slow.write_all(head.as_bytes()).unwrap();
        slow.write_all(&SAMPLE[..1000]).unwrap();
        std::thread::sleep(Duration::from_millis(50));
        server.stop();
        // New connections are refused, and idle ones do not delay the server.
        wait_for("the listener to be gone", || TcpStream::connect(server.addr).is_err());
        drop(idle);
        slow.write_all(&SAMPLE[1000..]).unwrap();
        let late = http_support::read_reply(&mut slow, false);
        assert_eq!((late.status, late.complete), (200, true));
        clients.into_iter().map(|client| client.join().unwrap()).map(|r| (r.status, r.complete)).collect::<Vec<_>>()
    });
    assert_eq!(statuses, [(200, true), (200, true)]);
    assert!(server.join(), "drained");
}

#[test]
fn a_drain_has_a_deadline() {
    let backend = Fake::new(Mode::Slow(Duration::from_mins(1)));
    let mut server = start(Arc::clone(&backend) as _, |c| c.server.drain_timeout_ms = 300);
    let stream = begin(&server, SAMPLE);
    wait_for("the job to run", || backend.started.load(Ordering::SeqCst) == 1);
    let start = Instant::now();
    server.stop();
    assert!(!server.join(), "requests were cut off");
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
    wait_for("the job to be cancelled", || backend.cancelled.load(Ordering::SeqCst) == 1);
    drop(stream);
}

#[test]
fn a_backend_that_cannot_be_cancelled_does_not_delay_the_response() {
    let backend = Fake::new(Mode::Uncancellable(Duration::from_secs(6)));
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.deadline_ms = 200);
    let start = Instant::now();
    server.post("/v1/meshes", &[], SAMPLE).problem(504, "deadline");
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
}

#[test]
fn keep_alive_serves_many_requests_on_one_connection() {
    let backend = Fake::new(Mode::Octahedra);
    let server = running(&backend);
    let mut stream = connect(server.addr);
    for _ in 0..50 {
        stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
        let mut bytes = Vec::new();
        let mut byte = [0];
        while !bytes.ends_with(b"\"live\"}") {
            stream.read_exact(&mut byte).unwrap();
            bytes.push(byte[0]);
        }
        assert!(bytes.starts_with(b"HTTP/1.1 200"));
    }
}

#[test]
fn errors_of_an_address_in_use_name_the_key() {
    let backend = Fake::new(Mode::Octahedra);
    let server = running(&backend);
    let mut config = molmesh::config::Config::default();
    config.server.listen = server.addr;
    let selected = molmesh::pipeline::SelectedBackend {
        backend,
        reason: String::new(),
        renderer: molmesh::picture::SelectedRenderer::cpu("set by a test"),
        devices: Vec::new(),
        no_gpu: None,
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let error = runtime.block_on(molmesh::http::Server::bind(config, selected)).err().unwrap().to_string();
    assert!(error.contains("server.listen") && error.contains(&server.addr.to_string()), "{error}");
}
