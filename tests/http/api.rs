//! The service over a socket: every resource, and every error below the limits.

use crate::bcif_support;
use crate::http_support;

use std::io::{Read as _, Write};
use std::sync::{Arc, LazyLock};

use bcif_support::CRAMBIN;
use http_support::{Fake, Mode, Running, SAMPLE, gzip, log_lines, send, start};
use molmesh::pipeline::{AreaLevel, areas, params};
use molmesh::structure::{self, ReadLimits};
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::{Control, SurfaceLimits};

/// Server with the fake backend that all tests share. It is never stopped.
static SERVER: LazyLock<Running> = LazyLock::new(|| {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let archive = server.dir.path().join("archive/pt");
    std::fs::create_dir_all(&archive).unwrap();
    std::fs::write(archive.join("pdb4pti.ent.gz"), gzip(SAMPLE)).unwrap();
    std::fs::write(server.dir.path().join("archive/1crn.bcif.gz"), gzip(CRAMBIN)).unwrap();
    server
});

fn zstd(bytes: &[u8]) -> Vec<u8> {
    ruzstd::encoding::compress_to_vec(bytes, ruzstd::encoding::CompressionLevel::Fastest)
}

const CURL: (&str, &str) = ("content-type", "application/x-www-form-urlencoded");

#[test]
fn a_plain_curl_upload_is_meshed_by_the_real_backend() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let reply = server.post("/v1/meshes", &[CURL, ("accept", "*/*"), ("x-request-id", "pasted-1")], SAMPLE);
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    assert_eq!(reply.header("content-type"), Some("model/gltf-binary"));
    assert_eq!(reply.header("content-length").unwrap().parse::<usize>().unwrap(), reply.body.len());
    assert_eq!(&reply.body[..4], b"glTF");
    assert_eq!(reply.header("content-disposition").unwrap().to_ascii_lowercase(), "attachment; filename=\"4pti.glb\"");
    assert_eq!(reply.header("molmesh-atoms"), Some("454"));
    assert_eq!(reply.header("molmesh-closed"), Some("true"));
    assert_eq!(reply.header("molmesh-manifold"), Some("true"));
    assert_eq!(reply.header("molmesh-resolution"), Some("0.5"));
    assert_eq!(reply.header("molmesh-backend"), Some("cpu"));
    assert_eq!(reply.header("molmesh-backend-reason"), Some("set by a test"));
    let volume: f64 = reply.header("molmesh-volume").unwrap().parse().unwrap();
    assert!((5_000.0..15_000.0).contains(&volume), "{volume}");
    assert_eq!(reply.header("vary"), Some("accept"));
    let timing = reply.header("server-timing").unwrap();
    for stage in ["receive", "queue", "read", "select", "field", "emit", "measure"] {
        assert!(timing.contains(&format!("{stage};dur=")), "{timing}");
    }
    // One line per request, without warnings.
    let lines = log_lines("pasted-1");
    assert!(lines.iter().any(|line| line.contains("answered") && line.contains("status=200")), "{lines:?}");
    assert!(lines.iter().all(|line| !line.contains("WARN") && !line.contains("ERROR")), "{lines:?}");
    // The same request gives the same bytes and ETag; another parameter gives different ones.
    let again = server.post("/v1/meshes", &[CURL], SAMPLE);
    assert_eq!((again.header("etag"), &again.body), (reply.header("etag"), &reply.body));
    let coarse = server.post("/v1/meshes?resolution=1", &[CURL], SAMPLE);
    assert_ne!(coarse.header("etag"), reply.header("etag"));
    assert!(coarse.body.len() < reply.body.len());
    assert!(server.metric("molmesh_grid_points_evaluated_total", &[]) > 0.0);
    assert!(server.join());
}

#[test]
fn the_report_is_returned_instead_of_the_mesh() {
    let reply = SERVER.post("/v1/report?surface=soft-object&isovalue=1.5", &[("accept", "text/html")], SAMPLE);
    assert_eq!(reply.status, 200);
    assert_eq!(reply.header("content-type"), Some("application/json"));
    assert_eq!(reply.header("etag"), None);
    let report = reply.json();
    for key in [
        "atoms",
        "vertices",
        "triangles",
        "closed",
        "manifold",
        "euler",
        "components",
        "area",
        "volume",
        "resolution",
        "surface",
        "backend",
        "timings_ms",
    ] {
        assert!(!report[key].is_null(), "{key} in {report}");
    }
    assert_eq!((&report["atoms"], &report["triangles"]), (&454.into(), &(454 * 8).into()));
    assert_eq!((report["surface"].as_str(), report["isovalue"].as_f64()), (Some("soft-object"), Some(1.5)));
    assert!(report["timings_ms"]["queue"].as_f64().is_some());
}

#[test]
fn formats_are_negotiated() {
    for (query, accept, status, media_type) in [
        ("", "", 200, "model/gltf-binary"),
        ("", "*/*", 200, "model/gltf-binary"),
        ("", "model/stl", 200, "model/stl"),
        ("", "model/obj;q=0.5, application/ply;q=0.9", 200, "application/ply"),
        ("", "model/gltf-binary;q=0, model/*", 200, "model/gltf+json"),
        ("", "text/html,application/xhtml+xml,*/*;q=0.8", 200, "model/gltf-binary"),
        ("?format=obj", "model/stl", 200, "model/obj"),
        ("?format=stl", "text/html", 200, "model/stl"),
        ("", "model/x-ply-text, */*;q=0.5", 200, "model/x-ply-text"),
        ("", "image/png", 200, "image/png"),
        ("?format=png", "model/stl", 200, "image/png"),
        ("", "image/webp", 406, "application/problem+json"),
        ("", "application/json", 200, "model/gltf-binary"),
        ("", "application/octet-stream", 200, "application/octet-stream"),
        ("", "application/problem+json", 200, "model/gltf-binary"),
    ] {
        let headers: &[(&str, &str)] = if accept.is_empty() { &[] } else { &[("accept", accept)] };
        let reply = SERVER.post(&format!("/v1/meshes{query}"), headers, SAMPLE);
        assert_eq!((reply.status, reply.header("content-type")), (status, Some(media_type)), "{query} {accept}");
        assert!(reply.complete);
        if status == 406 {
            assert_eq!(reply.problem(406, "not-acceptable")["available"].as_array().unwrap().len(), 10);
        } else {
            assert!(reply.body.len() > 1000);
        }
    }
}

