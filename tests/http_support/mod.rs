//! Server in this process, fake backends, and an HTTP/1.1 client that can misbehave.
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]
#![allow(clippy::format_push_string, reason = "requests are readable in the order in which they are sent")]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use molmesh::config::Config;
use molmesh::http::{Server, Stop, Stopped};
use molmesh::picture::SelectedRenderer;
use molmesh::pipeline::SelectedBackend;
use molmesh::surface::{
    Backend, BackendJob, Exceeded, FoundDevice, GridStats, Limit, Mesh, MeshOutput, Spheres, SurfaceError,
};

/// Sample of the product.
pub(crate) const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
/// Path of a mesh of the sample that takes long, by its estimate.
pub(crate) const LONG: &str = "/v1/meshes?resolution=0.2";

/// Behaviour of the fake backend.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Mode {
    /// Returns an octahedron for each sphere.
    Octahedra,
    /// Like `Octahedra` after a delay, unless cancelled.
    Slow(Duration),
    /// Like `Octahedra` once another mode is set.
    Held,
    /// Ignores the cancel token.
    Uncancellable(Duration),
    /// Panics.
    Panic,
    /// Fails with too many grid points.
    GridTooLarge,
    /// Fails without a surface.
    NoSurface,
    /// Returns a mesh with a missing normal, which every writer rejects.
    Broken,
}

/// Backend with a configurable behaviour that counts its jobs. The warm-up is always an octahedron unless `also_warm`
/// is set.
pub(crate) struct Fake {
    pub(crate) mode: Mutex<Mode>,
    pub(crate) also_warm: AtomicBool,
    pub(crate) started: AtomicUsize,
    pub(crate) finished: AtomicUsize,
    pub(crate) cancelled: AtomicUsize,
    /// Number of atoms of each job in the order of their start.
    pub(crate) begun: Mutex<Vec<usize>>,
}

impl Fake {
    pub(crate) fn new(mode: Mode) -> Arc<Self> {
        Arc::new(Self {
            mode: Mutex::new(mode),
            also_warm: AtomicBool::new(false),
            started: AtomicUsize::new(0),
            finished: AtomicUsize::new(0),
            cancelled: AtomicUsize::new(0),
            begun: Mutex::default(),
        })
    }

    pub(crate) fn set(&self, mode: Mode) {
        *self.mode.lock().unwrap() = mode;
    }
}

impl Backend for Fake {
    fn name(&self) -> &'static str {
        "fake"
    }

    fn describe(&self) -> String {
        "nothing".to_owned()
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        let BackendJob { spheres, params, control, sink, .. } = *job;
        let warm_up = spheres.len() == 1 && !self.also_warm.load(Ordering::SeqCst);
        let mode = if warm_up { Mode::Octahedra } else { *self.mode.lock().unwrap() };
        if !warm_up {
            self.begun.lock().unwrap().push(spheres.len());
            self.started.fetch_add(1, Ordering::SeqCst);
        }
        match mode {
            Mode::Octahedra | Mode::Broken => {}
            Mode::Slow(time) => {
                let end = Instant::now() + time;
                while Instant::now() < end {
                    if let Err(error) = control.check() {
                        self.cancelled.fetch_add(1, Ordering::SeqCst);
                        return Err(error);
                    }
                    std::thread::sleep(Duration::from_millis(5));
                }
            }
            Mode::Held => {
                while *self.mode.lock().unwrap() == Mode::Held {
                    if let Err(error) = control.check() {
                        self.cancelled.fetch_add(1, Ordering::SeqCst);
                        return Err(error);
                    }
                    std::thread::sleep(Duration::from_millis(5));
                }
            }
            Mode::Uncancellable(time) => std::thread::sleep(time),
            Mode::Panic => panic!("panic of a test"),
            Mode::GridTooLarge => {
                let error = Exceeded { actual: Some(1000), ..Exceeded::new(Limit::GridPoints, 100) };
                return Err(Exceeded { resolution: Some(params.resolution), ..error }.suggest(1.1).error());
            }
            Mode::NoSurface => return Err(SurfaceError::NoSurface { isovalue: params.level() }),
        }
        let mut mesh = octahedra(spheres);
        if mode == Mode::Broken {
            mesh.normals = mesh.normals[1..].to_vec().into();
        }
        if !warm_up {
            self.finished.fetch_add(1, Ordering::SeqCst);
        }
        let output = MeshOutput::new(mesh, GridStats { grid_points: 7, ..GridStats::default() });
        output.deliver(params, control, sink)
    }
}

