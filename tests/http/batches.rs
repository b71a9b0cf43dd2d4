//! Batches: archives and lists of ids, results as they finish, restarts, cancellation, hostile archives.

use crate::access_support::Keys;
use crate::http_support;
use crate::jobs_durable::{Process, ask};

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, gzip, sample, send, start, wait_for};
use molmesh::config::Config;
use serde_json::Value;

const BATCHES: &str = "/v1/batches";

/// Writes a tar archive. Names are not checked, and kinds are those of tar.
fn tar_of(entries: &[(&str, u8, &[u8])]) -> Vec<u8> {
    let mut builder = tar::Builder::new(Vec::new());
    for (name, kind, bytes) in entries {
        let mut header = tar::Header::new_gnu();
        header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
        header.set_entry_type(tar::EntryType::new(*kind));
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_cksum();
        builder.append(&header, *bytes).unwrap();
    }
    builder.into_inner().unwrap()
}

fn tar(files: &[(&str, &[u8])]) -> Vec<u8> {
    tar_of(&files.iter().map(|(name, bytes)| (*name, b'0', *bytes)).collect::<Vec<_>>())
}

/// Archive of `n` samples, which differ.
fn samples(n: usize) -> Vec<u8> {
    let files: Vec<_> = (0..n).map(|i| (format!("{i:03}.pdb"), sample(i))).collect();
    tar(&files.iter().map(|(name, bytes)| (name.as_str(), &bytes[..])).collect::<Vec<_>>())
}

fn zip(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut archive = rawzip::ZipArchiveWriter::new(&mut bytes);
    for (name, content) in files {
        let method = rawzip::CompressionMethod::DEFLATE;
        let (mut entry, config) = archive.new_file(*name).compression_method(method).start().unwrap();
        let encoder = flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::fast());
        let mut writer = config.wrap(encoder);
        writer.write_all(content).unwrap();
        let (encoder, descriptor) = writer.finish().unwrap();
        encoder.finish().unwrap();
        entry.finish(descriptor).unwrap();
    }
    archive.finish().unwrap();
    bytes
}

/// Server without a remote archive, with `4pti` in its folder.
fn fake(mode: Mode, change: impl FnOnce(&mut Config)) -> (Arc<Fake>, Running) {
    let backend = Fake::new(mode);
    let server = start(Arc::clone(&backend) as _, change);
    std::fs::create_dir_all(server.dir.path().join("archive")).unwrap();
    std::fs::write(server.dir.path().join("archive/4pti.pdb"), SAMPLE).unwrap();
    (backend, server)
}

/// Starts a batch and returns its path.
#[track_caller]
fn accepted(server: &Running, query: &str, headers: &[(&str, &str)], body: &[u8]) -> String {
    let reply = server.post(&format!("{BATCHES}{query}"), headers, body);
    assert_eq!(reply.status, 202, "{}", reply.text());
    let path = reply.header("location").unwrap().to_owned();
    assert_eq!(path, format!("{BATCHES}/{}", reply.json()["batchID"].as_str().unwrap()));
    path
}

/// Files of an archive of results, and the lines of its summary by input.
struct Results {
    names: Vec<String>,
    files: BTreeMap<String, Vec<u8>>,
    lines: Vec<Value>,
}

impl Results {
    #[track_caller]
    fn of(body: &[u8]) -> Self {
        let (mut names, mut files) = (Vec::new(), BTreeMap::new());
        for entry in tar::Archive::new(body).entries().unwrap() {
            let mut entry = entry.unwrap();
            let (name, mut bytes) = (String::from_utf8(entry.path_bytes().into_owned()).unwrap(), Vec::new());
            entry.read_to_end(&mut bytes).unwrap();
            assert!(files.insert(name.clone(), bytes).is_none(), "{name} is there twice");
            names.push(name);
        }
        assert_eq!(names.last().map(String::as_str), Some("summary.jsonl"));
        let lines = String::from_utf8(files["summary.jsonl"].clone()).unwrap();
        Self { names, files, lines: lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect() }
    }

