//! `/readyz`: each check fails and recovers, and load does not affect it.

use crate::http_support;

use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use http_support::{
    Fake, LONG, Mode, Running, SAMPLE, log_lines, sample, send, start, start_after, start_cold, wait_for,
};
use molmesh::config::Config;
use molmesh::http::Stop;
use molmesh::surface::{Backend, BackendJob, DeviceStatus, MeshOutput, SurfaceError};
use serde_json::Value;
use tempfile::TempDir;

/// Record of a later release.
const RECORD: &str = r#"{"version":2}"#;

/// Returns the names of failed checks. Asserts that all four checks are present.
#[track_caller]
fn failing(document: &Value) -> Vec<String> {
    let checks = document["checks"].as_array().unwrap_or_else(|| panic!("{document}"));
    let names: Vec<_> = checks.iter().map(|check| check["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["accepting", "devices", "store", "broker", "records"]);
    assert!(checks.iter().all(|check| !check["detail"].as_str().unwrap().is_empty()), "{document}");
    checks.iter().filter(|check| check["ok"] == false).map(|check| check["name"].as_str().unwrap().to_owned()).collect()
}

/// Returns the file of the record of a job in a data folder.
fn record_file(folder: &TempDir, id: &str) -> PathBuf {
    folder.path().join(format!("store/jobs/{id}.json"))
}

/// Creates a data folder whose jobs have this record.
fn data_folder(ids: &[&str], record: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(folder.path().join("store/jobs")).unwrap();
    for id in ids {
        std::fs::write(record_file(&folder, id), record).unwrap();
    }
    folder
}

/// Makes the store unavailable or available. Replaces its folder by a file, because permissions do not apply to root.
fn set_unavailable(server: &Running, away: bool) {
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
fn failure_and_recovery_of_the_store_are_detected() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.check_interval_ms = 1);
    set_unavailable(&server, true);
    wait_for("the failure is detected", || server.get("/readyz").status == 503);
    let problem = server.get("/readyz").problem(503, "not-ready");
    assert_eq!(failing(&problem), ["store"]);
    let said = problem["detail"].as_str().unwrap();
    assert!(said.contains("store") && !problem.to_string().contains(server.dir.path().to_str().unwrap()), "{problem}");
    assert_eq!(server.get("/livez").status, 200);
    let logged = || log_lines("the store has failed").len();
    assert_eq!(logged(), 1, "the failure is logged once");
    assert!(log_lines("the store has failed")[0].contains("error="));
    set_unavailable(&server, false);
    wait_for("the store is back", || server.get("/readyz").status == 200);
    assert_eq!((logged(), log_lines("the store works again").len()), (1, 1));
}

#[test]
fn unreadable_job_records_make_the_service_unready_until_they_are_deleted() {
    let ids = ["0", "1"].map(|digit| digit.repeat(32));
    let folder = data_folder(&[&ids[0], &ids[1]], "{");
    let server = start_cold(Fake::new(Mode::Octahedra), |c| folder.path().clone_into(&mut c.server.data_dir));
    let in_quarantine =
        |document: &Value| document["checks"][4]["detail"].as_str().unwrap().starts_with("2 job records");
    wait_for("the first mesh and the records", || {
        let document = server.get("/readyz").json();
        failing(&document) == ["records"] && in_quarantine(&document)
    });
    server.get("/readyz").problem(503, "not-ready");
    let log = log_lines("the record of a job cannot be read").concat();
    assert!(ids.iter().all(|id| log.contains(&format!("jobs/{}….json", &id[..8])) && !log.contains(id)), "{log}");
    for path in ["", "/events", "/result"] {
        server.get(&format!("/v1/jobs/{}{path}", ids[0])).problem(500, "record-unreadable");
    }
    for id in &ids {
        std::fs::remove_file(folder.path().join(format!("store/quarantine/{id}.json"))).unwrap();
    }
    assert_eq!(server.get("/readyz").status, 200);
    server.get(&format!("/v1/jobs/{}", ids[0])).problem(404, "no-such-job");
}

#[test]
fn jobs_of_another_release_do_not_affect_readiness() {
    let id = "0".repeat(32);
    let folder = data_folder(&[&id], RECORD);
    let file = record_file(&folder, &id);
    let server = start(Fake::new(Mode::Octahedra), |c| folder.path().clone_into(&mut c.server.data_dir));
    let document = server.get("/readyz").json();
    assert!(document.to_string().contains("jobs left to the releases that wrote them: 1"), "{document}");
    for path in ["", "/events", "/result"] {
        let reply = server.get(&format!("/v1/jobs/{id}{path}"));
        assert!(reply.header("retry-after").is_some());
        reply.problem(503, "other-release");
    }
    send(server.addr, "DELETE", &format!("/v1/jobs/{id}"), &[], b"").problem(503, "other-release");
    assert_eq!(std::fs::read_to_string(file).unwrap(), RECORD);
}

#[test]
fn a_service_that_reads_its_records_is_alive_and_not_ready() {
    let id = "0".repeat(32);
    let folder = data_folder(&[&id], RECORD);
    let file = record_file(&folder, &id);
    // A pipe cannot be opened until it is written.
    let replace_by_pipe = || {
        std::fs::remove_file(&file).unwrap();
        assert!(Command::new("mkfifo").arg(&file).status().unwrap().success());
    };
    let change = |c: &mut Config| {
        folder.path().clone_into(&mut c.server.data_dir);
        c.store.timeout_ms = 600_000;
    };
    let server = start_after(Fake::new(Mode::Octahedra), Vec::new(), change, replace_by_pipe);
    wait_for("the first mesh", || failing(&server.get("/readyz").json()) == ["records"]);
    let problem = server.get("/readyz").problem(503, "not-ready");
    assert_eq!(problem["detail"], "the records of jobs are being read");
    assert_eq!((server.get("/livez").status, server.get("/version").status), (200, 200));
    let path = format!("/v1/jobs/{id}");
    server.get(&path).problem(503, "not-ready");
    let pipe = folder.path().join("pipe");
    std::fs::rename(&file, &pipe).unwrap();
    std::fs::write(&file, RECORD).unwrap();
    // Unlike a write, this does not wait for a reader.
    drop(std::fs::OpenOptions::new().read(true).write(true).open(pipe).unwrap());
    // The pipe was empty, and so was the record.
    let detail = || server.get("/readyz").json()["detail"].as_str().unwrap_or_default().to_owned();
    wait_for("the records are read", || detail().starts_with("1 job records"));
    server.get(&path).problem(500, "record-unreadable");
    std::fs::remove_file(folder.path().join(format!("store/quarantine/{id}.json"))).unwrap();
    assert_eq!(server.get("/readyz").status, 200);
}

#[test]
fn the_store_is_not_checked_more_often_than_configured() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.check_interval_ms = 3_600_000);
    set_unavailable(&server, true);
    for _ in 0..5 {
        assert_eq!(server.get("/readyz").status, 200, "the cached result is used");
    }
    set_unavailable(&server, false);
}

