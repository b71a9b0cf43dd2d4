//! Every metric of the service is changed by an action of the table `ROWS`. The table of `docs/operate/monitoring.md`
//! is generated from the same descriptions (`MOLMESH_BLESS=1` writes it).

use crate::archive_support;
use crate::http_support;
use crate::metrics_support;
use crate::nats;
use crate::tools;
use crate::trace_support;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};

use http_support::{Fake, LONG, Mode, Running, SAMPLE, carbons, connect, sample, start, start_cold, wait_for};
use metrics_support::{Devices, Scrape, check, queries};
use molmesh::surface::CpuBackend;
use molmesh::telemetry::{self as t, METRICS, Metric, MetricKind, recorder};

/// Action that changes metrics. It calls `look` to wait until they have changed.
type Mover = fn(look: &dyn Fn());

/// Metric, labels of a series, and the action that changes it.
type Row = (&'static str, &'static [&'static str], Mover);

const ROWS: &[Row] = &[
    (t::HTTP_DURATION, &["method=\"POST\"", "route=\"/v1/meshes\"", "status=\"200\""], meshes),
    (t::HTTP_ACTIVE, &["method=\"POST\""], held),
    (t::HTTP_REQUEST_SIZE, &["method=\"POST\"", "route=\"/v1/meshes\"", "status=\"200\""], meshes),
    (t::HTTP_RESPONSE_SIZE, &["method=\"POST\"", "route=\"/v1/meshes\"", "status=\"200\""], meshes),
    (t::CONNECTIONS, &[], held),
    (t::REJECTED, &["reason=\"body-too-large\""], refusals),
    (t::BODIES_OPEN, &[], unread),
    (t::QUOTA_CLIENTS, &[], quotas),
    (t::JOBS_SUBMITTED, &["mode=\"sync\"", "dedup=\"no\""], meshes),
    (t::JOBS_FINISHED, &["outcome=\"successful\""], meshes),
    (t::BROKER_QUEUED, &[], held),
    (t::BROKER_UP, &[], cluster),
    (t::BROKER_REDELIVERIES, &[], cluster),
    (t::BROKER_CLAIM_ERRORS, &[], lost_consumers),
    (t::JOBS_RECOVERED, &[], restart),
    (t::RECORDS_QUARANTINED, &[], damaged_record),
    (t::JOBS_FALLBACK, &[], devices),
    (t::STAGE_DURATION, &["stage=\"field\""], meshes),
    (t::RESULTS_NOT_STORED, &["reason=\"failed\""], tiny_store),
    (t::QUEUE_DEPTH, &[], held),
    (t::QUEUE_AGE, &[], held),
    (t::QUEUE_WAIT, &[], held),
    (t::MEMORY_HELD, &[], held),
    (t::MEMORY_USED, &[], held),
    (t::MEMORY_LIMIT, &[], held),
    (t::GRID_POINTS, &[], meshes),
    (t::TRIANGLES, &[], meshes),
    (t::DEVICE_UP, &["device=\"0\""], devices),
    (t::DEVICE_BUSY, &["device=\"0\""], devices),
    (t::DEVICE_LOST, &["device=\"0\""], devices),
    (t::DEVICE_REBUILDS, &["device=\"0\""], devices),
    (t::DEVICE_MEMORY, &["device=\"0\""], devices),
    (t::DEVICE_WAITING, &["device=\"0\""], devices),
    (t::DEVICE_JOBS, &["device=\"0\"", "outcome=\"failed\""], devices),
    (t::DEVICE_SHARED, &["device=\"0\""], devices),
    (t::DEVICE_PARTITIONS, &["device=\"0\""], devices),
    (t::CACHE_REQUESTS, &["tier=\"memory\"", "result=\"hit\""], meshes),
    (t::STRUCTURE_CACHE_REQUESTS, &["result=\"miss\""], meshes),
    (t::STRUCTURE_CACHE_BYTES, &[], meshes),
    (t::SCRATCH_BYTES, &[], tileset_on_disk),
    (t::STORE_BYTES, &["folder=\"results\""], meshes),
    (t::STORE_OBJECTS, &["folder=\"results\""], meshes),
    (t::STORE_REMOVED, &["reason=\"cap\""], full_store),
    (t::STORE_ERRORS, &["op="], broken_store),
    (t::ARCHIVE_REQUESTS, &["source=\"remote\"", "result=\"found\""], archive),
    (t::ARCHIVE_FETCH, &["result=\"found\""], archive),
    (t::ARCHIVE_BREAKER, &["host=\"127.0.0.1\""], dead_archive),
    (t::ARCHIVE_KEPT, &[], archive),
    (t::TRACE_SPANS, &["result=\"exported\""], traces),
    (t::PANICS, &["component=\"job\""], panics),
    (t::BUILD_INFO, &[concat!("version=\"", env!("CARGO_PKG_VERSION"), "\"")], nothing),
    (t::PROCESS_CPU, &[], nothing),
    (t::PROCESS_RESIDENT, &[], nothing),
    (t::PROCESS_VIRTUAL, &[], nothing),
    (t::PROCESS_FDS, &[], nothing),
    (t::PROCESS_MAX_FDS, &[], nothing),
    (t::PROCESS_THREADS, &[], nothing),
    (t::PROCESS_START, &[], nothing),
];

/// Jobs of consumers that are deleted while a node waits for jobs.
fn lost_consumers(look: &dyn Fn()) {
    let Some(program) = nats::programs().pop() else { return };
    let (queue, folder) = (nats::NatsServer::start(&program), tempfile::tempdir().unwrap());
    let server = start(Fake::new(Mode::Octahedra), |config| {
        config.broker.url = Some(queue.address().to_owned());
        config.store.url = Some(format!("file://{}", folder.path().display()));
    });
    let failed = || scrape().moves(t::BROKER_CLAIM_ERRORS, &[]);
    let (before, mut jobs) = (failed(), 0);
    wait_for("a failed claim", || {
        let is_complete = || queue.jetstream("STREAM.INFO.molmesh-jobs").contains("\"consumer_count\":6");
        wait_for("the consumers", is_complete);
        queue.jetstream("CONSUMER.DELETE.molmesh-jobs.normal-cpu");
        // The node may create them again before it looks for the job.
        jobs += 1;
        let _accepted = server.post("/v1/meshes", &[("prefer", "respond-async")], &sample(jobs));
        failed() > before
    });
    look();
}

/// Requests a mesh until it comes from the memory cache.
fn meshes(look: &dyn Fn()) {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let ask = || server.post("/v1/meshes", &[], SAMPLE);
    assert_eq!(ask().status, 200);
    wait_for("the result is cached", || ask().header("server-timing").unwrap().contains("hit"));
    look();
}

/// Tileset that does not fit into the cache of structures.
fn tileset_on_disk(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |config| config.limits.structure_cache_bytes = 6 << 20);
    let items = ["type_symbol", "label_atom_id", "label_comp_id", "label_seq_id", "Cartn_x", "Cartn_y", "Cartn_z"];
    let tags: String = items.map(|item| format!("_atom_site.{item}\n")).concat();
    let row = |i: i32| format!("C CA ALA {i} {} {} {}\n", i % 60, i / 60 % 60, i / 3600);
    let rows: Vec<String> = (0..200_000).map(row).collect();
    let text = format!("data_x\nloop_\n{tags}{}", rows.concat());
    let stored = server.post("/v1/structures", &[], text.as_bytes());
    let tileset = server.get(&format!("{}/tileset.json?resolution=2", stored.header("location").unwrap()));
    assert_eq!(tileset.status, 200);
    look();
}

/// A running and a queued request, and a running and a queued asynchronous job.
fn held(look: &dyn Fn()) {
    let backend = Fake::new(Mode::Held);
    let server = start(Arc::clone(&backend) as _, |config| {
        config.jobs.workers = 1;
        config.jobs.deadline_ms = 600_000;
        // Another limit than that of the servers before.
        config.limits.memory_bytes = 1 << 30;
    });
    std::thread::scope(|scope| {
        // Long requests: a short one that runs gives way.
        let requests = [1, 4].map(|n| {
            let server = &server;
            scope.spawn(move || server.post(LONG, &[], &sample(n)))
        });
        wait_for("a job runs", || backend.started.load(Ordering::SeqCst) == 1);
        let later = [("prefer", "respond-async")];
        assert_eq!(server.post("/v1/meshes", &later, &sample(2)).status, 202);
        assert_eq!(server.post("/v1/meshes", &later, &sample(3)).status, 202);
        // A worker claims one job; the other one waits in the broker.
        look();
        backend.set(Mode::Octahedra);
        assert!(requests.into_iter().all(|request| request.join().unwrap().status == 200));
    });
}

/// Client that does not read its mesh.
fn unread(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let (mut client, body) = (connect(server.addr), carbons(60_000));
    let head =
        format!("POST /v1/meshes?format=stl HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len());
    client.write_all(&[head.as_bytes(), &body].concat()).unwrap();
    look();
}

fn refusals(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |config| config.limits.body_bytes = 1000);
    server.post("/v1/meshes", &[], SAMPLE).problem(413, "body-too-large");
    look();
}

fn quotas(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |config| config.access.address_requests = Some(100));
    assert_eq!(server.get("/v1/capabilities").status, 200);
    look();
}