#[test]
fn forms_contain_a_file_and_parameters() {
    let form = |parts: &[(&str, &[u8])]| {
        let mut body = Vec::new();
        for (head, content) in parts {
            write!(body, "--XX\r\ncontent-disposition: form-data; {head}\r\n\r\n").unwrap();
            body.extend_from_slice(content);
            body.extend_from_slice(b"\r\n");
        }
        body.extend_from_slice(b"--XX--\r\n");
        body
    };
    let kind = ("content-type", "multipart/form-data; boundary=XX");
    let binary = form(&[("name=\"file\"; filename=\"x.bcif\"", CRAMBIN), ("name=\"resolution\"", b"1")]);
    let reply = SERVER.post("/v1/meshes", &[kind], &binary);
    assert_eq!((reply.status, reply.header("molmesh-atoms")), (200, Some("327")));
    for name in ["file", "structure"] {
        let file = format!("name=\"{name}\"; filename=\"x.pdb\"");
        let body = form(&[(&file, SAMPLE), ("name=\"resolution\"", b"0.75"), ("name=\"format\"", b"ply")]);
        let reply = SERVER.post("/v1/meshes?isovalue=1.2", &[kind], &body);
        assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
        assert_eq!(reply.header("content-type"), Some("application/ply"));
        assert_eq!((reply.header("molmesh-resolution"), reply.header("molmesh-isovalue")), (Some("0.75"), Some("1.2")));
    }
    // A value that the surface does not have has no header.
    let reply = SERVER.post("/v1/meshes?surface=vdw&resolution=1", &[], SAMPLE);
    assert_eq!((reply.header("molmesh-surface"), reply.header("molmesh-isovalue")), (Some("vdw"), None));
    let post = |body: &[u8]| SERVER.post("/v1/meshes", &[kind], body);
    assert_eq!(post(&form(&[("name=\"resolution\"", b"1")])).problem(400, "bad-request")["expected"], "file");
    post(&form(&[("name=\"file\"", SAMPLE), ("name=\"file\"", SAMPLE)])).problem(400, "bad-request");
    post(b"not a form").problem(400, "bad-request");
    let unknown = post(&form(&[("name=\"file\"", SAMPLE), ("name=\"resolutoin\"", b"1")]));
    assert_eq!(unknown.problem(400, "bad-parameter")["nearest"], "resolution");
    let long = post(&form(&[("name=\"file\"", SAMPLE), ("name=\"chains\"", &[b'A'; 5000])]));
    assert_eq!(long.problem(400, "bad-parameter")["limit"], 4096);
    let twice = SERVER.post(
        "/v1/meshes?resolution=1",
        &[kind],
        &form(&[("name=\"file\"", SAMPLE), ("name=\"resolution\"", b"1")]),
    );
    assert_eq!(twice.problem(400, "bad-parameter")["parameter"], "resolution");
    SERVER.post("/v1/meshes", &[("content-type", "multipart/form-data")], b"x").problem(400, "bad-request");
}

#[test]
fn compressed_bodies_are_detected_by_content_and_header() {
    let (gz, zst) = (gzip(SAMPLE), zstd(SAMPLE));
    let post = |headers: &[(&str, &str)], body: &[u8]| SERVER.post("/v1/meshes", headers, body);
    for (encoding, body) in [("gzip", &gz), ("x-gzip", &gz), ("zstd", &zst), ("GZIP", &gz)] {
        for headers in [&[][..], &[("content-encoding", encoding)][..]] {
            let reply = post(headers, body);
            assert_eq!((reply.status, reply.header("molmesh-atoms")), (200, Some("454")), "{headers:?}");
        }
    }
    assert_eq!(post(&[("content-encoding", "identity")], SAMPLE).status, 200);
    for (encoding, body) in [("gzip", SAMPLE), ("zstd", &gz), ("br", SAMPLE), ("gzip, gzip", &gz)] {
        let reply = post(&[("content-encoding", encoding)], body);
        assert_eq!(reply.problem(415, "unsupported-encoding")["available"][0], "gzip", "{encoding}");
    }
    post(&[], &gz[..gz.len() / 2]).problem(422, "unreadable-structure");
    let json = ("content-type", "application/json");
    let encoded = SERVER.post("/v1/meshes", &[json, ("content-encoding", "gzip")], br#"{"pdb_id": "4pti"}"#);
    encoded.problem(415, "unsupported-encoding");
    let structure = SERVER.post("/v1/structures", &[json], br#"{"pdb_id": "4pti"}"#);
    let problem = structure.problem(415, "unsupported-media-type");
    assert!(problem["detail"].as_str().unwrap().contains("/v1/meshes"), "{problem}");
}

#[test]
fn a_media_type_that_contradicts_the_content_is_rejected() {
    let png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR";
    let cif = include_bytes!("../../samples/1crn.cif");
    for (declared, body, status) in [
        ("chemical/x-pdb", SAMPLE, 200),
        ("chemical/x-mmcif", cif, 200),
        ("text/plain; charset=utf-8", SAMPLE, 200),
        ("application/octet-stream", cif, 200),
        // A wrong hint about valid content is ignored.
        ("image/png", SAMPLE, 200),
        ("chemical/x-pdb", cif, 415),
        ("chemical/x-mmcif", SAMPLE, 415),
        ("application/gzip", SAMPLE, 415),
        ("image/png", png, 415),
        ("application/octet-stream", png, 422),
        ("application/octet-stream", CRAMBIN, 200),
        ("application/x-www-form-urlencoded", CRAMBIN, 200),
        ("chemical/x-bcif", CRAMBIN, 200),
        ("application/vnd.msgpack", CRAMBIN, 200),
        ("application/vnd.binarycif", SAMPLE, 415),
        ("chemical/x-bcif", cif, 415),
        ("chemical/x-mmcif", CRAMBIN, 415),
        ("chemical/x-pdb", CRAMBIN, 415),
        ("application/json", &SAMPLE[..8000], 415),
    ] {
        let reply = SERVER.post("/v1/meshes", &[("content-type", declared)], body);
        match status {
            200 => assert_eq!(reply.status, 200, "{declared}: {}", String::from_utf8_lossy(&reply.body)),
            415 => {
                let problem = reply.problem(415, "unsupported-media-type");
                assert_eq!(problem["declared"], declared.split(';').next().unwrap());
                assert!(problem["found"].is_string());
            }
            _ => drop(reply.problem(422, "unreadable-structure")),
        }
    }
}

#[test]
fn files_that_cannot_be_structures_are_rejected_before_a_job_is_accepted() {
    let prefer = ("prefer", "respond-async");
    SERVER.post("/v1/meshes", &[prefer], b"{}").problem(422, "unreadable-structure");
    SERVER.post("/v1/meshes", &[prefer, ("content-type", "image/png")], b"{}").problem(415, "unsupported-media-type");
    // `curl -d @file` removes the line ends.
    let line: Vec<u8> = SAMPLE.iter().copied().filter(|byte| *byte != b'\n').collect();
    for prefer in [&[prefer][..], &[]] {
        let headers = [&[("content-type", "application/x-www-form-urlencoded")], prefer].concat();
        let problem = SERVER.post("/v1/meshes", &headers, &line).problem(422, "unreadable-structure");
        assert!(problem["detail"].as_str().unwrap().contains("--data-binary"), "{problem}");
    }
}

#[test]
fn a_result_that_is_not_stored_is_absent_for_any_condition() {
    let path = format!("/v1/results/{}.glb", "0".repeat(64));
    for headers in [&[][..], &[("if-none-match", "*")]] {
        send(SERVER.addr, "GET", &path, headers, b"").problem(404, "not-found");
    }
}

#[test]
fn errors_name_bad_parameters_and_expected_values() {
    for (query, parameter, nearest) in [
        ("resolutoin=1", "resolutoin", Some("resolution")),
        ("Surface=gaussian", "Surface", Some("surface")),
        ("isovlaue=1", "isovlaue", Some("isovalue")),
        ("xyzzyxyzzyxyzzy=1", "xyzzyxyzzyxyzzy", None),
        ("resolution=1&resolution=1", "resolution", None),
        ("resolution=", "resolution", None),
        ("resolution=0", "resolution", None),
        ("resolution=-1", "resolution", None),
        ("resolution=1e-6", "resolution", None),
        ("resolution=nan", "resolution", None),
        ("resolution=inf", "resolution", None),
        ("resolution=1%20apple", "resolution", None),
        ("isovalue=0", "isovalue", None),
        ("surface=cubic", "surface", None),
        ("preset=nice", "preset", None),
        ("preset=blinn&surface=soft-object", "preset", None),
        ("smoothness=1&surface=inverse-square", "smoothness", None),
        ("surface=ses&isovalue=2", "isovalue", None),
        ("surface=vdw&smoothness=2", "smoothness", None),
        ("surface=sas&preset=ses-like", "preset", None),
        ("surface=vdw&probe=1.5", "probe", None),
        ("surface=ses&probe=10.5", "probe", None),
        ("paper_a=1", "paper_a", None),
        ("surface=inverse-square&paper_c=2&paper_b=5", "paper_c", None),
        ("atom_ids=maybe", "atom_ids", None),
        ("model=first", "model", None),
        ("chains=", "chains", None),
        ("chains=A,,B", "chains", None),
        ("select=proteins", "select", None),
        ("select=chain%20A%20and", "select", None),
        ("altloc=AB", "altloc", None),
        ("format=usdz", "format", None),
        ("check=lax", "check", None),
        ("validation=trust", "validation", None),
        ("compress=draco", "compress", None),
        ("compress=quantize&format=ply", "compress", None),
        ("compress=meshopt&format=ply", "compress", None),
        ("compress=meshopt&format=gltf", "compress", None),
        ("detial=3", "detial", Some("detail")),
        ("max_triangle=100", "max_triangle", Some("max_triangles")),
        ("normal=none", "normal", Some("normals")),
        ("unitss=nanometer", "unitss", Some("units")),
        ("unit=nanometer&assembly=1", "unit", None),
        ("unit=1", "unit", None),
        ("detail=7", "detail", None),
        ("detail=-1", "detail", None),
        ("detail=2.5", "detail", None),
        ("max_triangles=7", "max_triangles", None),
        ("max_triangles=1e6", "max_triangles", None),
        ("max_triangles=4294967296", "max_triangles", None),
        ("normals=flat", "normals", None),
        ("units=inch", "units", None),
        ("units=meter&format=ply", "units", None),
        ("resolution=0.6&detail=3", "detail", None),
        ("detail=3&resolution=0.6", "resolution", None),
        ("max_triangles=1000&detail=3", "detail", None),
        ("detail=3&max_triangles=1000", "max_triangles", None),
        ("max_triangles=1000&resolution=1", "resolution", None),
    ] {
        let problem = SERVER.post(&format!("/v1/meshes?{query}"), &[], SAMPLE).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], parameter, "{query}");
        match nearest {
            Some(nearest) => assert_eq!(problem["nearest"], nearest, "{query}"),
            None => assert!(problem["nearest"].is_null(), "{query}: {problem}"),
        }
        let repeated = query.matches(parameter).count() > 1;
        let known = !query.starts_with("xyzzy") && nearest.is_none();
        assert_eq!(problem["expected"].is_string(), known && !repeated, "{query}: {problem}");
    }
    let problem = SERVER.post("/v1/meshes?select=chain%20Z", &[], SAMPLE).problem(422, "empty-selection");
    assert_eq!(problem["parameter"], "select");
    assert_eq!(problem["value"], "Z");
}

