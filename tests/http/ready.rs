//! `/readyz`: what it looks at, each made to fail and to come back, and that load is none of it.

use crate::http_support;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use http_support::{Fake, Mode, Running, SAMPLE, log_lines, sample, start, wait_for};
use molmesh::http::Stop;
use molmesh::surface::{
    Backend, Control, DeviceStatus, MeshOutput, MeshSink, Spheres, SurfaceError, SurfaceLimits, SurfaceParams,
};
use serde_json::Value;

/// Names of the checks that are not as they should be; all three must be there.
#[track_caller]
fn failing(document: &Value) -> Vec<String> {
    let checks = document["checks"].as_array().unwrap_or_else(|| panic!("{document}"));
    let names: Vec<_> = checks.iter().map(|check| check["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["accepting", "devices", "store"]);
    assert!(checks.iter().all(|check| !check["detail"].as_str().unwrap().is_empty()), "{document}");
    checks.iter().filter(|check| check["ok"] == false).map(|check| check["name"].as_str().unwrap().to_owned()).collect()
}

/// Takes the store away, or gives it back: a file where its folder was. Permissions would not stop everybody.
fn take_away(server: &Running, away: bool) {
    let (store, aside) = (server.dir.path().join("store"), server.dir.path().join("aside"));
    if away {
        std::fs::rename(&store, aside).unwrap();
        std::fs::write(store, "").unwrap();
    } else {
        std::fs::remove_file(&store).unwrap();
        std::fs::rename(aside, store).unwrap();
    }
}

#[test]
fn a_ready_service_lists_its_checks() {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let reply = server.get("/readyz");
    assert_eq!((reply.status, reply.header("cache-control")), (200, Some("no-store")));
    assert_eq!((reply.json()["status"].as_str(), failing(&reply.json())), (Some("ready"), vec![]));
}

#[test]
fn a_store_that_cannot_be_written_is_seen_and_so_is_its_return() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.probe_ms = 1);
    take_away(&server, true);
    wait_for("the store is missed", || server.get("/readyz").status == 503);
    let problem = server.get("/readyz").problem(503, "not-ready");
    assert_eq!(failing(&problem), ["store"]);
    let said = problem["detail"].as_str().unwrap();
    assert!(said.contains("store") && !problem.to_string().contains(server.dir.path().to_str().unwrap()), "{problem}");
    assert_eq!(server.get("/livez").status, 200);
    let logged = || log_lines("the store has failed").len();
    assert_eq!(logged(), 1, "the log says it once, and why");
    assert!(log_lines("the store has failed")[0].contains("error="));
    take_away(&server, false);
    wait_for("the store is back", || server.get("/readyz").status == 200);
    assert_eq!((logged(), log_lines("the store works again").len()), (1, 1));
}

#[test]
fn the_store_is_not_asked_more_often_than_configured() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.probe_ms = 3_600_000);
    take_away(&server, true);
    for _ in 0..5 {
        assert_eq!(server.get("/readyz").status, 200, "what was known an hour ago is believed");
    }
    take_away(&server, false);
}

#[test]
fn a_full_queue_does_not_make_it_unready() {
    let backend = Fake::new(Mode::Slow(Duration::from_mins(5)));
    let server = start(Arc::clone(&backend) as _, |c| {
        (c.jobs.workers, c.jobs.queue, c.store.probe_ms) = (1, 1, 1);
        c.jobs.deadline_ms = 600_000;
        c.server.drain_timeout_ms = 1;
    });
    let server = &server;
    std::thread::scope(|scope| {
        let clients = [0, 1].map(|n| scope.spawn(move || server.post("/v1/meshes", &[], &sample(n)).status));
        wait_for("one to run", || backend.started.load(Ordering::SeqCst) == 1);
        wait_for("one to wait", || server.metric("molmesh_queue_depth", &[]) >= 1.0);
        for _ in 0..20 {
            server.post("/v1/meshes", &[], SAMPLE).problem(503, "queue-full");
            let reply = server.get("/readyz");
            assert_eq!((reply.status, failing(&reply.json())), (200, vec![]));
        }
        backend.set(Mode::Octahedra);
        server.order(Stop::Now);
        for client in clients {
            drop(client.join());
        }
    });
}

/// A backend on one device that can be taken away.
struct OneDevice {
    fake: Arc<Fake>,
    down: AtomicBool,
}

impl Backend for OneDevice {
    fn name(&self) -> &'static str {
        "fake"
    }

    fn describe(&self) -> String {
        "one device".to_owned()
    }

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
        self.fake.write(spheres, params, limits, control, sink)
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        let down = self.down.load(Ordering::SeqCst).then(|| "it was taken away".to_owned());
        vec![DeviceStatus {
            number: 0,
            name: "one".to_owned(),
            down,
            waiting: 0,
            finished: 0,
            failed: 0,
            busy: Duration::ZERO,
            lost: 0,
            rebuilds: 0,
            shared: 0,
            partitions: 0,
            held_bytes: 0,
        }]
    }
}

#[test]
fn no_device_left_and_nothing_in_its_place_is_not_ready() {
    let backend = Arc::new(OneDevice { fake: Fake::new(Mode::Octahedra), down: AtomicBool::new(false) });
    let server = start(Arc::clone(&backend) as _, |_| {});
    let document = server.get("/readyz").json();
    assert!(failing(&document).is_empty() && document.to_string().contains("1 of 1 devices"), "{document}");
    backend.down.store(true, Ordering::SeqCst);
    assert_eq!(failing(&server.get("/readyz").problem(503, "not-ready")), ["devices"]);
    backend.down.store(false, Ordering::SeqCst);
    assert_eq!(server.get("/readyz").status, 200);
}
