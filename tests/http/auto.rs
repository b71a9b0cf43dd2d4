//! A service with a CPU and a GPU backend: each runs the jobs that suit it, and results of either are found again.

use crate::http_support;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use http_support::{Fake, Mode, Reply, Running, SAMPLE, sample, send, start};
use molmesh::pipeline::AutoBackend;
use molmesh::surface::{Backend, BackendJob, MeshOutput, SurfaceError};

/// Fake backend with a name and, derived from it, an arithmetic of its own. It can fail.
#[derive(Clone)]
struct Named {
    name: &'static str,
    fake: Arc<Fake>,
    fails: Arc<AtomicBool>,
}

impl Backend for Named {
    fn name(&self) -> &'static str {
        self.name
    }

    fn describe(&self) -> String {
        format!("the {}", self.name)
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        if self.fails.load(Ordering::SeqCst) {
            return Err(SurfaceError::Device { why: "lost by a test".to_owned() });
        }
        self.fake.write(job)
    }
}

/// Starts a service. Returns its CPU and its GPU as well.
fn service() -> (Running, [Named; 2]) {
    let named = |name| Named { name, fake: Fake::new(Mode::Octahedra), fails: Arc::default() };
    let backends = ["cpu", "gpu"].map(named);
    let [cpu, gpu] = backends.clone().map(Box::new);
    (start(Arc::new(AutoBackend::new(cpu, gpu)), |_| {}), backends)
}

/// Returns the number of meshes that each backend has started.
fn started(backends: &[Named; 2]) -> [usize; 2] {
    backends.each_ref().map(|backend| backend.fake.started.load(Ordering::SeqCst))
}

#[track_caller]
fn header<'a>(reply: &'a Reply, name: &str) -> &'a str {
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    reply.header(name).unwrap_or_else(|| panic!("no {name}"))
}

#[test]
fn jobs_run_on_the_backend_that_they_suit_and_either_result_is_found() {
    let (server, backends) = service();
    for (n, query, used, reason) in [
        (0, "", "gpu", "set by a test"),
        (1, "?surface=ses", "gpu", "set by a test"),
        (2, "?resolution=2", "cpu", "auto: the job does not suit a GPU"),
    ] {
        let post = |path: &str| server.post(&format!("{path}{query}"), &[], &sample(n));
        assert_eq!(post("/v1/estimate").json()["backend"], used, "{query}");
        let before = started(&backends);
        let first = post("/v1/meshes");
        assert_eq!(header(&first, "molmesh-backend"), used, "{query}");
        assert_eq!(header(&first, "molmesh-backend-reason"), reason, "{query}");
        let after = started(&backends);
        let meshes = [0, 1].map(|k| after[k] - before[k]);
        assert_eq!(meshes, ["cpu", "gpu"].map(|name| usize::from(name == used)), "{query}");
        // Results are stored in the background.
        assert_eq!(server.get(header(&first, "content-location")).status, 200);
        let again = post("/v1/meshes");
        assert!(header(&again, "server-timing").contains("hit"), "{query}");
        for name in ["etag", "content-location", "molmesh-backend"] {
            assert_eq!(header(&again, name), header(&first, name), "{query}");
        }
        assert_eq!(again.body, first.body, "{query}");
        assert_eq!(started(&backends), after, "a stored result was computed again");
    }
}

#[test]
fn the_cpu_replaces_the_gpu_and_validators_name_its_result() {
    let (server, backends) = service();
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let path = format!("{structure}/surface.glb");
    let with = |name: &str, value: &str| send(server.addr, "GET", &path, &[(name, value)], b"");
    // The arithmetic is not known before the run.
    let head = send(server.addr, "HEAD", &path, &[], b"");
    assert_eq!((head.status, head.header("etag")), (200, None));
    backends[1].fails.store(true, Ordering::SeqCst);
    let reply = server.get(&path);
    backends[1].fails.store(false, Ordering::SeqCst);
    assert_eq!(header(&reply, "molmesh-backend"), "cpu");
    assert_eq!(header(&reply, "molmesh-backend-reason"), "set by a test; but the GPU failed: lost by a test");
    let etag = header(&reply, "etag").to_owned();
    assert_eq!(server.get(header(&reply, "content-location")).header("etag"), Some(etag.as_str()));
    // The GPU works again, but the result exists.
    let before = started(&backends);
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
    assert_eq!(started(&backends), before, "a stored result was computed again");
}
