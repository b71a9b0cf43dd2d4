//! HTTP requests to a server in this process: method, path, query, headers and body.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use molmesh::config::Config;
use molmesh::http::{Server, Stop};
use molmesh::picture::SelectedRenderer;
use molmesh::pipeline::SelectedBackend;
use molmesh::surface::CpuBackend;

/// Words of requests. `{digest}`, `{key}` and `{job}` stand for a structure, a result and a job that exist.
pub(super) const WORDS: &[&str] = &[
    "GET ",
    "POST ",
    "HEAD ",
    "PUT ",
    "DELETE ",
    "OPTIONS ",
    "TRACE ",
    "/v1/meshes",
    "/v1/report",
    "/v1/estimate",
    "/v1/structures",
    "/v1/structures/{digest}",
    "/v1/results/{key}",
    "/v1/areas",
    "/v1/jobs",
    "/v1/jobs/{job}",
    "/v1/batches",
    "/results.tar",
    "outputs=glb,areas",
    "/v1/pdb/1abc",
    "/surface.glb",
    "/surface.png",
    "/report.json",
    "/atoms",
    "/colors",
    "/areas",
    "/tileset.json",
    "/tileset.subtree",
    "/estimate",
    "/events",
    "/result",
    "/problems/",
    "/assets/",
    "?",
    "&",
    "%00",
    "%2f",
    "%",
    "..",
    "check=strict",
    "max_triangles=1000",
    "Range: bytes=",
    "If-Range: ",
    "If-None-Match: ",
    "If-Match: ",
    "Accept: ",
    "Accept-Encoding: ",
    "X-Forwarded-For: ",
    "traceparent: 00-",
    "tracestate: ",
    "Prefer: ",
    "respond-async",
    "wait=0",
    "Priority: u=",
    "Idempotency-Key: ",
    "Last-Event-ID: ",
    "Authorization: Bearer ",
    "X-Api-Key: ",
    "Origin: ",
    "X-Request-Id: ",
    "Content-Type: ",
    "application/json",
    "multipart/form-data; boundary=XX",
    "--XX\r\n",
    "--XX--",
    "Content-Disposition: ",
    "form-data; name=\"",
    "\r\n\r\n",
    "{\"pdb_id\": \"1abc\"}",
    "\"structure\": \"{digest}\"",
    ";q=0",
    "*/*",
    "image/png",
    "Content-Encoding: gzip",
    "expires=",
    "key_id=",
    "signature=",
];

/// Maximum pause while a response arrives.
const SILENCE: Duration = Duration::from_secs(5);

