//! Every limit of the configuration, exceeded over a socket: response, number and metric. The server keeps running.

use crate::http_support;

use std::io::{Read, Write};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Barrier};
use std::time::{Duration, Instant};

use http_support::{
    Fake, LONG, Mode, Reply, Running, SAMPLE, carbons, connect, gzip, read_reply, sample, send, start, wait_for,
};
use molmesh::config::Config;
use molmesh::surface::cpu::CpuBackend;

fn fake(change: impl FnOnce(&mut Config)) -> Running {
    start(Fake::new(Mode::Octahedra), change)
}

/// Bytes of the memory budget that a connection takes.
const CONNECTION_BYTES: u64 = 320 << 10;

fn rejected(server: &Running, reason: &str) -> f64 {
    server.metric("molmesh_requests_rejected_total", &[&format!("reason=\"{reason}\"")])
}

/// Posts a chunked body, which declares no length.
fn post_chunked(server: &Running, body: &[u8]) -> Reply {
    let mut stream = connect(server.addr);
    stream
        .write_all(
            b"POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ntransfer-encoding: chunked\r\n\r\n",
        )
        .unwrap();
    for chunk in body.chunks(16 << 10) {
        let framed = [format!("{:x}\r\n", chunk.len()).as_bytes(), chunk, b"\r\n"].concat();
        if stream.write_all(&framed).is_err() {
            break;
        }
    }
    stream.write_all(b"0\r\n\r\n").unwrap_or(());
    read_reply(&mut stream, false)
}

#[test]
fn bodies_are_limited_with_and_without_a_declared_length() {
    let server = fake(|c| c.limits.body_bytes = 100_000);
    let large = vec![b'x'; 5_000_000];
    let before = rejected(&server, "body-too-large");
    for reply in [server.post("/v1/meshes", &[], &large), post_chunked(&server, &large)] {
        assert_eq!(reply.problem(413, "body-too-large")["limit"], 100_000);
    }
    let mut form = b"--XX\r\ncontent-disposition: form-data; name=\"file\"\r\n\r\n".to_vec();
    form.extend_from_slice(&large);
    form.extend_from_slice(b"\r\n--XX--\r\n");
    let kind = ("content-type", "multipart/form-data; boundary=XX");
    assert_eq!(server.post("/v1/meshes", &[kind], &form).problem(413, "body-too-large")["limit"], 100_000);
    let mut stream = connect(server.addr);
    let head = "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: multipart/form-data; \
                boundary=XX\r\ntransfer-encoding: chunked\r\n\r\n";
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(format!("{:x}\r\n", form.len()).as_bytes()).unwrap();
    stream.write_all(&form).unwrap_or(());
    read_reply(&mut stream, false).problem(413, "body-too-large");
    assert!(rejected(&server, "body-too-large") >= before + 4.0);
    // A declared length over the limit is rejected before the body arrives.
    let start = Instant::now();
    let mut stream = connect(server.addr);
    stream
        .write_all(
            b"POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-length: 99999999999\r\n\r\n",
        )
        .unwrap();
    assert_eq!(read_reply(&mut stream, false).problem(413, "body-too-large")["actual"], 99_999_999_999u64);
    assert!(start.elapsed() < Duration::from_secs(20));
    assert_eq!(post_chunked(&server, SAMPLE).status, 200);
}

#[test]
fn json_bodies_are_limited_before_parsing() {
    let server = fake(|_| {});
    let json = ("content-type", "application/json");
    let before = rejected(&server, "body-too-large");
    let list = |items: usize| format!("{{\"pdb_id\":\"4pti\",\"chains\":[{}0]}}", "0,".repeat(items)).into_bytes();
    for path in ["/v1/meshes", "/v1/estimate"] {
        let problem = server.post(path, &[json], &list(10_000_000)).problem(413, "body-too-large");
        assert_eq!(problem["limit"], 65_536);
        assert!(problem["detail"].as_str().unwrap().contains("the limit is 65536"), "{problem}");
    }
    // Without a declared length, the body is rejected during the transfer.
    let mut stream = connect(server.addr);
    let head = "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: application/json\r\n\
                transfer-encoding: chunked\r\n\r\n10001\r\n";
    stream.write_all(&[head.as_bytes(), &vec![b' '; 0x10001]].concat()).unwrap();
    assert_eq!(read_reply(&mut stream, false).problem(413, "body-too-large")["limit"], 65_536);
    assert!(rejected(&server, "body-too-large") >= before + 3.0);
    // A document within the limit is read: only the entry is missing.
    let document = [list(2000), vec![b' '; 60_000]].concat();
    server.post("/v1/meshes", &[json], &document).problem(404, "not-in-archive");
}

/// Starts a form in a chunked body.
fn begin_form(server: &Running) -> std::net::TcpStream {
    let mut stream = connect(server.addr);
    let head = "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ntransfer-encoding: chunked\r\n\
                content-type: multipart/form-data; boundary=XX\r\n\r\n";
    stream.write_all(head.as_bytes()).unwrap();
    stream
}

fn send_chunk(stream: &mut std::net::TcpStream, bytes: &[u8]) -> std::io::Result<()> {
    stream.write_all(&[format!("{:x}\r\n", bytes.len()).as_bytes(), bytes, b"\r\n"].concat())
}