/// Job that outlives its server.
fn restart(look: &dyn Fn()) {
    let folder = tempfile::tempdir().unwrap();
    let keep = |config: &mut molmesh::config::Config| {
        folder.path().clone_into(&mut config.server.data_dir);
        config.server.drain_timeout_ms = 1;
    };
    let backend = Fake::new(Mode::Held);
    let server = start(Arc::clone(&backend) as _, keep);
    assert_eq!(server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE).status, 202);
    wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
    let _drained = server.join();
    let _server = start(Fake::new(Mode::Octahedra), keep);
    look();
}

/// Job that moves to another node.
fn cluster(look: &dyn Fn()) {
    let Some(program) = nats::programs().pop() else { return };
    let (queue, folder) = (nats::NatsServer::start(&program), tempfile::tempdir().unwrap());
    let shared = |config: &mut molmesh::config::Config| {
        config.broker.url = Some(queue.address().to_owned());
        config.store.url = Some(format!("file://{}", folder.path().display()));
        config.server.drain_timeout_ms = 1;
    };
    let backend = Fake::new(Mode::Held);
    let server = start(Arc::clone(&backend) as _, shared);
    let later = [("prefer", "respond-async")];
    wait_for("a job", || server.post("/v1/meshes", &later, SAMPLE).status == 202);
    wait_for("the job runs", || backend.started.load(Ordering::SeqCst) == 1);
    let _drained = server.join();
    let _server = start(Fake::new(Mode::Octahedra), shared);
    look();
}