#[test]
fn only_glb_and_gltf_are_quantized() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let archive = server.dir.path().join("archive/pt");
    std::fs::create_dir_all(&archive).unwrap();
    std::fs::write(archive.join("pdb4pti.ent.gz"), gzip(SAMPLE)).unwrap();
    let document = |body: &[u8]| -> serde_json::Value {
        let json = if body.starts_with(b"glTF") {
            &body[20..20 + u32::from_le_bytes(body[12..16].try_into().unwrap()) as usize]
        } else {
            body
        };
        serde_json::from_slice(json).unwrap()
    };
    let plain = server.post("/v1/meshes", &[], SAMPLE);
    let small = server.post("/v1/meshes?compress=quantize", &[], SAMPLE);
    assert_eq!((plain.status, small.status), (200, 200), "{}", String::from_utf8_lossy(&small.body));
    let vertices: usize = plain.header("molmesh-vertices").unwrap().parse().unwrap();
    assert_eq!(small.header("molmesh-vertices"), plain.header("molmesh-vertices"));
    // Their headers differ by a few bytes at most.
    let saved = plain.body.len() - small.body.len();
    assert!(saved.abs_diff(12 * vertices) < 1000, "{saved} bytes saved on {vertices} vertices");
    assert_ne!(small.header("etag"), plain.header("etag"));
    let none = server.post("/v1/meshes?compress=none", &[], SAMPLE);
    assert!(none.body == plain.body && none.header("etag") == plain.header("etag"));
    let step = document(&small.body)["asset"]["extras"]["quantization"]["step"].clone();
    assert!(step.as_f64().is_some_and(|step| step > 0.0 && step < 0.01), "{step}");
    let text = server.post("/v1/meshes?compress=quantize&format=gltf", &[], SAMPLE);
    assert_eq!(document(&text.body)["extensionsRequired"][0], "KHR_mesh_quantization");
    assert_eq!(document(&plain.body).get("extensionsRequired"), None);
    let report = server.post("/v1/report?compress=quantize", &[], SAMPLE).json();
    assert_eq!(report["quantization"]["step"], step);
    let entry = server.get("/v1/pdb/4pti/surface.glb?compress=quantize");
    assert!(entry.body == small.body);

    let packed = server.post("/v1/meshes?compress=meshopt", &[], SAMPLE);
    assert_eq!((packed.status, packed.header("content-type")), (200, Some("model/gltf-binary")));
    assert_eq!(packed.header("content-length").unwrap(), packed.body.len().to_string());
    assert_eq!(packed.header("molmesh-triangles"), plain.header("molmesh-triangles"));
    assert_eq!(document(&packed.body)["extensionsRequired"][1], "EXT_meshopt_compression");
    assert!(2 * packed.body.len() < small.body.len() && packed.header("etag") != small.header("etag"));
    let again = server.get("/v1/pdb/4pti/surface.glb?compress=meshopt");
    assert!(again.body == packed.body);
    // The estimate of the file is close.
    let estimate = server.post("/v1/estimate?compress=meshopt", &[], SAMPLE).json();
    let ratio = estimate["mesh_bytes"].as_f64().unwrap() / packed.body.len() as f64;
    assert!((0.8..1.25).contains(&ratio), "{ratio}");
    let refused = server.get("/v1/pdb/4pti/surface.gltf?compress=meshopt").problem(400, "bad-parameter");
    assert_eq!(refused["parameter"], "compress");
    assert!(refused["expected"].as_str().unwrap().contains("one of the formats glb"), "{refused}");

    // The format need not come from the query.
    let accept = server.post("/v1/meshes?compress=quantize", &[("accept", "model/stl")], SAMPLE);
    for refused in [accept, server.get("/v1/pdb/4pti/surface.obj?compress=quantize")] {
        let problem = refused.problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], "compress");
        assert!(problem["expected"].as_str().unwrap().contains("glb, gltf"), "{problem}");
    }
    let form =
        b"--XX\r\ncontent-disposition: form-data; name=\"compress\"\r\n\r\nquantize\r\n--XX\r\ncontent-disposition: \
        form-data; name=\"file\"\r\n\r\nHEADER\r\n--XX--\r\n";
    let kind = ("content-type", "multipart/form-data; boundary=XX");
    let refused = server.post("/v1/meshes", &[kind, ("accept", "application/ply")], form);
    assert_eq!(refused.problem(400, "bad-parameter")["parameter"], "compress");
    let can = server.get("/v1/capabilities").json();
    let compress = can["parameters"].as_array().unwrap().iter().find(|p| p["name"] == "compress").unwrap();
    assert_eq!(compress["values"], serde_json::json!(["none", "quantize", "meshopt"]));
}

