//! Keys, quotas and signed URLs of the real server: off by default, complete if enabled.

use crate::access_support;
use crate::http_support;

use std::io::{Read as _, Write as _};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use access_support::Keys;
use http_support::{Fake, Mode, Reply, Running, SAMPLE, connect, sample, send, start, wait_for};
use molmesh::access::SigningKeys;
use molmesh::config::{Config, Secret};

const ZERO: &str = "0000000000000000000000000000000000000000000000000000000000000000";
const ENTRY: &str = "/v1/pdb/4pti/surface.glb";

/// Starts a server with one entry in its archive.
fn server(mode: Mode, change: impl FnOnce(&mut Config)) -> Running {
    on(Fake::new(mode), change)
}

fn on(backend: Arc<Fake>, change: impl FnOnce(&mut Config)) -> Running {
    let server = start(backend, change);
    let folder = server.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
    server
}

fn get(server: &Running, path: &str, headers: &[(&str, &str)]) -> Reply {
    send(server.addr, "GET", path, headers, b"")
}

/// Sends a GET with a key.
fn with(server: &Running, key: &str, path: &str) -> Reply {
    get(server, path, &[("x-api-key", key)])
}

/// Returns the body for a method; only uploads have one.
fn body_of(method: &str) -> &'static [u8] {
    if method == "POST" { SAMPLE } else { b"" }
}

/// Returns every operation that requires a key, with its scope.
fn operations() -> Vec<(&'static str, String, &'static str)> {
    vec![
        ("POST", "/v1/meshes".into(), "mesh"),
        ("GET", ENTRY.into(), "mesh"),
        ("HEAD", ENTRY.into(), "mesh"),
        ("POST", "/v1/structures".into(), "mesh"),
        ("GET", format!("/v1/structures/{ZERO}"), "read"),
        ("GET", format!("/v1/structures/{ZERO}/surface.glb"), "mesh"),
        ("POST", "/v1/estimate".into(), "mesh"),
        ("GET", "/v1/jobs/x".into(), "read"),
        ("DELETE", "/v1/jobs/x".into(), "mesh"),
        ("GET", "/v1/jobs/x/events".into(), "read"),
        ("GET", "/v1/jobs/x/result".into(), "read"),
        ("GET", format!("/v1/results/{ZERO}.glb"), "read"),
        ("GET", format!("/v1/results/{ZERO}/report.json"), "read"),
        ("GET", "/v1/capabilities".into(), "read"),
    ]
}

#[test]
fn by_default_no_key_is_required_and_nothing_is_counted() {
    let server = server(Mode::Octahedra, |_| {});
    for (method, path, _) in operations() {
        for headers in [&[][..], &[("authorization", "Bearer mm_nobody_x"), ("x-api-key", "y")]] {
            let reply = send(server.addr, method, &path, headers, body_of(method));
            assert!(![401, 403, 429].contains(&reply.status), "{method} {path}: {}", reply.status);
            assert_eq!((reply.header("ratelimit"), reply.header("ratelimit-policy")), (None, None));
        }
    }
    assert!(get(&server, ENTRY, &[]).header("cache-control").unwrap().starts_with("public"));
    for name in ["signature", "expires", "key_id"] {
        let problem = get(&server, &format!("{ENTRY}?{name}=1"), &[]).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], name);
    }
}