    #[track_caller]
    fn get(server: &Running, batch: &str) -> Self {
        let reply = server.get(&format!("{batch}/results.tar"));
        assert!(reply.status == 200 && reply.complete, "{:?}", reply.headers);
        assert_eq!(reply.header("content-type"), Some("application/octet-stream"));
        Self::of(&reply.body)
    }

    /// Returns the inputs that failed, with the names of their problem types and texts.
    fn failed(&self) -> Vec<(&str, &str, &str)> {
        let failed = self.lines.iter().filter(|line| line["status"] == "failed");
        let text = |value: &'_ Value| value.as_str().unwrap_or_default().to_owned();
        failed
            .map(|line| {
                assert_eq!(text(&line["error"]), text(&line["problem"]["detail"]));
                let slug = line["problem"]["type"].as_str().unwrap().trim_start_matches("/problems/");
                (line["input"].as_str().unwrap(), slug, line["error"].as_str().unwrap())
            })
            .collect()
    }
}

#[test]
fn a_batch_gives_the_results_of_its_files_in_order() {
    let (_, server) = fake(Mode::Slow(Duration::from_millis(100)), |_| {});
    let files: Vec<Vec<u8>> = (0..3).map(sample).collect();
    let long = format!("{}/last.pdb", "long-name".repeat(15));
    let mut archive = tar::Builder::new(Vec::new());
    let no_atoms: &[u8] = b"HEADER\nnothing\n";
    for (name, bytes) in [
        ("b/1.pdb", &files[0][..]),
        ("a/2.pdb.gz", &gzip(&files[1])),
        ("broken.pdb", no_atoms),
        ("notes.txt", b"no structure"),
        (&long, &files[2]),
    ] {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        archive.append_data(&mut header, name, bytes).unwrap();
    }
    let query = "?outputs=stl,png,areas&surface=sas&width=64&height=64&by=chain&units=nanometer";
    let batch = accepted(&server, query, &[], &archive.into_inner().unwrap());
    // The results are requested before the batch has ended.
    let results = Results::get(&server, &batch);
    let expected: Vec<String> = ["b/1", "a/2", long.trim_end_matches(".pdb")]
        .iter()
        .flat_map(|stem| ["stl", "png", "csv"].map(|end| format!("{stem}.{end}")))
        .chain(["summary.jsonl".to_owned()])
        .collect();
    assert_eq!(results.names, expected);
    let failed = results.failed();
    assert_eq!(failed[0].0, "broken.pdb");
    assert!(matches!(failed[1], ("notes.txt", "unreadable-structure", _)) && failed.len() == 2, "{failed:?}");
    assert_eq!(
        results.lines[0]["files"][2],
        serde_json::json!({ "file": "b/1.csv", "bytes": results.files["b/1.csv"].len() })
    );
    // The same bytes as from single requests.
    let mesh = server.post("/v1/meshes?format=stl&surface=sas&units=nanometer", &[], &files[1]);
    assert_eq!((mesh.status, mesh.body == results.files["a/2.stl"]), (200, true));
    assert!(results.files["b/1.png"].starts_with(b"\x89PNG"));
    let report = results.lines[0]["files"][0]["report"].as_str().unwrap();
    assert_eq!(server.get(report).json()["file_units"], "nanometer");
    let entry = server.get("/v1/pdb/4pti/areas?surface=sas&by=chain");
    assert_eq!(results.files["b/1.csv"], entry.body);

    let state = server.get(&format!("{batch}?limit=2&offset=1")).json();
    assert_eq!((&state["status"], &state["progress"], &state["files"]), (&"successful".into(), &100.into(), &5.into()));
    assert_eq!((&state["counts"]["successful"], &state["counts"]["failed"]), (&3.into(), &2.into()));
    assert_eq!(state["outputs"], serde_json::json!(["stl", "png", "areas"]));
    let next = state["links"].as_array().unwrap().iter().find(|link| link["rel"] == "next").unwrap();
    assert_eq!(next["href"], format!("{batch}?offset=3&limit=2"));
    let members = &state["members"];
    assert_eq!((&members[0]["file"], &members[0]["jobs"][1]["format"]), (&"a/2.pdb.gz".into(), &"png".into()));
    assert_eq!((&members[1]["status"], members[1]["problem"]["type"].is_string()), (&"failed".into(), true));
    let job = server.get(&format!("/v1/jobs/{}", members[0]["jobs"][0]["jobID"].as_str().unwrap())).json();
    assert_eq!((&job["status"], &job["structure"]), (&"successful".into(), &members[0]["structure"]));
    // Events hold the state without members.
    let events = server.get(&format!("{batch}/events")).text();
    assert!(events.contains("event: successful") && events.contains("id: end") && events.contains("\"members\":[]"));
    let seen = [("last-event-id", "end")];
    assert_eq!(send(server.addr, "GET", &format!("{batch}/events"), &seen, b"").status, 204);
    send(server.addr, "DELETE", &batch, &[], b"").problem(409, "job-ended");
    for (query, name) in [("limit=1001", "limit"), ("limit=0", "limit"), ("offset=x", "offset")] {
        assert_eq!(server.get(&format!("{batch}?{query}")).problem(400, "bad-parameter")["parameter"], name);
    }
}

