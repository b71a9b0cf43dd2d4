//! Content codings of responses: decoded bytes, entity tags, ranges, and clients that accept none.

use crate::http_support;

use std::io::Read as _;
use std::sync::{Arc, LazyLock};

use async_compression::tokio::bufread::BrotliDecoder;
use http_support::{Reply, Running, SAMPLE, send, start, wait_for};
use molmesh::surface::CpuBackend;
use tokio::io::AsyncReadExt as _;

static SERVER: LazyLock<Running> = LazyLock::new(server);

fn server() -> Running {
    start(Arc::new(CpuBackend::new(None).unwrap()), |_| {})
}

fn structure() -> String {
    SERVER.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned()
}

fn decoded(reply: &Reply) -> Vec<u8> {
    let mut plain = Vec::new();
    match reply.header("content-encoding") {
        Some("gzip") => _ = flate2::read::GzDecoder::new(&reply.body[..]).read_to_end(&mut plain).unwrap(),
        Some("zstd") => {
            let mut decoder = ruzstd::decoding::StreamingDecoder::new(&reply.body[..]).unwrap();
            decoder.read_to_end(&mut plain).unwrap();
        }
        Some("br") => {
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let mut decoder = BrotliDecoder::new(&reply.body[..]);
            runtime.block_on(decoder.read_to_end(&mut plain)).unwrap();
        }
        other => panic!("{other:?}"),
    }
    plain
}

#[test]
fn decoded_responses_are_the_plain_ones() {
    let structure = structure();
    let paths = [
        format!("{structure}/surface.glb"),
        format!("{structure}/surface.glb?compress=meshopt"),
        format!("{structure}/surface.obj"),
        format!("{structure}/surface.stl"),
        format!("{structure}/surface.ply"),
        format!("{structure}/surface.vtp"),
        format!("{structure}/atoms"),
        format!("{structure}/areas?surface=ses"),
        "/openapi.json".to_owned(),
        "/openapi.yaml".to_owned(),
        "/v1/capabilities".to_owned(),
    ];
    for path in &paths {
        let plain = SERVER.get(path);
        assert_eq!((plain.status, plain.header("content-encoding")), (200, None), "{path}");
        assert!(plain.header("vary").unwrap().contains("accept-encoding"), "{path}");
        let etag = plain.header("etag").unwrap();
        for coding in ["zstd", "br", "gzip"] {
            let reply = send(SERVER.addr, "GET", path, &[("accept-encoding", coding)], b"");
            assert_eq!((reply.status, reply.header("content-encoding")), (200, Some(coding)), "{path}");
            assert!(decoded(&reply) == plain.body, "{coding} {path}");
            assert!(reply.body.len() < plain.body.len() * 19 / 20, "{coding} {path}: {}", reply.body.len());
            assert_eq!(reply.header("content-length"), None);
            let own = reply.header("etag").unwrap();
            assert_eq!(own, format!("{}-{coding}\"", etag.strip_suffix('"').unwrap()));
            let again = [("accept-encoding", coding), ("if-none-match", own)];
            let unchanged = send(SERVER.addr, "GET", path, &again, b"");
            assert_eq!((unchanged.status, unchanged.header("etag")), (304, Some(own)), "{coding} {path}");
            assert!(unchanged.header("vary").unwrap().contains("accept-encoding"), "{path}");
            let head = send(SERVER.addr, "HEAD", path, &[("accept-encoding", coding)], b"");
            assert!(head.status == 200 && head.body.is_empty(), "{path}");
            for name in ["content-encoding", "content-length", "etag", "vary"] {
                assert_eq!(head.header(name), reply.header(name), "{name} of {coding} {path}");
            }
            // A client that has the plain response only does not get the tag of another.
            let both = format!("\"stale-{coding}\", {etag}");
            let listed = [("accept-encoding", coding), ("if-none-match", both.as_str())];
            let unchanged = send(SERVER.addr, "GET", path, &listed, b"");
            assert_eq!((unchanged.status, unchanged.header("etag")), (304, Some(etag)), "{coding} {path}");
            // The tag of one coding is not that of another.
            let plain_again = send(SERVER.addr, "GET", path, &[("if-none-match", own)], b"");
            assert_eq!(plain_again.status, 200, "{coding} {path}");
        }
        assert_eq!(send(SERVER.addr, "GET", path, &[("if-none-match", etag)], b"").status, 304, "{path}");
    }
}