/// Start with a truncated job record in the store.
fn damaged_record(look: &dyn Fn()) {
    let folder = tempfile::tempdir().unwrap();
    let jobs = folder.path().join("store/jobs");
    std::fs::create_dir_all(&jobs).unwrap();
    std::fs::write(jobs.join(format!("{}.json", "0".repeat(32))), "{").unwrap();
    let server = start_cold(Fake::new(Mode::Octahedra), |config| folder.path().clone_into(&mut config.server.data_dir));
    look();
    drop(server);
}

/// Devices with nonzero metrics and a fallback.
fn devices(look: &dyn Fn()) {
    let server = start(Devices::new(), |_| {});
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    look();
}

/// Replaces the folder of results by a file.
fn broken_store(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let folder = server.dir.path().join("store/results");
    std::fs::remove_dir_all(&folder).unwrap();
    std::fs::write(&folder, "").unwrap();
    // The mesh is returned although it cannot be stored.
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    look();
}

/// Store without space for a mesh.
fn tiny_store(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |config| config.store.max_bytes = 3000);
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    look();
}

/// Five results in a store with space for two.
fn full_store(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Octahedra), |config| config.store.max_bytes = 500_000);
    for n in 0..5 {
        let made = server.post("/v1/meshes?format=stl", &[], &sample(n));
        // The request waits until the result is stored.
        server.get(made.header("content-location").unwrap());
    }
    look();
}

fn archive(look: &dyn Fn()) {
    let remote = archive_support::Remote::saying(archive_support::ok(SAMPLE));
    let server = archived(&remote.url("/{id}.pdb"));
    assert_eq!(server.get("/v1/pdb/4pti/surface.glb").status, 200);
    look();
}