#[test]
fn archives_of_every_kind_and_lists_of_ids_are_accepted() {
    let (backend, server) = fake(Mode::Octahedra, |c| c.store.memory_bytes = 0);
    let files: [(&str, &[u8]); 2] = [("a.pdb", SAMPLE), ("b.pdb", &sample(1))];
    for body in [tar(&files), gzip(&tar(&files)), zip(&files)] {
        // Defaults are accepted for outputs without the parameter.
        let results = Results::get(&server, &accepted(&server, "?by=residue&width=512", &[], &body));
        assert_eq!(results.names, ["a.glb", "b.glb", "summary.jsonl"]);
    }
    assert_eq!(backend.started.load(Ordering::SeqCst), 2, "stored results are used again");
    let json = [("content-type", "application/json")];
    let ids = br#"{"pdb_ids": ["4PTI", "9xyz", "x", "4pti"], "outputs": ["glb", "areas"], "surface": "vdw"}"#;
    let results = Results::get(&server, &accepted(&server, "", &json, ids));
    assert_eq!(results.names, ["4pti.glb", "4pti.csv", "summary.jsonl"]);
    let slugs: Vec<_> = results.failed().iter().map(|(input, slug, _)| (*input, *slug)).collect();
    assert_eq!(slugs, [("9xyz", "not-in-archive"), ("x", "bad-parameter"), ("4pti", "bad-request")]);
    for (query, body) in
        [("", "{}"), ("", r#"{"pdb_ids": "4pti", "x": 1}"#), ("?format=stl", r#"{"pdb_ids": ["4pti"]}"#)]
    {
        assert_eq!(server.post(&format!("{BATCHES}{query}"), &json, body.as_bytes()).status, 400, "{query} {body}");
    }
    // Results that are removed are named.
    let removed = accepted(&server, "?outputs=glb,areas&surface=vdw", &[], &tar(&files));
    assert_eq!(Results::get(&server, &removed).names.len(), 5);
    let remove = |folder: &str| {
        for entry in std::fs::read_dir(server.dir.path().join("store").join(folder)).unwrap() {
            std::fs::remove_file(entry.unwrap().path()).unwrap();
        }
    };
    remove("inputs");
    let failed = |slug| {
        let results = Results::get(&server, &removed);
        assert_eq!(results.failed().iter().map(|(_, slug, _)| *slug).collect::<Vec<_>>(), [slug; 2]);
    };
    failed("no-such-structure");
    remove("results");
    failed("result-gone");
}

#[test]
fn entries_that_cannot_be_used_are_refused_by_name() {
    let (_, server) = fake(Mode::Octahedra, |c| c.limits.body_bytes = 100_000);
    let nested = tar(&[("a.pdb", b"x")]);
    let body = tar_of(&[
        ("../up.pdb", b'0', SAMPLE),
        ("/etc/passwd", b'0', b"x"),
        ("a\\b.pdb", b'0', b"x"),
        ("link.pdb", b'2', b""),
        ("hard.pdb", b'1', b""),
        ("device.pdb", b'3', b""),
        ("folder/", b'5', b""),
        ("./good.pdb", b'0', SAMPLE),
        ("good.cif", b'0', b"x"),
        ("Good.GLB/in.pdb", b'0', SAMPLE),
        ("nested.tar", b'0', &nested),
        ("empty.pdb", b'0', b""),
        ("large.pdb", b'0', &vec![b' '; 100_001]),
    ]);
    let results = Results::get(&server, &accepted(&server, "", &[], &gzip(&body)));
    assert_eq!(results.names, ["good.glb", "summary.jsonl"]);
    let found: Vec<_> = results.failed().into_iter().map(|(input, slug, _)| (input, slug)).collect();
    let expected = [
        ("../up.pdb", "bad-request"),
        ("/etc/passwd", "bad-request"),
        ("a\\b.pdb", "bad-request"),
        ("link.pdb", "bad-request"),
        ("hard.pdb", "bad-request"),
        ("device.pdb", "bad-request"),
        ("good.cif", "bad-request"),
        ("Good.GLB/in.pdb", "bad-request"),
        ("nested.tar", "unreadable-structure"),
        ("empty.pdb", "unreadable-structure"),
        ("large.pdb", "body-too-large"),
    ];
    assert_eq!(found, expected, "{:?}", results.failed());
    let detail = "`good.glb` would be a result of `good.pdb` and a folder of the results of this entry";
    assert!(results.failed().contains(&("Good.GLB/in.pdb", "bad-request", detail)), "{:?}", results.failed());
    // An encrypted and a damaged entry of a zip archive.
    let mut body =
        zip(&[("secret.pdb", SAMPLE), ("damaged.pdb", &sample(1)), ("good.pdb", &sample(2)), ("xx/x", b"x")]);
    let find = |body: &[u8], text: &[u8]| body.windows(text.len()).position(|window| window == text).unwrap();
    for (signature, flags, name) in [(b"PK\x03\x04", 6, 30), (b"PK\x01\x02", 8, 46)] {
        let at = find(&body, signature);
        assert_eq!(&body[at + name..at + name + 6], b"secret");
        body[at + flags] |= 1;
    }
    // The library that writes the archive would change this name.
    while let Some(at) = body.windows(4).position(|window| window == b"xx/x") {
        body[at..at + 2].copy_from_slice(b"..");
    }
    let at = find(&body, b"damaged.pdb");
    body[at + 200..at + 220].fill(0xff);
    let results = Results::get(&server, &accepted(&server, "", &[], &body));
    assert_eq!(results.names, ["good.glb", "summary.jsonl"]);
    let found: Vec<_> = results.failed().iter().map(|(input, ..)| *input).collect();
    assert_eq!(found, ["secret.pdb", "damaged.pdb", "../x"]);
    assert!(results.failed()[0].2.contains("encrypted"), "{:?}", results.failed());
}

#[test]
fn archives_beyond_a_limit_are_refused_as_a_whole() {
    let (_, server) = fake(Mode::Octahedra, |c| c.limits.inflated_bytes = 1 << 20);
    let post = |body: &[u8]| server.post(BATCHES, &[], body);
    let zeros = vec![0; 4 << 20];
    let bomb = post(&gzip(&tar(&[("a.pdb", SAMPLE), ("b.pdb", &zeros)]))).problem(413, "inflated-too-large");
    assert_eq!(bomb["limit"], 1 << 20);
    post(&zip(&[("a.pdb", SAMPLE), ("b.pdb", &zeros)])).problem(413, "inflated-too-large");
    // Nor is a long name held.
    let mut entries = vec![("././@LongLink", b'L', &zeros[..100_000])];
    entries.push(("a.pdb", b'0', SAMPLE));
    post(&tar_of(&entries)).problem(400, "bad-request");
    let names: Vec<String> = (0..=10_000).map(|i| format!("{i}")).collect();
    let many: Vec<(&str, &[u8])> = names.iter().map(|name| (name.as_str(), &b""[..])).collect();
    let (_, roomy) = fake(Mode::Octahedra, |_| {});
    for body in [gzip(&tar(&many)), zip(&many)] {
        assert_eq!(roomy.post(BATCHES, &[], &body).problem(413, "body-too-large")["limit"], 10_000);
    }
    let whole = tar(&[("a.pdb", SAMPLE)]);
    for bad in [&b""[..], &tar(&[]), &gzip(&whole)[..1000], &whole[..20_000], SAMPLE, &zip(&[]), b"PK\x03\x04"] {
        post(bad).problem(400, "bad-request");
    }
    post(&[&whole[..512], &[b'x'; 512]].concat()).problem(400, "bad-request");
    // Cut between two entries.
    let cut = &samples(2)[..512 * (1 + sample(0).len().div_ceil(512))];
    for bad in [cut, &gzip(cut)] {
        let detail = post(bad).problem(400, "bad-request")["detail"].clone();
        assert_eq!(detail, "the archive cannot be read: it ends without an empty block; it is not complete");
    }
    let form = [("content-type", "multipart/form-data; boundary=X")];
    server.post(BATCHES, &form, &whole).problem(415, "unsupported-media-type");
    server.post(BATCHES, &[("content-encoding", "br")], &whole).problem(415, "unsupported-encoding");
    for query in ["?outputs=exe", "?outputs=areas", "?format=glb", "?resolutoin=1", "?color=map", "?by=chain"] {
        server.post(&format!("{BATCHES}{query}"), &[], &whole).problem(400, "bad-parameter");
    }
    assert_eq!(std::fs::read_dir(server.dir.path().join("store/jobs")).unwrap().count(), 0, "nothing was accepted");
    let (_, no_disk) = fake(Mode::Octahedra, |c| c.limits.scratch_bytes = 0);
    no_disk.post(BATCHES, &[], &whole).problem(422, "too-much-memory");
}

#[test]
fn a_batch_must_fit_into_the_queue() {
    let (backend, server) = fake(Mode::Held, |c| {
        c.broker.queue = 4;
        c.jobs.workers = 1;
    });
    server.post(BATCHES, &[], &samples(5)).problem(413, "body-too-large");
    let first = accepted(&server, "", &[], &samples(4));
    wait_for("one runs", || backend.started.load(Ordering::SeqCst) == 1);
    let refused = server.post(BATCHES, &[], &tar(&[("a.pdb", &sample(10)), ("b.pdb", &sample(11))]));
    let problem = refused.problem(503, "queue-full");
    assert_eq!((&problem["limit"], &problem["actual"]), (&4.into(), &3.into()));
    assert!(refused.header("retry-after").is_some());
    // A job that is sent alone overtakes those of the batch.
    let alone = server.post("/v1/meshes", &[("prefer", "respond-async")], &sample(12));
    assert_eq!(alone.status, 202, "{}", alone.text());
    let state = server.get(&first).json();
    assert_eq!((&state["status"], &state["counts"]["accepted"]), (&"running".into(), &3.into()));
    backend.set(Mode::Octahedra);
    assert_eq!(Results::get(&server, &first).names.len(), 5);
    // At the cap of the client, records of ended jobs make room.
    let (_, capped) = fake(Mode::Octahedra, |c| c.jobs.records_per_client = 4);
    capped.post(BATCHES, &[], &samples(4)).problem(413, "body-too-large");
    for _ in 0..2 {
        assert_eq!(Results::get(&capped, &accepted(&capped, "", &[], &samples(3))).names.len(), 4);
    }
}

#[test]
fn a_cancelled_batch_ends_at_once() {
    let (backend, server) = fake(Mode::Held, |c| c.jobs.workers = 1);
    let batch = accepted(&server, "", &[], &samples(3));
    wait_for("one runs", || backend.started.load(Ordering::SeqCst) == 1);
    let (addr, path) = (server.addr, format!("{batch}/results.tar"));
    let results = std::thread::spawn(move || send(addr, "GET", &path, &[], b""));
    for _ in 0..2 {
        let cancelled = send(server.addr, "DELETE", &batch, &[], b"");
        assert_eq!((cancelled.status, &cancelled.json()["status"]), (200, &"dismissed".into()));
    }
    let results = Results::of(&results.join().unwrap().body);
    assert_eq!(results.names, ["summary.jsonl"]);
    assert_eq!(results.failed().iter().map(|(_, slug, _)| *slug).collect::<Vec<_>>(), ["job-dismissed"; 3]);
    wait_for("the work stops", || backend.cancelled.load(Ordering::SeqCst) == 1);
}

#[test]
fn a_batch_belongs_to_its_group_and_its_idempotency_key() {
    let keys = Keys::new(&[("a", "read,mesh", ""), ("b", "read,mesh", ""), ("reads", "read", "group = \"a\"")]);
    let (backend, server) = fake(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let ask = |key: &str, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]| -> Reply {
        send(server.addr, method, path, &[&[("x-api-key", keys.text(key))], headers].concat(), body)
    };
    let key = [("idempotency-key", "k")];
    let body = samples(2);
    let post = |key_id: &str, query: &str, body: &[u8]| ask(key_id, "POST", &format!("{BATCHES}{query}"), &key, body);
    let location = |reply: &Reply| reply.header("location").unwrap().to_owned();
    let batch = location(&post("a", "", &body));
    let results = Results::of(&ask("reads", "GET", &format!("{batch}/results.tar"), &[], b"").body);
    assert_eq!(results.names, ["000.glb", "001.glb", "summary.jsonl"]);
    // Repeated, it is the same batch, and nothing is computed again.
    assert_eq!(location(&post("a", "", &gzip(&body))), batch);
    assert_eq!(backend.started.load(Ordering::SeqCst), 2);
    post("a", "?resolution=2", &body).problem(422, "other-request");
    post("a", "", &samples(3)).problem(422, "other-request");
    assert_ne!(location(&post("b", "", &body)), batch);
    for path in ["", "/events", "/results.tar"] {
        ask("b", "GET", &format!("{batch}{path}"), &[], b"").problem(404, "no-such-job");
        assert_eq!(ask("a", "GET", &format!("{batch}{path}"), &[], b"").status, 200);
    }
    ask("b", "DELETE", &batch, &[], b"").problem(404, "no-such-job");
    ask("reads", "DELETE", &batch, &[], b"").problem(403, "scope-missing");
}

/// Starts the program on a data folder.
fn process(folder: &Path) -> Process {
    Process::spawn(Command::new(env!("CARGO_BIN_EXE_molmesh")), folder)
}

#[test]
fn a_batch_survives_kills_during_its_acceptance_and_its_work() {
    const FILES: usize = 24;
    let folder = tempfile::tempdir().unwrap();
    let (path, key) = (format!("{BATCHES}?outputs=stl&resolution=1"), "idempotency-key: k\r\n");
    let body = samples(FILES);
    // Killed after each of these times: while the body is received, while jobs are accepted, while they run.
    let mut batch = None;
    for ms in [20, 60, 120, 400] {
        let server = process(folder.path());
        let (addr, path, body) = (server.addr, path.clone(), body.clone());
        let post = std::thread::spawn(move || ask(addr, "POST", &path, key, &body));
        std::thread::sleep(Duration::from_millis(ms));
        server.kill();
        if let Some((status, Some(location), _)) = post.join().unwrap() {
            assert_eq!((status, batch.get_or_insert(location.clone()).as_str()), (202, location.as_str()));
        }
    }
    let server = process(folder.path());
    let mut again = None;
    wait_for("the service is ready", || {
        again = ask(server.addr, "POST", &path, key, &body).filter(|(status, ..)| *status == 202);
        again.is_some()
    });
    let location = again.unwrap().1.unwrap();
    assert_eq!(batch.unwrap_or(location.clone()), location);
    let results = send(server.addr, "GET", &format!("{location}/results.tar"), &[], b"");
    let results = Results::of(&results.body);
    let expected: Vec<String> = (0..FILES).map(|i| format!("{i:03}.stl")).chain(["summary.jsonl".to_owned()]).collect();
    assert_eq!((results.names, results.lines.len()), (expected, FILES));
    let jobs = folder.path().join("store/jobs");
    // Kills have left unfinished files, whose names end otherwise.
    let records = || {
        let names = std::fs::read_dir(&jobs).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.filter(|name| Path::new(name).extension().is_some_and(|end| end == "json"))
    };
    wait_for("open records are removed", || records().all(|name| name.contains(".ended.") || name.contains(".batch.")));
    assert_eq!(records().count(), FILES + 1, "one job for each file, and the batch");
    server.kill();
}
