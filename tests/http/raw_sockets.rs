//! Malformed and abusive HTTP/1.1 messages and HTTP/2 frames, written byte by byte. After each of them the server
//! serves other clients.

use crate::http_support;

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use http_support::{Fake, Mode, Running, connect, frame, start};

fn server() -> Running {
    start(Fake::new(Mode::Octahedra), |_| {})
}

/// Sends bytes on one connection and reads until the server closes it. Returns the status of each response.
#[track_caller]
fn statuses(server: &Running, bytes: &[u8]) -> Vec<u16> {
    let mut stream = connect(server.addr);
    // The server may close the connection before it has read everything.
    drop(stream.write_all(bytes));
    let mut answer = Vec::new();
    if let Err(error) = stream.read_to_end(&mut answer) {
        assert_eq!(error.kind(), ErrorKind::ConnectionReset, "the connection stays open: {error}");
    }
    assert_eq!(server.get("/livez").status, 200);
    let text = String::from_utf8_lossy(&answer);
    text.split("HTTP/1.1 ").skip(1).map(|answer| answer[..3].parse().unwrap()).collect()
}

/// Request that ends the connection.
const LAST: &str = "GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";

/// Returns a request with a body and these header lines, and a second request behind it.
fn post(headers: &str, body: &str) -> Vec<u8> {
    format!("POST /v1/structures HTTP/1.1\r\nhost: localhost\r\n{headers}\r\n{body}{LAST}").into_bytes()
}

#[test]
fn ambiguous_lengths_never_start_a_second_request() {
    let server = server();
    let statuses = |headers: &str, body: &str| statuses(&server, &post(headers, body));
    let chunked = "transfer-encoding: chunked\r\n";
    // Control: with one length, the second request gets a response.
    assert_eq!(statuses(chunked, "1\r\nx\r\n0\r\n\r\n"), [422, 200]);
    assert_eq!(statuses("content-length: 1\r\n", "x"), [422, 200]);
    // With both framings, the chunks count, and the connection ends after the response (RFC 9112, 6.3).
    for length in ["1", "5", "500", "x"] {
        let before = format!("content-length: {length}\r\n{chunked}");
        let behind = format!("{chunked}content-length: {length}\r\n");
        let expected: &[u16] = if length == "x" { &[400] } else { &[422] };
        assert_eq!(statuses(&before, "1\r\nx\r\n0\r\n\r\n"), expected, "{before}");
        assert_eq!(statuses(&behind, "1\r\nx\r\n0\r\n\r\n"), [422], "{behind}");
    }
    for headers in [
        "content-length: 1\r\ncontent-length: 2\r\n",
        "content-length: 1, 2\r\n",
        "content-length: 1, 1\r\n",
        "content-length: +1\r\n",
        "content-length: -1\r\n",
        "content-length: 0x1\r\n",
        "content-length: 1 1\r\n",
        "content-length: 18446744073709551616\r\n",
        "transfer-encoding: identity\r\n",
        "transfer-encoding: chunked, identity\r\n",
        "transfer-encoding: chunked\r\ntransfer-encoding: identity\r\n",
        "transfer-encoding : chunked\r\n",
        "content-length\t: 1\r\n",
    ] {
        assert_eq!(statuses(headers, "x"), [400], "{headers}");
    }
    // Equal repeated lengths are one length.
    assert_eq!(statuses("content-length: 1\r\ncontent-length: 1\r\n", "x"), [422, 200]);
}

#[test]
fn chunks_must_be_well_formed() {
    let server = server();
    let statuses = |body: &str| statuses(&server, &post("transfer-encoding: chunked\r\n", body));
    assert_eq!(statuses("1;name=value;other=\"quoted\"\r\nx\r\n0;last\r\n\r\n"), [422, 200], "extensions are ignored");
    assert_eq!(statuses("01\r\nx\r\n0\r\ntrailer: value\r\n\r\n"), [422, 200], "trailers are ignored");
    for body in [
        "x\r\n",
        "-1\r\nx\r\n",
        "0x1\r\nx\r\n",
        "1\nx\n0\n\n",
        "1\r\nxy\r\n0\r\n\r\n",
        "1;a\nb\r\nx\r\n0\r\n\r\n",
        "10000000000000000\r\nx\r\n",
        "\r\n",
    ] {
        assert_eq!(statuses(body), [400], "{body:?}");
    }
    // 16 KiB of extensions per body.
    let long = |n: usize| format!("1;{}\r\nx\r\n0\r\n\r\n", "e".repeat(n));
    assert_eq!((statuses(&long(10 << 10)), statuses(&long(20 << 10))), (vec![422, 200], vec![400]));
    let many = "1;e=123456\r\nx\r\n".repeat(4 << 10);
    assert_eq!(statuses(&format!("{many}0\r\n\r\n")), [400], "extensions of all chunks count together");
}

