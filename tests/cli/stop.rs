//! Stop of `molmesh serve` under load by signals: no accepted request fails, durable jobs are kept, and each further
//! signal ends the current step.
#![cfg(unix)]

use crate::cli_support;
use crate::http_support;

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use cli_support::{Folder, Service};
use http_support::{SAMPLE, connect, read_reply, sample, send, wait_for};

fn addr(service: &Service) -> SocketAddr {
    service.addr.parse().unwrap()
}

/// Sends one request on a persistent connection. Returns the status and whether the server keeps the connection.
fn ask(stream: &mut TcpStream, body: &[u8]) -> (u16, bool) {
    let head =
        format!("POST /v1/meshes?resolution=1.5 HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len());
    stream.write_all(&[head.as_bytes(), body].concat()).unwrap();
    let (mut head, mut byte) = (Vec::new(), [0]);
    while !head.ends_with(b"\r\n\r\n") {
        stream.read_exact(&mut byte).unwrap();
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).unwrap();
    let value = |name: &str| head.lines().find_map(|l| l.strip_prefix(name)).map(str::to_owned);
    let mut body = vec![0; value("content-length: ").unwrap().parse().unwrap()];
    stream.read_exact(&mut body).unwrap();
    assert!(body.starts_with(b"glTF") || !head.starts_with("HTTP/1.1 200"), "{head}");
    (head[9..12].parse().unwrap(), value("connection: ").as_deref() != Some("close"))
}

#[test]
fn no_request_fails_under_load() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--devices", "cpu", "--set", "server.termination_notice_ms=3600000"]);
    let addr = addr(&service);
    let (noticed, answered, behind) = (AtomicBool::new(false), AtomicUsize::new(0), AtomicUsize::new(0));
    std::thread::scope(|scope| {
        let clients: Vec<_> = (0..6)
            .map(|client| {
                let (noticed, answered, behind) = (&noticed, &answered, &behind);
                scope.spawn(move || {
                    let mut kept = None;
                    for n in 0.. {
                        let late = noticed.load(Ordering::SeqCst);
                        // Late requests, before load balancers stop sending any, are still served.
                        if late && behind.load(Ordering::SeqCst) >= 30 {
                            return;
                        }
                        let body = sample(client * 1_000_000 + n);
                        let status = if client % 2 == 0 {
                            let reply = send(addr, "POST", "/v1/meshes?resolution=1.5", &[], &body);
                            assert!(reply.complete);
                            reply.status
                        } else {
                            let mut stream = kept.take().unwrap_or_else(|| connect(addr));
                            let (status, keeps) = ask(&mut stream, &body);
                            assert!(!(late && keeps), "connections are kept after the notice");
                            kept = keeps.then_some(stream);
                            status
                        };
                        assert_eq!(status, 200);
                        answered.fetch_add(1, Ordering::SeqCst);
                        behind.fetch_add(usize::from(late), Ordering::SeqCst);
                    }
                })
            })
            .collect();
        wait_for("the clients have started", || answered.load(Ordering::SeqCst) >= 30);
        // Requests with slow bodies are in progress all the time.
        let mut slow = [0, 1].map(|n| {
            let mut stream = connect(addr);
            let body = sample(77_000_000 + n);
            write!(stream, "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len())
                .unwrap();
            stream.write_all(&body[..1000]).unwrap();
            (stream, body)
        });
        service.signal("TERM");
        wait_for("the service is not ready", || send(addr, "GET", "/readyz", &[], b"").status == 503);
        noticed.store(true, Ordering::SeqCst);
        for client in clients {
            client.join().unwrap();
        }
        assert!(behind.load(Ordering::SeqCst) >= 30);
        service.signal("TERM");
        wait_for("the listener is gone", || TcpStream::connect(addr).is_err());
        for (stream, body) in &mut slow {
            stream.write_all(&body[1000..]).unwrap();
            let reply = read_reply(stream, false);
            assert_eq!((reply.status, reply.complete), (200, true));
        }
    });
    let (code, log) = service.wait();
    assert_eq!(code, Some(0), "{log}");
    assert!(!log.contains("ERROR") && !log.contains(" WARN "), "{log}");
}

#[test]
fn requests_cut_off_by_the_drain_get_a_response() {
    let folder = Folder::new();
    let flags = ["--devices", "cpu", "--set", "server.drain_timeout_ms=200", "--set", "jobs.workers=1"];
    let service = Service::start(&folder, &flags);
    let addr = addr(&service);
    let block = cli_support::block(30);
    std::thread::scope(|scope| {
        // One runs for long, the other one waits for the worker.
        let clients = ["0.07", "0.075"].map(|resolution| {
            let path = format!("/v1/meshes?resolution={resolution}");
            let block = &block;
            scope.spawn(move || send(addr, "POST", &path, &[], block.as_bytes()))
        });
        // Both requests are accepted long before that.
        std::thread::sleep(Duration::from_secs(1));
        service.signal("INT");
        for client in clients {
            let reply = client.join().unwrap();
            let problem: serde_json::Value = serde_json::from_slice(&reply.body).unwrap();
            assert_eq!((reply.status, problem["type"].as_str()), (503, Some("/problems/shutting-down")), "{problem}");
        }
    });
    let (code, log) = service.wait();
    assert_eq!(code, Some(1), "requests were cut off: {log}");
    assert!(!log.contains("the client left"), "{log}");
}

#[test]
fn second_signal_ends_the_drain() {
    for signals in [["TERM", "TERM"], ["INT", "TERM"], ["TERM", "INT"]] {
        let folder = Folder::new();
        let service = Service::start(&folder, &["--devices", "cpu", "--set", "server.drain_timeout_ms=3600000"]);
        let mut stream = connect(addr(&service));
        stream.write_all(b"POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-length: 5000\r\n\r\n").unwrap();
        stream.write_all(&SAMPLE[..1000]).unwrap();
        // A response to a later connection shows that this one was accepted.
        wait_for("the service responds", || send(addr(&service), "GET", "/livez", &[], b"").status == 200);
        let at = addr(&service);
        service.signal(signals[0]);
        wait_for("the listener is gone", || TcpStream::connect(at).is_err());
        service.signal(signals[1]);
        let (code, log) = service.wait();
        assert_eq!(code, Some(1), "a request was cut off: {log}");
    }
}

#[test]
fn durable_jobs_survive_a_stop() {
    let folder = Folder::new();
    let args = ["--devices", "cpu", "--set", "server.drain_timeout_ms=300", "--set", "jobs.attempts=1"];
    let service = Service::start(&folder, &args);
    // Seconds of work, of which only a part fits into the drain.
    let jobs: Vec<String> = (0..6)
        .map(|n| {
            let reply =
                send(addr(&service), "POST", "/v1/meshes?resolution=0.15", &[("prefer", "respond-async")], &sample(n));
            assert_eq!(reply.status, 202);
            reply.header("location").unwrap().to_owned()
        })
        .collect();
    let (code, log) = service.stop("TERM");
    assert_eq!(code, Some(0), "{log}");
    // Each job has one attempt; a stop does not count as one.
    let service = Service::start(&folder, &args);
    for job in &jobs {
        let status = || send(addr(&service), "GET", &format!("{job}?wait=10"), &[], b"").json()["status"].clone();
        wait_for("the job is done", || status() == "successful");
    }
    assert_eq!(service.stop("INT").0, Some(0));
}
