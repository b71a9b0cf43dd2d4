//! Grid spacing over HTTP by level of detail or by a limit on triangles; files without normals and in other units.
//! Names are the same in query, form and JSON document.

use crate::http_support;
use crate::tools;

use std::sync::Arc;

use http_support::{Reply, Running, SAMPLE, start};
use molmesh::formats::Format;
use molmesh::surface::CpuBackend;
use serde_json::{Value, json};
use tools::files::Files;

fn server() -> Running {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let folder = server.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
    server
}

fn good(reply: Reply) -> Reply {
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    reply
}

fn mesh(server: &Running, query: &str) -> Reply {
    good(server.post(&format!("/v1/meshes?{query}"), &[], SAMPLE))
}

/// Returns the report of the sample.
fn reported(server: &Running, query: &str) -> Value {
    good(server.post(&format!("/v1/report?{query}"), &[], SAMPLE)).json()
}

/// Sends the same parameter in a query, a form, a JSON document and for an archive entry.
fn everywhere(server: &Running, name: &str, value: &Value) -> [Reply; 4] {
    let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let mut form = format!("--XX\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n{text}\r\n").into_bytes();
    form.extend_from_slice(b"--XX\r\ncontent-disposition: form-data; name=\"file\"; filename=\"x\"\r\n\r\n");
    form.extend_from_slice(SAMPLE);
    form.extend_from_slice(b"\r\n--XX--\r\n");
    let document = json!({ "pdb_id": "4pti", name: value }).to_string();
    [
        mesh(server, &format!("{name}={text}")),
        good(server.post("/v1/meshes", &[("content-type", "multipart/form-data; boundary=XX")], &form)),
        good(server.post("/v1/meshes", &[("content-type", "application/json")], document.as_bytes())),
        good(server.get(&format!("/v1/pdb/4pti/surface.glb?{name}={text}"))),
    ]
}

#[test]
fn query_form_document_and_entry_give_the_same_bytes() {
    let server = server();
    let plain = mesh(&server, "");
    let mut tags = vec![plain.header("etag").unwrap().to_owned()];
    for (name, value, from) in [
        ("detail", json!(3), "detail"),
        ("max_triangles", json!(5000), "max_triangles"),
        ("normals", json!("none"), "resolution"),
        ("units", json!("nanometer"), "resolution"),
        ("units", json!("meter"), "resolution"),
    ] {
        let [first, others @ ..] = everywhere(&server, name, &value);
        assert_eq!(first.header("molmesh-resolution-from"), Some(from), "{name}");
        assert!(first.body != plain.body, "{name} changes the file");
        for other in others {
            assert!(other.body == first.body, "{name}");
            assert_eq!(other.header("etag"), first.header("etag"), "{name}");
            assert_eq!(other.header("molmesh-resolution"), first.header("molmesh-resolution"), "{name}");
            assert_eq!(other.header("molmesh-resolution-from"), Some(from), "{name}: stored or computed");
        }
        tags.push(first.header("etag").unwrap().to_owned());
    }
    let n = tags.len();
    tags.sort();
    tags.dedup();
    assert_eq!(tags.len(), n, "different files have different ETags");
}

#[test]
fn responses_report_the_chosen_spacing() {
    let server = server();
    let bounded = mesh(&server, "max_triangles=5000");
    let number = |name: &str| bounded.header(name).unwrap().parse::<f64>().unwrap();
    assert!(number("molmesh-triangles") <= 5000.0 && number("molmesh-triangles") > 4500.0, "{bounded:?}");
    assert!(number("molmesh-resolution") > 1.0, "{bounded:?}");
    let report = reported(&server, "max_triangles=5000");
    assert_eq!((&report["resolution_from"], &report["max_triangles"]), (&json!("max_triangles"), &json!(5000)));
    assert_eq!(report["resolution"].to_string(), bounded.header("molmesh-resolution").unwrap());
    assert!(report["tries"].as_u64().is_some_and(|tries| (2..=8).contains(&tries)), "{report}");
    let by_level = reported(&server, "detail=2");
    assert_eq!([&by_level["resolution_from"], &by_level["detail"]], [&json!("detail"), &json!(2)]);
    assert_eq!((&by_level["resolution"], by_level.get("tries")), (&json!(1.0), None));
    let scaled = reported(&server, "units=nanometer&normals=none&resolution=1");
    assert_eq!([&scaled["report_units"], &scaled["file_units"]], [&json!("angstrom"), &json!("nanometer")]);
    assert_eq!(scaled["normals"], "none");
    assert_eq!((&scaled["area"], &scaled["volume"]), (&by_level["area"], &by_level["volume"]), "reports stay in Å");
}

