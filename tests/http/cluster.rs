//! Processes of a cluster: one queue on NATS, one store in a shared folder.

use std::io::{BufRead, BufReader, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

use crate::http_support::{Reply, SAMPLE, sample, send, wait_for};
use crate::jobs_durable::Process;
use crate::nats::{self, NatsServer};

/// Lease of claims.
const LEASE: Duration = Duration::from_secs(2);
/// Header of a request for a job.
const ASYNCHRONOUS: (&str, &str) = ("prefer", "respond-async");

/// Queue and store that nodes share.
struct Cluster {
    nats: NatsServer,
    folder: TempDir,
}

impl Cluster {
    fn start(program: &Path) -> Self {
        Self { nats: NatsServer::start(program), folder: tempfile::tempdir().unwrap() }
    }

    /// Starts a node, whose own data are in the folder `name`.
    fn node(&self, name: &str, role: &str) -> Process {
        let node = Process::spawn(self.command(role), &self.folder.path().join(name));
        wait_for("the node to be ready", || get(node.addr, "/readyz").status == 200);
        node
    }

    /// Returns a command with the configuration of a node.
    fn command(&self, role: &str) -> Command {
        let mut program = Command::new(env!("CARGO_BIN_EXE_molmesh"));
        program
            .env("MOLMESH__BROKER__URL", self.nats.address())
            .env("MOLMESH__BROKER__LEASE_MS", LEASE.as_millis().to_string())
            .env("MOLMESH__STORE__URL", format!("file://{}", self.folder.path().join("store").display()))
            .env("MOLMESH__SERVER__ROLE", role);
        program
    }
}

fn get(addr: SocketAddr, path: &str) -> Reply {
    send(addr, "GET", path, &[], b"")
}

fn kill_all<const N: usize>(nodes: [Process; N]) {
    for node in nodes {
        node.kill();
    }
}

/// Submits a job and returns its path.
fn submit(addr: SocketAddr, path: &str, body: &[u8]) -> String {
    let reply = send(addr, "POST", path, &[ASYNCHRONOUS], body);
    assert_eq!(reply.status, 202, "{}", reply.text());
    reply.header("location").unwrap().to_owned()
}

/// Waits for the end of a job, which must be successful, and returns its document.
fn successful(addr: SocketAddr, job: &str) -> Value {
    let begun = Instant::now();
    loop {
        let document = get(addr, &format!("{job}?wait=20")).json();
        match document["status"].as_str() {
            Some("successful") => return document,
            Some("accepted" | "running") => assert!(begun.elapsed() < Duration::from_mins(2), "{document}"),
            _ => panic!("{document}"),
        }
    }
}

/// Returns the bytes of the result of a job.
fn result(addr: SocketAddr, job: &str) -> Vec<u8> {
    let found = get(addr, &format!("{job}/result"));
    assert_eq!(found.status, 303);
    get(addr, found.header("location").unwrap()).body
}

/// Reads events of a job until `is_last`, and returns the ids and statuses.
fn events(addr: SocketAddr, job: &str, last_id: &str, is_last: impl Fn(&str) -> bool) -> Vec<(String, String)> {
    let mut stream = TcpStream::connect(addr).unwrap();
    stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
    let head = format!("GET {job}/events HTTP/1.1\r\nhost: localhost\r\n{last_id}\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let (mut seen, mut id) = (Vec::new(), String::new());
    for line in BufReader::new(stream).lines().map(Result::unwrap) {
        if let Some(found) = line.strip_prefix("id:") {
            found.trim().clone_into(&mut id);
        }
        if let Some(status) = line.strip_prefix("event:").map(str::trim) {
            seen.push((id.clone(), status.to_owned()));
        }
        // The data follow id and event in any order.
        if line.is_empty() && seen.last().is_some_and(|(_, status)| is_last(status)) {
            if let Some(last) = seen.last_mut() {
                last.0.clone_from(&id);
            }
            break;
        }
    }
    seen
}

#[test]
fn every_node_answers_for_jobs_of_a_worker() {
    for program in nats::programs() {
        let cluster = Cluster::start(&program);
        let (a, b, worker) = (cluster.node("a", "api"), cluster.node("b", "api"), cluster.node("w", "worker"));
        let job = submit(a.addr, "/v1/meshes?format=stl&resolution=0.25", SAMPLE);
        // The stream moves from one node to the other.
        let first = events(a.addr, &job, "", |status| status == "running");
        let (id, status) = first.last().unwrap();
        assert_eq!(status, "running");
        let rest = events(b.addr, &job, &format!("last-event-id: {id}\r\n"), |status| status == "successful");
        assert_eq!(rest.last().unwrap().1, "successful");
        let (on_a, on_b) = (successful(a.addr, &job), successful(b.addr, &job));
        assert_eq!((&on_a["attempts"], &on_a["finished"]), (&1.into(), &on_b["finished"]));
        let mesh = result(b.addr, &job);
        assert_eq!(mesh, result(a.addr, &job));
        // A node without workers of the queue still answers synchronous requests, with the same bytes.
        let synchronous = send(b.addr, "POST", "/v1/meshes?format=stl&resolution=0.25", &[], &sample(1));
        assert!(synchronous.status == 200 && synchronous.body == mesh);
        // Cancelled on a node that neither accepted nor runs it.
        let long = submit(a.addr, "/v1/meshes?format=stl&resolution=0.1&quality=high", &sample(2));
        wait_for("the job to run", || get(a.addr, &long).json()["status"] == "running");
        assert_eq!(send(b.addr, "DELETE", &long, &[], b"").json()["status"], "dismissed");
        wait_for("the end on the other node", || get(a.addr, &long).json()["status"] == "dismissed");
        successful(a.addr, &submit(b.addr, "/v1/meshes?format=stl&resolution=1", &sample(3)));
        // A worker answers probes only.
        assert_eq!(get(worker.addr, "/version").status, 200);
        get(worker.addr, &job).problem(404, "not-found");
        send(worker.addr, "POST", "/v1/meshes", &[], SAMPLE).problem(404, "not-found");
        kill_all([a, b, worker]);
    }
}

#[test]
fn a_job_of_a_killed_worker_runs_again_on_another_one() {
    for program in nats::programs() {
        let cluster = Cluster::start(&program);
        let (api, first) = (cluster.node("a", "api"), cluster.node("w1", "worker"));
        let job = submit(api.addr, "/v1/meshes?format=stl&resolution=0.1&quality=high", SAMPLE);
        wait_for("the job to run", || get(api.addr, &job).json()["attempts"] == 1);
        let second = cluster.node("w2", "worker");
        first.kill();
        let killed = Instant::now();
        wait_for("the second attempt", || get(api.addr, &job).json()["attempts"] == 2);
        let time = killed.elapsed();
        println!("the job runs again after {time:?}");
        assert!(time < LEASE + Duration::from_secs(5), "{time:?}");
        assert_eq!(send(api.addr, "DELETE", &job, &[], b"").status, 200);
        kill_all([api, second]);
    }
}

#[test]
fn a_cluster_recovers_from_the_loss_of_its_queue() {
    for program in nats::programs() {
        let mut cluster = Cluster::start(&program);
        let (api, worker) = (cluster.node("a", "api"), cluster.node("w", "worker"));
        let known = submit(api.addr, "/v1/meshes?format=stl&resolution=1", SAMPLE);
        successful(api.addr, &known);
        for keeps_data in [true, false] {
            cluster.nats.stop(keeps_data);
            wait_for("the loss is noticed", || get(api.addr, "/readyz").status == 503);
            let checks = get(api.addr, "/readyz").json()["checks"].as_array().unwrap().clone();
            let failed: Vec<_> =
                checks.iter().filter(|check| check["ok"] == false).map(|check| &check["name"]).collect();
            assert_eq!(failed, ["broker"]);
            let refused = send(api.addr, "POST", "/v1/meshes?format=stl", &[ASYNCHRONOUS], &sample(1));
            refused.problem(503, "broker-failed");
            assert!(refused.header("retry-after").unwrap().parse::<u64>().unwrap() >= 1);
            // Other requests are answered.
            assert!(!result(api.addr, &known).is_empty());
            assert_eq!(send(api.addr, "POST", "/v1/meshes?format=stl", &[], &sample(2)).status, 200);
            cluster.nats.restart();
            let restarted = Instant::now();
            wait_for("jobs are accepted", || {
                send(api.addr, "POST", "/v1/meshes?format=stl", &[ASYNCHRONOUS], &sample(3)).status == 202
            });
            assert!(restarted.elapsed() < Duration::from_secs(5), "{:?}", restarted.elapsed());
            successful(api.addr, &submit(api.addr, "/v1/meshes?format=stl&resolution=1", &sample(4)));
        }
        kill_all([api, worker]);
    }
}

#[test]
fn jobs_of_a_lost_stream_are_dispatched_again_at_once() {
    for program in nats::programs() {
        let cluster = Cluster::start(&program);
        let api = cluster.node("a", "api");
        let job = submit(api.addr, "/v1/meshes?format=stl&resolution=1", SAMPLE);
        let is_queued = || cluster.nats.jetstream("STREAM.INFO.molmesh-jobs").contains("\"messages\":1,");
        assert!(is_queued());
        cluster.nats.jetstream("STREAM.DELETE.molmesh-jobs");
        let begun = Instant::now();
        for status in [503, 200] {
            wait_for("the loss is reported", || get(api.addr, "/readyz").status == status);
        }
        wait_for("the job is dispatched", is_queued);
        assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
        let worker = cluster.node("w", "worker");
        successful(api.addr, &job);
        kill_all([api, worker]);
    }
}

#[test]
fn settings_of_a_cluster_that_contradict_each_other_are_rejected() {
    for (set, why) in [
        (&["server.role=worker"][..], "server.role needs broker.url"),
        (&["store.url=file:///tmp/x"], "a folder in store.url needs broker.url"),
        (&["broker.url=nats://127.0.0.1:1"], "broker.url needs store.url"),
        (&["broker.url=nats://127.0.0.1:1", "store.url=file://tmp/x"], "expected file:///absolute/path"),
        (&["broker.url=nats://127.0.0.1:1", "store.url=s3://m", "broker.prefix=a.b"], "broker.prefix: expected"),
        (&["broker.url=nats://127.0.0.1:1", "store.url=s3://m", "broker.lease_ms=1"], "broker.lease_ms: expected"),
        (&["broker.url=nats://127.0.0.1:1", "store.url=s3://m", "broker.user=u"], "belong together"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let mut program = Command::new(env!("CARGO_BIN_EXE_molmesh"));
        program.args(["serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--data-dir"]).arg(folder.path());
        let output = program.args(set.iter().flat_map(|set| ["--set", set])).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && message.contains(why), "{message}");
    }
}

#[test]
fn a_folder_of_the_store_that_vanishes_is_not_created_again() {
    let folder = tempfile::tempdir().unwrap();
    let node = Process::spawn(Command::new(env!("CARGO_BIN_EXE_molmesh")), folder.path());
    wait_for("the node to be ready", || get(node.addr, "/readyz").status == 200);
    let (store, away) = (folder.path().join("store"), folder.path().join("away"));
    let known = submit(node.addr, "/v1/meshes?format=stl&resolution=1", SAMPLE);
    successful(node.addr, &known);
    std::fs::rename(&store, &away).unwrap();
    for n in 0..3 {
        let refused = send(node.addr, "POST", "/v1/meshes?format=stl&resolution=1", &[ASYNCHRONOUS], &sample(n));
        refused.problem(503, "store-failed");
    }
    assert_eq!(send(node.addr, "POST", "/v1/meshes?format=stl&resolution=1", &[], &sample(9)).status, 200);
    // A structure of the store is not missing, it cannot be read.
    let digest = molmesh::store::Digest::of(b"unknown");
    get(node.addr, &format!("/v1/structures/{digest}")).problem(503, "store-failed");
    assert!(!store.exists());
    std::fs::rename(&away, &store).unwrap();
    successful(node.addr, &submit(node.addr, "/v1/meshes?format=stl&resolution=1", &sample(4)));
    assert_eq!(get(node.addr, &known).json()["status"], "successful");
    node.kill();
}
