//! Shares of clients in connections, deliveries and archive fetches: the requests of a client that holds its share are
//! rejected, those of another one are served. The second client has another loopback address.
#![cfg(target_os = "linux")]

use crate::access_support::Keys;
use crate::archive_support::{Remote, Response, ok};
use crate::http_support;

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, carbons, read_reply, start, wait_for};
use molmesh::config::Config;
use socket2::{Domain, Socket, Type};

const FIRST: &str = "127.0.0.1";
const SECOND: &str = "127.0.0.2";
const SMALL: &str = "/v1/meshes?resolution=2";

fn serve(change: impl FnOnce(&mut Config)) -> Running {
    start(Fake::new(Mode::Octahedra), change)
}

/// Connects from an address and sends a request. Small buffers, so that an unread response stays with the server.
fn begin(from: &str, server: &Running, method: &str, path: &str, headers: &str, body: &[u8]) -> TcpStream {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
    socket.set_recv_buffer_size(16 << 10).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    socket.bind(&SocketAddr::new(from.parse().unwrap(), 0).into()).unwrap();
    socket.connect(&server.addr.into()).unwrap();
    let mut stream = TcpStream::from(socket);
    let head = format!("{method} {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}");
    let head = format!("{head}content-length: {}\r\n\r\n", body.len());
    // A refused connection may be closed before the request is sent.
    drop(stream.write_all(&[head.as_bytes(), body].concat()));
    stream
}

fn ask(from: &str, server: &Running, method: &str, path: &str, body: &[u8]) -> Reply {
    read_reply(&mut begin(from, server, method, path, "", body), method == "HEAD")
}

/// Sends a request and reads the first bytes of its response; the rest stays with the server.
fn hold(from: &str, server: &Running, method: &str, path: &str, headers: &str, body: &[u8]) -> TcpStream {
    let mut stream = begin(from, server, method, path, headers, body);
    let mut start = [0; 12];
    stream.read_exact(&mut start).unwrap();
    assert_eq!(&start, b"HTTP/1.1 200");
    stream
}

fn rejected(server: &Running) -> f64 {
    server.metric("molmesh_requests_rejected_total", &["reason=\"share-exceeded\""])
}

#[track_caller]
fn is_refused(reply: &Reply, limit: usize) {
    assert_eq!(reply.problem(503, "share-exceeded")["limit"], limit);
    assert_eq!(reply.header("retry-after"), Some("1"));
}

#[test]
fn a_client_cannot_take_all_connections() {
    let server = serve(|c| (c.server.connections, c.server.client_share) = (16, 0.25));
    let before = rejected(&server);
    let mut held = Vec::new();
    let refused = loop {
        let mut stream = http_support::connect(server.addr);
        stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
        let mut start = [0; 12];
        stream.read_exact(&mut start).unwrap();
        if &start == b"HTTP/1.1 503" {
            let mut rest = String::new();
            stream.read_to_string(&mut rest).unwrap();
            break rest;
        }
        held.push(stream);
        assert!(held.len() <= 4, "more than a quarter of the connections");
    };
    assert!(refused.contains("/problems/share-exceeded") && refused.contains("retry-after: 1"), "{refused}");
    assert_eq!(ask(SECOND, &server, "GET", "/livez", b"").status, 200);
    assert!(rejected(&server) > before);
    drop(held);
    wait_for("a connection is accepted", || ask(FIRST, &server, "GET", "/livez", b"").status == 200);
    // A proxy has many clients.
    let proxied = serve(|c| {
        (c.server.connections, c.server.client_share) = (16, 0.25);
        c.server.trusted_proxies = "127.0.0.1".parse().ok();
    });
    let _held: Vec<TcpStream> = (0..8).map(|_| http_support::connect(proxied.addr)).collect();
    assert_eq!(ask(FIRST, &proxied, "GET", "/livez", b"").status, 200);
}

#[test]
fn a_client_cannot_take_all_deliveries() {
    let server = serve(|c| (c.jobs.deliveries, c.server.client_share) = (8, 0.25));
    let (large, stl) = (carbons(60_000), "/v1/meshes?format=stl");
    let meshes = [(); 2].map(|()| hold(FIRST, &server, "POST", stl, "", &large));
    is_refused(&ask(FIRST, &server, "POST", SMALL, SAMPLE), 2);
    for path in ["/v1/structures", "/v1/estimate", "/v1/report"] {
        is_refused(&ask(FIRST, &server, "POST", path, SAMPLE), 2);
    }
    assert_eq!(ask(SECOND, &server, "POST", SMALL, SAMPLE).status, 200);
    drop(meshes);
    wait_for("the deliveries have ended", || ask(FIRST, &server, "POST", SMALL, SAMPLE).status == 200);
    // Stored results that are being sent count as well.
    let reply = ask(SECOND, &server, "POST", stl, &large);
    let stored = reply.header("content-location").unwrap();
    wait_for("the result is stored", || ask(SECOND, &server, "HEAD", stored, b"").status == 200);
    let results = [(); 2].map(|()| hold(FIRST, &server, "GET", stored, "", b""));
    is_refused(&ask(FIRST, &server, "GET", stored, b""), 2);
    is_refused(&ask(FIRST, &server, "POST", SMALL, &carbons(10)), 2);
    assert_eq!(ask(SECOND, &server, "GET", stored, b"").status, 200);
    drop(results);
    wait_for("the results were sent", || ask(FIRST, &server, "GET", stored, b"").status == 200);
}