#[test]
fn heads_of_parts_are_limited_at_any_position_and_speed() {
    const LIMIT: usize = 16 << 10;
    let server = fake(|_| {});
    let part = |head: &str, content: &str| format!("--XX\r\n{head}\r\n\r\n{content}\r\n");
    let named = |name: &str| format!("content-disposition: form-data; name=\"{name}\"");
    let sample = part(&named("file"), std::str::from_utf8(SAMPLE).unwrap());
    let long = format!("{}\r\nx: {}", named("resolution"), "y".repeat(LIMIT));
    let kind = ("content-type", "multipart/form-data; boundary=XX");
    let before = rejected(&server, "body-too-large");
    for (what, form) in [
        ("a preamble", format!("{}{sample}--XX--", "p".repeat(LIMIT))),
        ("a preamble without end", "p".repeat(1_000_000)),
        ("a first head", format!("{}{sample}--XX--", part(&long, "1"))),
        ("a later head", format!("{sample}{}--XX--", part(&long, "1"))),
        ("a name", format!("{sample}{}--XX--", part(&named(&"n".repeat(LIMIT)), "1"))),
        ("a head without end", format!("{sample}--XX\r\na: {}", "y".repeat(1_000_000))),
        ("an epilogue", format!("{sample}--XX--{}", "e".repeat(1_000_000))),
    ] {
        let problem = server.post("/v1/meshes", &[kind], form.as_bytes()).problem(413, "body-too-large");
        assert_eq!(problem["limit"], LIMIT, "{what}");
        assert!(problem["detail"].as_str().unwrap().contains("the headers of a part"), "{what}: {problem}");
    }
    // One byte at a time up to the limit and beyond it.
    let mut stream = begin_form(&server);
    send_chunk(&mut stream, b"--XX\r\na: ").unwrap();
    send_chunk(&mut stream, &[b'b'; LIMIT - 1000]).unwrap();
    for _ in 0..3000 {
        if send_chunk(&mut stream, b"b").is_err() {
            break;
        }
    }
    assert_eq!(read_reply(&mut stream, false).problem(413, "body-too-large")["limit"], LIMIT);
    assert!(rejected(&server, "body-too-large") >= before + 8.0);
    // Heads within the limit are accepted, with a preamble, an epilogue and small chunks.
    let form = format!("hello\r\n{}{sample}--XX--\r\nbye", part(&named("resolution"), "1.5"));
    let mut stream = begin_form(&server);
    for piece in form.as_bytes().chunks(777) {
        send_chunk(&mut stream, piece).unwrap();
    }
    stream.write_all(b"0\r\n\r\n").unwrap();
    assert_eq!(read_reply(&mut stream, false).status, 200);
    let wide = ("content-type", format!("multipart/form-data; boundary={}", "b".repeat(71)));
    assert_eq!(server.post("/v1/meshes", &[(wide.0, &wide.1)], b"x").problem(400, "bad-request")["limit"], 70);
}

#[test]
fn an_endless_head_of_a_part_uses_little_memory_and_time() {
    let server = fake(|_| {});
    let mut stream = begin_form(&server);
    let start = Instant::now();
    send_chunk(&mut stream, b"--XX\r\nA: ").unwrap();
    let (mut sent, piece) = (0, vec![b'a'; 64 << 10]);
    while sent < 60_000_000 && send_chunk(&mut stream, &piece).is_ok() {
        sent += piece.len();
    }
    assert_eq!(read_reply(&mut stream, false).problem(413, "body-too-large")["limit"], 16_384);
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
    // The parser's buffer counts as memory: if it does not fit, a form is rejected and a plain file is not.
    let server = fake(|c| c.limits.memory_bytes = CONNECTION_BYTES + 60_000);
    let kind = ("content-type", "multipart/form-data; boundary=XX");
    // It never fits, beside the buffers of its own connection.
    let refused = server.post("/v1/meshes", &[kind], b"--XX\r\n");
    assert!(refused.header("retry-after").is_none());
    assert_eq!(refused.problem(422, "too-much-memory")["limit"], CONNECTION_BYTES + 60_000);
    let plain = || server.post("/v1/meshes?resolution=2", &[], &carbons(10)).status == 200;
    wait_for("a plain file is accepted", plain);
}

#[test]
fn parts_of_forms_are_limited() {
    let server = fake(|_| {});
    let form = |parts: usize| {
        let fields = "--XX\r\ncontent-disposition: form-data; name=\"unknown\"\r\n\r\n\r\n".repeat(parts);
        server.post(
            "/v1/meshes",
            &[("content-type", "multipart/form-data; boundary=XX")],
            (fields + "--XX--").as_bytes(),
        )
    };
    let problem = form(129).problem(413, "body-too-large");
    assert_eq!(problem["limit"], 128);
    assert!(problem["detail"].as_str().unwrap().contains("more than 128 parts"), "{problem}");
    form(128).problem(400, "bad-request");
    form(100_000).problem(413, "body-too-large");
}

#[test]
fn compression_bombs_stop_at_the_inflated_limit() {
    let server = fake(|c| c.limits.inflated_bytes = 1_000_000);
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    encoder.write_all(&vec![b' '; 50_000_000]).unwrap();
    let bomb = encoder.finish().unwrap();
    let before = rejected(&server, "inflated-too-large");
    let start = Instant::now();
    assert_eq!(server.post("/v1/meshes", &[], &bomb).problem(413, "inflated-too-large")["limit"], 1_000_000);
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
    assert!(rejected(&server, "inflated-too-large") > before);
    let archive = server.dir.path().join("archive");
    std::fs::create_dir_all(&archive).unwrap();
    std::fs::write(archive.join("1abc.cif"), vec![b' '; 1_000_001]).unwrap();
    let problem = server.get("/v1/pdb/1abc/surface.glb").problem(413, "inflated-too-large");
    let detail = "entry 1abc has 1000001 bytes, the limit is 1000000 (limits.inflated_bytes)";
    assert_eq!((&problem["limit"], &problem["detail"]), (&1_000_000.into(), &detail.into()));
}

#[test]
fn atoms_are_limited() {
    let server = fake(|c| c.limits.atoms = 100);
    assert_eq!(server.post("/v1/meshes", &[], &carbons(101)).problem(422, "too-many-atoms")["limit"], 100);
    assert_eq!(server.post("/v1/meshes", &[], &carbons(100)).status, 200);
    assert!(rejected(&server, "too-many-atoms") >= 1.0);
}

#[test]
fn atoms_at_one_position_are_limited() {
    let server = fake(|_| {});
    let line = carbons(1);
    for path in ["/v1/meshes", "/v1/structures", "/v1/estimate"] {
        let problem = server.post(path, &[], &line.repeat(1001)).problem(422, "too-many-duplicates");
        assert_eq!((&problem["limit"], &problem["position"]), (&1000.into(), &serde_json::json!([0.0, 0.0, 0.0])));
        assert!([200, 201].contains(&server.post(path, &[], &line.repeat(1000)).status), "{path}");
    }
    assert!(rejected(&server, "too-many-duplicates") >= 3.0);
}

