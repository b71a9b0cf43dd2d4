//! A server in this process, backends that misbehave on command, and a client that speaks HTTP/1.1 by hand, so that it
//! can misbehave as well.
#![allow(dead_code, reason = "every test binary uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]
#![allow(clippy::format_push_string, reason = "requests read best as they are sent")]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use molmesh::config::Config;
use molmesh::http::{Chosen, Server, Stop};
use molmesh::picture::Drawer;
use molmesh::surface::{
    Backend, Control, FoundDevice, GridStats, Mesh, MeshOutput, MeshSink, Spheres, SurfaceError, SurfaceLimits,
    SurfaceParams,
};

/// The sample that ships with the product.
pub(crate) const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");

/// What a fake backend does with a job.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Mode {
    /// An octahedron around every sphere.
    Octahedra,
    /// The same after a while, unless it is cancelled.
    Slow(Duration),
    /// The same once another mode is set.
    Held,
    /// Never looks at the cancel token.
    Deaf(Duration),
    /// Panics.
    Panic,
    /// Fails as a backend that needs too many samples.
    GridTooLarge,
    /// Fails for want of a surface.
    NoSurface,
    /// A mesh with a normal too few, which no writer takes.
    Broken,
}

/// A backend that does as it is told, and says what happened to it. The warm-up is always an octahedron, unless
/// `also_warm` is set.
pub(crate) struct Fake {
    pub(crate) mode: Mutex<Mode>,
    pub(crate) also_warm: AtomicBool,
    pub(crate) started: AtomicUsize,
    pub(crate) finished: AtomicUsize,
    pub(crate) cancelled: AtomicUsize,
    /// Atoms of every job, in the order in which they began.
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

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        _: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
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
            Mode::Deaf(time) => std::thread::sleep(time),
            Mode::Panic => panic!("told to"),
            Mode::GridTooLarge => {
                return Err(SurfaceError::GridTooLarge {
                    samples: 1000,
                    limit: 100,
                    resolution: params.resolution,
                    suggested_resolution: 1.1,
                });
            }
            Mode::NoSurface => return Err(SurfaceError::NoSurface { isovalue: params.isovalue }),
        }
        let mut mesh = octahedra(spheres);
        if mode == Mode::Broken {
            mesh.normals = mesh.normals[1..].to_vec().into();
        }
        if !warm_up {
            self.finished.fetch_add(1, Ordering::SeqCst);
        }
        let output = MeshOutput::new(mesh, GridStats { samples: 7, ..GridStats::default() });
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

/// Everything that was logged in this process.
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

/// The log lines that hold `text`.
pub(crate) fn log_lines(text: &str) -> Vec<String> {
    let log = LOG.lock().unwrap();
    String::from_utf8_lossy(&log).lines().filter(|line| line.contains(text)).map(str::to_owned).collect()
}

/// A running server.
pub(crate) struct Running {
    pub(crate) addr: SocketAddr,
    pub(crate) metrics: SocketAddr,
    orders: tokio::sync::watch::Sender<Stop>,
    thread: Option<JoinHandle<bool>>,
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

/// Starts a server that says that it has found these devices.
pub(crate) fn start_on(
    backend: Arc<dyn Backend>,
    found: Vec<FoundDevice>,
    change: impl FnOnce(&mut Config),
) -> Running {
    LazyLock::force(&LOG);
    let dir = tempfile::tempdir().unwrap();
    let mut config = Config::default();
    config.server.listen = "127.0.0.1:0".parse().unwrap();
    config.server.metrics_listen = Some("127.0.0.1:0".parse().unwrap());
    dir.path().clone_into(&mut config.server.data_dir);
    // Tests stay on this machine unless they bring an archive of their own.
    config.archive.url = None;
    change(&mut config);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let drawer = Drawer::cpu("a test says so");
    let chosen = Chosen { backend, reason: "a test says so".to_owned(), drawer, devices: found };
    let server = runtime.block_on(Server::bind(config, chosen)).unwrap();
    let (addr, metrics) = (server.addr(), server.metrics_addr().unwrap());
    let (orders, ordered) = tokio::sync::watch::channel(Stop::Serve);
    let thread = std::thread::spawn(move || {
        let drained = runtime.block_on(server.run(ordered)).unwrap();
        runtime.shutdown_timeout(Duration::from_secs(1));
        drained
    });
    Running { addr, metrics, orders, thread: Some(thread), dir }
}

impl Running {
    pub(crate) fn get(&self, path: &str) -> Reply {
        send(self.addr, "GET", path, &[], b"")
    }

    pub(crate) fn post(&self, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
        send(self.addr, "POST", path, headers, body)
    }

    /// The sum of a metric's samples whose line holds all of `labels`.
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

    /// Says to stop and to finish what has begun, without waiting.
    pub(crate) fn stop(&mut self) {
        self.order(Stop::Drain);
    }

    /// Says to come so far to an end, unless it is further already.
    pub(crate) fn order(&self, stop: Stop) {
        self.orders.send_if_modified(|now| std::mem::replace(now, (*now).max(stop)) < stop);
    }

    /// Stops and waits: true if every request was finished.
    pub(crate) fn join(mut self) -> bool {
        self.stop();
        self.wait()
    }

    /// Waits for the end that was ordered: true if every request was finished. The folder is still there then.
    pub(crate) fn wait(&mut self) -> bool {
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

/// An answer.
#[derive(Debug)]
pub(crate) struct Reply {
    pub(crate) status: u16,
    pub(crate) headers: Vec<(String, String)>,
    pub(crate) body: Vec<u8>,
    /// The body came whole.
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

    /// Checks that this is a problem of `status` and `slug`, and gives its document.
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

/// Sends one request on a fresh connection and reads the answer.
pub(crate) fn send(addr: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
    let mut stream = connect(addr);
    let mut head = format!("{method} {path} HTTP/1.1\r\nhost: test\r\nconnection: close\r\n");
    if !body.is_empty() || method == "POST" {
        head += &format!("content-length: {}\r\n", body.len());
    }
    for (name, value) in headers {
        head += &format!("{name}: {value}\r\n");
    }
    head += "\r\n";
    stream.write_all(head.as_bytes()).unwrap();
    // A server that refuses early may close while the body is still under way.
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

/// Reads everything until the connection ends, and takes it apart.
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

/// Waits for something to become true, half a minute at most: machines may be busy.
#[track_caller]
pub(crate) fn wait_for(what: &str, mut is: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(30);
    while !is() {
        assert!(Instant::now() < end, "waited too long for: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The sample with a remark: the same mesh, but not the same work as with another one.
pub(crate) fn sample(n: usize) -> Vec<u8> {
    [SAMPLE, format!("REMARK 900 SAMPLE {n}\n").as_bytes()].concat()
}

/// A PDB file of `n` carbon atoms, 10 Å apart.
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
