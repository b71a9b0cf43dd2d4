//! Traces: propagated contexts, exported spans, failing collectors.

use crate::archive_support;
use crate::http_support;
use crate::trace_support;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use http_support::{Fake, Mode, Reply, Running, SAMPLE, log_lines, sample, send, start, start_on, wait_for};
use molmesh::config::Config;
use molmesh::surface::{Backend, CpuBackend};
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use trace_support::{Collector, CollectorMode, attribute, below, hex, named};

const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";
const PARENT: &str = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";

/// Repeatable request.
type Ask<'a> = Box<dyn Fn() -> Reply + 'a>;

/// Starts a server that exports spans to `collector`.
fn traced(backend: Arc<dyn Backend>, collector: &Collector, change: impl FnOnce(&mut Config)) -> Running {
    start(backend, |config| {
        config.telemetry.endpoint = Some(serde_json::from_value(collector.url().into()).unwrap());
        // Tests do not measure the speed of the machine.
        config.telemetry.flush_timeout_ms = 60_000;
        change(config);
    })
}

/// Number that increases after the service has detected the collector's behaviour.
type Sign = dyn Fn(&Running) -> f64;

/// Returns the trace and span ids of a response.
#[track_caller]
fn place(reply: &Reply) -> (String, String) {
    let text = reply.header("traceparent").unwrap();
    let parts: Vec<&str> = text.split('-').collect();
    assert_eq!((parts.len(), parts[0], parts[1].len(), parts[2].len()), (4, "00", 32, 16), "{text}");
    (parts[1].to_owned(), parts[2].to_owned())
}

fn kind(span: &Span) -> SpanKind {
    SpanKind::try_from(span.kind).unwrap()
}

/// Panics unless `span` lies within `around`.
#[track_caller]
fn lies_within(span: &Span, around: &Span) {
    let inside = around.start_time_unix_nano <= span.start_time_unix_nano
        && span.start_time_unix_nano <= span.end_time_unix_nano
        && span.end_time_unix_nano <= around.end_time_unix_nano;
    assert!(inside, "{span:?} in {around:?}");
}

#[test]
fn responses_name_their_span_with_and_without_a_collector() {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let get = |headers: &[(&str, &str)]| send(server.addr, "GET", "/livez", headers, b"");
    let (trace, span) = place(&get(&[("traceparent", PARENT)]));
    assert_eq!(trace, TRACE);
    assert_ne!(span, &PARENT[36..52]);
    // The flag of the parent is passed on. A new trace is not sampled without a collector.
    assert!(get(&[("traceparent", PARENT)]).header("traceparent").unwrap().ends_with("-01"));
    assert!(get(&[]).header("traceparent").unwrap().ends_with("-00"));
    // Invalid headers are ignored and a new trace starts.
    for bad in [PARENT.to_uppercase(), PARENT.replace("00-0", "ff-0"), format!("{PARENT}-x"), String::new()] {
        assert_ne!(place(&get(&[("traceparent", &bad)])).0, TRACE, "{bad}");
    }
    assert_ne!(
        place(&get(&[("traceparent", PARENT), ("traceparent", PARENT)])).0,
        TRACE,
        "a repeated header is invalid"
    );
    let (one, other) = (place(&get(&[])), place(&get(&[])));
    assert!(one.0 != other.0 && one.1 != other.1);
    // Errors and responses of middleware contain it too, and other origins may read it.
    assert_eq!(place(&send(server.addr, "GET", "/nowhere", &[("traceparent", PARENT)], b"")).0, TRACE);
    let cors = get(&[("origin", "http://elsewhere")]);
    assert!(cors.header("access-control-expose-headers").unwrap().contains("traceparent"));
}

