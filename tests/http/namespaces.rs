//! Namespaces of keys: for a key of another group, structures, results and jobs do not exist.

use crate::access_support::Keys;
use crate::http_support;

use std::time::{SystemTime, UNIX_EPOCH};

use http_support::{Fake, Mode, Reply, Running, SAMPLE, sample, send, start, wait_for};
use molmesh::access::SigningKeys;
use molmesh::config::Secret;

const ASYNC: (&str, &str) = ("prefer", "respond-async");
const SECRETS: &str = "b:0123456789abcdef0123456789abcdef a1@a:fedcba9876543210fedcba9876543210";

/// Server with the groups `a` and `b`, and a structure, a job and a result of `a`.
struct Setup {
    keys: Keys,
    server: Running,
    backend: std::sync::Arc<Fake>,
    structure: String,
    job: String,
    result: String,
}

impl Setup {
    fn new() -> Self {
        let keys =
            Keys::new(&[("a", "read,mesh", ""), ("b", "read,mesh", ""), ("second", "read,mesh", "group = \"a\"")]);
        let backend = Fake::new(Mode::Octahedra);
        let server = start(std::sync::Arc::clone(&backend) as _, |c| {
            c.access.keys_file = Some(keys.path());
            c.access.signing_secret = Some(Secret::new(SECRETS));
        });
        let folder = server.dir.path().join("archive");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
        let mut setup =
            Self { keys, server, backend, structure: String::new(), job: String::new(), result: String::new() };
        let stored = setup.ask("a", "POST", "/v1/structures", &[], SAMPLE);
        assert_eq!(stored.status, 201);
        stored.header("location").unwrap().clone_into(&mut setup.structure);
        let accepted = setup.ask("a", "POST", "/v1/meshes", &[ASYNC], SAMPLE);
        accepted.header("location").unwrap().clone_into(&mut setup.job);
        wait_for("the job ends", || setup.get("a", &setup.job).json()["status"] == "successful");
        let result = setup.get("a", &format!("{}/result", setup.job));
        result.header("location").unwrap().clone_into(&mut setup.result);
        setup
    }

    fn ask(&self, key: &str, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
        let headers = [&[("x-api-key", self.keys.text(key))], headers].concat();
        send(self.server.addr, method, path, &headers, body)
    }

    fn get(&self, key: &str, path: &str) -> Reply {
        self.ask(key, "GET", path, &[], b"")
    }

    fn started(&self) -> usize {
        self.backend.started.load(std::sync::atomic::Ordering::SeqCst)
    }
}

/// Replaces the digits of a digest or job id.
fn other(path: &str) -> String {
    let is_id = |part: &str| part.len() >= 32 && part.bytes().all(|c| c.is_ascii_hexdigit());
    let parts = path.split_inclusive(['/', '.', '?']).map(|part| {
        let (name, end) = part.split_at(part.trim_end_matches(['/', '.', '?']).len());
        if is_id(name) { "0".repeat(name.len()) + end } else { part.to_owned() }
    });
    parts.collect()
}

/// Returns status, headers and body without ids, dates and times.
fn comparable(reply: &Reply, path: &str) -> (u16, Vec<(String, String)>, String) {
    let ids: Vec<&str> = path.split(['/', '.', '?']).filter(|part| part.len() >= 32).collect();
    let hide = |text: &str| {
        ids.iter().fold(text.to_owned(), |text, id| text.replace(id, "ID").replace(&id[..40.min(id.len())], "ID"))
    };
    let changes = ["date", "x-request-id", "traceparent", "server-timing"];
    let headers = reply.headers.iter().filter(|(name, _)| !changes.contains(&name.as_str()));
    let mut body = String::from_utf8_lossy(&reply.body).into_owned();
    if let Ok(serde_json::Value::Object(mut document)) = serde_json::from_str(&body) {
        document.remove("instance");
        body = serde_json::Value::Object(document).to_string();
    }
    (reply.status, headers.map(|(n, v)| (n.clone(), hide(v))).collect(), hide(&body))
}

#[test]
fn objects_of_another_group_do_not_exist_for_a_key() {
    let setup = Setup::new();
    let Setup { structure, job, result, .. } = &setup;
    let report = result.replace(".glb", "/report.json");
    let tag = format!("\"{}\"", structure.rsplit('/').next().unwrap());
    let unchanged = ("if-none-match", tag.as_str());
    let json = ("content-type", "application/json");
    let routes = [
        ("GET", structure.clone()),
        ("GET", format!("{structure}/atoms")),
        ("GET", format!("{structure}/areas?surface=sas")),
        ("GET", format!("{structure}/colors?scheme=chain")),
        ("GET", format!("{structure}/surface.glb")),
        ("GET", format!("{structure}/surface.png?width=100&height=100")),
        ("GET", format!("{structure}/report.json")),
        ("GET", job.clone()),
        ("GET", format!("{job}?wait=1")),
        ("GET", format!("{job}/events")),
        ("GET", format!("{job}/result")),
        ("GET", result.clone()),
        ("GET", report.clone()),
        ("HEAD", result.clone()),
        ("DELETE", job.clone()),
    ];
    for (method, path) in &routes {
        for headers in [&[][..], &[unchanged], &[("if-match", "*")], &[("range", "bytes=0-9")], &[ASYNC]] {
            let found = setup.ask("b", method, path, headers, b"");
            let never = setup.ask("b", method, &other(path), headers, b"");
            assert_eq!(comparable(&found, path), comparable(&never, &other(path)), "{method} {path} {headers:?}");
            assert_eq!(found.status, 404, "{method} {path} {headers:?}");
        }
    }
    for path in ["/v1/meshes", "/v1/report", "/v1/estimate", "/v1/areas?surface=sas"] {
        let names = |structure: &str| format!("{{\"structure\": \"{}\"}}", structure.rsplit('/').next().unwrap());
        let ask = |structure: &str| setup.ask("b", "POST", path, &[json], names(structure).as_bytes());
        let (found, never) = (ask(structure), ask(&other(structure)));
        assert_eq!(comparable(&found, structure), comparable(&never, &other(structure)), "{path}");
        found.problem(404, "no-such-structure");
    }
    // They exist for the keys of the group.
    for key in ["a", "second"] {
        for (_, path) in routes.iter().filter(|(method, _)| *method == "GET") {
            assert!([200, 303].contains(&setup.get(key, path).status), "{key} {path}");
        }
        assert_eq!(setup.ask(key, "POST", "/v1/structures", &[], SAMPLE).status, 200);
        setup.ask(key, "DELETE", job, &[], b"").problem(409, "job-ended");
    }
}