#[test]
fn heads_must_be_well_formed() {
    let server = server();
    let statuses = |head: &str| statuses(&server, head.as_bytes());
    // Lines may end with a bare LF (RFC 9112, 2.2).
    assert_eq!(statuses("GET /livez HTTP/1.1\nhost: localhost\nconnection: close\n\n"), [200]);
    assert_eq!(statuses(&format!("\r\n{LAST}")), [200], "an empty line before a request");
    for head in [
        "GET /livez HTTP/1.1\r\nhost: localhost\r\nx-a: 1\r\n folded: 2\r\n\r\n",
        "GET /livez HTTP/1.1\r\nhost: localhost\r\nx-a: 1\r\n\t2\r\n\r\n",
        "GET /livez HTTP/1.1\r\n host: localhost\r\n\r\n",
        "GET /livez HTTP/1.1\r\nhost : localhost\r\n\r\n",
        "GET /livez HTTP/1.1\r\nhost: localhost\rx: y\r\n\r\n",
        "GET /livez HTTP/1.1\r\nhost: localhost\r\nx-a: \0\r\n\r\n",
        "GET /livez HTTP/1.1\r\nhost: localhost\r\nno colon\r\n\r\n",
        "GET /livez HTTP/1.1\r\nhost: localhost\r\n: empty\r\n\r\n",
        "GET  /livez HTTP/1.1\r\nhost: localhost\r\n\r\n",
        "GET /liv ez HTTP/1.1\r\nhost: localhost\r\n\r\n",
        "GET /livez HTTP/1.1 \r\nhost: localhost\r\n\r\n",
        "GET /livez HTTP/1.2\r\nhost: localhost\r\n\r\n",
        "GET /livez HTTP/2.0\r\nhost: localhost\r\n\r\n",
        "GET /livez\r\n\r\n",
        "GE(T /livez HTTP/1.1\r\nhost: localhost\r\n\r\n",
        "\x16\x03\x01\x02\0\x01\0\x01\u{fc}\x03\x03\r\n\r\n",
    ] {
        assert_eq!(statuses(head), [400], "{head:?}");
    }
    let many = |n: usize| {
        format!("GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{}\r\n", "a: b\r\n".repeat(n))
    };
    assert_eq!((statuses(&many(90)), statuses(&many(120))), (vec![200], vec![431]), "100 lines");
}

// ---- HTTP/2 ----

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const GOAWAY: u8 = 7;
const CONTINUATION: u8 = 9;
const ACK: u8 = 1;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
const ENHANCE_YOUR_CALM: u32 = 11;
/// `GET /` with HTTPS in HPACK's static table, and the authority `localhost`.
const GET: &[u8] = b"\x82\x84\x87\x01\x09localhost";