fn dead_archive(look: &dyn Fn()) {
    let remote = archive_support::Remote::saying(archive_support::status(500));
    let server = archived(&remote.url("/{id}.pdb"));
    assert_eq!(server.get("/v1/pdb/4pti/surface.glb").status, 424);
    look();
}

fn archived(url: &str) -> Running {
    start(Fake::new(Mode::Octahedra), |config| {
        config.archive.url = Some(url.parse().unwrap());
        config.archive.breaker_failures = 1;
        config.archive.attempts = 1;
    })
}

fn traces(look: &dyn Fn()) {
    let collector = trace_support::Collector::start(trace_support::CollectorMode::Accept);
    let _server = start(Fake::new(Mode::Octahedra), |config| {
        config.telemetry.endpoint = Some(serde_json::from_value(collector.url().into()).unwrap());
    });
    look();
}

fn panics(look: &dyn Fn()) {
    let server = start(Fake::new(Mode::Panic), |_| {});
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 500);
    look();
}

/// Metrics that exist from the start.
fn nothing(look: &dyn Fn()) {
    look();
}

/// Serializes the tests that count, because the recorder belongs to the process.
static SERIAL: Mutex<()> = Mutex::new(());

fn scrape() -> Scrape {
    Scrape::of(&recorder().unwrap().render())
}

/// Returns true for constant metrics, for which presence suffices.
fn is_fixed(name: &str) -> bool {
    name == t::BUILD_INFO || name.starts_with("process_")
}

#[test]
fn every_metric_has_a_row_and_changes() {
    let _serial = SERIAL.lock().unwrap_or_else(PoisonError::into_inner);
    let rows: BTreeSet<&str> = ROWS.iter().map(|(name, ..)| *name).collect();
    let known: BTreeSet<&str> = METRICS.iter().map(|metric| metric.name).collect();
    assert_eq!(rows, known, "exactly one row for each metric");
    let mut movers: Vec<(Mover, Vec<&Row>)> = Vec::new();
    for row in ROWS {
        match movers.iter_mut().find(|(mover, _)| std::ptr::fn_addr_eq(*mover, row.2)) {
            Some((_, rows)) => rows.push(row),
            None => movers.push((row.2, vec![row])),
        }
    }
    for (mover, rows) in movers {
        let before = scrape();
        // Control: the metrics have not changed yet.
        let moved = |now: &Scrape, (name, labels, _): &Row| {
            let value = |scrape: &Scrape| scrape.moves(name, labels);
            if is_fixed(name) { value(now) > 0.0 } else { (value(now) - value(&before)).abs() > 1e-12 }
        };
        for row in rows.iter().filter(|row| !is_fixed(row.0)) {
            assert!(!moved(&before, row), "{}", row.0);
        }
        mover(&|| {
            let missing = || {
                let now = scrape();
                rows.iter().filter(|row| !moved(&now, row)).map(|row| row.0).collect::<Vec<_>>()
            };
            wait_for(&format!("{:?}", rows.iter().map(|row| row.0).collect::<Vec<_>>()), || missing().is_empty());
        });
        let faults = check(&scrape(), METRICS);
        assert_eq!(faults, Vec::<String>::new());
    }
    // All metrics are exposed now, including those that dashboards and alerts query.
    let Some(files) = tools::queries(&queries::FILES.map(queries::path)) else { return };
    for (file, found) in queries::FILES.iter().zip(&files) {
        assert_eq!(queries::faults(found, &scrape()), Vec::<String>::new(), "{file}");
    }
    // Every exposed metric is queried.
    let asked: BTreeSet<&str> = files.iter().flat_map(queries::metrics).collect();
    let unseen: Vec<&&str> = known.difference(&asked).collect();
    assert_eq!(unseen, Vec::<&&str>::new());
}