#[test]
fn request_job_and_stages_form_one_tree() {
    let collector = Collector::start(CollectorMode::Accept);
    let secret = "authorization=Bearer sesame-8731";
    let server = traced(Arc::new(CpuBackend::new(None).unwrap()), &collector, |config| {
        config.telemetry.secret_headers = Some(serde_json::from_value(secret.into()).unwrap());
    });
    let headers = [("traceparent", PARENT), ("tracestate", "rojo=1, congo=2"), ("x-request-id", "tree-1")];
    let reply = server.post("/v1/meshes?check=strict", &headers, SAMPLE);
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    // The request waits until the result is stored.
    assert_eq!(server.get(reply.header("content-location").unwrap()).status, 200);
    // A trace without the sampled flag is not recorded.
    let other = PARENT.replace(TRACE, "11111111111111111111111111111111").replace("-01", "-00");
    assert_eq!(send(server.addr, "GET", "/version", &[("traceparent", &other)], b"").status, 200);
    assert!(server.join());
    let spans = collector.trace(TRACE);
    let request = named(&spans, "POST /v1/meshes");
    assert_eq!((hex(&request.span_id), hex(&request.parent_span_id)), (place(&reply).1, PARENT[36..52].to_owned()));
    assert_eq!((kind(request), request.flags), (SpanKind::Server, 0x301));
    assert_eq!(request.trace_state, "rojo=1,congo=2");
    for (key, value) in [
        ("http.request.method", "POST"),
        ("http.route", "/v1/meshes"),
        ("url.path", "/v1/meshes"),
        ("http.response.status_code", "200"),
        ("http.request.body.size", &SAMPLE.len().to_string()),
        ("http.response.body.size", &reply.body.len().to_string()),
        ("molmesh.request.id", "tree-1"),
        ("molmesh.complete", "true"),
    ] {
        assert_eq!(attribute(request, key).as_deref(), Some(value), "{key}");
    }
    let parts: Vec<&str> = below(&spans, request).iter().map(|span| span.name.as_str()).collect();
    for part in ["receive", "job", "encode", "save"] {
        assert!(parts.contains(&part), "{part} among {parts:?}");
    }
    for part in ["receive", "job", "encode"] {
        lies_within(named(&spans, part), request);
    }
    let job = named(&spans, "job");
    assert_eq!((kind(job), attribute(job, "molmesh.job.outcome").as_deref()), (SpanKind::Internal, Some("successful")));
    assert_eq!(attribute(job, "molmesh.atoms").as_deref(), Some("454"));
    let stages = below(&spans, job);
    for stage in ["queue", "check", "read", "select", "field", "classify", "emit", "measure"] {
        assert!(stages.iter().any(|span| span.name == stage), "{stage} among {stages:?}");
    }
    let mut taken = 0;
    for stage in &stages {
        lies_within(stage, job);
        taken += stage.end_time_unix_nano - stage.start_time_unix_nano;
    }
    assert!(taken <= job.end_time_unix_nano - job.start_time_unix_nano, "stages do not overlap");
    // Each span is exported once, and unsampled traces are not exported.
    let mut ids: Vec<&[u8]> = spans.iter().map(|span| &span.span_id[..]).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), spans.len());
    assert!(collector.trace(&other[3..35]).is_empty());
    let requests = collector.requests();
    let resource = requests[0].resource_spans[0].resource.as_ref().unwrap();
    let service = Span { attributes: resource.attributes.clone(), ..Span::default() };
    assert_eq!(attribute(&service, "service.name").as_deref(), Some("molmesh"));
    assert_eq!(attribute(&service, "service.version").as_deref(), Some(env!("CARGO_PKG_VERSION")));
    for head in collector.heads() {
        assert!(head.starts_with("post /v1/traces http/1.1") && head.contains("application/x-protobuf"), "{head}");
        assert!(head.contains("authorization: bearer sesame-8731"), "{head}");
    }
    assert_eq!(log_lines("sesame-8731"), Vec::<String>::new());
}

#[test]
fn failures_are_reported_in_spans_and_log_lines() {
    let collector = Collector::start(CollectorMode::Accept);
    let backend = Fake::new(Mode::Panic);
    let server = traced(Arc::clone(&backend) as _, &collector, |_| {});
    assert_eq!(server.post("/v1/meshes", &[("traceparent", PARENT)], SAMPLE).status, 500);
    let other = PARENT.replace(TRACE, "22222222222222222222222222222222");
    assert_eq!(server.post("/v1/meshes", &[("traceparent", &other)], b"HEADER without atoms").status, 422);
    assert!(server.join());
    let spans = collector.trace(TRACE);
    let (request, job) = (named(&spans, "POST /v1/meshes"), named(&spans, "job"));
    assert_eq!(attribute(job, "molmesh.job.outcome").as_deref(), Some("panicked"));
    for span in [request, job] {
        assert_eq!(span.status.as_ref().unwrap().code, 2, "{span:?}");
    }
    assert!(below(&spans, job).iter().any(|span| span.name == "read"), "completed stages are exported");
    let spans = collector.trace("22222222222222222222222222222222");
    assert_eq!(named(&spans, "job").status.as_ref().unwrap().code, 2);
    let status = named(&spans, "POST /v1/meshes").status.as_ref();
    assert_eq!(status.map(|status| status.code), Some(0), "4xx are not errors of the server");
}