/// Returns a file of ten atoms with an assembly of six copies.
fn hexamer() -> String {
    let operator = |n: usize| {
        let row = |k: usize| {
            let m = [0, 1, 2].map(|j| if j + 1 == k { "1.000000" } else { "0.000000" }).join("  ");
            format!("REMARK 350   BIOMT{k} {n:>3}  {m}  {:>13.5}\n", if k == 1 { 100.0 * n as f64 } else { 0.0 })
        };
        [1, 2, 3].map(row).concat()
    };
    let operators: String = (1..=6).map(operator).collect();
    let head = "REMARK 350 BIOMOLECULE: 1\nREMARK 350 APPLY THE FOLLOWING TO CHAINS: A\n";
    format!("{head}{operators}{}", String::from_utf8(carbons(10)).unwrap())
}

#[test]
fn parts_of_meshes_are_limited() {
    let server = fake(|_| {});
    let line = String::from_utf8(carbons(1)).unwrap();
    let model = |n: usize| format!("MODEL     {n:>4}\n{line}ENDMDL\n");
    let models = |n: usize| -> String { (1..=n).map(model).collect() };
    let ask = |path: &str, n: usize| server.post(&format!("{path}?model=all&resolution=2"), &[], models(n).as_bytes());
    for path in ["/v1/meshes", "/v1/estimate", "/v1/report"] {
        let problem = ask(path, 1001).problem(422, "too-many-parts");
        assert_eq!((&problem["parameter"], &problem["limit"]), (&"model".into(), &1000.into()), "{path}");
        assert_eq!(ask(path, 1000).status, 200, "{path}");
    }
    // Without parts, the limit does not apply.
    assert_eq!(server.post("/v1/meshes?resolution=2", &[], models(1001).as_bytes()).status, 200);
    assert!(rejected(&server, "too-many-parts") >= 3.0);
}