#[test]
fn errors_of_unusable_structures_are_specific_and_the_server_keeps_running() {
    let pdb = |x: &str| {
        format!("ATOM      1  CA  ALA A   1    {x:>8}   0.000   0.000  1.00  0.00           C  \n").into_bytes()
    };
    let long = "x".repeat(100_000).into_bytes();
    let waters = "HETATM    1  O   HOH A   1       0.000   0.000   0.000  1.00  0.00           O  \n".repeat(3);
    let cases: Vec<(&str, Vec<u8>, &str)> = vec![
        ("", Vec::new(), "no-atoms|unreadable-structure"),
        ("", vec![0; 1000], "unreadable-structure"),
        ("", b"hello, world\n".to_vec(), "unreadable-structure"),
        ("", long, "unreadable-structure"),
        ("", b"\x1f\x8b\x08garbage".to_vec(), "unreadable-structure"),
        ("", b"\x28\xb5\x2f\xfdgarbage".to_vec(), "unreadable-structure"),
        ("", pdb("nan"), "unreadable-structure"),
        ("", pdb("1e30"), "unreadable-structure"),
        ("", pdb("9999999."), "unreadable-structure"),
        ("", b"HEADER    EMPTY\nEND\n".to_vec(), "no-atoms"),
        ("", b"data_x\n_entry.id X\n".to_vec(), "no-atoms"),
        ("", waters.into_bytes(), "empty-selection"),
        ("?chains=Z", SAMPLE.to_vec(), "empty-selection"),
        ("?model=7", SAMPLE.to_vec(), "empty-selection"),
    ];
    for (n, (query, body, slugs)) in cases.iter().enumerate() {
        let reply = SERVER.post(&format!("/v1/meshes{query}"), &[("x-request-id", &format!("hostile-{n}"))], body);
        let slug = reply.json()["type"].as_str().unwrap().trim_start_matches("/problems/").to_owned();
        assert!(slugs.split('|').any(|s| s == slug), "case {n}: {slug}: {}", reply.text());
        reply.problem(422, &slug);
        let lines = log_lines(&format!("hostile-{n}"));
        assert!(lines.iter().all(|l| !l.contains("ERROR") && !l.contains("WARN")), "{lines:?}");
    }
    let broken = SERVER.post("/v1/meshes", &[], &[SAMPLE, &pdb("oops")[..]].concat());
    let problem = broken.problem(422, "unreadable-structure");
    assert!(problem["line"].as_u64().unwrap() > 400, "{problem}");
    assert!(problem["column"].is_u64() && problem["expected"].is_string(), "{problem}");
    assert_eq!(SERVER.post("/v1/meshes", &[], SAMPLE).status, 200);
}

#[test]
fn a_strict_check_reports_the_findings_of_the_strict_validator() {
    let bad = [b"CRYST1 nonsense line that strict readers reject\n", SAMPLE].concat();
    assert_eq!(SERVER.post("/v1/meshes", &[], &bad).status, 200);
    let problem = SERVER.post("/v1/meshes?check=strict", &[], &bad).problem(422, "unreadable-structure");
    assert!(!problem["diagnostics"].as_array().unwrap().is_empty(), "{problem}");
    let cif = include_bytes!("../../samples/1crn.cif");
    let reply = SERVER.post("/v1/report?check=strict", &[], cif);
    assert_eq!(reply.status, 200, "{}", reply.text());
    assert!(reply.json()["diagnostics"].is_array());
    assert!(SERVER.post("/v1/report", &[], cif).json().get("diagnostics").is_none());
}

#[test]
fn binarycif_is_accepted_by_every_operation_that_accepts_text() {
    let text = include_bytes!("../../samples/1crn.cif");
    // The same atoms give the same mesh in every format.
    let stl = |body: &[u8], headers: &[(&str, &str)]| {
        let reply = SERVER.post("/v1/meshes?resolution=1&format=stl", headers, body);
        assert_eq!((reply.status, reply.header("molmesh-atoms")), (200, Some("327")));
        reply.body
    };
    let expected = stl(text, &[]);
    for body in [CRAMBIN.to_vec(), gzip(CRAMBIN), zstd(CRAMBIN)] {
        assert!(stl(&body, &[]) == expected);
    }
    assert!(stl(&gzip(CRAMBIN), &[("content-encoding", "gzip")]) == expected);
    // From the archive, and by a JSON document that names the entry.
    let stored = SERVER.get("/v1/pdb/1crn/surface.stl?resolution=1");
    assert!(stored.status == 200 && stored.body == expected);
    let order = br#"{"pdb_id": "1crn", "resolution": 1, "format": "stl"}"#;
    let reply = SERVER.post("/v1/meshes", &[("content-type", "application/json")], order);
    assert!(reply.status == 200 && reply.body == expected, "{}", reply.status);
    assert_eq!(SERVER.get("/v1/pdb/1crn/report.json").json()["source_format"], "bcif");
    // As an uploaded structure.
    let kept = SERVER.post("/v1/structures", &[], CRAMBIN);
    assert_eq!((kept.status, &kept.json()["format"], &kept.json()["id"]), (201, &"bcif".into(), &"1CRN".into()));
    // The strict validator does not support the format, and reports it.
    let report = SERVER.post("/v1/report?check=strict", &[], CRAMBIN).json();
    assert!(report.to_string().contains("does not read BinaryCIF"), "{report}");
    // An invalid file: the problem contains the position.
    let problem = SERVER.post("/v1/meshes", &[], &CRAMBIN[..CRAMBIN.len() / 2]).problem(422, "unreadable-structure");
    assert!(problem["location"].as_str().unwrap().starts_with("BinaryCIF, byte "), "{problem}");
    assert!(problem["found"].is_string() && problem["expected"].is_string());
}

