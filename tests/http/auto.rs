//! A service with two backends: both are used under load, and results of either are found again.

use crate::http_support;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, sample, send, start, wait_for};
use molmesh::pipeline::AutoBackend;
use molmesh::surface::{
    Backend, Control, MeshOutput, MeshSink, Spheres, SurfaceError, SurfaceKind, SurfaceLimits, SurfaceParams,
};

/// Fake backend with a name and, derived from it, an arithmetic of its own.
struct Named(&'static str, Arc<Fake>);

impl Backend for Named {
    fn name(&self) -> &'static str {
        self.0
    }

    fn describe(&self) -> String {
        format!("the {}", self.0)
    }

    /// The GPU makes isosurfaces only.
    fn supports(&self, surface: SurfaceKind) -> bool {
        self.0 != "gpu" || surface.kernel().is_some()
    }

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
        self.1.write(spheres, params, limits, control, sink)
    }
}

/// Starts a service whose CPU and GPU take `times`, ms, for any job.
fn service(times: [u64; 2]) -> (Running, [Arc<Fake>; 2]) {
    let fakes = times.map(|ms| Fake::new(Mode::Slow(Duration::from_millis(ms))));
    let [cpu, gpu] = fakes.each_ref().map(Arc::clone);
    let backend = AutoBackend::new(Box::new(Named("cpu", cpu)), Box::new(Named("gpu", gpu)));
    let server = start(Arc::new(backend), |config| (config.jobs.workers, config.jobs.concurrent_saves) = (8, 16));
    (server, fakes)
}

fn started(fakes: &[Arc<Fake>; 2]) -> usize {
    fakes.iter().map(|fake| fake.started.load(Ordering::SeqCst)).sum()
}

#[track_caller]
fn header<'a>(reply: &'a Reply, name: &str) -> &'a str {
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    reply.header(name).unwrap_or_else(|| panic!("no {name}"))
}

#[test]
fn both_backends_work_under_load_and_either_result_is_found() {
    let (server, fakes) = service([160, 80]);
    let post = |n: usize| server.post("/v1/meshes", &[], &sample(n));
    // Without load, the faster backend gets every job.
    for n in 0..3 {
        let reply = post(n);
        assert_eq!(header(&reply, "molmesh-backend"), "gpu");
        let reason = header(&reply, "molmesh-backend-reason");
        assert!(reason.contains("ms on the CPU") && reason.contains("ms on a GPU"), "{reason}");
    }
    // A surface that the GPU does not make does not count as a failure of the GPU.
    for surface in ["vdw", "sas", "ses"] {
        let reply = server.post(&format!("/v1/meshes?surface={surface}"), &[], SAMPLE);
        assert_eq!(header(&reply, "molmesh-backend"), "cpu");
        assert!(!header(&reply, "molmesh-backend-reason").contains("but"), "{surface}");
    }
    let together: Vec<Reply> = std::thread::scope(|scope| {
        let clients: Vec<_> = (10..18).map(|n| scope.spawn(move || post(n))).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    let used: BTreeSet<&str> = together.iter().map(|reply| header(reply, "molmesh-backend")).collect();
    assert_eq!(used, BTreeSet::from(["cpu", "gpu"]));
    // Results are stored in the background.
    for reply in &together {
        assert_eq!(server.get(header(reply, "content-location")).status, 200);
    }
    let before = started(&fakes);
    for (n, first) in (10..18).zip(&together) {
        let again = post(n);
        assert!(header(&again, "server-timing").contains("hit"), "{n}");
        for name in ["etag", "content-location", "molmesh-backend"] {
            assert_eq!(header(&again, name), header(first, name), "{n}");
        }
        assert_eq!(again.body, first.body, "{n}");
    }
    assert_eq!(started(&fakes), before, "a stored result was computed again");
    let tags: BTreeSet<&str> = together.iter().map(|reply| header(reply, "etag")).collect();
    assert_eq!(tags.len(), together.len());
}

#[test]
fn validators_name_the_result_of_one_backend() {
    let (server, fakes) = service([40, 20]);
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let path = format!("{structure}/surface.glb");
    let with = |name: &str, value: &str| send(server.addr, "GET", &path, &[(name, value)], b"");
    // The arithmetic is not known before the run.
    let head = send(server.addr, "HEAD", &path, &[], b"");
    assert_eq!((head.status, head.header("etag")), (200, None));
    // The slower backend makes the mesh while the other one is busy.
    fakes[1].set(Mode::Held);
    let busy: Vec<_> = (0..4)
        .map(|n| {
            let addr = server.addr;
            std::thread::spawn(move || send(addr, "POST", "/v1/meshes", &[], &sample(n)).status)
        })
        .collect();
    wait_for("a job on the faster backend", || fakes[1].begun.lock().unwrap().iter().any(|atoms| *atoms < 900));
    // By now the held jobs are late, and the first backend has finished its own.
    std::thread::sleep(Duration::from_millis(400));
    let reply = server.get(&path);
    assert_eq!(header(&reply, "molmesh-backend"), "cpu");
    fakes[1].set(Mode::Octahedra);
    for client in busy {
        assert_eq!(client.join().unwrap(), 200);
    }
    let etag = header(&reply, "etag").to_owned();
    assert_eq!(server.get(header(&reply, "content-location")).header("etag"), Some(etag.as_str()));
    // The idle service prefers the other backend, but the result exists.
    let before = started(&fakes);
    assert_eq!(header(&server.get(&path), "etag"), etag);
    assert_eq!(send(server.addr, "HEAD", &path, &[], b"").header("etag"), Some(etag.as_str()));
    assert_eq!(with("if-none-match", &etag).status, 304);
    assert_eq!(with("if-match", &etag).header("etag"), Some(etag.as_str()));
    with("if-match", "\"other\"").problem(412, "precondition-failed");
    // So does an asynchronous job.
    let job =
        server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE).json()["jobID"].as_str().unwrap().to_owned();
    assert_eq!(server.get(&format!("/v1/jobs/{job}?wait=20")).json()["status"], "successful");
    let result = server.get(&format!("/v1/jobs/{job}/result"));
    assert_eq!(result.header("location"), reply.header("content-location"));
    assert_eq!(started(&fakes), before, "a stored result was computed again");
}
