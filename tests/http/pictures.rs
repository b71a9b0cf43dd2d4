//! Pictures over HTTP: every route of a mesh also returns a picture, which is cached like a mesh; parameters of
//! pictures; limits.

use crate::http_support;

use std::sync::Arc;
use std::sync::atomic::Ordering;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, send, start};
use molmesh::config::Config;

/// Starts a server with an archive entry.
fn server(backend: &Arc<Fake>, change: impl FnOnce(&mut Config)) -> Running {
    let server = start(Arc::clone(backend) as _, change);
    let folder = server.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
    server
}

/// Reads width, height and presence of an alpha channel from the header of a PNG.
#[track_caller]
fn png(reply: &Reply) -> (u32, u32, bool) {
    assert_eq!((reply.status, reply.complete), (200, true), "{}", String::from_utf8_lossy(&reply.body));
    assert_eq!(reply.header("content-type"), Some("image/png"));
    assert_eq!(reply.body[..8], *b"\x89PNG\r\n\x1a\n");
    let number = |at: usize| u32::from_be_bytes(reply.body[at..at + 4].try_into().unwrap());
    (number(16), number(20), reply.body[25] == 6)
}

#[test]
fn every_route_of_a_mesh_also_returns_a_picture() {
    let backend = Fake::new(Mode::Octahedra);
    let server = server(&backend, |_| {});
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let json = ("content-type", "application/json");
    let named = br#"{"pdb_id": "4pti", "format": "png", "width": 40, "height": 30, "view": "front"}"#;
    let query = "width=40&height=30&view=front";
    let first = server.get(&format!("/v1/pdb/4pti/surface.png?{query}"));
    // This response waits until the result is stored.
    assert_eq!(server.get(first.header("content-location").unwrap()).status, 200);
    let replies = [
        first,
        server.get(&format!("{structure}/surface.png?{query}")),
        server.post(&format!("/v1/meshes?format=png&{query}"), &[], SAMPLE),
        server.post(&format!("/v1/meshes?{query}"), &[("accept", "image/png")], SAMPLE),
        server.post("/v1/meshes", &[json], named),
    ];
    for reply in &replies {
        assert_eq!(png(reply), (40, 30, true));
        assert_eq!(reply.body, replies[0].body);
        assert_eq!(reply.header("etag"), replies[0].header("etag"));
        assert_eq!(reply.header("content-disposition"), Some("inline; filename=\"4PTI.png\""));
        assert_eq!(reply.header("molmesh-renderer"), Some("cpu"));
        assert!(reply.header("molmesh-renderer-device").unwrap().contains("rasterizer"));
        assert_eq!(reply.header("molmesh-renderer-reason"), Some("set by a test"));
        assert!(reply.header("molmesh-pixel").unwrap().parse::<f64>().unwrap() > 0.1);
        assert_eq!(reply.header("molmesh-atoms"), Some("454"));
    }
    // One picture was rendered; the others came from the store.
    assert_eq!(backend.started.load(Ordering::SeqCst), 1);
    // Headers of meshes are absent.
    let mesh = server.get("/v1/pdb/4pti/surface.glb");
    assert_eq!((mesh.status, mesh.header("molmesh-renderer")), (200, None));
    assert_eq!(mesh.header("content-disposition"), Some("attachment; filename=\"4PTI.glb\""));
}

#[test]
fn pictures_are_cached_like_meshes() {
    let backend = Fake::new(Mode::Octahedra);
    let server = server(&backend, |_| {});
    let at = |query: &str| server.get(&format!("/v1/pdb/4pti/surface.png?width=64&height=64&{query}"));
    let made = at("");
    let (etag, location) = (made.header("etag").unwrap(), made.header("content-location").unwrap());
    assert!(location.starts_with("/v1/results/") && location.split('.').next_back() == Some("png"), "{location}");
    assert!(made.header("cache-control").unwrap().contains("max-age"));
    let found = server.get(location);
    assert_eq!((png(&found), &found.body), ((64, 64, true), &made.body));
    assert!(found.header("cache-control").unwrap().contains("immutable"));
    for name in ["etag", "molmesh-renderer", "molmesh-renderer-reason", "molmesh-pixel", "content-disposition"] {
        assert_eq!(found.header(name), made.header(name), "{name}");
    }
    let unchanged = send(server.addr, "GET", location, &[("if-none-match", etag)], b"");
    assert_eq!((unchanged.status, unchanged.body.len()), (304, 0));
    let path = "/v1/pdb/4pti/surface.png?height=64&width=64&background=transparent";
    assert_eq!(send(server.addr, "GET", path, &[("if-none-match", etag)], b"").status, 304, "the same picture");
    let part = send(server.addr, "GET", location, &[("range", "bytes=0-7")], b"");
    assert_eq!((part.status, &part.body[..]), (206, &b"\x89PNG\r\n\x1a\n"[..]));
    let report = server.get(&location.replace(".png", "/report.json")).json();
    assert_eq!((&report["picture"]["width"], &report["picture"]["style"]), (&64.into(), &"surface".into()));
    assert_eq!((&report["picture"]["renderer"], &report["atoms"]), (&"cpu".into(), &454.into()));
    assert!(report["timings_ms"]["draw"].is_number() && report["timings_ms"]["png"].is_number(), "{report}");
    // Every parameter gives another picture with another ETag.
    let mut tags = vec![etag.to_owned()];
    for query in
        ["view=top", "azimuth=20", "elevation=-20", "background=white", "background=%23123456", "style=gouraud"]
    {
        let other = at(query);
        assert_eq!(other.status, 200, "{query}: {}", other.text());
        assert_ne!(other.body, made.body, "{query}");
        tags.push(other.header("etag").unwrap().to_owned());
    }
    tags.sort();
    tags.dedup();
    assert_eq!((tags.len(), backend.started.load(Ordering::SeqCst)), (7, 7));
    // HEAD returns the ETag without meshing.
    let head = send(server.addr, "HEAD", "/v1/pdb/4pti/surface.png?width=65", &[], b"");
    assert_eq!((head.status, head.header("content-type")), (200, Some("image/png")));
    assert_eq!(backend.started.load(Ordering::SeqCst), 7);
}

