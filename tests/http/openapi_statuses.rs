//! The server returns every status that the OpenAPI document lists, and no other. Each scenario provokes some of the
//! statuses; at the end, every documented one must have been returned.

use crate::access_support;
use crate::archive_support;
use crate::http_support;
use crate::openapi_support;

use std::io::Write as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use archive_support::{Remote, status};
use http_support::{
    Fake, LONG, Mode, Reply, Running, SAMPLE, connect, read_reply, sample, send, start, start_cold, wait_for,
};
use molmesh::config::Config;
use molmesh::surface::CpuBackend;
use openapi_support::Seen;

const LATER: (&str, &str) = ("prefer", "respond-async");
const JSON: (&str, &str) = ("content-type", "application/json");
/// Path of a job that does not exist.
const NO_JOB: &str = "/v1/jobs/00000000000000000000000000000000";
/// Digest and key that do not exist.
const ZERO: &str = "0000000000000000000000000000000000000000000000000000000000000000";

fn fake(mode: Mode, change: impl FnOnce(&mut Config)) -> Running {
    let server = start(Fake::new(mode), change);
    archive(server.dir.path(), "4pti", SAMPLE);
    server
}

/// Puts an entry into a server's folder of structures.
fn archive(dir: &Path, id: &str, bytes: &[u8]) {
    let folder = dir.join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join(format!("{id}.pdb")), bytes).unwrap();
}

/// Documents of an entry or a stored structure.
const DOCUMENTS: [&str; 5] = ["atoms", "colors?scheme=chain", "areas?surface=sas", "tileset.json", "tileset.subtree"];

/// Operations that take a structure.
const UPLOADS: [&str; 5] = ["/v1/meshes", "/v1/report", "/v1/estimate", "/v1/areas?surface=sas", "/v1/structures"];

fn location(reply: &Reply) -> String {
    reply.header("location").unwrap().to_owned()
}

/// Starts a job and waits for its end.
fn ended(seen: &Seen, server: &Running, body: &[u8]) -> String {
    let job = location(&seen.expect(202, server.addr, ("POST", "/v1/meshes"), &[LATER], body));
    let reply = seen.expect(200, server.addr, ("GET", &format!("{job}?wait=20")), &[], b"");
    assert!(!reply.json()["finished"].is_null(), "{}", reply.text());
    job
}

/// Requests without parameters, and paths that are not UTF-8.
fn plain(seen: &Seen, server: &Running) {
    let paths: Vec<_> = seen.described().filter(|(m, p)| *m == "GET" && !p.contains('{')).collect();
    assert!(paths.len() >= 5, "{paths:?}");
    for (method, path) in paths {
        seen.expect(200, server.addr, (method, path), &[], b"");
    }
    for (method, path) in seen.described().filter(|(_, path)| path.contains('{')) {
        let path = path.replace("{file}", "%ff").replace("{id}", "%ff").replace("{digest}", "%ff");
        let path = path.replace("{slug}", "%ff").replace("{key}", "%ff");
        seen.expect(400, server.addr, (method, &path), &[], b"");
    }
    seen.expect(400, server.addr, ("GET", "/v1/capabilities?x=1"), &[], b"");
    seen.expect(200, server.addr, ("GET", "/problems/internal"), &[], b"");
    seen.expect(404, server.addr, ("GET", "/problems/none"), &[], b"");
    // The web page is not part of the document.
    for (path, status) in [("/assets/icon.svg", 200), ("/assets/none.js", 404), ("/assets/%ff", 400)] {
        assert_eq!(server.get(path).status, status, "{path}");
    }
}