#[test]
fn contradictory_and_impossible_parameters_are_rejected() {
    let server = server();
    for (query, one, other) in [
        ("detail=3&resolution=1", "resolution", "detail"),
        ("resolution=1&max_triangles=1000", "max_triangles", "resolution"),
        ("max_triangles=1000&detail=3", "detail", "max_triangles"),
    ] {
        for path in ["/v1/meshes", "/v1/estimate"] {
            let problem = server.post(&format!("{path}?{query}"), &[], SAMPLE).problem(400, "bad-parameter");
            assert_eq!(problem["parameter"], one, "{problem}");
            let detail = problem["detail"].as_str().unwrap();
            assert!(detail.contains(&format!("`{one}`")) && detail.contains(&format!("`{other}`")), "{problem}");
        }
        server.get(&format!("/v1/pdb/4pti/surface.ply?{query}")).problem(400, "bad-parameter");
    }
    let document = json!({ "pdb_id": "4pti", "detail": 3, "resolution": 1 }).to_string();
    let json = [("content-type", "application/json")];
    server.post("/v1/meshes", &json, document.as_bytes()).problem(400, "bad-parameter");

    let problem = server.post("/v1/meshes?max_triangles=20", &[], SAMPLE).problem(422, "mesh-too-large");
    assert_eq!([&problem["parameter"], &problem["limit"]], [&json!("max_triangles"), &json!(20)]);
    assert_eq!(problem["resolution"], 4.0);
    let fewest = problem["actual"].as_u64().unwrap();
    assert!(fewest > 20, "{problem}");
    // The smallest possible limit on triangles; one less is impossible.
    let least = mesh(&server, &format!("max_triangles={fewest}"));
    assert!(least.header("molmesh-triangles").unwrap().parse::<u64>().unwrap() <= fewest);
    let below = server.post(&format!("/v1/meshes?max_triangles={}", fewest - 1), &[], SAMPLE);
    assert_eq!(below.problem(422, "mesh-too-large")["actual"], fewest);

    for (path, headers) in
        [("/v1/meshes?units=meter&format=obj", &[][..]), ("/v1/meshes?units=meter", &[("accept", "model/stl")][..])]
    {
        let problem = server.post(path, headers, SAMPLE).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], "units");
        let expected = problem["expected"].as_str().unwrap();
        assert!(expected.contains("nanometer") && expected.contains("glb, gltf"), "{problem}");
    }
    // A report has no format.
    reported(&server, "units=meter");
}

#[test]
fn estimates_and_capabilities_support_spacing_parameters() {
    let server = server();
    let estimate = |query: &str| good(server.post(&format!("/v1/estimate?{query}"), &[], SAMPLE)).json();
    let bounded = estimate("max_triangles=5000");
    let made = mesh(&server, "max_triangles=5000");
    assert_eq!((&bounded["accepted"], &bounded["resolution_from"]), (&json!(true), &json!("max_triangles")));
    let ratio =
        bounded["resolution"].as_f64().unwrap() / made.header("molmesh-resolution").unwrap().parse::<f64>().unwrap();
    assert!((0.9..1.1).contains(&ratio), "{ratio}");
    assert!(bounded["triangles"].as_u64().unwrap() <= 5000, "{bounded}");
    let refused = estimate("max_triangles=20");
    assert_eq!((&refused["accepted"], &refused["problem"]["limit"]), (&json!(false), &json!(20)));
    assert_eq!(refused["problem"]["type"], "/problems/mesh-too-large");
    let by_level = estimate("detail=1");
    assert_eq!((&by_level["resolution"], &by_level["resolution_from"]), (&json!(1.4), &json!("detail")));

    let can = server.get("/v1/capabilities").json();
    let parameter =
        |name: &str| can["parameters"].as_array().unwrap().iter().find(|p| p["name"] == name).unwrap().clone();
    let detail = parameter("detail");
    assert_eq!([&detail["type"], &detail["min"], &detail["max"]], [&json!("integer"), &json!(0), &json!(6)]);
    assert_eq!(parameter("max_triangles")["min"], 8);
    assert_eq!(parameter("normals")["values"], json!(["smooth", "none"]));
    assert_eq!(parameter("split")["values"], json!(["none", "chain", "entity", "residue-group", "pocket"]));
    assert_eq!(parameter("units")["values"], json!(["angstrom", "nanometer", "meter"]));
}