#[test]
fn another_group_uploads_and_computes_the_same_again() {
    let setup = Setup::new();
    let uploaded = |key| setup.ask(key, "POST", "/v1/structures", &[], SAMPLE);
    assert_eq!([uploaded("b").status, uploaded("b").status], [201, 200]);
    // The name of a result is the same, and so are its bytes; its work is not.
    let surface = format!("{}/surface.glb", setup.structure);
    let before = setup.started();
    let mesh = setup.get("b", &surface);
    assert!(mesh.status == 200 && !mesh.header("server-timing").unwrap().contains("cache"), "{:?}", mesh.headers);
    assert_eq!((mesh.header("content-location"), setup.started()), (Some(setup.result.as_str()), before + 1));
    wait_for("the result is stored", || setup.get("b", &setup.result).status == 200);
    assert!(setup.get("b", &surface).body == setup.get("a", &surface).body);
    assert_eq!(setup.started(), before + 1);
    // Archive entries are common, results of them are not.
    let entry = "/v1/pdb/4pti/surface.glb?resolution=2";
    let stored = setup.get("a", entry).header("content-location").unwrap().to_owned();
    wait_for("the result is stored", || setup.get("a", &stored).status == 200);
    assert_eq!(setup.get("b", &stored).status, 404);
    assert_eq!((setup.get("b", entry).status, setup.started()), (200, before + 3));
    // Running work is not shared: the second job does not get the result of the first one.
    setup.backend.set(Mode::Held);
    let submit = |key| setup.ask(key, "POST", "/v1/meshes", &[ASYNC, ("idempotency-key", "x")], &sample(7));
    let [first, second] = ["a", "b"].map(|key| submit(key).header("location").unwrap().to_owned());
    wait_for("both run", || setup.started() == before + 5);
    assert_ne!(first, second);
    setup.get("b", &first).problem(404, "no-such-job");
    setup.ask("b", "DELETE", &first, &[], b"").problem(404, "no-such-job");
    setup.backend.set(Mode::Octahedra);
    for (key, job) in [("a", &first), ("b", &second)] {
        wait_for("the job ends", || setup.get(key, job).json()["status"] == "successful");
    }
}

#[test]
fn signed_urls_open_objects_of_the_group_of_their_key() {
    let setup = Setup::new();
    let until = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs() + 3600;
    let keys = SigningKeys::parse(SECRETS).unwrap();
    let signed =
        |key, path: &str| send(setup.server.addr, "GET", &keys.sign(Some(key), path, until).unwrap(), &[], b"");
    for path in [&setup.result, &setup.structure, &setup.job, &format!("{}/surface.stl", setup.structure)] {
        assert_eq!((signed("a1", path).status, signed("b", path).status), (200, 404), "{path}");
    }
    // The target of a job's result is signed with the same key.
    let redirect = signed("a1", &format!("{}/result", setup.job));
    assert_eq!(redirect.status, 303);
    assert_eq!(send(setup.server.addr, "GET", redirect.header("location").unwrap(), &[], b"").status, 200);
    for key in ["a1", "b"] {
        assert_eq!(signed(key, "/v1/pdb/4pti/atoms").status, 200, "archive entries are common");
    }
}

#[test]
fn jobs_of_a_group_survive_a_restart_and_stay_with_it() {
    let keys = Keys::new(&[("a", "read,mesh", ""), ("b", "read,mesh", "")]);
    let folder = tempfile::tempdir().unwrap();
    let begin = |mode| {
        start(Fake::new(mode), |c| {
            folder.path().clone_into(&mut c.server.data_dir);
            c.access.keys_file = Some(keys.path());
            c.server.drain_timeout_ms = 100;
        })
    };
    let get =
        |server: &Running, key: &str, path: &str| send(server.addr, "GET", path, &[("x-api-key", keys.text(key))], b"");
    let server = begin(Mode::Held);
    let accepted = server.post("/v1/meshes", &[("x-api-key", keys.text("a")), ASYNC], SAMPLE);
    let job = accepted.header("location").unwrap().to_owned();
    server.join();
    let server = begin(Mode::Octahedra);
    wait_for("the job ends", || get(&server, "a", &job).json()["status"] == "successful");
    assert_eq!(get(&server, "a", &format!("{job}/result")).status, 303);
    get(&server, "b", &job).problem(404, "no-such-job");
    assert!(server.join());
    // No file name reveals the digest of the structure.
    let digest = molmesh::store::Digest::of(SAMPLE).to_string();
    for part in ["inputs", "results"] {
        let names: Vec<_> = std::fs::read_dir(folder.path().join("store").join(part)).unwrap().collect();
        assert!(!names.is_empty(), "{part}");
        for name in names {
            let name = name.unwrap().file_name().into_string().unwrap();
            assert!(!name.contains(&digest), "{name}");
        }
    }
}