/// Valid and invalid uploads.
fn uploads(seen: &Seen, server: &Running) {
    let addr = server.addr;
    seen.expect(201, addr, ("POST", "/v1/structures"), &[], SAMPLE);
    let form = ("content-type", "multipart/form-data; boundary=XX");
    for path in UPLOADS {
        seen.expect(200, addr, ("POST", path), &[], SAMPLE);
        seen.expect(400, addr, ("POST", path), &[form], b"--XX--\r\n");
        seen.expect(415, addr, ("POST", path), &[("content-encoding", "br")], SAMPLE);
        seen.expect(422, addr, ("POST", path), &[], b"nothing");
    }
    let post = ("POST", "/v1/meshes");
    seen.expect(202, addr, post, &[LATER], SAMPLE);
    seen.expect(406, addr, post, &[("accept", "image/webp")], SAMPLE);
    let octets = seen.expect(200, addr, post, &[("accept", "application/octet-stream")], SAMPLE);
    assert_eq!(octets.header("content-type"), Some("application/octet-stream"));
    // An estimate is JSON for every `Accept`.
    seen.expect(200, addr, ("POST", "/v1/estimate"), &[("accept", "application/json")], SAMPLE);
    for path in &UPLOADS[..4] {
        seen.expect(404, addr, ("POST", path), &[JSON], br#"{"pdb_id": "9xyz"}"#);
    }
}

/// Meshes, reports and documents of entries and stored structures.
fn surfaces(seen: &Seen, server: &Running) {
    let structure = location(&seen.ask(server.addr, "POST", "/v1/structures", &[], SAMPLE));
    for base in [structure.as_str(), "/v1/pdb/4pti"] {
        let path = format!("{base}/surface.glb");
        let get = |path: &str, headers: &[(&str, &str)], status: u16| {
            seen.expect(status, server.addr, ("GET", path), headers, b"")
        };
        get(&path, &[LATER], 202);
        let whole = get(&path, &[], 200);
        let varies = |reply: &Reply| reply.headers.iter().any(|(name, value)| name == "vary" && value == "accept");
        assert_eq!((whole.header("content-type"), varies(&whole)), (Some("model/gltf-binary"), false));
        let octets = get(&path, &[("accept", "application/octet-stream")], 200);
        let found = (octets.header("content-type"), varies(&octets), octets.body == whole.body);
        assert_eq!(found, (Some("application/octet-stream"), true, true));
        get(&path, &[("if-none-match", whole.header("etag").unwrap())], 304);
        let kept = whole.header("content-location").unwrap();
        get(kept, &[], 200);
        get(&path, &[("range", "bytes=0-9")], 206);
        get(&path, &[("range", "bytes=99999999-")], 416);
        let report = format!("{base}/report.json");
        get(&report, &[], 200);
        get(&format!("{report}?x=1"), &[], 400);
        get(&format!("{report}?chains=Z"), &[], 422);
        get(&format!("{base}/surface.exe"), &[], 404);
        get(&format!("{path}?x=1"), &[], 400);
        get(&format!("{path}?chains=Z"), &[], 422);
        // The stored result at its own address.
        get(kept, &[("range", "bytes=0-9")], 206);
        get(kept, &[("range", "bytes=99999999-")], 416);
        get(kept, &[("if-none-match", "*")], 304);
        get(kept, &[("if-none-match", "*"), ("range", "bytes=0-9")], 304);
        // `If-Match`: only a matching `ETag` is accepted.
        let other = [("if-match", "\"other\""), ("if-none-match", "*")];
        for path in [&path, kept, &format!("{base}/atoms"), &kept.replace(".glb", "/report.json")] {
            get(path, &other, 412).problem(412, "precondition-failed");
            let etag = get(path, &[("if-match", "*")], 200).header("etag").unwrap().to_owned();
            get(path, &[("if-match", &etag)], 200);
            get(path, &[("if-match", &format!("W/{etag}"))], 412);
        }
        get(&format!("{base}/surface.ply"), &other[..1], 412);
        get(&format!("{base}/report.json"), &[("if-match", "\"other\"")], 200);
        for document in DOCUMENTS {
            let path = format!("{base}/{document}");
            let whole = get(&path, &[], 200);
            get(&path, &[("if-none-match", whole.header("etag").unwrap())], 304);
            get(&path, &[("if-match", "\"other\"")], 412);
            get(&format!("{path}{}x=1", if path.contains('?') { '&' } else { '?' }), &[], 400);
        }
        let [colors, areas] = [1, 2].map(|i| format!("{base}/{}", DOCUMENTS[i]));
        get(&colors, &[("range", "bytes=0-9")], 206);
        get(&colors, &[("range", "bytes=99999999-")], 416);
        assert_eq!(get(&areas, &[], 200).header("content-type"), Some("text/csv"));
        // Required parameters.
        get(&format!("{base}/colors"), &[], 400);
        get(&format!("{base}/areas"), &[], 400);
        for query in [
            "colors?scheme=chain&chains=Z",
            "areas?surface=sas&interface=A,Z",
            "areas?surface=sas&chains=Z",
            "atoms?positions=true&chains=Z",
            "tileset.json?chains=Z",
            "tileset.subtree?chains=Z",
        ] {
            get(&format!("{base}/{query}"), &[], 422);
        }
        let report = kept.replace(".glb", "/report.json");
        let tag = get(&report, &[], 200).header("etag").unwrap().to_owned();
        get(&report, &[("if-none-match", &tag)], 304);
    }
    let get =
        |path: &str, headers: &[(&str, &str)], status| seen.expect(status, server.addr, ("GET", path), headers, b"");
    let etag = get(&structure, &[], 200).header("etag").unwrap().to_owned();
    get(&structure, &[("if-none-match", &etag)], 304);
    get(&structure, &[("if-match", "\"other\"")], 412);
    get(&format!("/v1/structures/{ZERO}"), &[], 404);
    for document in DOCUMENTS {
        get(&format!("/v1/structures/{ZERO}/{document}"), &[], 404);
        get(&format!("/v1/pdb/9xyz/{document}"), &[], 404);
    }
    get("/v1/pdb/9xyz/report.json", &[], 404);
    get(&format!("/v1/structures/{ZERO}/report.json"), &[], 404);
    get(&format!("/v1/results/{ZERO}.glb"), &[], 404);
    get(&format!("/v1/results/{ZERO}/report.json"), &[], 404);
}

/// Jobs that succeed, fail, are cancelled or exceed their deadline.
fn jobs(seen: &Seen) {
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, |c| c.limits.inflated_bytes = 100_000);
    let get = |path: &str, status| seen.expect(status, server.addr, ("GET", path), &[], b"");
    let result = |job: &str, status| get(&format!("{job}/result"), status);
    let job = ended(seen, &server, SAMPLE);
    result(&job, 303);
    seen.expect(409, server.addr, ("DELETE", &job), &[], b"");
    let events = get(&format!("{job}/events"), 200).text();
    let last = events.lines().find_map(|line| line.strip_prefix("id: ")).unwrap().to_owned();
    let events = format!("{job}/events");
    seen.expect(204, server.addr, ("GET", &events), &[("last-event-id", &last)], b"");
    for path in [NO_JOB, &format!("{NO_JOB}/events"), &format!("{NO_JOB}/result")] {
        get(path, 404);
    }
    seen.expect(404, server.addr, ("DELETE", NO_JOB), &[], b"");
    // A damaged record.
    let damaged = "1".repeat(32);
    std::fs::write(server.dir.path().join(format!("store/jobs/{damaged}.json")), "{").unwrap();
    for path in ["", "/events", "/result"] {
        get(&format!("/v1/jobs/{damaged}{path}"), 500);
    }
    seen.expect(500, server.addr, ("DELETE", &format!("/v1/jobs/{damaged}")), &[], b"");
    get(&format!("{NO_JOB}?wait=1000"), 400);
    get("/v1/jobs?limit=0", 400);
    // A job without a result ends with the problem of a synchronous request.
    result(&ended(seen, &server, format!("HEADER{}", " ".repeat(100_001)).as_bytes()), 413);
    result(&ended(seen, &server, b"HEADER\nnothing"), 422);
    backend.set(Mode::Panic);
    result(&ended(seen, &server, &sample(1)), 500);
    backend.set(Mode::Slow(Duration::from_secs(30)));
    let job = location(&seen.expect(202, server.addr, ("POST", "/v1/meshes"), &[LATER], &sample(2)));
    result(&job, 404);
    seen.expect(200, server.addr, ("DELETE", &job), &[], b"");
    result(&job, 410);
    let late = fake(Mode::Slow(Duration::from_secs(30)), |c| c.jobs.batch_deadline_ms = 200);
    let job = ended(seen, &late, SAMPLE);
    seen.expect(504, late.addr, ("GET", &format!("{job}/result")), &[], b"");
}