#[test]
fn deviations_from_descriptions_are_detected() {
    let faults = |line: &str| {
        let name = line.split(['{', ' ']).next().unwrap();
        let kind = METRICS.iter().find(|metric| metric.name == name).map_or("gauge", |metric| metric.kind.name());
        check(&Scrape::of(&format!("# HELP {name} x\n# TYPE {name} {kind}\n{line}\n")), METRICS)
    };
    assert!(faults("molmesh_queue_depth 3").iter().all(|fault| !fault.contains("molmesh_queue_depth")));
    for (line, said) in [
        ("molmesh_unknown 1", "is not described"),
        ("molmesh_queue_depth{job=\"1\"} 1", "labels"),
        ("molmesh_jobs_finished_total{outcome=\"vanished\"} 1", "vanished"),
        ("molmesh_jobs_finished_total 1", "labels"),
    ] {
        assert!(faults(line).iter().any(|fault| fault.contains(said)), "{line}: {:?}", faults(line));
    }
    let wrong = "# HELP molmesh_queue_depth x\n# TYPE molmesh_queue_depth counter\nmolmesh_queue_depth 1\n";
    assert!(check(&Scrape::of(wrong), METRICS).iter().any(|fault| fault.contains("counter")));
}

/// Names made up by clients do not create series.
#[test]
fn unknown_names_of_clients_are_not_labels() {
    let _serial = SERIAL.lock().unwrap_or_else(PoisonError::into_inner);
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let series = || {
        let scrape = scrape();
        let of = |name: &str| scrape.series(name).len();
        [t::HTTP_DURATION, t::HTTP_ACTIVE, t::HTTP_REQUEST_SIZE, t::REJECTED].map(of)
    };
    let walk = |n: usize| {
        server.get(&format!("/nowhere/{n}"));
        server.get(&format!("/v1/jobs/{n:032x}"));
        server.get(&format!("/v1/results/{n:064x}.glb"));
        server.get(&format!("/v1/pdb/{n:04}/surface.glb"));
        server.post(&format!("/v1/meshes?parameter{n}=1"), &[], SAMPLE);
        http_support::send(server.addr, &format!("METHOD{n}"), "/livez", &[], b"");
        http_support::send(server.addr, "GET", "/livez", &[("x-request-id", &format!("id-{n}"))], b"");
    };
    let before = series();
    (0..40).for_each(walk);
    // A response is counted after its last byte.
    wait_for("the last request is counted", || {
        let scrape = scrape();
        scrape.moves(t::HTTP_DURATION, &["route=\"unmatched\""]) >= 40.0
    });
    // Each kind of request may create one series, not forty.
    for (before, now) in before.into_iter().zip(series()) {
        assert!(now <= before + 12, "{now} after {before}");
    }
}

/// Returns the table of metrics as in the documentation.
fn table() -> String {
    let mut text = "| metric | kind | labels | meaning |\n| --- | --- | --- | --- |\n".to_owned();
    for metric in METRICS {
        let label = |label: &t::Label| match label.closed() {
            Some(values) => format!("`{}`: {}", label.name, values.collect::<Vec<_>>().join(", ")),
            None => format!("`{}`: {}", label.name, label.values),
        };
        let Metric { name, labels, .. } = metric;
        let labels = labels.iter().map(label).collect::<Vec<_>>().join("; ");
        writeln!(text, "| `{name}` | {} | {labels} | {} |", metric.kind.name(), metric.help).unwrap();
    }
    text
}

#[test]
fn the_documentation_lists_every_metric() {
    const MARKS: [&str; 2] = ["<!-- metrics -->\n", "<!-- end of metrics -->"];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/operate/monitoring.md");
    let text = std::fs::read_to_string(&path).unwrap();
    let (before, rest) = text.split_once(MARKS[0]).unwrap();
    let (listed, after) = rest.split_once(MARKS[1]).unwrap();
    if std::env::var_os("MOLMESH_BLESS").is_some() {
        std::fs::write(&path, [before, MARKS[0], &table(), MARKS[1], after].concat()).unwrap();
        return;
    }
    assert_eq!(listed, table(), "MOLMESH_BLESS=1 updates it");
}

#[test]
fn counters_of_seconds_have_the_type_counter() {
    let text = recorder().unwrap().render();
    assert!(text.contains("# TYPE process_cpu_seconds_total counter\n"), "{text}");
    let kinds: BTreeMap<&str, MetricKind> = METRICS.iter().map(|metric| (metric.name, metric.kind)).collect();
    assert_eq!(kinds[t::DEVICE_BUSY], MetricKind::Seconds);
}