#[test]
fn archive_entries_are_cacheable_by_url() {
    let path = "/v1/pdb/4pti/surface.glb?resolution=1";
    let reply = SERVER.get(path);
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    assert_eq!(reply.header("content-type"), Some("model/gltf-binary"));
    assert!(reply.header("cache-control").unwrap().contains("max-age=86400"));
    assert!(reply.header("cache-control").unwrap().contains("stale-while-revalidate"));
    let etag = reply.header("etag").unwrap();
    assert!(etag.starts_with('"') && etag.len() == 66, "{etag}");
    // All spellings of the id name the same entry.
    for path in ["/v1/pdb/4PTI/surface.glb?resolution=1.0", "/v1/pdb/pdb_00004pti/surface.glb?resolution=1"] {
        assert_eq!(SERVER.get(path).header("etag"), Some(etag));
    }
    for tag in [etag, "*", &format!("W/{etag}"), &format!("\"x\", {etag}")] {
        let same = send(SERVER.addr, "GET", path, &[("if-none-match", tag)], b"");
        assert_eq!((same.status, same.body.len(), same.header("etag")), (304, 0, Some(etag)), "{tag}");
        assert!(same.header("cache-control").is_some());
    }
    assert_eq!(send(SERVER.addr, "GET", path, &[("if-none-match", "\"other\"")], b"").status, 200);
    let head = send(SERVER.addr, "HEAD", path, &[], b"");
    assert_eq!((head.status, head.body.len(), head.header("etag")), (200, 0, Some(etag)));
    assert_eq!(head.header("content-type"), Some("model/gltf-binary"));
    let new = send(SERVER.addr, "HEAD", "/v1/pdb/4pti/surface.glb?resolution=1.0371", &[], b"");
    assert_eq!((new.status, new.header("content-length")), (200, None), "the length of a mesh that was not computed");
    for (ext, media_type) in [
        ("gltf", "model/gltf+json"),
        ("ply", "application/ply"),
        ("ply-text", "model/x-ply-text"),
        ("stl", "model/stl"),
        ("obj", "model/obj"),
        ("vtp", "model/x-vtp"),
        ("vert", "model/x-msms-vert"),
        ("face", "model/x-msms-face"),
    ] {
        let other = SERVER.get(&format!("/v1/pdb/4pti/surface.{ext}?resolution=1"));
        assert_eq!((other.status, other.header("content-type")), (200, Some(media_type)));
        assert_ne!(other.header("etag"), Some(etag));
    }
    assert_eq!(SERVER.get("/v1/pdb/4pti/report.json").json()["atoms"], 454);
    SERVER.get("/v1/pdb/1abc/surface.glb").problem(404, "not-in-archive");
    SERVER.get("/v1/pdb/4pti/surface.usdz").problem(404, "not-found");
    SERVER.get("/v1/pdb/4pti/volume.glb").problem(404, "not-found");
    for id in ["x", "..%2f..%2fetc", "4pti%00", "abcd", "4ptii", "%2e%2e"] {
        let problem = SERVER.get(&format!("/v1/pdb/{id}/surface.glb")).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], "id", "{id}");
    }
    assert_eq!(SERVER.get("/v1/pdb/4pti/surface.glb?format=stl").problem(400, "bad-parameter")["parameter"], "format");
    assert_eq!(SERVER.get("/v1/pdb/4pti/surface.glb?q=1").problem(400, "bad-parameter")["parameter"], "q");
    send(SERVER.addr, "DELETE", path, &[], b"").problem(405, "method-not-allowed");
}

#[test]
fn a_server_without_an_archive_reports_it() {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let problem = server.get("/v1/pdb/4pti/surface.glb").problem(404, "not-in-archive");
    assert!(!problem.to_string().contains(&*server.dir.path().to_string_lossy()), "{problem}");
}

#[test]
fn errors_of_the_http_library_are_problems() {
    let missing = SERVER.get("/v2/meshes").problem(404, "not-found");
    assert!(missing["detail"].as_str().unwrap().contains("/v2/meshes"));
    for (method, path, allow) in
        [("GET", "/v1/meshes", "POST"), ("POST", "/livez", "GET,HEAD"), ("PUT", "/", "GET,HEAD")]
    {
        let reply = send(SERVER.addr, method, path, &[], b"");
        reply.problem(405, "method-not-allowed");
        assert_eq!(reply.header("allow"), Some(allow));
    }
    send(SERVER.metrics, "GET", "/", &[], b"").problem(404, "not-found");
}

#[test]
fn every_problem_type_is_documented_at_its_url() {
    let list = SERVER.get("/problems").json();
    let list = list.as_array().unwrap();
    assert!(list.len() >= 20);
    for problem in list {
        let address = problem["type"].as_str().unwrap();
        let one = SERVER.get(address).json();
        assert_eq!(&one, problem);
        assert!(one["about"].as_str().unwrap().len() > 30, "{one}");
    }
    SERVER.get("/problems/none-such").problem(404, "not-found");
}

#[test]
fn health_version_and_capabilities() {
    assert_eq!(SERVER.get("/livez").json()["status"], "live");
    assert_eq!(SERVER.get("/readyz").json()["status"], "ready");
    assert_eq!(SERVER.get("/version").json()["version"], env!("CARGO_PKG_VERSION"));
    let can = SERVER.get("/v1/capabilities").json();
    assert_eq!(can["formats"].as_array().unwrap().len(), 10);
    assert_eq!(can["surfaces"].as_array().unwrap().len(), 6);
    assert_eq!(can["presets"]["ses-like"]["isovalue"], 1.9);
    assert_eq!(can["backends"][0]["reason"], "set by a test");
    assert_eq!(can["radii"]["values"]["C"], 1.7);
    assert_eq!(can["radii"]["values"].as_object().unwrap().len(), 118);
    assert_eq!(can["limits"]["body_bytes"], 256 << 20);
    // All listed parameters are accepted in a form.
    for parameter in can["parameters"].as_array().unwrap() {
        let name = parameter["name"].as_str().unwrap();
        let problem = SERVER.post(&format!("/v1/meshes?{name}=%01"), &[], SAMPLE).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], name);
        assert!(
            parameter["doc"].as_str().unwrap().ends_with('.') || parameter["doc"].as_str().unwrap().ends_with(").")
        );
    }
}

#[test]
fn the_page_loads_nothing_from_other_hosts() {
    let page = SERVER.get("/");
    assert_eq!(page.header("content-type"), Some("text/html; charset=utf-8"));
    let policy = page.header("content-security-policy").unwrap();
    // WebAssembly is a module of the page, not evaluated text.
    let unsafe_ones = policy.replace("'wasm-unsafe-eval'", "");
    assert!(policy.contains("default-src 'none'") && !unsafe_ones.contains("unsafe"), "{policy}");
    let html = page.text();
    assert!(!html.contains("<style") && !html.contains(" style=") && !html.contains(" onclick"));
    let mut found = 0;
    for attribute in ["src=\"", "href=\""] {
        for link in html.split(attribute).skip(1).map(|rest| rest.split('"').next().unwrap()) {
            if link.starts_with('#') {
                continue;
            }
            assert!(link.starts_with('/') && !link.starts_with("//"), "{link}");
            assert_eq!(SERVER.get(link).status, 200, "{link}");
            found += 1;
        }
    }
    assert!(found >= 4, "{found}");
    // tests/cli/browser.rs tests the page in a browser.
    assert!(!html.contains("http://") && !html.contains("https://"));
    assert_eq!(SERVER.get("/v1/capabilities").json()["viewer"], molmesh::http::has_viewer());
    assert_eq!(html.contains("/assets/index-"), molmesh::http::has_viewer());
    assert!(html.contains("/docs") && html.contains("curl"));
    let component = SERVER.get("/molmesh-viewer.js");
    assert_eq!(component.header("content-type"), Some("text/javascript; charset=utf-8"));
    assert_eq!(component.header("cache-control"), Some("no-cache"));
    SERVER.get("/assets/none.js").problem(404, "not-found");
    assert_eq!(SERVER.get("/sample.pdb").body, SAMPLE);
}