/// Batches that succeed, are cancelled or are refused.
fn batches(seen: &Seen) {
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, |c| (c.broker.queue, c.jobs.workers) = (2, 1));
    let addr = server.addr;
    let archive = |n: usize| {
        let mut builder = tar::Builder::new(Vec::new());
        for n in [n, n + 1] {
            let mut header = tar::Header::new_gnu();
            header.set_size(sample(n).len() as u64);
            builder.append_data(&mut header, format!("{n}.pdb"), &sample(n)[..]).unwrap();
        }
        builder.into_inner().unwrap()
    };
    let post = ("POST", "/v1/batches");
    let key = [("idempotency-key", "k")];
    let batch = location(&seen.expect(202, addr, post, &key, &archive(0)));
    seen.expect(422, addr, post, &key, &archive(10));
    seen.expect(415, addr, post, &[("content-encoding", "br")], &archive(0));
    seen.expect(400, addr, post, &[], b"nothing");
    let get = |path: &str, headers: &[(&str, &str)], status| seen.expect(status, addr, ("GET", path), headers, b"");
    get(&format!("{batch}/results.tar"), &[], 200);
    get(&batch, &[], 200);
    get(&format!("{batch}?limit=9999"), &[], 400);
    get(&format!("{batch}/events"), &[], 200);
    get(&format!("{batch}/events"), &[("last-event-id", "end")], 204);
    seen.expect(409, addr, ("DELETE", &batch), &[], b"");
    let damaged = "1".repeat(32);
    std::fs::write(server.dir.path().join(format!("store/jobs/{damaged}.batch.json")), "{").unwrap();
    for (id, status) in [(&damaged, 500), (&"0".repeat(32), 404)] {
        for path in ["", "/events", "/results.tar"] {
            get(&format!("/v1/batches/{id}{path}"), &[], status);
        }
        seen.expect(status, addr, ("DELETE", &format!("/v1/batches/{id}")), &[], b"");
    }
    backend.set(Mode::Held);
    let held = location(&seen.expect(202, addr, post, &[], &archive(20)));
    wait_for("one runs", || get(&held, &[], 200).json()["counts"]["running"] == 1);
    seen.expect(503, addr, post, &[], &archive(30));
    seen.expect(200, addr, ("DELETE", &held), &[], b"");
    break_store(server.dir.path());
    for path in ["", "/events", "/results.tar"] {
        get(&format!("{batch}{path}"), &[], 503);
    }
    seen.expect(503, addr, ("DELETE", &batch), &[], b"");
}