#[test]
fn a_full_queue_does_not_affect_readiness() {
    let backend = Fake::new(Mode::Slow(Duration::from_mins(5)));
    let server = start(Arc::clone(&backend) as _, |c| {
        (c.jobs.workers, c.jobs.queue, c.store.check_interval_ms) = (1, 1, 1);
        c.jobs.deadline_ms = 600_000;
        c.server.drain_timeout_ms = 1;
    });
    let server = &server;
    std::thread::scope(|scope| {
        let clients = [0, 1].map(|n| scope.spawn(move || server.post(LONG, &[], &sample(n)).status));
        wait_for("one to run", || backend.started.load(Ordering::SeqCst) == 1);
        wait_for("one to wait", || server.metric("molmesh_queue_depth", &[]) >= 1.0);
        for _ in 0..20 {
            server.post(LONG, &[], SAMPLE).problem(503, "queue-full");
            let reply = server.get("/readyz");
            assert_eq!((reply.status, failing(&reply.json())), (200, vec![]));
        }
        backend.set(Mode::Octahedra);
        server.request_stop(Stop::Now);
        for client in clients {
            drop(client.join());
        }
    });
}

/// Backend with one device that can fail.
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

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        self.fake.write(job)
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        let down = self.down.load(Ordering::SeqCst).then(|| "device lost by a test".to_owned());
        vec![DeviceStatus {
            number: 0,
            name: "one".to_owned(),
            down,
            waiting: 0,
            finished: 0,
            failed: 0,
            busy: Duration::ZERO,
            lost: 0,
            hung: 0,
            rebuilds: 0,
            shared: 0,
            partitions: 0,
            held_bytes: 0,
        }]
    }
}

#[test]
fn not_ready_without_devices_and_fallback() {
    let backend = Arc::new(OneDevice { fake: Fake::new(Mode::Octahedra), down: AtomicBool::new(false) });
    let server = start(Arc::clone(&backend) as _, |_| {});
    let document = server.get("/readyz").json();
    assert!(failing(&document).is_empty() && document.to_string().contains("1 of 1 devices"), "{document}");
    backend.down.store(true, Ordering::SeqCst);
    assert_eq!(failing(&server.get("/readyz").problem(503, "not-ready")), ["devices"]);
    backend.down.store(false, Ordering::SeqCst);
    assert_eq!(server.get("/readyz").status, 200);
}