#[test]
fn compressed_assets_are_decompressed_for_clients_without_support() {
    let html = SERVER.get("/").text();
    let paths = html.split('"').filter(|text| text.starts_with("/assets/"));
    for path in paths.chain(["/", "/molmesh-viewer.js"]) {
        let plain = SERVER.get(path);
        let packed = send(SERVER.addr, "GET", path, &[("accept-encoding", "gzip")], b"");
        assert_eq!((plain.status, packed.status), (200, 200), "{path}");
        assert_eq!(plain.header("content-encoding"), None, "{path}");
        let named = path.contains('-') && path.starts_with("/assets/");
        assert_eq!(plain.header("cache-control").unwrap().contains("immutable"), named, "{path}");
        if packed.header("content-encoding").is_some() {
            let mut unpacked = Vec::new();
            flate2::read::GzDecoder::new(&packed.body[..]).read_to_end(&mut unpacked).unwrap();
            assert_eq!(unpacked, plain.body, "{path}");
            assert!(packed.body.len() < plain.body.len() || plain.body.len() < 500, "{path}");
        }
    }
}

#[test]
fn atoms_are_listed_with_the_indices_of_meshes() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let reply = server.get(&format!("{structure}/atoms"));
    assert_eq!(reply.status, 200);
    let (etag, list) = (reply.header("etag").unwrap().to_owned(), reply.json());
    let unchanged = send(server.addr, "GET", &format!("{structure}/atoms"), &[("if-none-match", &etag)], b"");
    assert_eq!(unchanged.status, 304);
    assert_eq!(list["count"], server.get(&structure).json()["atoms"]);
    // Meshes use the polymer atoms only: LYS 15 but not water.
    let ply = server.get(&format!("{structure}/surface.ply?atom_ids=true&resolution=1")).body;
    let head = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let text = std::str::from_utf8(&ply[..head]).unwrap();
    let n: usize = text.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap().parse().unwrap();
    let named: std::collections::BTreeSet<u64> = (0..n)
        .map(|i| u64::from(u32::from_le_bytes(ply[head + 28 * i + 24..head + 28 * i + 28].try_into().unwrap())))
        .collect();
    let rows = |column: &str| list["residues"][column].as_array().unwrap();
    let residue = |atom: u64| rows("first").iter().rposition(|first| first.as_u64().unwrap() <= atom).unwrap();
    let others: Vec<u64> = named.iter().copied().filter(|atom| rows("kind")[residue(*atom)] != "protein").collect();
    assert!(others.is_empty(), "{others:?} of {named:?}");
    assert!(named.iter().any(|atom| rows("name")[residue(*atom)] == "LYS" && rows("number")[residue(*atom)] == 15));
    assert!(rows("kind").iter().any(|kind| kind == "water"));
}

#[test]
fn atoms_of_a_mesh_are_listed_with_their_positions() {
    let structure = SERVER.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let ask = |query: &str| SERVER.get(&format!("{structure}/atoms{query}"));
    let list = ask("?positions=true&select=water").json();
    let text = std::str::from_utf8(SAMPLE).unwrap();
    let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("ATOM") || l.starts_with("HETATM")).collect();
    let expected: Vec<(usize, [f64; 3])> = lines
        .iter()
        .enumerate()
        .filter(|(_, line)| line[17..20].trim() == "HOH")
        .map(|(row, line)| (row, [30..38, 38..46, 46..54].map(|c| line[c].trim().parse().unwrap())))
        .collect();
    let column = |name: &str| list["atoms"][name].as_array().unwrap().iter().map(|v| v.as_f64().unwrap());
    let places = column("x").zip(column("y")).zip(column("z")).map(|((x, y), z)| [x, y, z]);
    let index = list["atoms"]["index"].as_array().unwrap().iter();
    let rows = index.map(|row| usize::try_from(row.as_u64().unwrap()).unwrap());
    assert_eq!(rows.zip(places).collect::<Vec<_>>(), expected);
    assert_eq!((&list["count"], expected.len()), (&60.into(), 60));
    assert!(list["residues"]["kind"].as_array().unwrap().iter().all(|kind| kind == "water"));
    // The whole list has no positions, and another validator.
    let whole = ask("?positions=false&select=polymer");
    assert_eq!((whole.json(), whole.header("etag")), (ask("").json(), ask("").header("etag")));
    assert!(whole.json()["atoms"].get("x").is_none());
    assert_ne!(ask("?positions=true").header("etag"), whole.header("etag"));
    assert_ne!(ask("?positions=true").header("etag"), ask("?positions=true&chains=A").header("etag"));
    for (query, parameter) in
        [("select=water", "positions"), ("positions=yes", "positions"), ("positions=true&resolution=1", "resolution")]
    {
        assert_eq!(ask(&format!("?{query}")).problem(400, "bad-parameter")["parameter"], parameter, "{query}");
    }
    ask("?positions=true&select=ligand").problem(422, "empty-selection");
}

#[test]
fn areas_are_those_of_the_library() {
    let address = SERVER.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let (read, surface) = (ReadLimits::default(), SurfaceLimits::default());
    let structure = structure::read(SAMPLE, &read).unwrap();
    let mut tags = std::collections::BTreeSet::new();
    for (query, level) in [
        ("surface=ses", AreaLevel::Residue),
        ("surface=ses&by=atom", AreaLevel::Atom),
        ("surface=ses&by=chain", AreaLevel::Chain),
        ("surface=sas&by=chain", AreaLevel::Chain),
    ] {
        let reply = SERVER.get(&format!("{address}/areas?{query}"));
        assert_eq!((reply.status, reply.header("content-type")), (200, Some("text/csv")), "{query}");
        let kind = query.split('&').next().and_then(|pair| pair.split_once('='));
        let job = params::parse(kind.into_iter().chain([("exact", "true")])).unwrap().options;
        let measured = areas::measure_selection(&structure, &job, &read, &surface, &Control::default()).unwrap();
        let mut expected = Vec::new();
        measured.areas.write_csv(&structure, level, &Control::default(), &mut expected).unwrap();
        assert_eq!(reply.text(), String::from_utf8(expected).unwrap(), "{query}");
        tags.insert(reply.header("etag").unwrap().to_owned());
    }
    assert_eq!(tags.len(), 4);
}