/// An asynchronous job is run with its recorded parameters.
#[test]
fn asynchronous_jobs_use_their_recorded_parameters() {
    let server = server();
    let query = "/v1/meshes?max_triangles=3000&normals=none&units=nanometer&format=ply";
    let accepted = server.post(query, &[("prefer", "respond-async")], SAMPLE);
    assert_eq!(accepted.status, 202, "{}", accepted.text());
    let job = accepted.header("location").unwrap().to_owned();
    let end = good(server.get(&format!("{job}?wait=15"))).json();
    assert_eq!(end["status"], "successful", "{end}");
    let result = server.get(&format!("{job}/result"));
    assert_eq!(result.status, 303);
    let kept = good(server.get(result.header("location").unwrap()));
    assert!(kept.body == good(server.post(query, &[], SAMPLE)).body);
    let head = String::from_utf8_lossy(&kept.body[..1500]).into_owned();
    assert!(head.contains("comment units nanometer") && !head.contains("property float nx"), "{head}");
}

#[test]
fn external_readers_accept_served_files() {
    let server = server();
    let (mut all, mut gltf) = (Files::new(), Files::new());
    let mut expected = Vec::new();
    for format in ["glb", "gltf", "ply", "ply-text", "stl", "obj"] {
        let extension = format.parse::<Format>().unwrap().extension();
        for (n, more) in ["", "&normals=none", "&units=nanometer", "&normals=none&units=nanometer"].iter().enumerate() {
            let body = mesh(&server, &format!("detail=2&format={format}{more}")).body;
            all.add(&format!("{n}-{format}.{extension}"), &body);
            if format.starts_with("gl") {
                gltf.add(&format!("{n}.{format}"), &body);
            }
            expected.push((format, more.contains("none"), if more.contains("nano") { 0.1 } else { 1.0 }));
        }
    }
    gltf.add("meter.glb", &mesh(&server, "detail=2&units=meter&compress=quantize&normals=none").body);
    if let Some(reports) = tools::gltf_validate(&gltf.paths) {
        reports.iter().for_each(tools::GltfReport::assert_clean);
    }
    let report = reported(&server, "detail=2");
    let (area, volume) = (report["area"].as_f64().unwrap(), report["volume"].as_f64().unwrap());
    let Some(reports) = tools::trimesh(&all.paths) else { return };
    let plain = reports[0].bounds;
    for (found, (format, bare, scale)) in reports.iter().zip(expected) {
        assert_eq!(found.error, None);
        // Four decimals of text may make corners of a triangle coincide, which is not a fault of the surface.
        assert!(found.watertight && found.winding_consistent && found.bad_edges == 0, "{found:#?}");
        assert!((found.area / (area * scale * scale) - 1.0).abs() < 1e-3, "{found:#?}");
        assert!((found.volume / (volume * scale * scale * scale) - 1.0).abs() < 1e-3, "{found:#?}");
        let worst = found.bounds.as_flattened().iter().zip(plain.as_flattened());
        let worst = worst.map(|(found, plain)| (found - scale * plain).abs()).fold(0.0, f64::max);
        assert!(worst < 2e-4, "{worst}: {found:#?}");
        assert_eq!(found.max_normal_error.is_none(), bare || format == "stl", "{found:#?}");
    }
}
