//! Clients that read a response body slowly or not at all, over raw HTTP/2 frames and small socket buffers: which of
//! them are disconnected, and their cost for the server.
#![cfg(target_os = "linux")]

use crate::http_support;

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use http_support::{Fake, Mode, Running, SAMPLE, carbons, connect, frame, start, wait_for};
use molmesh::config::Config;
use socket2::{Domain, Socket, Type};

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const WINDOW_UPDATE: u8 = 8;
const END_STREAM: u8 = 1;
/// Maximum number of concurrent streams on one connection.
const STREAMS: u32 = 64;

/// Serializes the tests, because metrics and file descriptors belong to the process.
fn serialize() -> MutexGuard<'static, ()> {
    static SERIAL: Mutex<()> = Mutex::new(());
    SERIAL.lock().unwrap_or_else(PoisonError::into_inner)
}

fn serve(change: impl FnOnce(&mut Config)) -> Running {
    start(Fake::new(Mode::Octahedra), |config| {
        config.server.write_timeout_ms = 1000;
        // All readers have one address.
        config.server.client_share = 1.0;
        change(config);
    })
}

/// Computes a result of about `400 * atoms` bytes and returns its path.
fn result(server: &Running, atoms: usize) -> String {
    let path =
        server.post("/v1/meshes?format=stl", &[], &carbons(atoms)).header("content-location").unwrap().to_owned();
    wait_for("the result is stored", || server.get(&path).status == 200);
    path
}

fn cut_off(server: &Running) -> f64 {
    server.metric("molmesh_requests_rejected_total", &["reason=\"write-timeout\""])
}

fn open_files() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

/// State of a stream.
#[derive(Debug, Default, Clone)]
struct Seen {
    bytes: usize,
    ended: bool,
    reset: bool,
}

/// HTTP/2 connection in raw frames.
struct H2 {
    socket: TcpStream,
    unread: Vec<u8>,
    seen: BTreeMap<u32, Seen>,
}