#[test]
fn an_asynchronous_job_stays_in_the_trace_of_its_request() {
    let collector = Collector::start(CollectorMode::Accept);
    let server = traced(Fake::new(Mode::Octahedra), &collector, |_| {});
    let headers = [("prefer", "respond-async"), ("traceparent", PARENT), ("x-request-id", "later-1")];
    let reply = server.post("/v1/meshes", &headers, SAMPLE);
    assert_eq!(reply.status, 202);
    let id = reply.json()["jobID"].as_str().unwrap().to_owned();
    let failing = [("prefer", "respond-async"), ("x-request-id", "later-2")];
    let failed = server.post("/v1/meshes", &failing, b"HEADER without atoms");
    for location in [reply.header("location").unwrap(), failed.header("location").unwrap()] {
        wait_for("the job ends", || !server.get(&format!("{location}?wait=20")).json()["finished"].is_null());
    }
    assert!(server.join());
    let spans = collector.trace(TRACE);
    let (request, job) = (named(&spans, "POST /v1/meshes"), named(&spans, "job"));
    assert_eq!((&job.parent_span_id, kind(job)), (&request.span_id, SpanKind::Consumer));
    assert_eq!(attribute(job, "molmesh.job.id"), Some(format!("{}…", &id[..8])));
    assert_eq!(named(&spans, "save").parent_span_id, request.span_id);
    // Log lines of a job name request, trace and job.
    let lines = log_lines("a job failed");
    let (trace, _) = place(&failed);
    let job = format!("{}…", &failed.json()["jobID"].as_str().unwrap()[..8]);
    let named = |line: &&String| ["later-2", &trace, &job].iter().all(|id| line.contains(*id));
    assert_eq!(lines.iter().filter(named).count(), 1, "{lines:?}");
}

#[test]
fn a_trace_continues_after_a_restart() {
    let held = Fake::new(Mode::Held);
    let (before, after) = (Collector::start(CollectorMode::Accept), Collector::start(CollectorMode::Accept));
    let folder = tempfile::tempdir().unwrap();
    let keep = |config: &mut Config| folder.path().clone_into(&mut config.server.data_dir);
    let server = traced(Arc::clone(&held) as _, &before, |config| {
        keep(config);
        config.server.drain_timeout_ms = 1;
    });
    let headers = [("prefer", "respond-async"), ("traceparent", PARENT), ("tracestate", "rojo=1")];
    let reply = server.post("/v1/meshes", &headers, SAMPLE);
    assert_eq!(reply.status, 202);
    let location = reply.header("location").unwrap().to_owned();
    wait_for("the job runs", || held.started.load(Ordering::SeqCst) == 1);
    // The job is left to the next start. The result of `join` is ignored, because the last response may miss the drain.
    let _drained = server.join();

    let server = traced(Fake::new(Mode::Octahedra), &after, keep);
    wait_for("the job ends", || server.get(&format!("{location}?wait=20")).json()["status"] == "successful");
    assert!(server.join());
    let (_, request) = place(&reply);
    let spans = after.trace(TRACE);
    let job = named(&spans, "job");
    assert_eq!((hex(&job.parent_span_id), kind(job), &job.trace_state[..]), (request, SpanKind::Consumer, "rojo=1"));
    assert!(below(&spans, job).iter().any(|span| span.name == "read"));
}