#[test]
fn parts_of_an_assembly_are_named_by_chain_and_copy() {
    let server = fake(|_| {});
    let text = hexamer();
    let report = server.post("/v1/report?assembly=1&split=chain&resolution=2", &[], text.as_bytes());
    let parts = report.json()["parts"].clone();
    let names: Vec<&str> = parts.as_array().unwrap().iter().map(|part| part["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["A-1", "A-2", "A-3", "A-4", "A-5", "A-6"]);
    let bad = server.post("/v1/meshes?split=atom", &[], text.as_bytes()).problem(400, "bad-parameter");
    assert_eq!(bad["parameter"], "split");
    assert!(bad["expected"].as_str().unwrap().contains("none, chain, entity, residue-group, pocket"), "{bad}");
    let none = server.post("/v1/meshes?split=entity", &[], text.as_bytes()).problem(400, "bad-parameter");
    assert_eq!((&none["parameter"], &none["value"]), (&"split".into(), &"entity".into()));
}

#[test]
fn assemblies_are_limited() {
    let text = hexamer();
    let ask =
        |server: &Running, path: &str| server.post(&format!("{path}?assembly=1&resolution=2"), &[], text.as_bytes());
    let few = fake(|c| c.limits.assembly_copies = 5);
    let small = fake(|c| c.limits.atoms = 59);
    let exact = fake(|c| (c.limits.assembly_copies, c.limits.atoms) = (6, 60));
    for path in ["/v1/meshes", "/v1/estimate", "/v1/report"] {
        assert_eq!(ask(&few, path).problem(422, "too-many-copies")["limit"], 5);
        let problem = ask(&small, path).problem(422, "too-many-atoms");
        assert_eq!((&problem["limit"], &problem["actual"]), (&59.into(), &60.into()), "{path}");
        assert_eq!(ask(&exact, path).status, 200, "{path}");
    }
    // Without an assembly, its limits do not apply.
    assert_eq!(few.post("/v1/meshes", &[], text.as_bytes()).status, 200);
    assert!(rejected(&few, "too-many-copies") >= 3.0 && rejected(&small, "too-many-atoms") >= 3.0);
    assert_eq!(ask(&exact, "/v1/report").json()["assembly"], serde_json::json!({ "id": "1", "copies": 6 }));
}

#[test]
fn assemblies_of_a_structure_in_memory_are_listed_counted_and_meshed() {
    let server = fake(|_| {});
    let text = hexamer();
    let uploaded = server.post("/v1/structures", &[], text.as_bytes()).json();
    assert_eq!(uploaded["assemblies"], serde_json::json!([{ "id": "1", "copies": 6 }]));
    let path = format!("/v1/structures/{}", uploaded["digest"].as_str().unwrap());
    let hits = || server.metric("molmesh_structure_cache_requests_total", &["result=\"hit\""]);
    let before = hits();
    let report = server.get(&format!("{path}/report.json?assembly=1")).json();
    assert_eq!(
        (&report["atoms"], &report["atoms_in_file"], &report["assembly"]["copies"]),
        (&60.into(), &10.into(), &6.into())
    );
    assert!(hits() > before, "the file was read again");
    let unknown = server.get(&format!("{path}/surface.glb?assembly=2")).problem(422, "empty-selection");
    assert_eq!((&unknown["parameter"], &unknown["value"]), (&"assembly".into(), &"2".into()));
    assert_eq!(unknown["expected"], "the assemblies 1");
    let estimate = |query: &str| server.post(&format!("/v1/estimate?{query}"), &[], text.as_bytes()).json();
    let [unit, all] = ["assembly=asymmetric-unit", "assembly=1"].map(estimate);
    assert_eq!((&unit["atoms"], &all["atoms"]), (&10.into(), &60.into()));
    // The copies do not touch. The time has a constant part.
    assert_eq!(all["grid_points"].as_u64().unwrap(), 6 * unit["grid_points"].as_u64().unwrap(), "{all}");
    let [one, six] = [&unit, &all].map(|estimate| estimate["seconds"].as_f64().unwrap());
    assert!(1.1 * one < six && six < 6.5 * one, "{all}");
}

#[test]
fn listed_atoms_are_limited() {
    let server = fake(|c| c.limits.labels = 100);
    let listed = |atoms| {
        let structure = server.post("/v1/structures", &[], &carbons(atoms)).header("location").unwrap().to_owned();
        server.get(&format!("{structure}/atoms"))
    };
    assert_eq!(listed(101).problem(422, "too-many-atoms")["limit"], 100);
    assert_eq!(listed(100).json()["count"], 100);
    let colored = |atoms| {
        let structure = server.post("/v1/structures", &[], &carbons(atoms)).header("location").unwrap().to_owned();
        server.get(&format!("{structure}/colors?scheme=chain"))
    };
    assert_eq!(colored(101).problem(422, "too-many-atoms")["limit"], 100);
    assert_eq!(colored(100).body.len(), 400);
    // The copies of an assembly count.
    let structure = server.post("/v1/structures", &[], hexamer().as_bytes()).header("location").unwrap().to_owned();
    let placed = |server: &Running| server.get(&format!("{structure}/atoms?positions=true&assembly=1"));
    assert_eq!(placed(&server).json()["count"], 60);
    let few = fake(|c| c.limits.labels = 59);
    few.post("/v1/structures", &[], hexamer().as_bytes());
    assert_eq!(placed(&few).problem(422, "too-many-atoms")["limit"], 59);
    assert!(rejected(&server, "too-many-atoms") >= 1.0);
    // The limit does not apply to meshes.
    assert_eq!(server.post("/v1/meshes", &[], &carbons(101)).status, 200);
}

#[test]
fn tested_distances_of_a_selection_are_limited() {
    let path = "/v1/meshes?resolution=2&select=within%205%20of%20resi%201";
    assert_eq!(fake(|_| {}).post(path, &[], SAMPLE).status, 200);
    let server = fake(|c| c.limits.candidate_pairs = 1);
    let before = rejected(&server, "too-many-candidates");
    let problem = server.post(path, &[], SAMPLE).problem(422, "too-many-candidates");
    assert_eq!((problem["parameter"].as_str(), problem["limit"].as_u64()), (Some("select"), Some(64)), "{problem}");
    assert!(rejected(&server, "too-many-candidates") > before);
}

/// Repeats a request for a mesh, refused at `resolution` with `problem`, with the suggested resolution until it is
/// accepted. Returns that resolution. Each one is coarser, and the third is accepted at the latest.
fn accepted_resolution(server: &Running, body: &[u8], mut resolution: f64, mut problem: serde_json::Value) -> f64 {
    for _ in 0..3 {
        let suggested = problem["suggested_resolution"].as_f64().unwrap_or_else(|| panic!("{problem}"));
        assert!(suggested > resolution, "{resolution}: {problem}");
        resolution = suggested;
        let reply = server.post(&format!("/v1/meshes?resolution={resolution}"), &[], body);
        if reply.status == 200 {
            return resolution;
        }
        problem = reply.json();
    }
    panic!("{problem}");
}

#[test]
fn grids_and_meshes_are_limited_and_suggested_spacings_fit() {
    for (slug, change) in [
        ("grid-too-large", Box::new(|c: &mut Config| c.limits.grid_points = 60_000) as Box<dyn FnOnce(&mut Config)>),
        ("too-many-candidates", Box::new(|c: &mut Config| c.limits.candidate_pairs = 10_000)),
        ("mesh-too-large", Box::new(|c: &mut Config| c.limits.mesh_bytes = 300_000)),
        ("mesh-too-large", Box::new(|c: &mut Config| c.limits.output_bytes = 300_000)),
    ] {
        let server = start(Arc::new(CpuBackend::new(None).unwrap()), change);
        let problem = server.post("/v1/meshes?resolution=0.4", &[], SAMPLE).problem(422, slug);
        assert!(problem["actual"].as_u64() > problem["limit"].as_u64(), "{problem}");
        accepted_resolution(&server, SAMPLE, 0.4, problem);
        assert!(rejected(&server, slug) >= 1.0);
    }
}

#[test]
fn suggestions_of_the_pair_limit_lead_to_one_that_fits_the_grid_and_the_mesh_limit() {
    for (what, grid_points, mesh_bytes) in [("grid", 1_000_000, 2 << 30), ("mesh", 1 << 30, 1 << 20)] {
        let server = start(Arc::new(CpuBackend::new(None).unwrap()), |c| {
            (c.limits.candidate_pairs, c.limits.grid_points, c.limits.mesh_bytes) = (100_000, grid_points, mesh_bytes);
        });
        let body = carbons(3);
        let problem = server.post("/v1/meshes?resolution=0.01", &[], &body).problem(422, "too-many-candidates");
        assert_eq!(problem["title"], "Too many pairs of atoms and grid bricks");
        let estimate = server.post("/v1/estimate?resolution=0.01", &[], &body).json();
        assert_eq!(estimate["problem"]["suggested_resolution"], problem["suggested_resolution"], "{what}");
        let accepted = accepted_resolution(&server, &body, 0.01, problem);
        // Control: half of it exceeds a limit.
        assert_eq!(server.post(&format!("/v1/meshes?resolution={}", accepted / 2.0), &[], &body).status, 422);
    }
}

#[test]
fn a_full_queue_rejects_with_retry_after() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(600)));
    let server = start(Arc::clone(&backend) as _, |c| {
        c.jobs.workers = 1;
        c.jobs.queue = 2;
    });
    let server = &server;
    std::thread::scope(|scope| {
        let accepted: Vec<_> = (0..3).map(|n| scope.spawn(move || server.post(LONG, &[], &sample(n)).status)).collect();
        wait_for("two jobs to wait", || server.metric("molmesh_queue_depth", &[]) >= 2.0);
        wait_for("one job to run", || backend.started.load(Ordering::SeqCst) == 1);
        let start = Instant::now();
        let refused = server.post(LONG, &[], &sample(9));
        assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
        let problem = refused.problem(503, "queue-full");
        assert_eq!((&problem["limit"], &problem["actual"]), (&2.into(), &2.into()));
        assert!(problem["estimated_wait_s"].as_f64().unwrap() > 0.0);
        let after: u64 = refused.header("retry-after").unwrap().parse().unwrap();
        assert!((1..=5).contains(&after), "{after}");
        // Load does not affect readiness.
        assert_eq!(server.get("/readyz").status, 200);
        for job in accepted {
            assert_eq!(job.join().unwrap(), 200);
        }
    });
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    assert!(rejected(server, "queue-full") >= 1.0);
}