#[test]
fn every_operation_requires_a_valid_key_with_its_scope() {
    let mut keys = Keys::new(&[
        ("reads", "read", ""),
        ("makes", "mesh", ""),
        ("both", "read,mesh", "expires = \"2999-01-01T00:00:00Z\""),
        ("past", "read,mesh", "expires = \"2020-02-03T04:05:06Z\""),
        ("gone", "read,mesh", ""),
    ]);
    keys.write(&[
        ("reads", "read", ""),
        ("makes", "mesh", ""),
        ("both", "read,mesh", "expires = \"2999-01-01T00:00:00Z\""),
        ("past", "read,mesh", "expires = \"2020-02-03T04:05:06Z\""),
    ]);
    let server = server(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let other_secret = keys.text("both").replace("mm_both", "mm_reads");
    for (method, path, scope) in operations() {
        let ask = |headers: &[(&str, &str)]| send(server.addr, method, &path, headers, body_of(method));
        let refused = |headers: &[(&str, &str)], status: u16, slug: &str, challenge: &str| {
            let reply = ask(headers);
            assert!(reply.header("www-authenticate").unwrap().starts_with("Bearer realm=\"molmesh\""));
            assert!(reply.header("www-authenticate").unwrap().contains(challenge), "{reply:?}");
            if method == "HEAD" {
                assert_eq!(reply.status, status);
                return None;
            }
            Some(reply.problem(status, slug))
        };
        refused(&[], 401, "key-required", "");
        refused(&[("authorization", "Basic YTpi")], 401, "key-required", "");
        for wrong in ["x", "mm_reads_", &other_secret, keys.text("gone"), &keys.text("both").to_uppercase()] {
            refused(&[("x-api-key", wrong)], 401, "key-invalid", "error=\"invalid_token\"");
        }
        if let Some(problem) = refused(&[("x-api-key", keys.text("past"))], 401, "key-expired", "invalid_token") {
            assert_eq!(problem["expired"], "2020-02-03T04:05:06Z");
        }
        let lacks = if scope == "mesh" { "reads" } else { "makes" };
        if let Some(problem) = refused(&[("x-api-key", keys.text(lacks))], 403, "scope-missing", "insufficient_scope") {
            assert_eq!(problem["scope"], scope);
        }
        let has = if scope == "mesh" { "makes" } else { "reads" };
        let bearer = format!("Bearer {}", keys.text(has));
        for headers in [("authorization", bearer.as_str()), ("x-api-key", keys.text("both"))] {
            let reply = ask(&[headers]);
            assert!(![401, 403].contains(&reply.status), "{method} {path}: {}", reply.status);
            assert_eq!(reply.header("ratelimit-policy"), None, "no quota, no fields");
        }
        // Two keys are rejected.
        refused(&[("authorization", &bearer), ("x-api-key", keys.text("both"))], 401, "key-invalid", "invalid_token");
    }
    for open in
        ["/", "/docs", "/openapi.yaml", "/problems/key-required", "/livez", "/readyz", "/version", "/sample.pdb"]
    {
        assert_eq!(get(&server, open, &[]).status, 200, "{open}");
    }
    get(&server, "/v1/nothing", &[]).problem(404, "not-found");
    let mesh = with(&server, keys.text("makes"), ENTRY);
    assert_eq!((mesh.status, mesh.header("cache-control").unwrap().split(',').next()), (200, Some("private")));
    for reason in ["key-required", "key-invalid", "key-expired", "scope-missing"] {
        let label = format!("reason=\"{reason}\"");
        assert!(server.metric("molmesh_requests_rejected_total", &[&label]) >= 1.0, "{reason}");
    }
}

fn forwarded(address: &str) -> (&'static str, &str) {
    ("x-forwarded-for", address)
}

/// Returns the parameters of an item in a structured list.
fn item(reply: &Reply, field: &str, policy: &str) -> Vec<(String, u64)> {
    let items = reply.header(field).unwrap_or_else(|| panic!("no {field}: {reply:?}")).split(", ");
    let of = items.filter_map(|item| item.strip_prefix(&format!("\"{policy}\";")));
    let parameters = of.flat_map(|item| item.split(';')).filter_map(|p| p.split_once('='));
    parameters.filter_map(|(name, value)| Some((name.to_owned(), value.parse().ok()?))).collect()
}

fn number(reply: &Reply, field: &str, policy: &str, parameter: &str) -> u64 {
    let parameters = item(reply, field, policy);
    parameters.iter().find(|(name, _)| name == parameter).unwrap_or_else(|| panic!("{parameters:?}")).1
}

#[test]
fn requests_are_counted_per_key_and_reported_in_header_fields() {
    let keys =
        Keys::new(&[("a", "read", "requests = 3\nwindow_s = 86400"), ("b", "read", "requests = 3\nwindow_s = 86400")]);
    let server = server(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let mut last = 86_400;
    for left in [2, 1, 0] {
        let reply = with(&server, keys.text("a"), "/v1/capabilities");
        assert_eq!(reply.status, 200);
        assert_eq!(reply.header("ratelimit-policy"), Some("\"requests\";q=3;w=86400"));
        assert_eq!(number(&reply, "ratelimit", "requests", "r"), left);
        let t = number(&reply, "ratelimit", "requests", "t");
        assert!((1..=last).contains(&t), "{t} after {last}");
        last = t;
        // Public paths and requests rejected for other reasons are not counted.
        assert_eq!(with(&server, keys.text("a"), "/livez").header("ratelimit"), None);
        assert_eq!(with(&server, keys.text("a"), ENTRY).status, 403);
    }
    for _ in 0..3 {
        let refused = with(&server, keys.text("a"), "/v1/capabilities");
        let problem = refused.problem(429, "quota-exceeded");
        assert_eq!((&problem["violated-policies"], &problem["limit"]), (&serde_json::json!(["requests"]), &3.into()));
        assert_eq!(number(&refused, "ratelimit", "requests", "r"), 0);
        let wait: u64 = refused.header("retry-after").unwrap().parse().unwrap();
        // Both are rounded up; the field is computed later.
        let t = number(&refused, "ratelimit", "requests", "t");
        assert!(wait >= t && wait <= last && t > 600, "{wait} {t}");
    }
    assert_eq!(with(&server, keys.text("b"), "/v1/capabilities").status, 200);
    assert!(server.metric("molmesh_requests_rejected_total", &["reason=\"quota-exceeded\""]) >= 3.0);
    wait_for("the gauge", || server.metric("molmesh_quota_clients", &[]) >= 2.0);
}

#[test]
fn a_used_up_quota_is_restored() {
    let keys = Keys::new(&[("a", "read", "requests = 1\nwindow_s = 1")]);
    let server = server(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let status = || with(&server, keys.text("a"), "/v1/capabilities").status;
    for _ in 0..2 {
        wait_for("the quota is used up", || status() == 429);
        wait_for("the quota is restored", || status() == 200);
    }
}

#[test]
fn computing_time_is_limited_but_other_requests_are_served() {
    let keys =
        Keys::new(&[("a", "mesh,read", "work_s = 1\nwindow_s = 86400"), ("b", "mesh", "work_s = 1\nwindow_s = 86400")]);
    let backend = Fake::new(Mode::Slow(Duration::from_millis(1100)));
    let server = on(Arc::clone(&backend), |c| c.access.keys_file = Some(keys.path()));
    let post = |key: &str, path: &str, n: usize, more: &[(&str, &str)]| {
        server.post(path, &[&[("x-api-key", keys.text(key))], more].concat(), &sample(n))
    };
    let first = post("a", "/v1/meshes", 1, &[]);
    assert_eq!(first.status, 200, "{}", first.text());
    let policy = first.header("ratelimit-policy").unwrap();
    assert_eq!(policy, "\"work\";q=1;qu=\"molmesh-work-seconds\";w=86400");
    assert_eq!(number(&first, "ratelimit", "work", "r"), 0);
    for (path, more) in [("/v1/meshes", &[][..]), ("/v1/meshes", &[("prefer", "respond-async")]), ("/v1/estimate", &[])]
    {
        let problem = post("a", path, 2, more).problem(429, "quota-exceeded");
        assert_eq!(problem["violated-policies"], serde_json::json!(["work"]), "{path}");
    }
    let structure = post("a", "/v1/structures", 2, &[]).header("location").unwrap().to_owned();
    let problem =
        with(&server, keys.text("a"), &format!("{structure}/areas?surface=sas")).problem(429, "quota-exceeded");
    assert_eq!(problem["violated-policies"], serde_json::json!(["work"]));
    assert_eq!(with(&server, keys.text("a"), "/v1/capabilities").status, 200);
    wait_for("stored results cost no computing time", || post("a", "/v1/meshes", 1, &[]).status == 200);
    assert_eq!(post("b", "/v1/meshes", 3, &[]).status, 200, "each key has its own quota");
    // Asynchronous jobs are charged when they end.
    let keys = Keys::new(&[("c", "mesh,read", "work_s = 1\nwindow_s = 86400")]);
    let server = on(backend, |c| c.access.keys_file = Some(keys.path()));
    let ask = |n: usize, more: &[(&str, &str)]| {
        server.post("/v1/meshes", &[&[("x-api-key", keys.text("c"))], more].concat(), &sample(n))
    };
    let accepted = ask(4, &[("prefer", "respond-async")]);
    let job = accepted.header("location").unwrap();
    wait_for("the job ends", || with(&server, keys.text("c"), job).json()["status"] == "successful");
    assert_eq!(ask(5, &[]).status, 429);
}

#[test]
fn concurrent_requests_are_counted_to_the_last_byte() {
    let keys = Keys::new(&[("a", "mesh,read", "concurrent = 1")]);
    let server = server(Mode::Slow(Duration::from_mins(10)), |c| {
        c.access.keys_file = Some(keys.path());
        // The stop must not wait for the endless job.
        c.server.drain_timeout_ms = 100;
    });
    let accepted = server.post("/v1/meshes", &[("x-api-key", keys.text("a")), ("prefer", "respond-async")], SAMPLE);
    assert_eq!(accepted.status, 202);
    assert_eq!(accepted.header("ratelimit-policy"), Some("\"concurrency\";q=1;qu=\"concurrent-requests\""));
    assert_eq!(accepted.header("ratelimit"), Some("\"concurrency\";r=0"));
    let job = accepted.header("location").unwrap();
    let mut listening = connect(server.addr);
    let head = format!("GET {job}/events HTTP/1.1\r\nhost: localhost\r\nx-api-key: {}\r\n\r\n", keys.text("a"));
    let mut begun = [0; 12];
    wait_for("the POST request has ended", || {
        listening = connect(server.addr);
        listening.write_all(head.as_bytes()).unwrap();
        listening.read_exact(&mut begun).unwrap();
        &begun == b"HTTP/1.1 200"
    });
    let refused = with(&server, keys.text("a"), "/v1/capabilities");
    let problem = refused.problem(429, "quota-exceeded");
    assert_eq!(
        (&problem["violated-policies"], refused.header("retry-after")),
        (&serde_json::json!(["concurrency"]), Some("1"))
    );
    drop(listening);
    wait_for("the event stream has ended", || with(&server, keys.text("a"), "/v1/capabilities").status == 200);
}

#[test]
fn addresses_have_quotas_also_behind_trusted_proxies() {
    let limited = |c: &mut Config| c.access.address_requests = Some(2);
    let own = server(Mode::Octahedra, limited);
    let ask = |server: &Running, header: (&str, &str)| get(server, "/v1/capabilities", &[header]).status;
    // Without trusted proxies the peer is the client.
    let statuses = ["198.51.100.1", "198.51.100.2", "198.51.100.3"].map(|address| ask(&own, forwarded(address)));
    assert_eq!(statuses, [200, 200, 429]);
    let behind = server(Mode::Octahedra, |c| {
        limited(c);
        c.server.trusted_proxies = "127.0.0.0/8".parse().ok();
    });
    for client in ["198.51.100.1", "198.51.100.2", "2001:db8:0:1::1"] {
        let statuses =
            ["", "203.0.113.7, ", "203.0.113.8, "].map(|forged| ask(&behind, forwarded(&format!("{forged}{client}"))));
        assert_eq!(statuses, [200, 200, 429], "{client}");
    }
    // Addresses of one IPv6 network are one client. `Forwarded`, which proxies pass on, is ignored.
    assert_eq!(ask(&behind, forwarded("2001:db8:0:1:ffff::1")), 429);
    assert_eq!(ask(&behind, forwarded("2001:db8:0:2::1")), 200);
    let statuses = ["198.51.100.7", "198.51.100.8", "198.51.100.9"]
        .map(|address| ask(&behind, ("forwarded", &format!("for={address}"))));
    assert_eq!(statuses, [200, 200, 429]);
}

#[test]
fn addresses_have_quotas_of_time() {
    let server = server(Mode::Slow(Duration::from_secs(2)), |c| c.access.address_work_s = Some(1));
    let first = server.post("/v1/meshes", &[], SAMPLE);
    assert_eq!(first.status, 200);
    assert_eq!(first.header("ratelimit-policy"), Some("\"work\";q=1;qu=\"molmesh-work-seconds\";w=60"));
    // Two seconds of computing exceed the quota of one. Other requests are served.
    let again = server.post("/v1/meshes?resolution=1.5", &[], SAMPLE);
    assert_eq!(again.problem(429, "quota-exceeded")["violated-policies"], serde_json::json!(["work"]));
    assert_eq!(get(&server, "/v1/capabilities", &[]).status, 200);
}

#[test]
fn a_request_is_concurrent_while_its_body_arrives() {
    let keys = Keys::new(&[("a", "mesh,read", "concurrent = 1")]);
    let server = server(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let head = format!(
        "POST /v1/structures HTTP/1.1\r\nhost: localhost\r\nx-api-key: {}\r\ncontent-length: 1000\r\n\r\nATOM",
        keys.text("a")
    );
    let upload = || {
        let mut stream = connect(server.addr);
        stream.write_all(head.as_bytes()).unwrap();
        stream.set_nonblocking(true).unwrap();
        stream
    };
    let status = || with(&server, keys.text("a"), "/v1/capabilities").status;
    let mut sending = upload();
    wait_for("the concurrent request is rejected", || {
        // A request is counted until shortly after its response was read, so the upload may be rejected. Sends it
        // again.
        if sending.peek(&mut [0]).is_ok() {
            sending = upload();
        }
        status() == 429
    });
    drop(sending);
    wait_for("the upload has ended", || status() == 200);
}

#[test]
fn a_key_is_one_client_at_any_address() {
    let keys = Keys::new(&[("a", "mesh", ""), ("b", "mesh", "")]);
    let server = server(Mode::Octahedra, |c| {
        c.access.keys_file = Some(keys.path());
        c.server.trusted_proxies = "127.0.0.1".parse().ok();
    });
    let submit = |key: &str, address: &str| {
        let headers = [
            ("x-api-key", keys.text(key)),
            ("x-forwarded-for", address),
            ("prefer", "respond-async"),
            ("idempotency-key", "mine"),
        ];
        let reply = server.post("/v1/meshes", &headers, SAMPLE);
        assert_eq!(reply.status, 202, "{}", reply.text());
        reply.header("location").unwrap().to_owned()
    };
    let first = submit("a", "198.51.100.1");
    assert_eq!(submit("a", "198.51.100.2"), first);
    assert_ne!(submit("b", "198.51.100.1"), first);
}

const SECRETS: &str = "new@a:0123456789abcdef0123456789abcdef old@a:fedcba9876543210fedcba9876543210";

fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs()
}

fn sign(target: &str, key: Option<&str>) -> String {
    SigningKeys::parse(SECRETS).unwrap().sign(key, target, now() + 3600).unwrap()
}

fn signing(keys: &Keys, secrets: &str) -> Running {
    server(Mode::Octahedra, |c| {
        c.access.keys_file = Some(keys.path());
        c.access.signing_secret = Some(Secret::new(secrets));
    })
}

#[test]
fn a_signed_url_replaces_a_key_and_changes_nothing_else() {
    let keys = Keys::new(&[("a", "mesh,read", "")]);
    let server = signing(&keys, SECRETS);
    for target in [format!("{ENTRY}?resolution=1&atom_ids=true"), ENTRY.to_owned(), "/v1/capabilities".to_owned()] {
        let (signed, keyed) = (get(&server, &sign(&target, None), &[]), with(&server, keys.text("a"), &target));
        assert_eq!((signed.status, keyed.status), (200, 200), "{}", signed.text());
        assert!(signed.body == keyed.body);
        for name in ["etag", "content-type"] {
            assert_eq!(signed.header(name), keyed.header(name), "{name}");
        }
        assert!(!signed.headers.iter().any(|(_, value)| value.contains("signature")), "{:?}", signed.headers);
        // An additional valid key is accepted; an invalid one is rejected.
        assert_eq!(with(&server, keys.text("a"), &sign(&target, None)).status, 200);
        assert_eq!(with(&server, "mm_a_x", &sign(&target, None)).status, 401);
    }
    let target = sign(ENTRY, None);
    assert_eq!(send(server.addr, "HEAD", &target, &[], b"").status, 200);
    let etag = get(&server, &target, &[]).header("etag").unwrap().to_owned();
    assert_eq!(get(&server, &target, &[("if-none-match", &etag)]).status, 304);
    // `Content-Location` does not contain the signature.
    let fresh = get(&server, &sign(&format!("{ENTRY}?resolution=0.9"), None), &[]);
    let location = fresh.header("content-location").unwrap();
    assert!(location.starts_with("/v1/results/") && !location.contains('?'), "{location}");
    wait_for("the result is stored", || get(&server, &sign(location, None), &[]).body == fresh.body);
    // A signature allows GET and HEAD only.
    send(server.addr, "POST", &sign("/v1/meshes", None), &[], SAMPLE).problem(401, "key-required");
    send(server.addr, "DELETE", &sign("/v1/jobs/x", None), &[], b"").problem(401, "key-required");
    // Its parameters are unknown without a signature, and unknown parameters are rejected although signed.
    let key = [("x-api-key", keys.text("a"))];
    send(server.addr, "POST", &sign("/v1/meshes", None), &key, SAMPLE).problem(400, "bad-parameter");
    get(&server, &format!("{ENTRY}?expires=1"), &key).problem(400, "bad-parameter");
    get(&server, &sign(&format!("{ENTRY}?sginature=1"), None), &[]).problem(400, "bad-parameter");
}

#[test]
fn a_signature_opens_a_job_with_its_events_and_bytes() {
    let keys = Keys::new(&[("a", "mesh,read", "")]);
    let server = signing(&keys, SECRETS);
    let key = ("x-api-key", keys.text("a"));
    let accepted = server.post("/v1/meshes", &[key, ("prefer", "respond-async")], SAMPLE);
    let job = accepted.header("location").unwrap();
    wait_for("the job ends", || with(&server, keys.text("a"), job).json()["status"] == "successful");
    let signed = sign(job, None);
    let query = signed.split_once('?').unwrap().1;
    assert_eq!(get(&server, &signed, &[]).json()["status"], "successful");
    let events = get(&server, &format!("{job}/events?{query}"), &[]);
    assert!(events.status == 200 && events.text().contains("successful"), "{}", events.text());
    let result = get(&server, &format!("{job}/result?{query}"), &[]);
    let target = result.header("location").unwrap();
    assert!(result.status == 303 && target.contains("signature="), "{result:?}");
    let mesh = get(&server, target, &[]);
    assert!(mesh.status == 200 && mesh.body.starts_with(b"glTF"), "{}", mesh.status);
    // The target expires with the job's address.
    let expires = |target: &str| target.split("expires=").nth(1).unwrap()[..10].to_owned();
    assert_eq!(expires(target), expires(&signed));
    get(&server, &format!("{job}x/result?{query}"), &[]).problem(403, "signature-invalid");
    let keyed = with(&server, keys.text("a"), &format!("{job}/result"));
    assert!(!keyed.header("location").unwrap().contains('?'));
}

#[test]
fn signed_responses_are_not_cached_longer_than_their_signature() {
    let keys = Keys::new(&[("a", "mesh,read", "")]);
    let server = signing(&keys, SECRETS);
    let end = now() + 100;
    let until = |target: &str| SigningKeys::parse(SECRETS).unwrap().sign(None, target, end).unwrap();
    let fresh = get(&server, &until(ENTRY), &[]);
    let stored = fresh.header("content-location").unwrap();
    wait_for("the result is stored", || get(&server, &until(stored), &[]).status == 200);
    for target in [ENTRY, stored] {
        let etag = fresh.header("etag").unwrap();
        for headers in [&[][..], &[("if-none-match", etag)]] {
            let reply = get(&server, &until(target), headers);
            let caching = reply.header("cache-control").unwrap();
            let age: u64 = caching.strip_prefix("private, max-age=").unwrap().parse().unwrap();
            assert!(age <= 100 && now() + age <= end + 1, "{target}: {caching}");
        }
        let keyed = with(&server, keys.text("a"), target);
        assert!(keyed.header("cache-control").unwrap().len() > "private, max-age=100".len(), "{keyed:?}");
    }
}

#[test]
fn a_signature_is_valid_for_one_url_until_its_expiry() {
    let keys = Keys::new(&[("a", "mesh,read", "")]);
    let server = signing(&keys, SECRETS);
    let good = sign(&format!("{ENTRY}?resolution=1"), None);
    assert_eq!(get(&server, &good, &[]).status, 200);
    for bad in [
        format!("{good}&compress=quantize"),
        good.replace("resolution=1", "resolution=2"),
        good.replace("resolution=1&", ""),
        good.replace("surface.glb", "surface.stl"),
        good.replace("4pti", "4PTI"),
        good.replace("key_id=new", "key_id=old"),
        good.replace("key_id=new", "key_id=other"),
        format!("{good}&{}", good.split('&').next_back().unwrap()),
    ] {
        let problem = get(&server, &bad, &[]).problem(403, "signature-invalid");
        assert!(!problem["detail"].as_str().unwrap().contains("key_id"), "{problem}");
    }
    let past = SigningKeys::parse(SECRETS).unwrap().sign(None, ENTRY, 1_577_836_800).unwrap();
    let problem = get(&server, &past, &[]).problem(403, "signature-expired");
    assert!(problem["expired"].as_str().unwrap().starts_with("2020-01-01T00:00:00"), "{problem}");
    // Expiry is reported only for a correct signature.
    get(&server, &past.replace(".glb", ".stl"), &[]).problem(403, "signature-invalid");
    assert!(server.metric("molmesh_requests_rejected_total", &["reason=\"signature-invalid\""]) >= 8.0);
    assert!(server.metric("molmesh_requests_rejected_total", &["reason=\"signature-expired\""]) >= 1.0);
}

#[test]
fn every_byte_of_a_url_is_signed() {
    let keys = Keys::new(&[("a", "mesh,read", "")]);
    let server = signing(&keys, SECRETS);
    let good = sign(&format!("{ENTRY}?resolution=1"), None);
    assert_eq!(get(&server, &good, &[]).status, 200);
    for at in 0..good.len() {
        let other = if good.as_bytes()[at] == b'a' { "b" } else { "a" };
        let other = format!("{}{other}{}", &good[..at], &good[at + 1..]);
        let status = get(&server, &other, &[]).status;
        assert!([400, 401, 403, 404].contains(&status), "{status} for {other}");
    }
}

#[test]
fn signing_keys_can_be_rotated() {
    let keys = Keys::new(&[]);
    let both = signing(&keys, SECRETS);
    for key in ["new", "old"] {
        assert_eq!(get(&both, &sign(ENTRY, Some(key)), &[]).status, 200, "{key}");
    }
    let later = signing(&keys, SECRETS.split(' ').next().unwrap());
    assert_eq!(get(&later, &sign(ENTRY, Some("new")), &[]).status, 200);
    get(&later, &sign(ENTRY, Some("old")), &[]).problem(403, "signature-invalid");
    // Without a key file, only signatures are accepted. Public paths stay public.
    let alone = server(Mode::Octahedra, |c| c.access.signing_secret = Some(Secret::new(SECRETS)));
    assert_eq!(get(&alone, &sign(ENTRY, None), &[]).status, 200);
    get(&alone, ENTRY, &[]).problem(401, "key-required");
    with(&alone, "mm_a_b", ENTRY).problem(401, "key-invalid");
    assert_eq!(get(&alone, "/", &[]).status, 200);
}

#[test]
fn changed_key_files_are_reloaded() {
    let mut keys = Keys::new(&[("a", "read", "")]);
    let server = server(Mode::Octahedra, |c| c.access.keys_file = Some(keys.path()));
    let status = |key: &str| with(&server, key, "/v1/capabilities").status;
    assert_eq!(status(keys.text("a")), 200);
    keys.write(&[("b", "read", "note = \"replaces a\"")]);
    wait_for("the new key is known", || status(keys.text("b")) == 200);
    assert_eq!(status(keys.text("a")), 401);
    std::fs::write(keys.path(), "[[key]]\nnmae = 3").unwrap();
    wait_for("the error is logged", || !http_support::log_lines("line 2: unknown name `nmae`").is_empty());
    assert_eq!(status(keys.text("b")), 200);
}

#[test]
fn pages_of_listed_origins_may_read_responses() {
    let (trusted, other) = ("https://viewer.example", "https://other.example");
    let preflight = |server: &Running, origin: &str| {
        let headers = [
            ("origin", origin),
            ("access-control-request-method", "POST"),
            ("access-control-request-headers", "authorization,content-type"),
        ];
        send(server.addr, "OPTIONS", "/v1/meshes", &headers, b"")
    };
    let listed = server(Mode::Octahedra, |c| {
        c.access.cors_origins = trusted.parse().ok();
        c.access.cors_credentials = true;
    });
    let reply = preflight(&listed, trusted);
    assert_eq!(reply.header("access-control-allow-origin"), Some(trusted));
    assert_eq!(reply.header("access-control-allow-credentials"), Some("true"));
    assert!(reply.header("access-control-allow-headers").unwrap().contains("authorization"));
    assert_eq!(preflight(&listed, other).header("access-control-allow-origin"), None);
    let plain = get(&listed, "/v1/capabilities", &[("origin", trusted)]);
    assert_eq!(plain.header("access-control-allow-origin"), Some(trusted));
    assert!(plain.headers.iter().any(|(name, value)| name == "vary" && value.contains("origin")));
    assert_eq!(plain.header("cross-origin-resource-policy"), Some("same-origin"));
    let exposed = plain.header("access-control-expose-headers").unwrap();
    assert!(exposed.contains("ratelimit") && exposed.contains("retry-after") && !exposed.contains('*'), "{exposed}");

    let keys = Keys::new(&[]);
    let any_origin = server(Mode::Octahedra, |c| {
        c.access.keys_file = Some(keys.path());
        c.access.cors_origins = "*".parse().ok();
    });
    let reply = preflight(&any_origin, other);
    assert_eq!(reply.header("access-control-allow-origin"), Some("*"));
    assert_eq!(reply.header("access-control-allow-credentials"), None);
    // `*` does not cover this header.
    assert!(reply.header("access-control-allow-headers").unwrap().contains("authorization"));
    let refused = get(&any_origin, "/v1/capabilities", &[("origin", other)]);
    assert_eq!(
        (refused.status, refused.header("access-control-allow-origin")),
        (401, Some("*")),
        "scripts can read the error"
    );
    let own_pages = server(Mode::Octahedra, |c| c.access.cors_origins = None);
    assert_eq!(preflight(&own_pages, trusted).header("access-control-allow-origin"), None);
    assert_eq!(get(&own_pages, "/v1/capabilities", &[("origin", trusted)]).header("access-control-allow-origin"), None);
}

#[test]
fn security_headers_are_sent() {
    let plain = server(Mode::Octahedra, |_| {});
    for path in ["/", "/docs", "/v1/capabilities", ENTRY, "/v1/nothing"] {
        let reply = get(&plain, path, &[]);
        assert_eq!(reply.header("x-content-type-options"), Some("nosniff"), "{path}");
        assert_eq!(reply.header("referrer-policy"), Some("no-referrer"), "{path}");
        assert_eq!(reply.header("cross-origin-resource-policy"), Some("same-site"), "{path}");
        let policy = reply.header("content-security-policy").unwrap();
        assert!(
            policy.starts_with("default-src 'none'") && policy.contains("frame-ancestors 'none'"),
            "{path}: {policy}"
        );
        assert_eq!(policy.contains("script-src 'self'"), ["/", "/docs"].contains(&path), "{path}: {policy}");
        assert_eq!(reply.header("server"), None, "{path}");
        let version = env!("CARGO_PKG_VERSION");
        assert!(!reply.headers.iter().any(|(_, value)| value.contains(version)), "{path}: {:?}", reply.headers);
    }
}