fn octahedra(spheres: &Spheres) -> Mesh {
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..spheres.len() {
        let base = u32::try_from(positions.len()).unwrap();
        let (centre, r) = (spheres.centre(i), spheres.radius(i));
        for axis in 0..3 {
            for sign in [1.0f32, -1.0] {
                let mut normal = [0.0f32; 3];
                normal[axis] = sign;
                let at = |k: usize| {
                    #[allow(clippy::cast_possible_truncation, reason = "positions are 32 bits wide")]
                    let c = centre[k] as f32;
                    c + r * normal[k]
                };
                positions.push([at(0), at(1), at(2)]);
                normals.push(normal);
            }
        }
        for [a, b, c] in [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]] {
            triangles.push([base + a, base + b, base + c]);
        }
    }
    Mesh { positions: positions.into(), normals: normals.into(), triangles: triangles.into(), ..Mesh::default() }
}

/// Log of this process.
static LOG: LazyLock<Arc<Mutex<Vec<u8>>>> = LazyLock::new(|| {
    let log = Arc::new(Mutex::new(Vec::new()));
    let sink = Sink(Arc::clone(&log));
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter("warn,molmesh=debug")
        .with_ansi(false)
        .with_writer(move || sink.clone())
        .finish();
    tracing::subscriber::set_global_default(subscriber).expect("no other subscriber in this process");
    log
});

#[derive(Clone)]
struct Sink(Arc<Mutex<Vec<u8>>>);