struct Service {
    addr: SocketAddr,
    /// Placeholders and what replaces them.
    known: [(&'static str, String); 3],
}

/// Sends one request. Checks that the response has a status, and none that indicates a defect.
pub(super) fn request(bytes: &[u8]) {
    static SERVICE: LazyLock<Service> = LazyLock::new(start);
    let Some((head, body)) = message(bytes, &SERVICE.known) else { return };
    let response = exchange(SERVICE.addr, &head, &body);
    let status = response.get(9..12).and_then(|digits| std::str::from_utf8(digits).ok()?.parse::<u16>().ok());
    let shown = || String::from_utf8_lossy(&response[..response.len().min(2000)]).into_owned();
    assert!(response.starts_with(b"HTTP/1.1 ") && status.is_some(), "not a response: {:?}", shown());
    // No request needs more time than the deadline, and nothing is unavailable for a single client.
    assert!(status.is_some_and(|status| status < 500), "{}", shown());
}

/// Returns the head and the body of a request. The framing is set here: the HTTP library checks it, and an incomplete
/// request would wait for its timeout.
fn message(bytes: &[u8], known: &[(&'static str, String)]) -> Option<(Vec<u8>, Vec<u8>)> {
    let text_end = bytes.windows(2).position(|two| two == b"\n\n").map(|at| (at, at + 2));
    let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").map(|at| (at, at + 4));
    let (head_end, body_start) = text_end.into_iter().chain(end).min().unwrap_or((bytes.len(), bytes.len()));
    let replaced = |bytes: &[u8]| match std::str::from_utf8(bytes) {
        Ok(text) => known.iter().fold(text.to_owned(), |text, (name, value)| text.replace(name, value)).into_bytes(),
        Err(_) => bytes.to_vec(),
    };
    let (head, body) = (replaced(&bytes[..head_end]), replaced(&bytes[body_start..]));
    let framing =
        [&b"content-length"[..], b"transfer-encoding", b"connection", b"expect", b"upgrade", b"http2-settings"];
    let mut lines = head.split(|byte| *byte == b'\n').map(|line| line.strip_suffix(b"\r").unwrap_or(line));
    let first = lines.next().filter(|line| line.ends_with(b" HTTP/1.1"))?;
    let mut request = [first, b"\r\nHost: localhost\r\nConnection: close\r\n"].concat();
    for line in lines {
        let name = line.split(|byte| *byte == b':').next().unwrap_or_default().trim_ascii().to_ascii_lowercase();
        if !framing.contains(&&name[..]) && name != b"host" {
            request.extend([line, b"\r\n"].concat());
        }
    }
    if !body.is_empty() {
        request.extend(format!("Content-Length: {}\r\n", body.len()).bytes());
    }
    request.extend(b"\r\n");
    Some((request, body))
}

/// Sends a request and reads the response until the connection ends, or the first MiB of it.
fn exchange(addr: SocketAddr, head: &[u8], body: &[u8]) -> Vec<u8> {
    let mut stream = TcpStream::connect(addr).expect("the server accepts connections");
    stream.set_read_timeout(Some(SILENCE)).expect("a valid timeout");
    let mut response = Vec::new();
    // The server may respond and close before it has read everything.
    let sent = stream.write_all(head).and_then(|()| stream.write_all(body));
    let read = (&mut stream).take(1 << 20).read_to_end(&mut response);
    assert!(!response.is_empty(), "no response: {sent:?}, {read:?}");
    response
}

fn start() -> Service {
    let dir = tempfile::tempdir().expect("a temporary folder can be created");
    let entry = fs::read(crate::corpus("pdb").join("plain.pdb")).expect("the seed exists");
    fs::write(dir.path().join("1abc.pdb"), &entry).expect("the folder is writable");
    let mut config = Config::default();
    config.server.listen = SocketAddr::from(([127, 0, 0, 1], 0));
    config.server.data_dir = dir.path().join("data");
    config.server.trusted_proxies = "127.0.0.1".parse().ok();
    config.archive.dir = Some(dir.path().to_owned());
    config.archive.url = None;
    config.limits.grid_points = 1 << 19;
    config.limits.candidate_pairs = 1 << 18;
    config.limits.mesh_bytes = 8 << 20;
    config.limits.output_bytes = 16 << 20;
    config.limits.inflated_bytes = 1 << 20;
    config.limits.atoms = 5_000;
    config.limits.picture_side = 64;
    config.store.max_bytes = 64 << 20;
    config.store.memory_bytes = 4 << 20;
    let backend = Arc::new(CpuBackend::default());
    let selected = SelectedBackend {
        backend,
        reason: "fuzzing".to_owned(),
        renderer: SelectedRenderer::cpu("fuzzing"),
        devices: Vec::new(),
        no_gpu: None,
    };
    let runtime = super::text::runtime();
    let server = runtime.block_on(Server::bind(config, selected)).expect("the server starts");
    let addr = server.addr();
    std::thread::spawn(move || {
        // Serves until the process ends: `orders` never changes.
        let (orders, receiver) = tokio::sync::watch::channel(Stop::Serve);
        let ended = runtime.block_on(server.run(receiver));
        drop((orders, dir));
        ended.expect("the server runs");
    });
    let ask = |head: &str| {
        let head =
            format!("POST {head}\r\nHost: localhost\r\nConnection: close\r\nContent-Length: {}\r\n\r\n", entry.len());
        String::from_utf8_lossy(&exchange(addr, head.as_bytes(), &entry)).into_owned()
    };
    // Returns the hexadecimal digits behind a text in a response.
    let after = |response: &str, text: &str| {
        let rest = response.split_once(text).map(|(_, rest)| rest);
        let digits: String = rest.into_iter().flat_map(str::chars).take_while(char::is_ascii_hexdigit).collect();
        assert!(digits.len() >= 32, "no {text} in {response:.2000}");
        digits
    };
    let digest = after(&ask("/v1/structures HTTP/1.1"), "/v1/structures/");
    let key = after(&ask("/v1/meshes?resolution=2 HTTP/1.1"), "/v1/results/");
    let job = after(&ask("/v1/meshes?resolution=2 HTTP/1.1\r\nPrefer: respond-async"), "/v1/jobs/");
    Service { addr, known: [("{digest}", digest), ("{key}", key), ("{job}", job)] }
}