#[test]
fn areas_of_an_upload_are_those_of_the_stored_structure() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.limits.body_bytes = 100_000);
    let query = "surface=ses&probe=1.5&by=chain";
    let uploaded = server.post(&format!("/v1/areas?{query}"), &[], SAMPLE);
    assert_eq!((uploaded.status, uploaded.header("content-type")), (200, Some("text/csv")));
    assert_eq!(uploaded.header("cache-control"), None);
    let digest = molmesh::store::Digest::of(SAMPLE);
    server.get(&format!("/v1/structures/{digest}")).problem(404, "no-such-structure");
    let address = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let stored = server.get(&format!("{address}/areas?{query}"));
    assert!(stored.body == uploaded.body && stored.header("etag") == uploaded.header("etag"));
    let field = |name: &str, value: &str| {
        format!("--XX\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n{value}\r\n").into_bytes()
    };
    let text = std::str::from_utf8(SAMPLE).unwrap();
    let form = [field("surface", "ses"), field("by", "chain"), field("file", text), b"--XX--\r\n".to_vec()].concat();
    let json = format!("{{\"structure\": \"{digest}\", \"surface\": \"ses\", \"by\": \"chain\"}}").into_bytes();
    let multipart = "multipart/form-data; boundary=XX";
    for (content_type, body) in [(multipart, &form), ("application/json", &json)] {
        let reply = server.post("/v1/areas?probe=1.5", &[("content-type", content_type)], body);
        assert!(reply.status == 200 && reply.body == stored.body, "{content_type}: {}", reply.text());
        // Parameters of the query are checked although the body may have others.
        let reply = server.post("/v1/areas?prob=1.5", &[("content-type", content_type)], body);
        assert_eq!(reply.problem(400, "bad-parameter")["nearest"], "probe", "{content_type}");
    }
    let mapped = [field("map", "x"), form].concat();
    let reply = server.post("/v1/areas", &[("content-type", multipart)], &mapped);
    assert_eq!(reply.problem(400, "bad-parameter")["parameter"], "map");
    // These are rejected before the body arrives.
    for (query, length, status) in [("", 10, 400), ("?surface=gaussian", 10, 400), ("?surface=sas", 100_001, 413)] {
        let mut stream = http_support::connect(server.addr);
        write!(stream, "POST /v1/areas{query} HTTP/1.1\r\nhost: localhost\r\ncontent-length: {length}\r\n\r\n")
            .unwrap();
        let reply = http_support::read_reply(&mut stream, false);
        assert_eq!(reply.status, status, "{query}");
        assert!(status != 400 || reply.json()["parameter"] == "surface", "{}", reply.text());
    }
}

#[test]
fn reports_list_at_most_a_thousand_chains() {
    let mut cif = b"data_x\nloop_\n_atom_site.type_symbol\n_atom_site.auth_asym_id\n_atom_site.Cartn_x\n\
                    _atom_site.Cartn_y\n_atom_site.Cartn_z\n"
        .to_vec();
    for i in 0..1001 {
        writeln!(cif, "C chain{i} {} {} 0", 8 * (i % 40), 8 * (i / 40)).unwrap();
    }
    let reply = SERVER.post("/v1/report?surface=sas&exact=true&resolution=3", &[], &cif);
    let exact = &reply.json()["exact"];
    assert_eq!((exact["chain_count"].as_u64(), exact["chains"].as_array().unwrap().len()), (Some(1001), 1000));
    let location = SERVER.post("/v1/structures", &[], &cif).header("location").unwrap().to_owned();
    let table = SERVER.get(&format!("{location}/areas?surface=sas&by=chain"));
    assert_eq!(table.text().lines().count(), 1002);
}

#[test]
fn colours_of_atoms_are_those_of_the_vertices() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let cases = [
        ("element", ""),
        ("bfactor", "&palette=cividis"),
        ("charge", "&chains=A"),
        // The range is that of the whole, not of the selected atoms.
        ("bfactor", "&context=whole&select=resi%2010-30"),
    ];
    for (scheme, more) in cases {
        let path = format!("{structure}/colors?scheme={scheme}{more}");
        let reply = server.get(&path);
        assert_eq!((reply.status, reply.header("content-type")), (200, Some("application/octet-stream")), "{scheme}");
        let (colors, rest) = reply.body.as_chunks::<4>();
        assert_eq!((colors.len(), rest.len()), (514, 0));
        let legend: serde_json::Value = serde_json::from_str(reply.header("molmesh-colors").unwrap()).unwrap();
        let query = format!("color={scheme}{more}&atom_ids=true&resolution=1");
        let report = server.get(&format!("{structure}/report.json?{query}")).json();
        assert_eq!(legend, report["color"], "{scheme}");
        // Vertices of 32 bytes: position, normal, colour and atom.
        let ply = server.get(&format!("{structure}/surface.ply?{query}")).body;
        let head = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let text = std::str::from_utf8(&ply[..head]).unwrap();
        assert!(text.contains("property uchar red\n") && text.contains("property uint atom\n"), "{text}");
        let n: usize = text.lines().find_map(|l| l.strip_prefix("element vertex ")).unwrap().parse().unwrap();
        let mut distinct = std::collections::BTreeSet::new();
        for vertex in ply[head..head + 32 * n].as_chunks::<32>().0 {
            let atom = u32::from_le_bytes(vertex[28..].try_into().unwrap());
            assert_eq!(colors[atom as usize], vertex[24..28], "{scheme}: atom {atom}");
            distinct.insert(colors[atom as usize]);
        }
        assert!(distinct.len() >= 3, "{scheme}: {distinct:?}");
        // Validators and ranges.
        let etag = reply.header("etag").unwrap();
        let ask = |headers: &[(&str, &str)]| send(server.addr, "GET", &path, headers, b"");
        assert_eq!(ask(&[("if-none-match", etag)]).status, 304);
        let part = ask(&[("range", "bytes=4-11"), ("if-range", etag)]);
        assert_eq!((part.status, part.header("content-range")), (206, Some("bytes 4-11/2056")));
        assert_eq!(part.body, reply.body[4..12]);
        assert_eq!(ask(&[("range", "bytes=4-11"), ("if-range", "\"x\"")]).status, 200);
        let beyond = ask(&[("range", "bytes=9999-")]);
        assert_eq!(beyond.problem(416, "range-not-satisfiable")["actual"], 2056);
        let other = server.get(&format!("{structure}/colors?scheme=chain"));
        assert_ne!(other.header("etag").unwrap(), etag);
    }
}

#[test]
fn requests_for_unavailable_colours_are_rejected_with_the_valid_names() {
    let structure = SERVER.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    for (path, parameter) in [
        ("colors", "scheme"),
        ("colors?scheme=none", "scheme"),
        ("colors?scheme=rainbow", "scheme"),
        ("colors?scheme=chain&scheme=chain", "scheme"),
        ("colors?scheme=entity", "scheme"),
        ("colors?scheme=chain&palette=viridis", "palette"),
        ("colors?scheme=bfactor&color_range=5", "color_range"),
        ("colors?scheme=chain&resolution=1", "resolution"),
        ("surface.glb?color=rainbow", "color"),
        ("surface.glb?color=entity", "color"),
        ("report.json?color=chain&palette=viridis", "palette"),
    ] {
        let problem = SERVER.get(&format!("{structure}/{path}")).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], parameter, "{path}: {problem}");
        if parameter == "scheme" && !path.contains("&scheme") || parameter == "color" {
            assert!(problem["expected"].as_str().unwrap().contains("uniform:#RRGGBB, element, chain"), "{problem}");
        }
    }
    let empty = SERVER.get(&format!("{structure}/colors?scheme=chain&chains=Z"));
    assert_eq!(empty.problem(422, "empty-selection")["parameter"], "chains");
    let estimate = SERVER.post("/v1/estimate?color=entity", &[], SAMPLE);
    assert_eq!(estimate.problem(400, "bad-parameter")["parameter"], "color");
}

#[test]
fn request_ids_are_kept_or_generated() {
    let given = send(SERVER.addr, "GET", "/nowhere", &[("x-request-id", "mine-42")], b"");
    assert_eq!(given.problem(404, "not-found")["instance"], "mine-42");
    let made: Vec<String> = (0..2).map(|_| SERVER.get("/livez").header("x-request-id").unwrap().to_owned()).collect();
    assert_ne!(made[0], made[1]);
    let insane = send(SERVER.addr, "GET", "/livez", &[("x-request-id", "a b\"c")], b"");
    assert_ne!(insane.header("x-request-id"), Some("a b\"c"));
}

