//! Maps sent beside a structure, for `color=map`.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use molmesh::surface::CpuBackend;
use serde_json::Value;

use crate::http_support::{self, Reply, Running, SAMPLE, gzip, start};

fn server(change: impl FnOnce(&mut molmesh::config::Config)) -> Running {
    start(Arc::new(CpuBackend::new(Some(2)).unwrap()), change)
}

/// Returns an `OpenDX` map of 5 × 5 × 5 points around the sample, with the value `slope · x` in volts.
fn map(slope: f64) -> Vec<u8> {
    let mut text = "object 1 class gridpositions counts 5 5 5\norigin -40 -40 -40\n".to_owned();
    text += "delta 30 0 0\ndelta 0 30 0\ndelta 0 0 30\nobject 2 class gridconnections counts 5 5 5\n";
    text += "object 3 class array type double rank 0 items 125 data follows\n";
    for i in 0..125 {
        let x = 30.0 * f64::from(i / 25) - 40.0;
        writeln!(text, "{}", slope * x).unwrap();
    }
    text.into_bytes()
}

const FORM: (&str, &str) = ("content-type", "multipart/form-data; boundary=XX");

/// Returns a form of the sample and further parts.
fn form(parts: &[(&str, &[u8])]) -> Vec<u8> {
    let part = |name: &str, content: &[u8]| {
        let head = format!("--XX\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"f\"\r\n\r\n");
        [head.as_bytes(), content, b"\r\n"].concat()
    };
    let parts = parts.iter().map(|(name, content)| part(name, content)).collect::<Vec<_>>().concat();
    [part("file", SAMPLE), parts, b"--XX--".to_vec()].concat()
}

const MESH: &str = "/v1/meshes?resolution=1.5&color=map&format=ply";

fn meshed(server: &Running, map: &[u8]) -> Reply {
    server.post(MESH, &[FORM], &form(&[("map", map)]))
}

#[test]
fn a_map_in_a_form_colours_the_mesh_and_belongs_to_the_key() {
    let server = server(|_| {});
    let first = meshed(&server, &map(1.0));
    assert_eq!(first.status, 200, "{}", first.text());
    let (tag, body) = (first.header("etag").unwrap().to_owned(), first.body.clone());
    let again = meshed(&server, &map(1.0));
    assert_eq!((again.header("etag"), &again.body), (Some(tag.as_str()), &body));
    // The values decide: another map, or the same one compressed, has another key, and only the latter the same
    // colours.
    let [other, packed] = [map(-1.0), gzip(&map(1.0))].map(|map| meshed(&server, &map));
    assert!(other.header("etag") != Some(&tag) && packed.header("etag") != Some(&tag));
    assert!(other.body != body && packed.body == body);
    let report = server.post("/v1/report?resolution=1.5&color=map", &[FORM], &form(&[("map", &map(1.0))])).json();
    let color = &report["color"];
    assert_eq!((&color["scheme"], &color["palette"]), (&"map".into(), &"red-white-blue".into()));
    assert_eq!(
        color["map"],
        serde_json::json!({ "format": "dx", "size": [5, 5, 5], "offset": 1.4, "vertices_outside": 0 })
    );
    let [low, high] = [0, 1].map(|end| color["range"][end].as_f64().unwrap());
    assert!((low + high).abs() < 1e-9 && high > 20.0, "{color}");
    assert_eq!(server.post("/v1/estimate?color=map", &[FORM], &form(&[("map", &map(1.0))])).status, 200);
}