#[test]
fn a_full_broker_rejects_jobs_with_retry_after() {
    let backend = Fake::new(Mode::Slow(Duration::from_millis(600)));
    let server = start(Arc::clone(&backend) as _, |c| (c.jobs.workers, c.broker.queue) = (1, 2));
    let asynchronous = [("prefer", "respond-async")];
    let submit = |n| server.post("/v1/meshes", &asynchronous, &sample(n));
    assert_eq!(submit(0).status, 202);
    wait_for("one job to run", || backend.started.load(Ordering::SeqCst) == 1);
    for n in 1..3 {
        assert_eq!(submit(n).status, 202);
    }
    assert!((server.metric("molmesh_broker_jobs_queued", &[]) - 2.0).abs() < 0.1);
    let refused = submit(9);
    let problem = refused.problem(503, "queue-full");
    assert_eq!((&problem["limit"], &problem["actual"]), (&2.into(), &2.into()));
    assert!(refused.header("retry-after").unwrap().parse::<u64>().unwrap() >= 1);
    assert_eq!(server.post("/v1/meshes", &[], &sample(10)).status, 200, "an interactive request needs no slot");
    wait_for("a slot to become free", || submit(9).status == 202);
}

#[test]
fn the_deadline_includes_queueing_and_stops_the_job() {
    let backend = Fake::new(Mode::Slow(Duration::from_secs(30)));
    let server = start(Arc::clone(&backend) as _, |c| {
        c.jobs.workers = 1;
        c.jobs.deadline_ms = 300;
    });
    let server = &server;
    std::thread::scope(|scope| {
        let replies: Vec<_> = (0..2).map(|n| scope.spawn(move || server.post("/v1/meshes", &[], &sample(n)))).collect();
        let replies: Vec<Reply> = replies.into_iter().map(|reply| reply.join().unwrap()).collect();
        let began = replies.iter().filter(|reply| reply.status == 504).count();
        for reply in &replies {
            // The second job did not begin, unless it got the worker between the two deadlines.
            let problem = match reply.status {
                504 => reply.problem(504, "deadline"),
                _ => reply.problem(503, "queue-full"),
            };
            assert_eq!(reply.status == 503, reply.header("retry-after").is_some());
            let limit = problem["limit"].as_u64().unwrap();
            assert!((200..=300).contains(&limit), "{limit}");
        }
        assert!(began >= 1, "the first job began");
    });
    wait_for("every job that started is cancelled", || {
        let started = backend.started.load(Ordering::SeqCst);
        started >= 1 && backend.cancelled.load(Ordering::SeqCst) == started
    });
    backend.set(Mode::Octahedra);
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
}

#[test]
fn slow_bodies_time_out() {
    let server = fake(|c| c.server.body_timeout_ms = 300);
    let mut stream = connect(server.addr);
    let start = Instant::now();
    stream
        .write_all(
            b"POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-length: 1000\r\n\r\nATOM",
        )
        .unwrap();
    assert_eq!(read_reply(&mut stream, false).problem(408, "body-timeout")["limit"], 300);
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
    assert!(rejected(&server, "body-timeout") >= 1.0);
}

#[test]
fn slow_heads_and_idle_connections_are_closed() {
    let server = fake(|c| c.server.header_timeout_ms = 300);
    let before = rejected(&server, "header-timeout");
    for sent in [&b""[..], b"P", b"PRI * HTTP/2.0\r\n", b"GET /livez HTTP/1.1\r\nhost: localhost\r\nx-slow: "] {
        let mut stream = connect(server.addr);
        stream.write_all(sent).unwrap();
        let start = Instant::now();
        let mut rest = Vec::new();
        stream.read_to_end(&mut rest).unwrap_or(0);
        let time = start.elapsed();
        assert!(time > Duration::from_millis(200) && time < Duration::from_secs(8), "{sent:?}: {time:?}");
    }
    // A connection that becomes idle after a request is closed too.
    let mut stream = connect(server.addr);
    stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    let start = Instant::now();
    let reply = read_reply(&mut stream, false);
    assert!(reply.status == 200 && start.elapsed() < Duration::from_secs(8), "{:?}", start.elapsed());
    wait_for("they are counted", || rejected(&server, "header-timeout") >= before + 4.0);
    assert_eq!(server.get("/livez").status, 200);
}

#[test]
fn excess_connections_are_rejected_with_503() {
    let server = fake(|c| (c.server.connections, c.server.client_share) = (4, 1.0));
    wait_for("earlier connections to be gone", || server.metric("molmesh_connections", &[]) >= 0.0);
    let mut held = Vec::new();
    let refused = loop {
        let mut stream = connect(server.addr);
        stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
        let mut start = [0; 12];
        stream.read_exact(&mut start).unwrap();
        if &start[9..] == b"503" {
            let mut rest = start.to_vec();
            stream.read_to_end(&mut rest).unwrap();
            break String::from_utf8(rest).unwrap();
        }
        held.push(stream);
        assert!(held.len() <= 4, "more than four connections");
    };
    assert!(refused.contains("retry-after: 1") && refused.contains("/problems/too-many-connections"), "{refused}");
    assert!(rejected(&server, "too-many-connections") >= 1.0);
    drop(held);
    wait_for("a connection is accepted", || send(server.addr, "GET", "/livez", &[], b"").status == 200);
}

#[test]
fn a_client_that_does_not_read_is_disconnected_and_its_mesh_freed() {
    let server = fake(|c| c.server.write_timeout_ms = 400);
    // Larger than the socket buffers.
    let body = carbons(60_000);
    let before = rejected(&server, "write-timeout");
    let mut stream = connect(server.addr);
    let head =
        format!("POST /v1/meshes?format=stl HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len());
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&body).unwrap();
    wait_for("the client is given up", || rejected(&server, "write-timeout") > before);
    wait_for("the mesh is freed", || server.metric("molmesh_memory_held_bytes", &[]) < 1e6);
    let mut rest = Vec::new();
    stream.read_to_end(&mut rest).unwrap_or(0);
    assert!(rest.len() < 84 + 50 * 60_000 * 8, "the response was cut off");
}