#[test]
fn a_client_cannot_take_all_readers() {
    const READS: usize = 16;
    let server = serve(|c| {
        (c.jobs.workers, c.server.client_share) = (2, 0.25);
        c.limits.structure_cache_bytes = 0;
    });
    let upload = |body: &[u8]| {
        let document = ask(FIRST, &server, "POST", "/v1/structures", body).json();
        format!("/v1/structures/{}", document["digest"].as_str().unwrap())
    };
    let large = |n: usize| [format!("REMARK 900 {n}\n").as_bytes(), &carbons(100_000)].concat();
    let (paths, small): (Vec<_>, _) = ((0..READS).map(|n| upload(&large(n))).collect(), upload(SAMPLE));
    let ended = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        for path in &paths {
            let (ended, server) = (&ended, &server);
            scope.spawn(move || {
                assert_eq!(ask(FIRST, server, "GET", path, b"").status, 200);
                ended.fetch_add(1, Ordering::SeqCst);
            });
        }
        std::thread::sleep(Duration::from_millis(100));
        assert_eq!(ask(SECOND, &server, "GET", &small, b"").status, 200);
        let before = ended.load(Ordering::SeqCst);
        assert!(before < READS * 3 / 4, "{before} reads of the first client had ended");
    });
}

#[test]
fn a_key_is_one_client_with_one_share_at_any_address() {
    let keys = Keys::new(&[("a", "read,mesh", ""), ("b", "read,mesh", "")]);
    let server = serve(|c| {
        (c.jobs.deliveries, c.server.client_share) = (4, 0.25);
        c.access.keys_file = Some(keys.path());
    });
    let key = |id| format!("x-api-key: {}\r\n", keys.text(id));
    let status = |from, id| {
        let mut stream = begin(from, &server, "POST", SMALL, &key(id), SAMPLE);
        read_reply(&mut stream, false)
    };
    let _mesh = hold(FIRST, &server, "POST", "/v1/meshes?format=stl", &key("a"), &carbons(60_000));
    is_refused(&status(SECOND, "a"), 1);
    assert_eq!(status(FIRST, "b").status, 200);
}

#[test]
fn a_client_cannot_take_all_fetches_of_the_archive() {
    let remote = Remote::start(|_, n| match n {
        0 => Response::After(Duration::from_secs(5), Box::new(ok(SAMPLE))),
        _ => ok(SAMPLE),
    });
    let url = remote.url("/d/{id}.cif").parse().unwrap();
    let server = serve(|c| {
        c.archive.url = Some(url);
        (c.archive.concurrent, c.server.client_share) = (4, 0.25);
    });
    let path = |entry: &str| format!("/v1/pdb/{entry}/atoms");
    let mut slow = begin(FIRST, &server, "GET", &path("1aaa"), "", b"");
    wait_for("the first fetch runs", || remote.count() == 1);
    // The client waits for its own share; another one that requests the same entry does not wait for it.
    let mut waits = begin(FIRST, &server, "GET", &path("2aaa"), "", b"");
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(remote.count(), 1);
    assert_eq!((ask(SECOND, &server, "GET", &path("2aaa"), b"").status, remote.count()), (200, 2));
    // Its copy needs no fetch.
    assert_eq!(ask(FIRST, &server, "GET", &path("2aaa"), b"").status, 200);
    assert_eq!(read_reply(&mut slow, false).status, 200);
    assert_eq!(read_reply(&mut waits, false).status, 200);
    assert_eq!(ask(FIRST, &server, "GET", &path("3aaa"), b"").status, 200);
}

#[test]
fn fetches_beyond_the_share_wait_in_line_until_the_deadline() {
    let slow = |ms| Response::After(Duration::from_millis(ms), Box::new(ok(SAMPLE)));
    let remote = Remote::start(move |request, _| if request.path.contains("9aaa") { slow(60_000) } else { slow(200) });
    let url: molmesh::config::Templates = remote.url("/d/{id}.cif").parse().unwrap();
    let patient = serve(|c| c.archive.url = Some(url.clone()));
    // A page with six entries that are not in the cache; its share is two fetches.
    let mut page: Vec<_> = (1..7)
        .map(|n| begin(FIRST, &patient, "GET", &format!("/v1/pdb/{n}aaa/surface.glb?resolution=2"), "", b""))
        .collect();
    for reply in &mut page {
        assert_eq!(read_reply(reply, false).status, 200);
    }
    assert_eq!(remote.count(), 6);
    let impatient = serve(|c| {
        c.archive.url = Some(url);
        (c.archive.concurrent, c.server.client_share) = (4, 0.25);
        c.archive.timeout_ms = 10_000;
    });
    let _held = begin(FIRST, &impatient, "GET", "/v1/pdb/9aaa/atoms", "", b"");
    wait_for("the slow fetch runs", || remote.count() == 7);
    is_refused(&ask(FIRST, &impatient, "GET", "/v1/pdb/8aaa/atoms", b""), 1);
}