#[test]
fn pictures_can_be_rendered_asynchronously() {
    let server = server(&Fake::new(Mode::Octahedra), |_| {});
    let later = ("prefer", "respond-async");
    let accepted = send(server.addr, "GET", "/v1/pdb/4pti/surface.png?width=50&height=20", &[later], b"");
    assert_eq!(accepted.status, 202, "{}", accepted.text());
    let job = accepted.header("location").unwrap();
    let ended = server.get(&format!("{job}?wait=50")).json();
    assert_eq!(ended["status"], "successful", "{ended}");
    let result = server.get(&format!("{job}/result"));
    assert_eq!(result.status, 303);
    let picture = server.get(result.header("location").unwrap());
    assert_eq!(png(&picture), (50, 20, true));
    assert_eq!(picture.body, server.get("/v1/pdb/4pti/surface.png?width=50&height=20").body);
}

#[test]
fn parameters_that_do_not_apply_to_the_format_are_rejected() {
    let server = server(&Fake::new(Mode::Octahedra), |_| {});
    for (query, parameter) in [
        ("format=png&width=0", "width"),
        ("format=png&height=16385", "height"),
        ("format=png&view=inside", "view"),
        ("format=png&azimuth=361", "azimuth"),
        ("format=png&elevation=91", "elevation"),
        ("format=png&background=plaid", "background"),
        ("format=png&style=cubist", "style"),
        ("format=png&compress=quantize", "compress"),
        ("format=png&compress=meshopt", "compress"),
        ("format=png&normals=none", "normals"),
        ("format=png&units=nanometer", "units"),
        ("width=100", "width"),
        ("width=512&height=30", "height"),
        ("format=stl&view=top", "view"),
        ("format=glb&style=gouraud", "style"),
    ] {
        let problem = server.post(&format!("/v1/meshes?{query}"), &[], SAMPLE).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], parameter, "{query}: {problem}");
        assert!(problem["expected"].as_str().is_some_and(|text| !text.is_empty()), "{query}: {problem}");
    }
    let problem = server.get("/v1/pdb/4pti/surface.glb?background=white").problem(400, "bad-parameter");
    assert!(problem["expected"].as_str().unwrap().contains("png"), "{problem}");
    let problem = server.get("/v1/pdb/4pti/surface.jpg").problem(404, "not-found");
    assert!(problem["available"].as_array().unwrap().contains(&"surface.png".into()), "{problem}");
    // A report with a picture describes the run of the picture.
    let report = server.post("/v1/report?format=png&width=32", &[], SAMPLE).json();
    assert_eq!(report["picture"]["width"], 32, "{report}");
}

#[test]
fn pictures_are_limited_before_any_work() {
    let backend = Fake::new(Mode::Octahedra);
    let server = server(&backend, |c| c.limits.picture_side = 100);
    for (side, query) in [("width", "width=101&height=5"), ("height", "width=5&height=101")] {
        for reply in [
            server.get(&format!("/v1/pdb/4pti/surface.png?{query}")),
            // Rejected before the body is read.
            server.post(&format!("/v1/meshes?format=png&{query}"), &[], b"no structure"),
        ] {
            let problem = reply.problem(422, "picture-too-large");
            assert_eq!((&problem["parameter"], &problem["limit"]), (&side.into(), &100.into()), "{problem}");
            assert_eq!(problem["actual"], 101);
        }
    }
    let refused = server.metric("molmesh_requests_rejected_total", &["reason=\"picture-too-large\""]);
    assert!(refused >= 4.0, "{refused}");
    assert_eq!(backend.started.load(Ordering::SeqCst), 0);
    assert_eq!(png(&server.get("/v1/pdb/4pti/surface.png?width=100&height=100")), (100, 100, true));
    assert_eq!(server.get("/v1/capabilities").json()["limits"]["picture_side"], 100);
    assert_eq!(server.get("/v1/capabilities").json()["renderers"][0]["name"], "cpu");
}

#[test]
fn drawing_uses_the_memory_budget() {
    let backend = Fake::new(Mode::Octahedra);
    let server = server(&backend, |c| c.limits.memory_bytes = 4 << 20);
    // Drawing takes 40 bytes per pixel: ten million pixels exceed the budget, ten thousand do not.
    server.get("/v1/pdb/4pti/surface.png?width=500&height=500").problem(422, "too-much-memory");
    assert_eq!(backend.started.load(Ordering::SeqCst), 0);
    assert_eq!(server.get("/v1/pdb/4pti/surface.png?width=100&height=100").status, 200);
}