#[test]
fn memory_is_shared_and_limited() {
    let limit = 2 * CONNECTION_BYTES + 1_000_000;
    let server = fake(|c| c.limits.memory_bytes = limit);
    // Compressed, the body is far below its own limit of half the memory.
    let (body, encoding) = (gzip(&b"REMARK\n".repeat(1 << 19)), [("content-encoding", "gzip")]);
    let refused = server.post("/v1/meshes", &encoding, &body);
    let problem = refused.problem(422, "too-much-memory");
    assert_eq!((&problem["limit"], refused.header("retry-after")), (&limit.into(), None));
    assert!(problem["detail"].as_str().unwrap().contains("(limits.memory_bytes)"), "{problem}");
    let small = || server.post("/v1/meshes?resolution=4", &[], SAMPLE).status == 200;
    wait_for("a small mesh is accepted", small);
    assert!(rejected(&server, "too-much-memory") >= 1.0);
}

#[test]
fn a_mesh_that_exceeds_the_memory_alone_is_rejected_by_estimate_mesh_and_job() {
    let limit = 48 << 20;
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |c| c.limits.memory_bytes = limit);
    // 2 million vertices of 48 bytes each, with their triangles.
    let query = "resolution=0.05";
    let exceeds = |problem: &serde_json::Value, what: &str| {
        assert_eq!(problem["type"], "/problems/too-much-memory", "{what}: {problem}");
        assert_eq!(problem["limit"], limit, "{what}");
        assert!(problem["actual"].as_u64().unwrap() > limit, "{what}: {problem}");
    };
    let estimate = server.post(&format!("/v1/estimate?{query}"), &[], SAMPLE);
    assert_eq!((estimate.status, &estimate.json()["accepted"]), (200, &false.into()));
    exceeds(&estimate.json()["problem"], "estimate");
    for path in ["/v1/meshes", "/v1/report"] {
        let refused = server.post(&format!("{path}?{query}"), &[], SAMPLE);
        assert_eq!((refused.status, refused.header("retry-after")), (422, None), "{path}");
        exceeds(&refused.json(), path);
    }
    let accepted = server.post(&format!("/v1/meshes?{query}"), &[("prefer", "respond-async")], SAMPLE);
    let job = server.get(&format!("{}?wait=20", accepted.header("location").unwrap())).json();
    assert_eq!(job["status"], "failed", "{job}");
    exceeds(&server.get(&format!("{}/result", accepted.header("location").unwrap())).json(), "job");
    // Most of the work was not done.
    assert!(server.metric("molmesh_grid_points_total", &[]) < 1e6);
    assert_eq!(server.post("/v1/meshes?resolution=0.5", &[], SAMPLE).status, 200);
    let coarser = server.post("/v1/estimate?resolution=0.5", &[], SAMPLE).json();
    assert_eq!(coarser["accepted"], true, "{coarser}");
}

#[test]
fn bodies_leave_half_of_the_memory_to_jobs() {
    let limit = 2 * CONNECTION_BYTES + 2_000_000;
    let server = fake(|c| c.limits.memory_bytes = limit);
    let within = server.post("/v1/structures", &[], &carbons(1000));
    let beyond = server.post("/v1/structures", &[], &carbons(18_000));
    assert_eq!(within.status, 201);
    assert_eq!(beyond.problem(422, "too-much-memory")["limit"], limit / 2);
}

#[test]
fn structures_in_memory_are_not_read_again() {
    let server = fake(|_| {});
    let cache = |result: &str| server.metric("molmesh_structure_cache_requests_total", &[result]);
    let structure = server.post("/v1/structures", &[], &carbons(1000)).header("location").unwrap().to_owned();
    let (hits, misses) = (cache("hit"), cache("miss"));
    assert!(misses >= 1.0 && server.metric("molmesh_structure_cache_bytes", &[]) >= 61_000.0);
    for query in ["?isovalue=0.9", "?isovalue=1.1", "?resolution=2"] {
        let reply = server.get(&format!("{structure}/surface.glb{query}"));
        assert_eq!(reply.status, 200, "{query}");
    }
    assert_eq!(server.get(&format!("{structure}/atoms")).status, 200);
    assert!(cache("hit") >= hits + 4.0, "{} hits, {} misses", cache("hit"), cache("miss"));
    // Control: another file is read, and without a cache every request reads.
    assert_eq!(server.post("/v1/meshes", &[], &carbons(1001)).status, 200);
    assert!(cache("miss") > misses);
    let without = fake(|c| c.limits.structure_cache_bytes = 0);
    let misses = without.metric("molmesh_structure_cache_requests_total", &["miss"]);
    for query in ["?isovalue=0.9", "?isovalue=1.1"] {
        assert_eq!(without.post(&format!("/v1/meshes{query}"), &[], &carbons(1000)).status, 200);
    }
    assert!(without.metric("molmesh_structure_cache_requests_total", &["miss"]) >= misses + 2.0);
}

#[test]
fn the_file_of_a_structure_in_memory_is_not_loaded_again() {
    let kept = fake(|_| {});
    let without = fake(|c| c.limits.structure_cache_bytes = 0);
    let file = carbons(1000);
    for (server, is_kept) in [(&kept, true), (&without, false)] {
        let path = server.post("/v1/structures", &[], &file).header("location").unwrap().to_owned();
        let digest = path.rsplit('/').next().unwrap();
        // A request that loads the file finds it damaged from now on.
        let stored = server.dir.path().join("store/inputs").join(digest);
        assert_eq!(std::fs::read(&stored).unwrap(), file);
        std::fs::write(&stored, vec![b' '; file.len()]).unwrap();
        let status = |path: &str| server.get(&format!("/v1/structures/{digest}{path}")).status;
        let named = serde_json::json!({ "structure": digest, "resolution": 1.5 }).to_string();
        let post = |path: &str| server.post(path, &[("content-type", "application/json")], named.as_bytes()).status;
        let found = [
            status("/surface.glb"),
            status("/surface.glb?isovalue=1.1"),
            status("/report.json?resolution=2"),
            status("/atoms"),
            status("/colors?scheme=element"),
            post("/v1/meshes"),
            post("/v1/estimate"),
        ];
        assert_eq!(found, [if is_kept { 200 } else { 404 }; 7], "kept: {is_kept}");
        if is_kept {
            assert_eq!(server.get(&path).json()["bytes"], file.len());
        }
        // The strict validator and durable jobs need the file.
        assert_eq!(status("/surface.glb?check=strict"), 404);
        // A file that was removed cannot be meshed, even if its structure is in memory.
        assert!(!stored.exists());
        assert_eq!(status("/surface.glb?isovalue=1.2"), 404);
    }
}