impl Write for Sink {
    fn write(&mut self, data: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(data);
        Ok(data.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Returns the log lines that contain `text`.
pub(crate) fn log_lines(text: &str) -> Vec<String> {
    let log = LOG.lock().unwrap();
    String::from_utf8_lossy(&log).lines().filter(|line| line.contains(text)).map(str::to_owned).collect()
}

/// Running server, stopped on drop.
pub(crate) struct Running {
    pub(crate) addr: SocketAddr,
    pub(crate) metrics: SocketAddr,
    stop_sender: tokio::sync::watch::Sender<Stop>,
    thread: Option<JoinHandle<Stopped>>,
    pub(crate) dir: tempfile::TempDir,
}

/// Starts a server and waits until it is ready.
pub(crate) fn start(backend: Arc<dyn Backend>, change: impl FnOnce(&mut Config)) -> Running {
    let server = start_cold(backend, change);
    wait_for("ready", || server.get("/readyz").status == 200);
    server
}

/// Starts a server.
pub(crate) fn start_cold(backend: Arc<dyn Backend>, change: impl FnOnce(&mut Config)) -> Running {
    start_on(backend, Vec::new(), change)
}

/// Starts a server with the given detected devices.
pub(crate) fn start_on(
    backend: Arc<dyn Backend>,
    found: Vec<FoundDevice>,
    change: impl FnOnce(&mut Config),
) -> Running {
    start_after(backend, found, change, || {})
}

/// Starts a server, which runs after `prepare`; its store is open before.
pub(crate) fn start_after(
    backend: Arc<dyn Backend>,
    found: Vec<FoundDevice>,
    change: impl FnOnce(&mut Config),
    prepare: impl FnOnce(),
) -> Running {
    LazyLock::force(&LOG);
    let dir = tempfile::tempdir().unwrap();
    let mut config = Config::default();
    config.server.listen = "127.0.0.1:0".parse().unwrap();
    config.server.metrics_listen = Some("127.0.0.1:0".parse().unwrap());
    dir.path().clone_into(&mut config.server.data_dir);
    // Tests do not use a remote archive unless they configure one.
    config.archive.url = None;
    change(&mut config);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let renderer = SelectedRenderer::cpu("set by a test");
    let reason = "set by a test".to_owned();
    let selected = SelectedBackend { backend, reason, renderer, devices: found, no_gpu: None };
    let server = runtime.block_on(Server::bind(config, selected)).unwrap();
    prepare();
    let (addr, metrics) = (server.addr(), server.metrics_addr().unwrap());
    let (stop_sender, stop_receiver) = tokio::sync::watch::channel(Stop::Serve);
    let thread = std::thread::spawn(move || {
        let stopped = runtime.block_on(server.run(stop_receiver)).unwrap();
        runtime.shutdown_timeout(Duration::from_secs(1));
        stopped
    });
    Running { addr, metrics, stop_sender, thread: Some(thread), dir }
}

impl Running {
    pub(crate) fn get(&self, path: &str) -> Reply {
        send(self.addr, "GET", path, &[], b"")
    }

    pub(crate) fn post(&self, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
        send(self.addr, "POST", path, headers, body)
    }

    /// Returns the sum of a metric's samples whose labels contain all of `labels`.
    pub(crate) fn metric(&self, name: &str, labels: &[&str]) -> f64 {
        let text = send(self.metrics, "GET", "/metrics", &[], b"").text();
        let of_name =
            |line: &&str| line.strip_prefix(name).is_some_and(|rest| rest.starts_with('{') || rest.starts_with(' '));
        text.lines()
            .filter(of_name)
            .filter(|line| labels.iter().all(|label| line.contains(label)))
            .map(|line| line.rsplit(' ').next().unwrap().parse::<f64>().unwrap())
            .sum()
    }

    /// Requests a drain without waiting for it.
    pub(crate) fn stop(&mut self) {
        self.request_stop(Stop::Drain);
    }

    /// Requests a stop unless a stricter one was requested.
    pub(crate) fn request_stop(&self, stop: Stop) {
        self.stop_sender.send_if_modified(|now| std::mem::replace(now, (*now).max(stop)) < stop);
    }

    /// Drains and waits. Returns true if the stop was orderly.
    pub(crate) fn join(mut self) -> bool {
        self.stop();
        self.wait()
    }

    /// Waits for the requested stop. Returns true if it was orderly. The data folder still exists.
    pub(crate) fn wait(&mut self) -> bool {
        self.stopped().is_orderly()
    }

    /// Waits for the requested stop and returns its result.
    pub(crate) fn stopped(&mut self) -> Stopped {
        self.thread.take().unwrap().join().unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop();
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}

/// HTTP response.
#[derive(Debug)]
pub(crate) struct Reply {
    pub(crate) status: u16,
    pub(crate) headers: Vec<(String, String)>,
    pub(crate) body: Vec<u8>,
    /// True if the body was received completely.
    pub(crate) complete: bool,
}

impl Reply {
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
    }

    pub(crate) fn text(&self) -> String {
        String::from_utf8(self.body.clone()).unwrap()
    }

    pub(crate) fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|e| panic!("{e}: {self:?}"))
    }

    /// Asserts that this is a problem with `status` and `slug`, and returns its document.
    #[track_caller]
    pub(crate) fn problem(&self, status: u16, slug: &str) -> serde_json::Value {
        assert_eq!(self.status, status, "{}", String::from_utf8_lossy(&self.body));
        assert_eq!(self.header("content-type"), Some("application/problem+json"));
        let document = self.json();
        assert_eq!(document["type"], format!("/problems/{slug}"), "{document}");
        assert_eq!(document["status"], status);
        assert!(document["title"].as_str().is_some_and(|t| !t.is_empty()), "{document}");
        assert!(document["detail"].as_str().is_some_and(|t| !t.is_empty()), "{document}");
        assert_eq!(document["instance"].as_str(), self.header("x-request-id").or(Some("unknown")), "{document}");
        document
    }
}

/// Sends one request on a new connection and reads the response.
pub(crate) fn send(addr: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
    send_on(connect(addr), method, path, headers, body)
}

/// Sends a request on a new connection with a timeout of its own, and reads the response.
pub(crate) fn send_on(mut stream: TcpStream, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
    let mut head = format!("{method} {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n");
    if !body.is_empty() || method == "POST" {
        head += &format!("content-length: {}\r\n", body.len());
    }
    for (name, value) in headers {
        head += &format!("{name}: {value}\r\n");
    }
    head += "\r\n";
    stream.write_all(head.as_bytes()).unwrap();
    // A server that rejects early may close the connection before the body is sent.
    drop(stream.write_all(body));
    read_reply(&mut stream, method == "HEAD")
}

pub(crate) fn connect(addr: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(addr).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream.set_write_timeout(Some(Duration::from_secs(20))).unwrap();
    stream.set_nodelay(true).unwrap();
    stream
}

/// Reads and parses the response until the connection ends.
pub(crate) fn read_reply(stream: &mut TcpStream, head_only: bool) -> Reply {
    let mut bytes = Vec::new();
    let ended = stream.read_to_end(&mut bytes);
    let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").unwrap_or_else(|| panic!("no head: {ended:?} {bytes:?}"));
    let head = std::str::from_utf8(&bytes[..end]).unwrap();
    let mut lines = head.split("\r\n");
    let status = lines.next().unwrap().split(' ').nth(1).unwrap().parse().unwrap();
    let headers: Vec<(String, String)> =
        lines.map(|line| line.split_once(": ").map(|(n, v)| (n.to_ascii_lowercase(), v.to_owned())).unwrap()).collect();
    let raw = bytes[end + 4..].to_vec();
    let header = |name: &str| headers.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str());
    let (body, complete) = if header("transfer-encoding") == Some("chunked") {
        unchunk(&raw)
    } else {
        let length: Option<usize> = header("content-length").map(|l| l.parse().unwrap());
        let complete = head_only || length.is_none_or(|l| l == raw.len());
        (raw, complete)
    };
    Reply { status, headers, body, complete }
}