#[test]
fn a_mesh_of_an_upload_is_compressed_while_it_is_sent() {
    let plain = SERVER.post("/v1/meshes?format=ply-text", &[], SAMPLE);
    let reply = SERVER.post("/v1/meshes?format=ply-text", &[("accept-encoding", "gzip, zstd;q=0.5")], SAMPLE);
    assert_eq!((reply.status, reply.header("content-encoding")), (200, Some("gzip")));
    assert!(decoded(&reply) == plain.body);
    let octets = [("accept-encoding", "zstd"), ("accept", "application/octet-stream")];
    let reply = SERVER.post("/v1/meshes?format=ply-text", &octets, SAMPLE);
    assert_eq!(reply.header("content-type"), Some("application/octet-stream"));
    assert!(decoded(&reply) == plain.body);
}

#[test]
fn ranges_are_those_of_the_plain_response() {
    let path = format!("{}/surface.glb", structure());
    let plain = SERVER.get(&path);
    let path = plain.header("content-location").unwrap();
    let whole = SERVER.get(path);
    let tag = whole.header("etag").unwrap();
    assert_eq!(whole.header("accept-ranges"), Some("bytes"));
    let range = [("accept-encoding", "zstd"), ("range", "bytes=100-199"), ("if-range", tag)];
    let part = send(SERVER.addr, "GET", path, &range, b"");
    assert_eq!((part.status, part.header("content-encoding"), part.header("etag")), (206, None, Some(tag)));
    assert!(part.header("vary").unwrap().contains("accept-encoding"));
    assert!(part.body == plain.body[100..200]);
    let compressed = send(SERVER.addr, "GET", path, &[("accept-encoding", "zstd")], b"");
    assert_eq!(compressed.header("accept-ranges"), None);
    // The part would not fit to the compressed bytes of the client.
    let own = compressed.header("etag").unwrap();
    let range = [("accept-encoding", "zstd"), ("range", "bytes=100-199"), ("if-range", own)];
    let all = send(SERVER.addr, "GET", path, &range, b"");
    assert_eq!((all.status, all.header("content-encoding")), (200, Some("zstd")));
}

#[test]
fn pictures_small_responses_and_events_stay_plain() {
    let structure = structure();
    for path in [format!("{structure}/surface.png?width=64&height=64"), "/livez".to_owned()] {
        let reply = send(SERVER.addr, "GET", &path, &[("accept-encoding", "zstd, br, gzip")], b"");
        assert_eq!((reply.status, reply.header("content-encoding")), (200, None), "{path}");
    }
    let job = SERVER.post("/v1/meshes?resolution=1.9", &[("prefer", "respond-async")], SAMPLE);
    let events = format!("{}/events", job.header("location").unwrap());
    let reply = send(SERVER.addr, "GET", &events, &[("accept-encoding", "zstd")], b"");
    let found = (reply.status, reply.header("content-type"), reply.header("content-encoding"));
    assert_eq!(found, (200, Some("text/event-stream"), None));
}

#[test]
fn a_client_that_accepts_nothing_gets_406_before_any_work() {
    // Other tests mesh on the shared server.
    let server = server();
    let meshes = || server.metric("molmesh_jobs_finished_total", &["outcome=\"successful\""]);
    let before = meshes();
    for refused in ["identity;q=0", "*;q=0", "identity;q=0, deflate;q=1"] {
        let reply = server.post("/v1/meshes?resolution=1.7", &[("accept-encoding", refused)], SAMPLE);
        let problem = reply.problem(406, "not-acceptable");
        assert_eq!(problem["available"], serde_json::json!(["zstd", "br", "gzip"]));
    }
    assert!(meshes() <= before);
    assert_eq!(server.post("/v1/meshes?resolution=1.7", &[], SAMPLE).status, 200);
    wait_for("a counted mesh", || meshes() > before);
    for nonsense in ["deflate", ";;q=,", "gzip;q=2", ""] {
        let reply = send(server.addr, "GET", "/openapi.json", &[("accept-encoding", nonsense)], b"");
        assert_eq!((reply.status, reply.header("content-encoding")), (200, None), "{nonsense}");
    }
}