#[test]
fn the_use_of_a_structure_in_memory_restarts_the_time_to_live_of_its_file() {
    let server = fake(|c| (c.store.input_ttl_ms, c.store.sweep_ms) = (2000, 20));
    let path = server.post("/v1/structures", &[], &carbons(100)).header("location").unwrap().to_owned();
    let begun = Instant::now();
    for i in 100.. {
        assert_eq!(server.get(&format!("{path}/surface.glb?isovalue=0.{i}")).status, 200);
        if begun.elapsed() > Duration::from_millis(2500) {
            break;
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    let stored = server.dir.path().join("store/inputs").join(path.rsplit('/').next().unwrap());
    assert!(stored.exists());
    // Control: it ends without a use.
    wait_for("the file expires", || !stored.exists());
}

/// Returns atoms, 81 bytes each, in a small file.
fn compressed_atoms(n: usize) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(&carbons(n)).unwrap();
    encoder.finish().unwrap()
}

#[test]
fn reading_counts_against_the_memory_limit() {
    let server = fake(|c| c.limits.memory_bytes = 8_000_000);
    let body = compressed_atoms(100_000);
    assert!(body.len() < 2_000_000, "{}", body.len());
    for path in ["/v1/meshes", "/v1/structures", "/v1/estimate", "/v1/meshes?check=strict"] {
        wait_for("the memory to be returned", || server.metric("molmesh_memory_held_bytes", &[]) == 0.0);
        let refused = server.post(path, &[], &body);
        let problem = refused.problem(422, "too-much-memory");
        assert_eq!(problem["limit"], 8_000_000, "{path}");
        assert!(problem["actual"].as_u64() > problem["limit"].as_u64(), "{problem}");
        assert!(refused.header("retry-after").is_none(), "{path}");
    }
    wait_for("the memory to be returned", || server.metric("molmesh_memory_held_bytes", &[]) == 0.0);
    assert_eq!(server.post("/v1/structures", &[], &carbons(1000)).status, 201);
}

#[test]
fn abandoned_uploads_are_read_one_at_a_time_and_cancelled() {
    let server = fake(|c| c.jobs.workers = 1);
    let body = compressed_atoms(300_000);
    let head = format!("POST /v1/structures HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len());
    let mut most: f64 = 0.0;
    let mut measure = || most = most.max(server.metric("molmesh_memory_held_bytes", &[]));
    for _ in 0..4 {
        let mut stream = connect(server.addr);
        stream.write_all(&[head.as_bytes(), &body].concat()).unwrap();
        for _ in 0..5 {
            std::thread::sleep(Duration::from_millis(10));
            measure();
        }
    }
    wait_for("the readings to stop", || {
        measure();
        server.metric("molmesh_memory_held_bytes", &[]) == 0.0
    });
    // A reading holds 50 MB while its text grows from 17 to 34 MB, or 34 MB and 18 MB of atoms.
    assert!(most > 10e6 && most < 60e6 + 4.0 * body.len() as f64 && body.len() < 8_000_000, "{most}");
    assert_eq!(server.post("/v1/structures", &[], &carbons(1000)).status, 201);
}

#[test]
fn buffers_of_connections_count_as_memory() {
    let server = fake(|c| c.limits.memory_bytes = 10 * CONNECTION_BYTES);
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    let idle: Vec<_> = (0..10).map(|_| connect(server.addr)).collect();
    wait_for("the budget is used up", || server.post("/v1/meshes", &[], SAMPLE).status == 503);
    let problem = server.post("/v1/meshes", &[], SAMPLE).problem(503, "memory-full");
    assert!(problem["actual"].as_u64().unwrap() >= 10 * CONNECTION_BYTES, "{problem}");
    assert!(problem["detail"].as_str().unwrap().contains("(limits.memory_bytes)"), "{problem}");
    assert_eq!(server.get("/livez").status, 200);
    drop(idle);
    wait_for("the buffers are freed", || server.post("/v1/meshes", &[], SAMPLE).status == 200);
}

#[test]
fn a_hundred_concurrent_clients_are_all_answered() {
    let server = fake(|_| {});
    let barrier = Barrier::new(100);
    let statuses: Vec<u16> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..100)
            .map(|n| {
                let (server, barrier) = (&server, &barrier);
                scope.spawn(move || {
                    barrier.wait();
                    let reply = server.post("/v1/meshes", &[], &sample(n));
                    assert!(reply.complete);
                    reply.status
                })
            })
            .collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    assert!(statuses.iter().all(|status| [200, 503].contains(status)), "{statuses:?}");
    assert!(statuses.iter().filter(|status| **status == 200).count() >= 60, "{statuses:?}");
}

#[test]
fn slow_readers_cannot_occupy_all_threads() {
    let server = fake(|c| c.jobs.deliveries = 1);
    let body = carbons(60_000);
    let mut stream = connect(server.addr);
    let head =
        format!("POST /v1/meshes?format=stl HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", body.len());
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&body).unwrap();
    let mut some = [0; 1000];
    stream.read_exact(&mut some).unwrap();
    let refused = server.post("/v1/meshes", &[], SAMPLE);
    assert_eq!(refused.problem(503, "too-many-deliveries")["limit"], 1);
    assert!(refused.header("retry-after").is_some());
    drop(stream);
    wait_for("the delivery has ended", || server.post("/v1/meshes", &[], SAMPLE).status == 200);
}

#[test]
fn an_idle_http2_connection_is_closed() {
    use hyper_util::rt::{TokioExecutor, TokioIo};
    let server = fake(|c| {
        c.server.header_timeout_ms = 300;
        c.server.idle_timeout_ms = 300;
    });
    let addr = server.addr;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let time = runtime.block_on(async move {
        let stream = tokio::net::TcpStream::connect(addr).await.unwrap();
        let (mut client, connection) =
            hyper::client::conn::http2::handshake(TokioExecutor::new(), TokioIo::new(stream)).await.unwrap();
        let request = hyper::Request::get(format!("http://{addr}/livez"))
            .body(http_body_util::Empty::<bytes::Bytes>::new())
            .unwrap();
        let start = Instant::now();
        let driven = tokio::spawn(connection);
        assert_eq!(client.send_request(request).await.unwrap().status().as_u16(), 200);
        tokio::time::timeout(Duration::from_secs(20), driven).await.expect("closed").unwrap().unwrap();
        start.elapsed()
    });
    assert!(time > Duration::from_millis(250), "{time:?}");
}