/// Opens an HTTP/2 connection.
fn connect2(server: &Running) -> TcpStream {
    let mut stream = connect(server.addr);
    stream.write_all(&[b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", &frame(SETTINGS, 0, 0, &[])[..]].concat()).unwrap();
    stream
}

/// Frame of the server.
struct Received {
    kind: u8,
    flags: u8,
    stream: u32,
    payload: Vec<u8>,
}

/// Reads one frame; `None` at the end of the connection.
fn receive(stream: &mut TcpStream) -> Option<Received> {
    let mut head = [0; 9];
    match stream.read_exact(&mut head) {
        Err(error) if [ErrorKind::UnexpectedEof, ErrorKind::ConnectionReset].contains(&error.kind()) => return None,
        read => read.unwrap(),
    }
    let [a, b, c, kind, flags, id @ ..] = head;
    let mut payload = vec![0; u32::from_be_bytes([0, a, b, c]) as usize];
    stream.read_exact(&mut payload).unwrap();
    Some(Received { kind, flags, stream: u32::from_be_bytes(id), payload })
}

/// Sends frames until the server ends the connection, and returns the code of its GOAWAY.
#[track_caller]
fn flood(server: &Running, mut next: impl FnMut(u32) -> Vec<u8> + Send) -> Option<u32> {
    let mut stream = connect2(server);
    let mut writer = stream.try_clone().unwrap();
    let code = std::thread::scope(|scope| {
        // Without an end of the connection, the server stays silent, and reading fails after its timeout.
        scope.spawn(move || (0..200_000).find(|n| writer.write_all(&next(*n)).is_err()));
        let mut code = None;
        while let Some(frame) = receive(&mut stream) {
            if frame.kind == GOAWAY {
                code = Some(u32::from_be_bytes(frame.payload[4..8].try_into().unwrap()));
            }
        }
        code
    });
    assert_eq!(server.get("/livez").status, 200);
    code
}

#[test]
fn requests_that_are_reset_at_once_end_the_connection() {
    let server = server();
    let code = flood(&server, |n| {
        let id = 2 * n + 1;
        [frame(HEADERS, END_HEADERS | END_STREAM, id, GET), frame(RST_STREAM, 0, id, &[0, 0, 0, 8])].concat()
    });
    assert_eq!(code, Some(ENHANCE_YOUR_CALM));
}

#[test]
fn endless_header_blocks_end_the_connection() {
    let server = server();
    // An open block keeps the state of one request, so the number of frames is limited, for any size.
    for payload in [&b""[..], b"\x00\x01a\x01b", &[0; 16 << 10]] {
        let code = flood(&server, |n| match n {
            0 => frame(HEADERS, END_STREAM, 1, GET),
            _ => frame(CONTINUATION, 0, 1, payload),
        });
        assert_eq!(code, Some(ENHANCE_YOUR_CALM), "frames of {} bytes", payload.len());
    }
}

#[test]
fn large_header_lists_are_rejected() {
    let server = server();
    let mut stream = connect2(&server);
    // HPACK literals without indexing: 80 headers of 1,000 bytes.
    let headers = [&b"\x00\x01a\x7f\xe9\x06"[..], &[b'x'; 1000]].concat().repeat(16);
    stream.write_all(&frame(HEADERS, END_STREAM, 1, GET)).unwrap();
    for _ in 0..4 {
        stream.write_all(&frame(CONTINUATION, 0, 1, &headers)).unwrap_or(());
    }
    stream.write_all(&frame(CONTINUATION, END_HEADERS, 1, &headers)).unwrap_or(());
    let answer = std::iter::from_fn(|| receive(&mut stream)).find(|f| [HEADERS, RST_STREAM, GOAWAY].contains(&f.kind));
    let answer = answer.expect("an answer");
    // `:status: 431`, its value in Huffman code (RFC 7541).
    assert!(answer.kind != HEADERS || answer.payload.starts_with(b"\x48\x83\x69\x90\xff"), "{:?}", answer.payload);
    assert_eq!(server.get("/livez").status, 200);
}

#[test]
fn pings_are_answered_no_faster_than_they_are_read() {
    let server = server();
    let ping = |n: u32| frame(PING, 0, 0, &u64::from(n).to_be_bytes());
    // A client that reads gets every answer.
    let mut stream = connect2(&server);
    let mut writer = stream.try_clone().unwrap();
    let writing = std::thread::spawn(move || (0..20_000).for_each(|n| writer.write_all(&ping(n)).unwrap()));
    let answers = std::iter::from_fn(|| receive(&mut stream)).filter(|f| f.kind == PING && f.flags == ACK);
    assert!(answers.take(20_000).enumerate().all(|(n, f)| f.payload == (n as u64).to_be_bytes()));
    writing.join().unwrap();
    // The server stops reading from one that does not.
    let mut stream = connect2(&server);
    stream.set_write_timeout(Some(Duration::from_secs(2))).unwrap();
    let many: Vec<u8> = (0..1000).flat_map(ping).collect();
    let accepted = (0..16_000).find(|_| stream.write_all(&many).is_err());
    assert!(accepted.is_some(), "the server keeps the answers to 16,000,000 pings");
    assert_eq!(server.get("/livez").status, 200);
}

#[test]
fn frames_for_no_stream_end_the_connection() {
    let server = server();
    for bad in [
        frame(DATA, 0, 1, b"x"),
        frame(HEADERS, END_HEADERS | END_STREAM, 2, GET),
        frame(HEADERS, END_HEADERS | END_STREAM, 0, GET),
        frame(SETTINGS, 0, 1, &[]),
        frame(SETTINGS, 0, 0, &[0; 5]),
        frame(PING, 0, 0, &[0; 7]),
        frame(DATA, 0, 0, &vec![0; (16 << 10) + 1]),
    ] {
        let mut stream = connect2(&server);
        stream.write_all(&bad).unwrap();
        let frames: Vec<Received> = std::iter::from_fn(|| receive(&mut stream)).collect();
        assert!(frames.iter().any(|f| f.kind == GOAWAY && f.stream == 0), "{:?}", &bad[..9]);
        assert!(!frames.iter().any(|f| f.kind == HEADERS), "{:?}", &bad[..9]);
    }
    assert_eq!(server.get("/livez").status, 200);
}