#[test]
fn requests_without_a_map_or_with_a_useless_one_are_rejected() {
    let server = server(|_| {});
    let refused = |reply: Reply, kind: &str, words: &str| {
        let status = if kind == "bad-parameter" || kind == "bad-request" { 400 } else { 422 };
        let problem = reply.problem(status, kind);
        assert!(problem["detail"].as_str().unwrap().contains(words), "{words}: {problem}");
        problem
    };
    let needs = "it needs a map: send one as the part `map` of a form";
    refused(server.post(MESH, &[], SAMPLE), "bad-parameter", needs);
    refused(server.post(MESH, &[FORM], &form(&[])), "bad-parameter", needs);
    refused(server.get("/v1/pdb/4pti/surface.glb?color=map"), "bad-parameter", needs);
    let useless = server.post("/v1/meshes?color=chain", &[FORM], &form(&[("map", &map(1.0))]));
    assert_eq!(refused(useless, "bad-parameter", "does not use the map")["value"], "chain");
    let twice = server.post(MESH, &[FORM], &form(&[("map", &map(1.0)), ("map", &map(1.0))]));
    refused(twice, "bad-request", "more than one map");
    let stored = server.post("/v1/structures", &[FORM], &form(&[("map", &map(1.0))]));
    assert_eq!(refused(stored, "bad-parameter", "no parameter `map`")["parameter"], "map");
    let text = String::from_utf8(map(1.0)).unwrap();
    let bad = meshed(&server, text.replace("\n80\n", "\neighty\n").as_bytes());
    let problem = refused(bad, "unreadable-map", "line 108: found `eighty`");
    assert_eq!((&problem["location"], &problem["parameter"]), (&"line 108".into(), &"map".into()));
    refused(meshed(&server, SAMPLE), "unreadable-map", "unknown map format");
    let zipped = gzip(&map(1.0));
    assert_eq!(refused(meshed(&server, &zipped[..60]), "unreadable-map", "gzip")["encoding"], "gzip");
    let far = text.replace("origin -40 -40 -40", "origin 900 900 900");
    refused(meshed(&server, far.as_bytes()), "bad-parameter", "extends from (900.0, 900.0, 900.0)");
    let offset = server.post("/v1/meshes?color=chain&color_offset=2", &[], SAMPLE);
    assert_eq!(refused(offset, "bad-parameter", "color=map")["parameter"], "color_offset");
    for bad in ["10.5", "x", "-11"] {
        let reply = server.post(&format!("{MESH}&color_offset={bad}"), &[FORM], &form(&[("map", &map(1.0))]));
        assert_eq!(refused(reply, "bad-parameter", "a number from -10 to 10 Å")["value"], bad);
    }
    server.get("/v1/pdb/4pti/colors?scheme=map").problem(400, "bad-parameter");
}

#[test]
fn maps_are_limited() {
    let few = server(|c| c.limits.map_points = 124);
    let problem = meshed(&few, &map(1.0)).problem(422, "map-too-large");
    assert_eq!((&problem["limit"], &problem["actual"]), (&124.into(), &125.into()));
    assert_eq!(meshed(&server(|c| c.limits.map_points = 125), &map(1.0)).status, 200);
    let small = server(|c| c.limits.inflated_bytes = 100_000);
    let bomb = gzip(&[map(1.0), vec![b' '; 200_000]].concat());
    let problem = meshed(&small, &bomb).problem(413, "inflated-too-large");
    assert_eq!((&problem["limit"], &problem["parameter"]), (&100_000.into(), &"map".into()));
    assert_eq!(meshed(&small, &map(1.0)).status, 200);
}

#[test]
fn asynchronous_jobs_keep_their_map() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().to_path_buf();
    let sync = meshed(&server(|_| {}), &map(1.0)).body;
    let accepted = |server: &Running, map: &[u8], key: &str| {
        let headers = [FORM, ("prefer", "respond-async"), ("idempotency-key", key)];
        server.post(MESH, &headers, &form(&[("map", map)]))
    };
    let first = {
        // The only worker is busy with another job, so the job with the map is open when the server stops.
        let mut server = start(http_support::Fake::new(http_support::Mode::Slow(Duration::from_mins(1))), |c| {
            c.server.data_dir = data.clone();
            c.jobs.workers = 1;
            c.server.drain_timeout_ms = 0;
        });
        let busy = server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE);
        assert_eq!(busy.status, 202, "{}", busy.text());
        let reply = accepted(&server, &map(1.0), "one");
        assert_eq!(reply.status, 202, "{}", reply.text());
        let same = accepted(&server, &map(1.0), "one");
        assert_eq!(same.header("location"), reply.header("location"));
        accepted(&server, &map(2.0), "one").problem(422, "other-request");
        server.stop();
        reply.header("location").unwrap().to_owned()
    };
    let next = start(Arc::new(CpuBackend::new(Some(2)).unwrap()), |c| c.server.data_dir = data);
    let end = |path: &str| -> Value {
        for _ in 0..20 {
            let job = next.get(&format!("{path}?wait=20")).json();
            if !["accepted", "running"].contains(&job["status"].as_str().unwrap()) {
                return job;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("the job does not end")
    };
    assert_eq!(end(&first)["status"], "successful", "{}", end(&first));
    let result = |job: &str| {
        let found = next.get(&format!("{job}/result"));
        next.get(found.header("location").unwrap()).body
    };
    assert!(result(&first) == sync);
    // Negative control: another map gives other bytes.
    let other = accepted(&next, &map(-1.0), "two").header("location").unwrap().to_owned();
    assert_eq!(end(&other)["status"], "successful");
    let other = result(&other);
    assert!(other.len() == sync.len() && other != sync);
}