#[test]
fn heads_are_limited() {
    let server = fake(|_| {});
    let with = |n: usize| {
        let mut stream = connect(server.addr);
        let head = "GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\nx-long: ";
        // The server may close the connection before it has read everything.
        drop(stream.write_all(&[head.as_bytes(), &vec![b'x'; n], b"\r\n\r\n"].concat()));
        read_reply(&mut stream, false).status
    };
    let before = rejected(&server, "head-too-large");
    // A head of less than twice the limit is accepted if it arrives at once.
    assert_eq!((with(65_000), with(140_000)), (200, 431));
    wait_for("it is counted", || rejected(&server, "head-too-large") > before);
}

#[test]
fn http2_settings_announce_the_limits() {
    let server = fake(|_| {});
    let mut stream = connect(server.addr);
    // HTTP/2 preface and empty settings. The first frame of the server contains its settings (RFC 9113, 3.4).
    stream.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").unwrap();
    let mut head = [0; 9];
    stream.read_exact(&mut head).unwrap();
    assert_eq!(head[3], 4, "not a SETTINGS frame");
    let mut settings = vec![0; usize::from(u16::from_be_bytes([head[1], head[2]]))];
    stream.read_exact(&mut settings).unwrap();
    let value = |id: u8| settings.chunks(6).find(|s| s[1] == id).map(|s| u32::from_be_bytes([s[2], s[3], s[4], s[5]]));
    // Concurrent streams, and bytes of a header section.
    assert_eq!((value(3), value(6)), (Some(64), Some(64 << 10)));
}

#[test]
fn idle_event_streams_send_heartbeats() {
    let server = start(Fake::new(Mode::Held), |c| {
        (c.server.heartbeat_ms, c.server.drain_timeout_ms) = (20, 100);
    });
    let accepted = server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE);
    assert_eq!(accepted.status, 202);
    let mut stream = connect(server.addr);
    write!(stream, "GET {}/events HTTP/1.1\r\nhost: localhost\r\n\r\n", accepted.header("location").unwrap()).unwrap();
    let mut text = String::new();
    let mut some = [0; 1024];
    // Comments are lines that begin with a colon.
    while text.matches("\n:\n").count() + text.matches("\n: \n").count() < 3 {
        let n = stream.read(&mut some).unwrap();
        assert!(n > 0, "the stream ended: {text}");
        text.push_str(&String::from_utf8_lossy(&some[..n]));
    }
}

#[test]
fn requests_do_not_wait_for_asynchronous_jobs() {
    let backend = Fake::new(Mode::Held);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    for n in [2, 3] {
        assert_eq!(server.post("/v1/meshes", &[("prefer", "respond-async")], &carbons(n)).status, 202);
    }
    wait_for("an asynchronous job to run", || backend.started.load(Ordering::SeqCst) == 1);
    std::thread::scope(|scope| {
        let request = scope.spawn(|| server.post("/v1/meshes", &[], &carbons(4)).status);
        wait_for("the request to run", || backend.started.load(Ordering::SeqCst) == 2);
        backend.set(Mode::Octahedra);
        assert_eq!(request.join().unwrap(), 200);
    });
    wait_for("all to have begun", || backend.started.load(Ordering::SeqCst) == 3);
    assert_eq!(*backend.begun.lock().unwrap(), [2, 4, 3]);
}

#[test]
fn a_request_that_takes_longer_than_expected_delays_no_other() {
    let backend = Fake::new(Mode::Held);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    std::thread::scope(|scope| {
        let post = |n| server.post("/v1/meshes", &[], &carbons(n)).status;
        let long = scope.spawn(move || post(2));
        wait_for("one to run", || backend.started.load(Ordering::SeqCst) == 1);
        // The worker is not taken from it unless another job waits.
        std::thread::sleep(Duration::from_millis(300));
        assert_eq!(backend.started.load(Ordering::SeqCst), 1);
        let short = scope.spawn(move || post(3));
        wait_for("both to run", || backend.started.load(Ordering::SeqCst) == 3);
        backend.set(Mode::Octahedra);
        assert_eq!((long.join().unwrap(), short.join().unwrap()), (200, 200));
    });
    assert_eq!(backend.cancelled.load(Ordering::SeqCst), 1);
}

/// Sends concurrent requests until a result is not stored because too many are.
fn exceed_saves(server: &Running, clients: usize) {
    let busy = || server.metric("molmesh_results_not_stored_total", &["reason=\"busy\""]);
    let (before, end) = (busy(), Instant::now() + Duration::from_mins(1));
    for round in 0.. {
        std::thread::scope(|scope| {
            for n in 0..clients {
                scope.spawn(move || server.post("/v1/meshes", &[], &carbons(5_000 + 10 * round + n)).status);
            }
        });
        if busy() > before {
            break;
        }
        assert!(Instant::now() < end, "all {clients} concurrent results were stored");
    }
}

#[test]
fn concurrent_saves_are_limited() {
    exceed_saves(&fake(|c| (c.jobs.concurrent_saves, c.jobs.queue) = (1, 100)), 6);
}

#[test]
fn results_are_stored_one_by_one_while_jobs_wait() {
    exceed_saves(&fake(|c| (c.jobs.concurrent_saves, c.jobs.queue, c.jobs.workers) = (10_000, 100, 1)), 10);
}

#[test]
fn expired_objects_are_swept_at_the_configured_interval() {
    let server = fake(|c| (c.store.sweep_ms, c.store.result_ttl_ms) = (20, 1));
    let removed = || server.metric("molmesh_store_removed_total", &["reason=\"ttl\""]);
    let before = removed();
    assert_eq!(server.post("/v1/meshes", &[], SAMPLE).status, 200);
    wait_for("the result is removed", || removed() > before);
}