#[test]
fn requests_are_linked_to_a_coalesced_job() {
    let (held, collector) = (Fake::new(Mode::Held), Collector::start(CollectorMode::Accept));
    let server = traced(Arc::clone(&held) as _, &collector, |config| config.jobs.deadline_ms = 600_000);
    let other = PARENT.replace(TRACE, "33333333333333333333333333333333");
    let joined = || server.metric("molmesh_jobs_submitted_total", &["dedup=\"yes\""]);
    let timing = std::thread::scope(|scope| {
        let first = scope.spawn(|| server.post("/v1/meshes", &[("traceparent", PARENT)], SAMPLE));
        wait_for("the job runs", || held.started.load(Ordering::SeqCst) == 1);
        let second = scope.spawn(|| server.post("/v1/meshes", &[("traceparent", &other)], SAMPLE));
        wait_for("the second request joins the job", || joined() > 0.0);
        held.set(Mode::Octahedra);
        assert_eq!(first.join().unwrap().status, 200);
        second.join().unwrap().header("server-timing").unwrap().to_owned()
    });
    assert!(timing.contains("joined;dur=") && !timing.contains("queue;dur="), "{timing}");
    assert!(server.join());
    let (mine, theirs) = (collector.trace(TRACE), collector.trace("33333333333333333333333333333333"));
    let (job, request) = (named(&mine, "job"), named(&theirs, "POST /v1/meshes"));
    assert!(!theirs.iter().any(|span| span.name == "job"), "the job ran once");
    let links = |span: &Span| -> Vec<(String, String)> {
        span.links.iter().map(|link| (hex(&link.trace_id), hex(&link.span_id))).collect()
    };
    assert_eq!(links(job), [(hex(&request.trace_id), hex(&request.span_id))]);
    assert_eq!(links(request), [(hex(&job.trace_id), hex(&job.span_id))]);
}

#[test]
fn archives_receive_the_trace_but_nothing_else_of_the_client() {
    let collector = Collector::start(CollectorMode::Accept);
    let archive = archive_support::Remote::saying(archive_support::ok(SAMPLE));
    let url = archive.url("/d/{id}.pdb");
    let server = traced(Fake::new(Mode::Octahedra), &collector, |config| {
        config.archive.url = Some(url.parse().unwrap());
    });
    let headers = [
        ("traceparent", PARENT),
        ("tracestate", "rojo=1,congo=2"),
        ("x-request-id", "private-id"),
        ("user-agent", "private-agent"),
        ("cookie", "private-cookie"),
    ];
    let reply = send(server.addr, "GET", "/v1/pdb/4pti/surface.glb", &headers, b"");
    assert_eq!(reply.status, 200);
    assert!(server.join());
    let spans = collector.trace(TRACE);
    let (request, fetch) = (named(&spans, "GET /v1/pdb/{id}/{file}"), named(&spans, "GET"));
    assert_eq!((&fetch.parent_span_id, kind(fetch)), (&request.span_id, SpanKind::Client));
    assert_eq!(attribute(fetch, "http.response.status_code").as_deref(), Some("200"));
    assert_eq!(attribute(fetch, "server.address").as_deref(), Some("127.0.0.1"));
    let asked = archive.requests();
    let told = asked.iter().map(|a| (a.header("traceparent"), a.header("tracestate"))).collect::<Vec<_>>();
    let expected = format!("00-{TRACE}-{}-01", hex(&fetch.span_id));
    assert_eq!(told, [(Some(expected.as_str()), None)]);
    assert!(!format!("{asked:?}").contains("private-"), "{asked:?}");
    // Without export, not even the trace.
    let silent = start(Fake::new(Mode::Octahedra), |config| config.archive.url = Some(url.parse().unwrap()));
    assert_eq!(send(silent.addr, "GET", "/v1/pdb/4pti/surface.glb", &headers, b"").status, 200);
    assert_eq!(archive.requests().last().unwrap().header("traceparent"), None);
    assert_eq!(archive.requests().len(), 2);
}

#[test]
fn a_fraction_of_the_traces_is_recorded() {
    let collector = Collector::start(CollectorMode::Accept);
    let server = traced(Fake::new(Mode::Octahedra), &collector, |config| {
        config.telemetry.sample_ratio = serde_json::from_value(0.0.into()).unwrap();
    });
    assert!(server.get("/version").header("traceparent").unwrap().ends_with("-00"));
    // The parent decides for its children.
    assert_eq!(send(server.addr, "GET", "/version", &[("traceparent", PARENT)], b"").status, 200);
    assert!(server.join());
    let spans = collector.spans();
    assert_eq!(spans.len(), 1, "{spans:?}");
    assert_eq!(hex(&spans[0].trace_id), TRACE);
}

