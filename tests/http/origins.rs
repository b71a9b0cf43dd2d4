//! Protection against pages of other sites: the host that a request names, and the origin of the page that sends it.

use crate::access_support;
use crate::http_support;

use std::io::Write as _;
use std::net::SocketAddr;

use access_support::Keys;
use http_support::{Fake, Mode, Reply, Running, SAMPLE, connect, log_lines, read_reply, send, start};
use molmesh::config::Config;

const FOREIGN: (&str, &str) = ("origin", "https://evil.example");
const CROSS_SITE: (&str, &str) = ("sec-fetch-site", "cross-site");

fn server(change: impl FnOnce(&mut Config)) -> Running {
    start(Fake::new(Mode::Octahedra), change)
}

fn post(server: &Running, headers: &[(&str, &str)]) -> Reply {
    server.post("/v1/meshes", headers, SAMPLE)
}

fn get(server: &Running, path: &str, headers: &[(&str, &str)]) -> Reply {
    send(server.addr, "GET", path, headers, b"")
}

/// Sends the head of a GET request with these lines after the request line.
fn raw(server: &Running, target: &str, version: &str, lines: &str) -> Reply {
    raw_at(server.addr, target, version, lines)
}

fn raw_at(address: SocketAddr, target: &str, version: &str, lines: &str) -> Reply {
    let mut stream = connect(address);
    write!(stream, "GET {target} HTTP/{version}\r\n{lines}connection: close\r\n\r\n").unwrap();
    read_reply(&mut stream, false)
}

#[test]
fn requests_name_one_host_of_this_machine() {
    let own = server(|c| c.server.hosts = "meshes.example".parse().ok());
    for host in ["localhost", "LOCALHOST:81", "127.0.0.1:8080", "127.9.9.9", "[::1]:80", "meshes.example:443"] {
        assert_eq!(raw(&own, "/livez", "1.1", &format!("host: {host}\r\n")).status, 200, "{host}");
    }
    for (host, status) in [("localhost:9", 200), ("127.0.0.1", 200), ("meshes.example", 200), ("evil.example", 421)] {
        let reply = raw_at(own.metrics, "/metrics", "1.1", &format!("host: {host}\r\n"));
        assert_eq!(reply.status, status, "{host}");
    }
    for host in ["evil.example", "localhost.evil.example", "192.0.2.1", "127.0.0.1.evil.example:80"] {
        for path in ["/", "/livez", "/v1/capabilities"] {
            raw(&own, path, "1.1", &format!("host: {host}\r\n")).problem(421, "wrong-host");
        }
    }
    for lines in ["", "host: localhost\r\nhost: localhost\r\n", "host: a@localhost\r\n", "host: a b\r\n", "host: \r\n"]
    {
        raw(&own, "/livez", "1.1", lines).problem(400, "bad-request");
    }
    raw(&own, "http://evil.example/livez", "1.1", "host: localhost\r\n").problem(400, "bad-request");
    raw(&own, "http://evil.example/livez", "1.1", "host: evil.example\r\n").problem(421, "wrong-host");
    assert_eq!(raw(&own, "/livez", "1.0", "").status, 200);
    assert!(own.metric("molmesh_requests_rejected_total", &["reason=\"wrong-host\""]) >= 13.0);
    // An exposed service has names that it does not know.
    let exposed = server(|c| c.server.listen = "0.0.0.0:0".parse().unwrap());
    assert_eq!(raw(&exposed, "/livez", "1.1", "host: meshes.example\r\n").status, 200);
    raw(&exposed, "/livez", "1.1", "").problem(400, "bad-request");
}

#[test]
fn pages_of_other_sites_are_rejected_without_a_key() {
    let keys = Keys::new(&[("a", "mesh,read", "")]);
    let closed = server(|c| c.access.keys_file = Some(keys.path()));
    let open = server(|_| {});
    for server in [&open, &closed] {
        for headers in [
            &[FOREIGN][..],
            &[CROSS_SITE],
            &[FOREIGN, CROSS_SITE],
            &[FOREIGN, ("sec-fetch-site", "same-site")],
            &[("origin", "null")],
            &[FOREIGN, ("authorization", "Basic YTpi")],
        ] {
            post(server, headers).problem(403, "cross-site");
            get(server, "/v1/capabilities", headers).problem(403, "cross-site");
            assert_eq!(get(server, "/livez", headers).header("access-control-allow-origin"), None);
        }
    }
    assert_eq!(post(&closed, &[FOREIGN, CROSS_SITE, ("x-api-key", keys.text("a"))]).status, 200);
    for headers in [
        &[][..],
        &[("sec-fetch-site", "none")],
        &[("origin", "http://localhost"), ("sec-fetch-site", "same-origin")],
        // Pages of a developer's server.
        &[("origin", "http://localhost:5173"), ("sec-fetch-site", "same-site")],
        &[("origin", "http://127.0.0.1:5173"), CROSS_SITE],
    ] {
        assert_eq!(post(&open, headers).status, 200, "{headers:?}");
    }
    // Links lead to the pages, but not to what costs work.
    let link = [CROSS_SITE, ("sec-fetch-mode", "navigate"), ("sec-fetch-dest", "document")];
    for path in ["/", "/docs"] {
        assert_eq!(get(&open, path, &link).status, 200, "{path}");
        get(&open, path, &[CROSS_SITE, link[1], ("sec-fetch-dest", "iframe")]).problem(403, "cross-site");
    }
    get(&open, "/v1/pdb/4pti/surface.glb", &link).problem(403, "cross-site");
    send(open.addr, "POST", "/v1/meshes", &link, SAMPLE).problem(403, "cross-site");
    assert!(open.metric("molmesh_requests_rejected_total", &["reason=\"cross-site\""]) >= 14.0);
}

#[test]
fn the_address_decides_which_origins_are_allowed() {
    let allowed = |server: &Running, origin: &str| {
        let preflight = [("origin", origin), ("access-control-request-method", "POST")];
        let reply = send(server.addr, "OPTIONS", "/v1/meshes", &preflight, b"");
        reply.header("access-control-allow-origin").map(str::to_owned)
    };
    let developer = "http://localhost:5173";
    let own = server(|_| {});
    assert_eq!(allowed(&own, developer).as_deref(), Some(developer));
    assert_eq!(allowed(&own, "https://evil.example"), None);
    let warnings = || log_lines("set access.cors_origins").len();
    let before = warnings();
    let exposed = server(|c| c.server.listen = "0.0.0.0:0".parse().unwrap());
    assert_eq!(allowed(&exposed, developer), None);
    post(&exposed, &[("origin", developer)]).problem(403, "cross-site");
    assert_eq!(post(&exposed, &[("origin", "https://localhost")]).status, 200, "a page behind a proxy with TLS");
    assert!(warnings() > before);
    let any = server(|c| {
        c.server.listen = "0.0.0.0:0".parse().unwrap();
        c.access.cors_origins = "*".parse().ok();
    });
    assert_eq!(allowed(&any, developer).as_deref(), Some("*"));
    assert_eq!(post(&any, &[FOREIGN, CROSS_SITE]).status, 200);
}