#[test]
fn allowed_origins_may_read_all_responses() {
    let preflight = send(
        SERVER.addr,
        "OPTIONS",
        "/v1/meshes",
        &[("origin", "http://localhost:5173"), ("access-control-request-method", "POST")],
        b"",
    );
    assert_eq!(
        (preflight.status, preflight.header("access-control-allow-origin")),
        (200, Some("http://localhost:5173"))
    );
    let error = SERVER.post("/v1/meshes?x=1", &[("origin", "http://localhost:5173")], b"");
    error.problem(400, "bad-parameter");
    assert_eq!(error.header("access-control-allow-origin"), Some("http://localhost:5173"));
    assert!(error.header("access-control-expose-headers").unwrap().contains("molmesh-triangles"));
    assert_eq!(error.header("x-content-type-options"), Some("nosniff"));
}

#[test]
fn http2_without_tls_is_supported() {
    use http_body_util::{BodyExt as _, Full};
    use hyper_util::rt::{TokioExecutor, TokioIo};
    let addr = SERVER.addr;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let (status, body) = runtime.block_on(async move {
        let stream = tokio::net::TcpStream::connect(addr).await.unwrap();
        let (mut client, connection) =
            hyper::client::conn::http2::handshake(TokioExecutor::new(), TokioIo::new(stream)).await.unwrap();
        tokio::spawn(connection);
        let request = hyper::Request::post(format!("http://{addr}/v1/meshes?format=stl"))
            .body(Full::new(bytes::Bytes::from_static(SAMPLE)))
            .unwrap();
        let reply = client.send_request(request).await.unwrap();
        assert_eq!(reply.version(), hyper::Version::HTTP_2);
        (reply.status(), reply.into_body().collect().await.unwrap().to_bytes())
    });
    assert_eq!((status.as_u16(), body.len()), (200, 84 + 50 * 454 * 8));
}

#[test]
fn requests_change_the_metrics() {
    let labels = ["route=\"/v1/meshes\"", "status=\"200\"", "method=\"POST\""];
    let count = || SERVER.metric("http_server_request_duration_seconds_count", &labels);
    let before = (count(), SERVER.metric("molmesh_jobs_finished_total", &["successful"]));
    assert_eq!(SERVER.post("/v1/meshes", &[], &http_support::sample(77)).status, 200);
    http_support::wait_for("the request is counted", || count() > before.0);
    assert!(SERVER.metric("molmesh_jobs_finished_total", &["successful"]) > before.1);
    for name in
        ["molmesh_triangles_emitted_total", "molmesh_grid_points_evaluated_total", "molmesh_jobs_submitted_total"]
    {
        assert!(SERVER.metric(name, &[]) > 0.0, "{name}");
    }
    for stage in ["queue", "read", "select", "measure", "encode"] {
        let label = format!("stage=\"{stage}\"");
        assert!(SERVER.metric("molmesh_job_stage_duration_seconds_count", &[&label]) > 0.0, "{stage}");
    }
    assert!((SERVER.metric("molmesh_build_info", &[env!("CARGO_PKG_VERSION")]) - 1.0).abs() < 1e-9);
    SERVER.get("/made-up");
    http_support::wait_for("unmatched", || {
        SERVER.metric("http_server_request_duration_seconds_count", &["route=\"unmatched\""]) > 0.0
    });
}

#[test]
fn a_patch_of_the_whole_surface_says_that_it_is_open() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let query = "context=whole&select=resi%2010-20&resolution=1";
    let reply = server.post(&format!("/v1/meshes?{query}"), &[], SAMPLE);
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    assert_eq!((reply.header("molmesh-closed"), reply.header("molmesh-volume")), (Some("false"), None));
    assert!(reply.header("molmesh-area").unwrap().parse::<f64>().unwrap() > 100.0);
    let report = server.post(&format!("/v1/report?{query}"), &[], SAMPLE).json();
    assert_eq!((&report["closed"], &report["open_reason"]), (&false.into(), &"cut".into()));
    assert!(report["volume"].is_null() && report.as_object().unwrap().contains_key("volume"));
    assert!(report["selected_atoms"].as_u64().unwrap() < report["atoms"].as_u64().unwrap());
    // Control: without the context, the patch is closed.
    let alone = server.post("/v1/report?select=resi%2010-20&resolution=1", &[], SAMPLE).json();
    assert!(alone["closed"] == true && alone["volume"].is_number() && alone.get("open_reason").is_none());
    let estimate = server.post(&format!("/v1/estimate?{query}"), &[], SAMPLE).json();
    let [expected, found] = [&estimate, &report].map(|document| document["triangles"].as_f64().unwrap());
    assert!(estimate["accepted"] == true && (0.6..1.6).contains(&(expected / found)), "{expected} {found}");
    // An asynchronous job has the same bytes.
    let job = server.post(&format!("/v1/meshes?{query}"), &[("prefer", "respond-async")], SAMPLE);
    let location = job.header("location").unwrap().to_owned();
    assert_eq!(server.get(&format!("{location}?wait=20")).json()["status"], "successful");
    let result = server.get(server.get(&format!("{location}/result")).header("location").unwrap());
    assert!(result.body == reply.body);
    // The key differs from that of the surface of the selection.
    let other = server.post("/v1/meshes?select=resi%2010-20&resolution=1", &[], SAMPLE);
    assert_ne!(other.header("etag"), reply.header("etag"));
    let buried = "context=whole&select=resi%2021%20and%20name%20C&resolution=1";
    let problem = server.post(&format!("/v1/meshes?{buried}"), &[], SAMPLE).problem(422, "no-surface");
    assert_eq!(problem["parameter"], "context");
    let bad = server.post("/v1/meshes?context=all", &[], SAMPLE).problem(400, "bad-parameter");
    assert!(bad["expected"].as_str().unwrap().contains("selection, whole"), "{bad}");
    assert!(server.join());
}

#[test]
fn instances_need_an_assembly_and_a_format_that_repeats_a_mesh() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let query = "assembly=1&instances=true&resolution=1.5";
    let reply = server.post(&format!("/v1/meshes?{query}"), &[], SAMPLE);
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    let text = String::from_utf8_lossy(&reply.body).into_owned();
    assert!(text.contains("EXT_mesh_gpu_instancing"));
    let report = server.post(&format!("/v1/report?{query}"), &[], SAMPLE).json();
    assert_eq!((&report["instances"]["count"], &report["instances"]["joined"]), (&1.into(), &false.into()));
    assert_eq!(report["instances"]["area_sum"], report["area"]);
    for (query, expected) in [
        ("instances=true", "asymmetric unit"),
        ("instances=true&assembly=1&format=stl", "glb, gltf"),
        ("instances=true&assembly=1&format=png", "glb, gltf"),
        ("instances=true&assembly=1&context=whole", "context=whole"),
        ("instances=true&assembly=1&split=chain", "split=chain"),
    ] {
        let problem = server.post(&format!("/v1/meshes?{query}"), &[], SAMPLE).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], "instances", "{query}");
        assert!(problem["expected"].as_str().unwrap().contains(expected), "{problem}");
    }
    // `Accept` chooses the format as well.
    let accepted = server.post(&format!("/v1/meshes?{query}"), &[("accept", "model/stl")], SAMPLE);
    assert_eq!(accepted.problem(400, "bad-parameter")["parameter"], "instances");
    assert!(server.join());
}