/// Limits of bodies and atom lists, and an archive that fails.
fn sizes(seen: &Seen) {
    let small = fake(Mode::Octahedra, |c| {
        c.limits.body_bytes = 100;
        c.limits.inflated_bytes = 100;
        c.server.body_timeout_ms = 200;
    });
    for path in UPLOADS.into_iter().chain(["/v1/batches"]) {
        seen.expect(413, small.addr, ("POST", path), &[], SAMPLE);
        let mut stream = connect(small.addr);
        let head =
            format!("POST {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-length: 10\r\n\r\nATOM");
        stream.write_all(head.as_bytes()).unwrap();
        let late = read_reply(&mut stream, false);
        assert_eq!(late.status, 408);
        seen.note("POST", path, &late).unwrap();
    }
    seen.expect(413, small.addr, ("GET", "/v1/pdb/4pti/surface.glb"), &[], b"");
    for document in DOCUMENTS {
        seen.expect(413, small.addr, ("GET", &format!("/v1/pdb/4pti/{document}")), &[], b"");
    }
    seen.expect(413, small.addr, ("GET", "/v1/pdb/4pti/report.json"), &[], b"");
    let remote = Remote::saying(status(500));
    let away = fake(Mode::Octahedra, |c| {
        c.archive.url = Some(remote.url("/{id}.cif").parse().unwrap());
        c.archive.allow_private = true;
        c.archive.attempts = 1;
    });
    seen.expect(424, away.addr, ("GET", "/v1/pdb/9xyz/surface.glb"), &[], b"");
    for document in DOCUMENTS {
        seen.expect(424, away.addr, ("GET", &format!("/v1/pdb/9xyz/{document}")), &[], b"");
    }
    seen.expect(424, away.addr, ("GET", "/v1/pdb/9xyz/report.json"), &[], b"");
    let few = fake(Mode::Octahedra, |c| c.limits.labels = 10);
    seen.expect(422, few.addr, ("GET", "/v1/pdb/4pti/atoms"), &[], b"");
    for path in &UPLOADS[..4] {
        seen.expect(424, away.addr, ("POST", path), &[JSON], br#"{"pdb_id": "9xyz"}"#);
    }
    seen.expect(424, away.addr, ("POST", "/v1/batches"), &[JSON], br#"{"pdb_ids": ["9xyz"]}"#);
}

/// Backends that panic or do not end, a full queue, and exhausted memory.
fn failures(seen: &Seen) {
    for (mode, status) in [(Mode::Panic, 500), (Mode::Slow(Duration::from_secs(30)), 504)] {
        let server = fake(mode, |c| c.jobs.deadline_ms = 300);
        let structure = location(&seen.ask(server.addr, "POST", "/v1/structures", &[], SAMPLE));
        for path in &UPLOADS[..3] {
            seen.expect(status, server.addr, ("POST", path), &[], SAMPLE);
        }
        for path in ["surface.stl", "report.json"] {
            for base in [&structure, "/v1/pdb/4pti"] {
                seen.expect(status, server.addr, ("GET", &format!("{base}/{path}")), &[], b"");
            }
        }
    }
    let backend = Fake::new(Mode::Slow(Duration::from_secs(2)));
    let full = &start(Arc::clone(&backend) as _, |c| (c.jobs.workers, c.jobs.queue) = (1, 1));
    archive(full.dir.path(), "4pti", SAMPLE);
    std::thread::scope(|scope| {
        for n in [1, 2] {
            scope.spawn(move || full.post(LONG, &[], &sample(n)));
        }
        wait_for("one runs", || backend.started.load(Ordering::SeqCst) == 1);
        wait_for("one waits", || full.metric("molmesh_queue_depth", &[]) >= 1.0);
        seen.expect(503, full.addr, ("POST", LONG), &[], &sample(3));
        seen.expect(503, full.addr, ("GET", "/v1/pdb/4pti/surface.glb?resolution=0.2"), &[], b"");
        seen.expect(503, full.addr, ("GET", "/v1/pdb/4pti/report.json?resolution=0.2"), &[], b"");
    });
    // The request alone exceeds the first limit, and together with other connections the second one.
    for (memory_bytes, connections, status) in [(1_000, 0, 422), (1 << 20, 4, 503)] {
        let crowded = fake(Mode::Octahedra, |c| c.limits.memory_bytes = memory_bytes);
        let _idle: Vec<_> = (0..connections).map(|_| connect(crowded.addr)).collect();
        for document in DOCUMENTS {
            seen.expect(status, crowded.addr, ("GET", &format!("/v1/pdb/4pti/{document}")), &[], b"");
        }
        for path in UPLOADS {
            seen.expect(status, crowded.addr, ("POST", path), &[], SAMPLE);
        }
    }
}

/// Change of the configuration of a server.
type Change = fn(&mut Config);

/// Objects stored under other limits, and a failing store.
fn restarts(seen: &Seen) {
    let folder = tempfile::tempdir().unwrap();
    let begin = |change: fn(&mut Config)| {
        start(Fake::new(Mode::Octahedra), |c| {
            folder.path().clone_into(&mut c.server.data_dir);
            c.store.memory_bytes = 0;
            change(c);
        })
    };
    let server = begin(|_| {});
    let structure = location(&seen.ask(server.addr, "POST", "/v1/structures", &[], SAMPLE));
    let surface = format!("{structure}/surface.glb");
    let job = ended(seen, &server, SAMPLE);
    let reply = seen.ask(server.addr, "GET", &format!("{job}/result"), &[], b"");
    let result = location(&reply);
    assert!(server.join());

    let get = |server: &Running, path: &str, status| seen.expect(status, server.addr, ("GET", path), &[], b"");
    let server = begin(|c| c.limits.inflated_bytes = 1_000);
    get(&server, &structure, 413);
    for document in DOCUMENTS {
        get(&server, &format!("{structure}/{document}"), 413);
    }
    get(&server, &format!("{surface}?resolution=2"), 413);
    get(&server, &format!("{structure}/report.json"), 413);
    assert!(server.join());
    let server = begin(|c| c.limits.atoms = 10);
    get(&server, &structure, 422);
    get(&server, &format!("{structure}/atoms"), 422);
    assert!(server.join());
    let tight: [(Change, usize, u16); 2] =
        [(|c| c.limits.memory_bytes = 1_000, 0, 422), (|c| c.limits.memory_bytes = 1 << 20, 4, 503)];
    for (change, connections, status) in tight {
        let server = begin(change);
        let _idle: Vec<_> = (0..connections).map(|_| connect(server.addr)).collect();
        get(&server, &structure, status);
        for document in DOCUMENTS {
            get(&server, &format!("{structure}/{document}"), status);
        }
        if status == 503 {
            get(&server, &format!("{surface}?resolution=2"), status);
            get(&server, &format!("{structure}/report.json"), status);
        }
        assert!(server.join());
    }

    let server = begin(|_| {});
    break_store(folder.path());
    let report = result.replace(".glb", "/report.json");
    for path in ["/v1/jobs", &job, &format!("{job}/events"), &format!("{job}/result"), &result, &report] {
        get(&server, path, 503);
    }
    seen.expect(503, server.addr, ("DELETE", &job), &[], b"");
}

/// Keys and quotas: every operation without a key, with a key that lacks its scope, and beyond the quota.
fn rights(seen: &Seen) {
    let keys = access_support::Keys::new(&[
        ("reads", "read", ""),
        ("makes", "mesh", ""),
        ("once", "mesh,read", "requests = 1\nwindow_s = 86400"),
    ]);
    let server = fake(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let once = [("x-api-key", keys.text("once"))];
    assert_eq!(send(server.addr, "GET", "/v1/capabilities", &once, b"").status, 200);
    let operations: Vec<_> = seen.described().filter(|(_, path)| path.starts_with("/v1/")).collect();
    assert!(operations.len() > 10, "{operations:?}");
    for (method, path) in operations {
        let path = path.replace("{file}", "surface.glb").replace(['{', '}'], "");
        let ask = |status, headers: &[(&str, &str)]| seen.expect(status, server.addr, (method, &path), headers, b"");
        ask(401, &[]);
        let others =
            ["reads", "makes"].map(|id| send(server.addr, method, &path, &[("x-api-key", keys.text(id))], b""));
        let refused = others.iter().filter(|reply| reply.status == 403).inspect(|reply| {
            seen.note(method, &path, reply).unwrap_or_else(|wrong| panic!("{wrong}"));
        });
        assert_eq!(refused.count(), 1, "{method} {path} needs one scope");
        ask(429, &once);
    }
}

/// Replaces the folders of the store by files.
fn break_store(dir: &Path) {
    for folder in ["inputs", "jobs", "results"].map(|name| dir.join("store").join(name)) {
        std::fs::rename(&folder, folder.with_extension("away")).unwrap();
        std::fs::write(&folder, b"no folder").unwrap();
    }
}

#[test]
fn the_server_returns_every_documented_status_and_no_other() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    archive(server.dir.path(), "4pti", SAMPLE);
    let seen = Seen::of(&server.get("/openapi.json").json());
    plain(&seen, &server);
    uploads(&seen, &server);
    surfaces(&seen, &server);
    jobs(&seen);
    batches(&seen);
    sizes(&seen);
    failures(&seen);
    restarts(&seen);
    rights(&seen);
    let cold = Fake::new(Mode::NoSurface);
    cold.also_warm.store(true, Ordering::SeqCst);
    let cold = start_cold(cold, |_| {});
    wait_for("the listener", || cold.get("/livez").status == 200);
    seen.expect(503, cold.addr, ("GET", "/readyz"), &[], b"");
    assert_eq!(seen.unseen(), Vec::<String>::new(), "documented but never returned");
}

#[test]
fn control_undocumented_and_missing_responses_are_reported() {
    let server = fake(Mode::Octahedra, |_| {});
    let mut description = server.get("/openapi.json").json();
    let live = server.get("/livez");
    let seen = Seen::of(&description);
    assert!(seen.note("GET", "/livez", &live).is_ok());
    assert!(
        seen.unseen().contains(&"GET /version: 200".to_owned())
            && !seen.unseen().contains(&"GET /livez: 200".to_owned())
    );
    assert!(seen.note("GET", "/nowhere", &live).unwrap_err().contains("is not documented"));
    let gone = server.get(NO_JOB);
    assert!(seen.note("GET", NO_JOB, &gone).is_ok());
    let responses = &mut description["paths"]["/v1/jobs/{id}"]["get"]["responses"];
    responses["404"] = serde_json::json!({ "$ref": "#/components/responses/NotFound" });
    assert!(Seen::of(&description).note("GET", NO_JOB, &gone).unwrap_err().contains("not one of"));
    let responses = &mut description["paths"]["/v1/jobs/{id}"]["get"]["responses"];
    responses.as_object_mut().unwrap().remove("404");
    assert!(Seen::of(&description).note("GET", NO_JOB, &gone).unwrap_err().contains("404 is not documented"));
}