impl H2 {
    /// Requests each path on a separate stream with this flow-control window.
    fn ask(addr: SocketAddr, window: u32, paths: &[&str]) -> Self {
        let mut socket = connect(addr);
        let setting = [&[0, 4][..], &window.to_be_bytes()].concat();
        socket
            .write_all(&[b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", &frame(SETTINGS, 0, 0, &setting)[..]].concat())
            .unwrap();
        let mut seen = BTreeMap::new();
        for (n, path) in (0..).zip(paths) {
            // HPACK (RFC 7541): GET, http, and two literals, `:path` and `:authority`.
            let path = [&[0x04, u8::try_from(path.len()).unwrap()], path.as_bytes()].concat();
            let head = [&[0x82, 0x86][..], &path, b"\x01\x09localhost"].concat();
            socket.write_all(&frame(HEADERS, 0x4 | END_STREAM, 2 * n + 1, &head)).unwrap();
            seen.insert(2 * n + 1, Seen::default());
        }
        Self { socket, unread: Vec::new(), seen }
    }

    fn grant(&mut self, bytes: u32, also_connection: bool) {
        let mut frames = if also_connection { frame(WINDOW_UPDATE, 0, 0, &bytes.to_be_bytes()) } else { Vec::new() };
        for (id, seen) in &self.seen {
            if !seen.reset && !seen.ended {
                frames.extend(frame(WINDOW_UPDATE, 0, *id, &bytes.to_be_bytes()));
            }
        }
        self.socket.write_all(&frames).unwrap();
    }

    /// Reads the frames that arrive within `time`.
    fn read(&mut self, time: Duration) {
        let end = Instant::now() + time;
        let mut some = vec![0; 64 << 10];
        while let Some(left) = end.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            self.socket.set_read_timeout(Some(left)).unwrap();
            match self.socket.read(&mut some) {
                Ok(0) => panic!("the connection was closed"),
                Ok(n) => self.unread.extend_from_slice(&some[..n]),
                Err(e) if [ErrorKind::WouldBlock, ErrorKind::TimedOut].contains(&e.kind()) => break,
                Err(e) => panic!("{e}"),
            }
            self.take_frames();
        }
    }

    fn take_frames(&mut self) {
        loop {
            let Some(head) = self.unread.first_chunk::<9>().copied() else { return };
            let length = u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize;
            if self.unread.len() < 9 + length {
                return;
            }
            self.unread.drain(..9 + length);
            let id = u32::from_be_bytes([head[5], head[6], head[7], head[8]]);
            let Some(seen) = self.seen.get_mut(&id) else { continue };
            match head[3] {
                DATA => {
                    seen.bytes += length;
                    seen.ended |= head[4] & END_STREAM != 0;
                }
                RST_STREAM => seen.reset = true,
                _ => {}
            }
        }
    }

    fn all(&self, is: impl Fn(&Seen) -> bool) -> bool {
        self.seen.values().all(is)
    }
}

/// Connects with small kernel buffers, as on a slow line.
fn connect_with_small_buffers(addr: SocketAddr) -> TcpStream {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
    socket.set_recv_buffer_size(16 << 10).unwrap();
    socket.connect(&addr.into()).unwrap();
    socket.into()
}

#[test]
fn stalled_readers_lose_only_their_streams() {
    let _serial = serialize();
    let server = serve(|c| c.server.write_timeout_ms = 3000);
    // From a file, from memory, and one that fits into the send buffer with its last frame.
    let paths = [result(&server, 20_000), result(&server, 2000), result(&server, 50)];
    let (files, before) = (open_files(), cut_off(&server));
    let asked: Vec<&str> = (0..STREAMS as usize).map(|n| paths[n % 3].as_str()).collect();
    let mut attackers: Vec<H2> = (0..4).map(|_| H2::ask(server.addr, 0, &asked)).collect();
    wait_for("all of them have begun", || server.metric("molmesh_response_bodies_open", &[]) >= 256.0);
    let begun = Instant::now();
    let mut slowest = Duration::ZERO;
    while !attackers.iter().all(|attacker| attacker.all(|seen| seen.reset)) {
        assert!(begun.elapsed() < Duration::from_secs(20), "some were not disconnected");
        for attacker in &mut attackers {
            attacker.grant(1, false);
            attacker.read(Duration::from_millis(20));
        }
        // They hold little memory and no files. Their sockets count twice in this process.
        let held = server.metric("molmesh_memory_held_bytes", &[]);
        let pieces = held / f64::from(4 * STREAMS) / 16_384.0;
        assert!(pieces < 2.5, "{held} bytes");
        if begun.elapsed() < Duration::from_millis(500) {
            assert!(pieces > 0.5, "{held} bytes");
        }
        assert!(open_files() < files + 40, "{} open files, {files} before", open_files());
        let start = Instant::now();
        assert!(server.get(&paths[1]).complete);
        slowest = slowest.max(start.elapsed());
    }
    assert!(begun.elapsed() > Duration::from_millis(2500), "{:?}", begun.elapsed());
    assert!(slowest < Duration::from_secs(2), "others waited for {slowest:?}");
    assert!(attackers.iter().all(|attacker| attacker.all(|seen| seen.bytes < 1000)));
    wait_for("they are counted", || cut_off(&server) >= before + 256.0);
    wait_for("all is freed", || {
        server.metric("molmesh_memory_held_bytes", &[]) < 1.0
            && server.metric("molmesh_response_bodies_open", &[]) < 1.0
    });
    // The connections remain usable.
    for attacker in &mut attackers {
        attacker.read(Duration::from_millis(1));
    }
}

#[test]
fn stalled_readers_of_small_responses_lose_their_streams() {
    let _serial = serialize();
    let server = serve(|_| {});
    let before = cut_off(&server);
    let mut attacker = H2::ask(server.addr, 0, &["/nothing"; STREAMS as usize]);
    let begun = Instant::now();
    while !attacker.all(|seen| seen.reset) {
        assert!(begun.elapsed() < Duration::from_secs(20), "some were not disconnected");
        attacker.grant(1, false);
        attacker.read(Duration::from_millis(100));
    }
    assert!(attacker.all(|seen| seen.bytes < 300 && !seen.ended));
    wait_for("they are counted", || cut_off(&server) >= before + f64::from(STREAMS));
    // Readers of the same responses with a window are served.
    let mut reader = H2::ask(server.addr, 1 << 16, &["/nothing"; STREAMS as usize]);
    while !reader.all(|seen| seen.ended) {
        reader.read(Duration::from_millis(100));
        assert!(reader.all(|seen| !seen.reset));
    }
}

#[test]
fn readers_above_the_minimum_rate_get_the_whole_body() {
    let _serial = serialize();
    let server = serve(|_| {});
    let path = result(&server, 2000);
    let (length, before) = (server.get(&path).body.len(), cut_off(&server));
    std::thread::scope(|scope| {
        // Several concurrent bodies over HTTP/2, each at four times the minimum rate.
        scope.spawn(|| {
            let mut reader = H2::ask(server.addr, 0, &[path.as_str(); 4]);
            reader.socket.write_all(&frame(WINDOW_UPDATE, 0, 0, &(1_u32 << 30).to_be_bytes())).unwrap();
            while !reader.all(|seen| seen.ended) {
                reader.grant(16 << 10, false);
                reader.read(Duration::from_millis(250));
                assert!(reader.all(|seen| !seen.reset), "{:?}", reader.seen);
            }
            assert!(reader.all(|seen| seen.bytes == length), "{:?}", reader.seen);
        });
        // Over HTTP/1.1 the kernel hides progress from the server until its buffer has space.
        scope.spawn(|| {
            let mut reader = connect_with_small_buffers(server.addr);
            write!(reader, "GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").unwrap();
            let (mut some, mut bytes) = (vec![0; 32 << 10], 0);
            loop {
                match reader.read(&mut some).unwrap() {
                    0 => break,
                    n => bytes += n,
                }
                std::thread::sleep(Duration::from_millis(100));
            }
            assert!(bytes > length, "{bytes} of {length}");
        });
    });
    assert!(cut_off(&server) < before + 1.0);
}

#[test]
fn http1_readers_below_the_minimum_rate_are_disconnected() {
    let _serial = serialize();
    let server = serve(|_| {});
    let path = result(&server, 20_000);
    let before = cut_off(&server);
    let mut reader = connect_with_small_buffers(server.addr);
    write!(reader, "GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    let start = Instant::now();
    let mut byte = [0; 1];
    while cut_off(&server) < before + 1.0 {
        assert!(start.elapsed() < Duration::from_secs(20), "it was not disconnected");
        // Afterwards there may be no data left to read.
        if reader.read(&mut byte).is_err() {
            break;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(start.elapsed() > Duration::from_millis(900), "{:?}", start.elapsed());
    wait_for("it is cut off", || cut_off(&server) >= before + 1.0);
    wait_for("all is freed", || server.metric("molmesh_memory_held_bytes", &[]) < 1.0);
}

#[test]
fn event_streams_have_no_minimum_rate() {
    let _serial = serialize();
    let server = start(Fake::new(Mode::Held), |c| {
        (c.server.write_timeout_ms, c.server.drain_timeout_ms) = (300, 100);
    });
    let accepted = server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE);
    let events = format!("{}/events", accepted.header("location").unwrap());
    let mut listener = H2::ask(server.addr, 0, &[&events]);
    listener.read(Duration::from_millis(1500));
    assert!(listener.all(|seen| !seen.reset && seen.bytes == 0), "{:?}", listener.seen);
    listener.grant(1 << 20, true);
    listener.read(Duration::from_millis(500));
    assert!(listener.all(|seen| !seen.reset && seen.bytes > 0), "{:?}", listener.seen);
}

/// Reads the body of a response at `rate` bytes per second with the default buffers of the system. Returns its length.
fn read_steadily(addr: SocketAddr, path: &str, rate: u32) -> usize {
    let mut reader = connect(addr);
    write!(reader, "GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").unwrap();
    let (start, mut some, mut bytes) = (Instant::now(), [0; 512], 0);
    loop {
        match reader.read(&mut some) {
            Ok(0) => return bytes,
            Ok(n) => bytes += n,
            Err(error) => panic!("cut off after {bytes} bytes: {error}"),
        }
        let due = start + Duration::from_secs_f64(bytes as f64 / f64::from(rate));
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

#[test]
fn steady_readers_of_twice_the_minimum_rate_are_served() {
    let _serial = serialize();
    let server = serve(|_| {});
    let path = result(&server, 1600);
    let (length, before) = (server.get(&path).body.len(), cut_off(&server));
    // With the former buffers of 256 KiB, the server saw progress every eight seconds.
    let bytes = read_steadily(server.addr, &path, 32 << 10);
    assert!(bytes > length, "{bytes} of {length}");
    assert!(cut_off(&server) < before + 1.0);
}