fn unchunk(mut raw: &[u8]) -> (Vec<u8>, bool) {
    let mut body = Vec::new();
    loop {
        let Some(line) = raw.windows(2).position(|w| w == b"\r\n") else { return (body, false) };
        let size = usize::from_str_radix(std::str::from_utf8(&raw[..line]).unwrap(), 16).unwrap();
        raw = &raw[line + 2..];
        if size == 0 {
            return (body, true);
        }
        if raw.len() < size + 2 {
            body.extend_from_slice(raw);
            return (body, false);
        }
        body.extend_from_slice(&raw[..size]);
        raw = &raw[size + 2..];
    }
}

/// Returns the maximum of this process's resident memory, bytes; 0 if the system does not tell.
pub(crate) fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kib = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    kib.and_then(|kib| kib.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()).unwrap_or_default() << 10
}

/// Waits until a condition holds, for at most two minutes, as the machine may be busy.
#[track_caller]
pub(crate) fn wait_for(what: &str, mut is: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_mins(2);
    while !is() {
        assert!(Instant::now() < end, "waited too long for: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Returns the sample with a distinct remark: the same mesh, but a different input.
pub(crate) fn sample(n: usize) -> Vec<u8> {
    [SAMPLE, format!("REMARK 900 SAMPLE {n}\n").as_bytes()].concat()
}

/// Returns a PDB file of `n` carbon atoms at distances of 10 Å.
pub(crate) fn carbons(n: usize) -> Vec<u8> {
    let mut text = String::new();
    for i in 0..n {
        let (x, y) = ((i % 90) * 10, (i / 90) % 90 * 10);
        text += &format!(
            "ATOM  {:5}  CA  ALA A{:4}    {x:8.3}{y:8.3}{:8.3}  1.00  0.00           C  \n",
            i % 99_999 + 1,
            i % 9_999 + 1,
            (i / 8100) * 10
        );
    }
    text.into_bytes()
}

/// Compresses bytes.
pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// Returns a frame of HTTP/2.
pub(crate) fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}