#[test]
fn failing_collectors_do_not_affect_requests() {
    let exported = |result: &'static str| {
        let label = format!("result=\"{result}\"");
        Box::new(move |server: &Running| server.metric("molmesh_trace_spans_total", &[&label])) as Box<Sign>
    };
    let logged = |text: &'static str| Box::new(move |_: &Running| log_lines(text).len() as f64) as Box<Sign>;
    // No listener.
    let gone = Collector::start(CollectorMode::Accept).url();
    for (mode, sign, queue, timeout_ms) in [
        (None, exported("failed"), 4096, 500),
        (Some(CollectorMode::Status(503)), exported("failed"), 4096, 500),
        (Some(CollectorMode::Status(400)), exported("failed"), 4096, 10_000),
        (Some(CollectorMode::Status(400)), logged("status code: 400"), 4096, 10_000),
        (Some(CollectorMode::Reject(1)), logged("rejected_spans=1"), 4096, 10_000),
        (Some(CollectorMode::Silent), exported("failed"), 4096, 500),
        (Some(CollectorMode::Silent), logged("dropped a Span due to queue full"), 1, 600_000),
        (Some(CollectorMode::Accept), exported("exported"), 4096, 10_000),
    ] {
        let collector = mode.map(Collector::start);
        let url = collector.as_ref().map_or_else(|| gone.clone(), Collector::url);
        let server = start_on(Fake::new(Mode::Octahedra), Vec::new(), |config| {
            config.telemetry.endpoint = Some(serde_json::from_value(url.into()).unwrap());
            config.telemetry.queue = queue;
            config.telemetry.timeout_ms = timeout_ms;
            config.telemetry.flush_timeout_ms = 100;
        });
        let before = sign(&server);
        wait_for(&format!("{mode:?}"), || {
            assert_eq!(server.post("/v1/meshes?format=stl", &[], &sample(1)).status, 200);
            sign(&server) > before
        });
        // A silent collector delays the stop by the flush timeout at most.
        assert!(server.join(), "{mode:?}");
    }
}

#[test]
fn server_timing_adds_up_to_the_response_time() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let archive = server.dir.path().join("archive");
    std::fs::create_dir_all(&archive).unwrap();
    std::fs::write(archive.join("4pti.pdb"), SAMPLE).unwrap();
    let stored = server.post("/v1/structures", &[], &sample(9)).json()["digest"].as_str().unwrap().to_owned();
    let sums = |timing: &str| -> (f64, f64) {
        let entries = timing.split(", ").map(|entry| entry.split_once(";dur=").unwrap());
        let entries: Vec<(&str, f64)> = entries.map(|(name, ms)| (name, ms.parse().unwrap())).collect();
        let of = |is_total: bool| entries.iter().filter(|e| (e.0 == "total") == is_total).map(|e| e.1).sum();
        (of(false), of(true))
    };
    for n in 0..3 {
        let asked: [(&str, Ask); 4] = [
            ("an upload", Box::new(|| server.post("/v1/meshes?resolution=0.4", &[], &sample(n)))),
            ("a report", Box::new(|| server.post("/v1/report?check=strict", &[], &sample(n)))),
            ("an entry", Box::new(|| server.get(&format!("/v1/pdb/4pti/surface.glb?resolution=0.{}", n + 5)))),
            (
                "a structure",
                Box::new(|| server.get(&format!("/v1/structures/{stored}/surface.glb?resolution=0.{}", n + 5))),
            ),
        ];
        for (what, ask) in asked {
            let begun = Instant::now();
            let reply = ask();
            let outside = begun.elapsed().as_secs_f64() * 1e3;
            assert_eq!(reply.status, 200, "{what}: {}", String::from_utf8_lossy(&reply.body));
            let timing = reply.header("server-timing").unwrap();
            let (parts, total) = sums(timing);
            for entry in ["receive", "queue", "read", "field", "emit", "measure", "encode", "other", "total"] {
                assert!(timing.contains(&format!("{entry};dur=")), "{what}, {entry}: {timing}");
            }
            // Each entry may be rounded by one microsecond.
            assert!((parts - total).abs() < 0.05, "{what}: {parts} of {total}: {timing}");
            assert!(total <= outside, "{what}: {total} in {outside}");
            // Control: the longest stage is missing.
            let (without, _) = sums(&timing.replace("field;dur=", "field;dur=-"));
            assert!(without < parts, "{what}: {timing}");
        }
    }
    // A result is not stored while too many others are: then the next request computes it again.
    let cached = (0..50).any(|_| {
        std::thread::sleep(Duration::from_millis(100));
        let again = server.get("/v1/pdb/4pti/surface.glb?resolution=0.5");
        again.header("server-timing").unwrap().starts_with("cache;desc=hit, total;dur=")
    });
    assert!(cached);
}
