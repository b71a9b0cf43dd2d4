//! Stored results under their keys: complete, in ranges, unchanged; uploaded structures; estimates.

use crate::http_support;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use http_support::{Fake, Mode, Reply, Running, SAMPLE, carbons, sample, send, start, wait_for};
use molmesh::surface::CpuBackend;

fn real(change: impl FnOnce(&mut molmesh::config::Config)) -> Running {
    start(Arc::new(CpuBackend::new(None).unwrap()), change)
}

#[test]
fn text_ply_has_its_own_address_and_the_usual_file_name() {
    let server = start(Fake::new(Mode::Octahedra) as _, |_| {});
    let binary = server.post("/v1/meshes?format=ply", &[], SAMPLE);
    let made = server.post("/v1/meshes?format=ply-text", &[], SAMPLE);
    assert!(made.body.starts_with(b"ply\nformat ascii 1.0\n"));
    assert!(made.header("content-disposition").unwrap().ends_with(".ply\""));
    let location = made.header("content-location").unwrap();
    assert!(location.ends_with(".ply-text"), "{location}");
    assert_ne!(made.header("content-location"), binary.header("content-location"));
    assert!(server.get(location).body == made.body);
}

#[test]
fn a_synchronous_result_is_stored_at_its_content_location() {
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, |_| {});
    let made = server.post("/v1/meshes?format=ply", &[], SAMPLE);
    let location = made.header("content-location").unwrap().to_owned();
    let etag = made.header("etag").unwrap().to_owned();
    let found = server.get(&location);
    assert_eq!((found.status, found.complete), (200, true));
    assert_eq!(found.body, made.body);
    for name in ["etag", "content-type", "molmesh-atoms", "molmesh-area", "molmesh-closed", "molmesh-radii"] {
        assert_eq!(found.header(name), made.header(name), "{name}");
    }
    assert!(found.header("cache-control").unwrap().contains("immutable"));
    assert_eq!(found.header("accept-ranges"), Some("bytes"));
    let unchanged = send(server.addr, "GET", &location, &[("if-none-match", &etag)], b"");
    assert_eq!((unchanged.status, unchanged.body.len()), (304, 0));
    let head = send(server.addr, "HEAD", &location, &[], b"");
    assert_eq!(head.header("content-length"), Some(made.body.len().to_string().as_str()));
    // The same request is served from the store.
    let again = server.post("/v1/meshes?format=ply", &[], SAMPLE);
    assert_eq!((again.body == made.body, backend.started.load(Ordering::SeqCst)), (true, 1));
    assert!(again.header("server-timing").unwrap().contains("hit"));
    assert!(again.header("cache-control").is_none(), "responses to POST are not cached");
    let report = location.replace(".ply", "/report.json");
    for path in [&location, &report] {
        let refused = server.get(&format!("{path}?resolution=1")).problem(400, "bad-parameter");
        assert_eq!(refused["parameter"], "resolution", "{path}");
        assert_eq!(server.get(&format!("{path}?")).status, 200, "an empty query has no parameter");
    }
    assert_eq!(server.get(&report).json()["atoms"], 454);
    let etag = server.get(&report).header("etag").unwrap().to_owned();
    assert_eq!(send(server.addr, "GET", &report, &[("if-none-match", &etag)], b"").status, 304);
    let key = location.split('/').next_back().unwrap().split('.').next().unwrap();
    let other = key.replace(&key[..4], "0000");
    for missing in [
        format!("{other}.ply"),
        format!("{key}.glb"),
        format!("{key}.exe"),
        "x.glb".to_owned(),
        format!("{other}/report.json"),
    ] {
        server.get(&format!("/v1/results/{missing}")).problem(404, "not-found");
    }
}

#[test]
fn identical_requests_store_one_result() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.jobs.concurrent_saves = 1);
    for round in 0..20 {
        let input = carbons(2_000 + round);
        let replies: Vec<Reply> = std::thread::scope(|scope| {
            let ask = || scope.spawn(|| server.post("/v1/meshes?format=stl", &[], &input));
            [(); 6].map(|()| ask()).map(|reply| reply.join().unwrap()).into()
        });
        // One concurrent save suffices for six responses and is released afterwards.
        for reply in &replies {
            let location = reply.header("content-location");
            assert!(location.is_some() && location == replies[0].header("content-location"), "{location:?}");
        }
        assert!(server.get(replies[0].header("content-location").unwrap()).body == replies[0].body);
    }
}

#[test]
fn ranges_of_a_result_add_up_to_the_whole() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.memory_object_bytes = 1000);
    // One result in memory, one on disk.
    for atoms in [2, 2_000] {
        let made = server.post("/v1/meshes?format=stl", &[], &carbons(atoms));
        let location = made.header("content-location").unwrap();
        let n = made.body.len();
        let etag = made.header("etag").unwrap();
        let get = |range: &str| send(server.addr, "GET", location, &[("range", range)], b"");
        let (a, b) = (get("bytes=0-99"), get("bytes=100-"));
        assert_eq!((a.status, b.status), (206, 206));
        assert_eq!([a.body.clone(), b.body].concat(), made.body);
        assert_eq!(a.header("content-range"), Some(format!("bytes 0-99/{n}").as_str()));
        assert_eq!(a.header("content-length"), Some("100"));
        assert_eq!(get("bytes=-50").body, made.body[n - 50..]);
        assert_eq!(get("bytes=0-5,9-10").status, 200);
        let outside = get(&format!("bytes={n}-"));
        outside.problem(416, "range-not-satisfiable");
        assert_eq!(outside.header("content-range"), Some(format!("bytes */{n}").as_str()));
        let same = send(server.addr, "GET", location, &[("range", "bytes=0-9"), ("if-range", etag)], b"");
        let other = send(server.addr, "GET", location, &[("range", "bytes=0-9"), ("if-range", "\"x\"")], b"");
        assert_eq!((same.status, other.status), (206, 200));
    }
}

#[test]
fn a_mesh_and_its_report_are_kept_and_removed_together() {
    let folder = tempfile::tempdir().unwrap();
    let backend = Fake::new(Mode::Octahedra);
    let open = |ttl_ms| {
        start(Arc::clone(&backend) as _, |c| {
            folder.path().clone_into(&mut c.server.data_dir);
            (c.store.result_ttl_ms, c.store.sweep_ms) = (ttl_ms, 50);
        })
    };
    let server = open(1000);
    let made = server.post("/v1/meshes?format=stl", &[], SAMPLE);
    let mesh = made.header("content-location").unwrap().to_owned();
    let report = mesh.replace(".stl", "/report.json");
    // Only the mesh is read, for three times its time to live.
    let end = Instant::now() + Duration::from_secs(3);
    while Instant::now() < end {
        assert_eq!(server.get(&mesh).status, 200);
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(server.get(&report).status, 200);
    server.join();
    let server = open(3_600_000);
    assert_eq!([&mesh, &report].map(|path| server.get(path).status), [200, 200]);
    server.join();
    // A mesh without its report counts as absent, and both are stored again.
    let key = mesh.rsplit('/').next().unwrap().strip_suffix(".stl").unwrap();
    let remove_report = || std::fs::remove_file(folder.path().join(format!("store/results/{key}.json"))).unwrap();
    remove_report();
    let server = open(3_600_000);
    server.get(&mesh).problem(404, "not-found");
    assert_eq!(server.post("/v1/meshes?format=stl", &[], SAMPLE).header("content-location"), Some(mesh.as_str()));
    assert_eq!([&mesh, &report].map(|path| server.get(path).status), [200, 200]);
    server.join();
    remove_report();
    let server = open(3_600_000);
    let job = server.post("/v1/meshes?format=stl", &[("prefer", "respond-async")], SAMPLE);
    let job = job.header("location").unwrap();
    assert_eq!(server.get(&format!("{job}?wait=20")).json()["status"], "successful");
    assert_eq!(server.get(&format!("{job}/result")).header("location"), Some(mesh.as_str()));
    assert_eq!([&mesh, &report].map(|path| server.get(path).status), [200, 200]);
    assert_eq!(backend.started.load(Ordering::SeqCst), 3);
}

#[test]
fn eviction_removes_a_mesh_with_its_report() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.max_bytes = 400_000);
    let made: Vec<String> = (0..8)
        .map(|n| {
            let made = server.post("/v1/meshes?format=stl", &[], &carbons(200 + n));
            let mesh = made.header("content-location").unwrap().to_owned();
            // The response arrives when the mesh is stored.
            assert_eq!(server.get(&mesh).status, 200);
            mesh
        })
        .collect();
    let statuses = made
        .iter()
        .map(|mesh| [mesh.clone(), mesh.replace(".stl", "/report.json")].map(|path| server.get(&path).status));
    let statuses: Vec<_> = statuses.collect();
    assert!(statuses.iter().all(|[mesh, report]| mesh == report), "{statuses:?}");
    assert!(statuses.contains(&[200; 2]) && statuses.contains(&[404; 2]), "{statuses:?}");
}

#[test]
fn a_result_that_exceeds_the_store_is_not_found_later() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.store.max_bytes = 3_000);
    let before = server.metric("molmesh_results_not_stored_total", &["failed"]);
    let made = server.post("/v1/meshes", &[], SAMPLE);
    assert_eq!((made.status, made.complete), (200, true), "the response does not depend on the store");
    wait_for("the metric", || server.metric("molmesh_results_not_stored_total", &["failed"]) > before);
    assert_eq!(made.header("content-location"), None, "a result that is not kept has no address");
    // Work that requires the store is rejected.
    let refused = server.post("/v1/meshes", &[("prefer", "respond-async")], &sample(1));
    let problem = refused.problem(413, "body-too-large");
    assert_eq!(problem["limit"], 3_000);
    assert!(problem["detail"].as_str().unwrap().contains("(store.max_bytes)"), "{problem}");
    server.post("/v1/structures", &[], SAMPLE).problem(413, "body-too-large");
}

#[test]
fn a_structure_is_uploaded_once_and_meshed_many_times() {
    let server = real(|_| {});
    let made = server.post("/v1/structures", &[], SAMPLE);
    assert_eq!(made.status, 201);
    let summary = made.json();
    assert_eq!((&summary["atoms"], &summary["format"], &summary["id"]), (&514.into(), &"pdb".into(), &"4PTI".into()));
    assert_eq!(summary["chains"][0]["name"], "A");
    let location = made.header("location").unwrap().to_owned();
    assert_eq!(location, format!("/v1/structures/{}", summary["digest"].as_str().unwrap()));
    assert_eq!(server.post("/v1/structures", &[], SAMPLE).status, 200, "the structure existed");
    assert_eq!(server.get(&location).json(), summary);
    let surface = |query: &str| server.get(&format!("{location}/surface.glb{query}"));
    let (coarse, fine) = (surface("?resolution=1"), surface("?resolution=0.6"));
    assert_eq!((coarse.status, fine.status), (200, 200));
    assert!(fine.body.len() > coarse.body.len());
    assert_eq!(server.post("/v1/meshes?resolution=1", &[], SAMPLE).body, coarse.body);
    let etag = coarse.header("etag").unwrap();
    let path = format!("{location}/surface.glb?resolution=1");
    assert_eq!(send(server.addr, "GET", &path, &[("if-none-match", etag)], b"").status, 304);
    let named = format!("{{\"structure\": \"{}\", \"resolution\": 1}}", summary["digest"].as_str().unwrap());
    let json = [("content-type", "application/json")];
    assert_eq!(server.post("/v1/meshes", &json, named.as_bytes()).body, coarse.body);
    surface("?resolution=x").problem(400, "bad-parameter");
    server.get(&format!("{location}/surface.exe")).problem(404, "not-found");
    let other = location.replace(&location[location.len() - 4..], "0000");
    for missing in [other.as_str(), "/v1/structures/x"] {
        server.get(missing).problem(404, "no-such-structure");
        server.get(&format!("{missing}/surface.glb")).problem(404, "no-such-structure");
    }
    server.post("/v1/structures", &[], b"not a structure").problem(422, "unreadable-structure");
    let contradicted = [("content-type", "chemical/x-mmcif")];
    server.post("/v1/structures", &contradicted, SAMPLE).problem(415, "unsupported-media-type");
}

#[test]
fn a_damaged_structure_is_neither_used_nor_kept_by_another_upload() {
    // Structures in memory would hide the file.
    let server = start(Fake::new(Mode::Octahedra), |c| c.limits.structure_cache_bytes = 0);
    let made = server.post("/v1/structures", &[], SAMPLE);
    let location = made.header("location").unwrap().to_owned();
    let digest = location.rsplit('/').next().unwrap();
    let [stored, quarantined] =
        ["inputs", "quarantine"].map(|at| server.dir.path().join("store").join(at).join(digest));
    let mut flipped = SAMPLE.to_vec();
    // A digit of a coordinate.
    let at = flipped.windows(6).position(|line| line == b"ATOM  ").unwrap() + 35;
    flipped[at] ^= 1;
    let json = format!(r#"{{"structure": "{digest}", "resolution": 2.5}}"#);
    let verified = || server.metric("molmesh_store_errors_total", &["op=\"verify\""]);
    for (n, damaged) in [&flipped[..], &SAMPLE[..1000], b""].into_iter().enumerate() {
        std::fs::write(&stored, damaged).unwrap();
        let refused = match n {
            0 => server.get(&location),
            1 => server.post("/v1/meshes", &[("content-type", "application/json")], json.as_bytes()),
            _ => server.get(&format!("{location}/surface.glb?resolution=3")),
        };
        let problem = refused.problem(404, "no-such-structure");
        assert!(problem["detail"].as_str().unwrap().contains("damaged"), "{problem}");
        assert_eq!(std::fs::read(&quarantined).unwrap(), damaged);
        assert!(!stored.exists());
        assert_eq!(server.post("/v1/structures", &[], SAMPLE).status, 201);
        assert_eq!(server.get(&location).status, 200);
        // An upload also replaces a file whose damage nobody has noticed.
        std::fs::write(&stored, damaged).unwrap();
        assert_eq!(server.post("/v1/structures", &[], SAMPLE).status, 201);
        assert_eq!(std::fs::read(&stored).unwrap(), SAMPLE);
        std::fs::write(&stored, damaged).unwrap();
        let accepted = server.post("/v1/meshes", &[("prefer", "respond-async")], SAMPLE);
        assert_eq!(accepted.status, 202);
        assert_eq!(std::fs::read(&stored).unwrap(), SAMPLE);
        // The worker reads the file as well.
        let job = accepted.header("location").unwrap();
        assert_eq!(server.get(&format!("{job}?wait=20")).json()["status"], "successful");
        assert!((verified() - 3.0 * (n as f64 + 1.0)).abs() < 0.5);
    }
    // Undamaged, it is not written again, and the service remains ready.
    assert_eq!(server.post("/v1/structures", &[], SAMPLE).status, 200);
    assert_eq!((server.get("/readyz").status, verified()), (200, 9.0));
}

#[test]
fn a_damaged_result_is_quarantined_and_computed_again() {
    let folder = tempfile::tempdir().unwrap();
    let backend = Fake::new(Mode::Octahedra);
    let open = || {
        start(Arc::clone(&backend) as _, |c| {
            folder.path().clone_into(&mut c.server.data_dir);
            // Results in memory would hide the file.
            c.store.memory_object_bytes = 1;
        })
    };
    let started = || backend.started.load(Ordering::SeqCst);
    let server = open();
    let post = |server: &Running| server.post("/v1/meshes?format=stl", &[], SAMPLE);
    let mesh = post(&server).header("content-location").unwrap().to_owned();
    let whole = server.get(&mesh).body;
    let report = mesh.replace(".stl", "/report.json");
    let key = mesh.rsplit('/').next().unwrap().strip_suffix(".stl").unwrap();
    let at = |place: &str| folder.path().join("store").join(place);
    let [stored, quarantined] = ["results", "quarantine"].map(|place| at(place).join(format!("{key}.stl")));
    let mut flipped = whole.clone();
    flipped[200] ^= 1;
    // While the service runs, its file may change; a request for a range is no way around the check.
    for (n, header) in [("accept", "*/*"), ("range", "bytes=0-9")].into_iter().enumerate() {
        std::fs::write(&stored, &flipped).unwrap();
        send(server.addr, "GET", &mesh, &[header], b"").problem(404, "not-found");
        assert!(std::fs::read(&quarantined).unwrap() == flipped && !stored.exists());
        assert!((server.metric("molmesh_store_errors_total", &["op=\"verify\""]) - (n as f64 + 1.0)).abs() < 0.5);
        assert_eq!(post(&server).header("content-location"), Some(mesh.as_str()));
        assert!(server.get(&mesh).body == whole && std::fs::read(&stored).unwrap() == whole);
        assert_eq!(started(), n + 2, "computed again");
    }
    server.join();
    // Control: an undamaged result is served and not computed again after a restart.
    let server = open();
    assert!(server.get(&mesh).body == whole && post(&server).body == whole && started() == 3);
    server.join();
    // A job does not succeed with a damaged result, and a damaged report does not hide one.
    std::fs::write(&stored, &flipped).unwrap();
    let server = open();
    let job = server.post("/v1/meshes?format=stl", &[("prefer", "respond-async")], SAMPLE);
    let job = job.header("location").unwrap().to_owned();
    assert_eq!(server.get(&format!("{job}?wait=20")).json()["status"], "successful");
    assert!(server.get(&mesh).body == whole && started() == 4);
    server.join();
    let file = at("results").join(format!("{key}.json"));
    let text = std::fs::read_to_string(&file).unwrap();
    for damaged in [text.replacen("atoms", "atomz", 1), text[..text.len() / 2].to_owned(), String::new()] {
        std::fs::write(&file, damaged).unwrap();
        let server = open();
        server.get(&report).problem(404, "not-found");
        server.get(&mesh).problem(404, "not-found");
        assert!(post(&server).body == whole);
        assert_eq!([&mesh, &report].map(|path| server.get(path).status), [200, 200]);
        assert_eq!(server.get("/readyz").status, 200);
        server.join();
    }
    assert_eq!(started(), 7);
}

#[test]
fn json_documents_name_entries_and_structures() {
    let server = real(|_| {});
    let json = [("content-type", "application/json")];
    let folder = server.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
    let named = server.post("/v1/meshes", &json, br#"{"pdb_id": "4PTI", "resolution": 1.0, "chains": ["A"]}"#);
    assert_eq!(named.status, 200, "{}", String::from_utf8_lossy(&named.body));
    assert_eq!(named.body, server.get("/v1/pdb/4pti/surface.glb?resolution=1&chains=A").body);
    server.post("/v1/meshes", &json, br#"{"pdb_id": "9xyz"}"#).problem(404, "not-in-archive");
    for (bad, slug) in [
        (&b"{\"pdb_id\": \"4pti\", \"resolutoin\": 1}"[..], "bad-parameter"),
        (b"{\"pdb_id\": \"../x\"}", "bad-parameter"),
        (b"{\"resolution\": 1}", "bad-request"),
        (b"{\"pdb_id\": ", "bad-request"),
        (b"[1]", "bad-request"),
        (b"{\"pdb_id\": \"4pti\", \"structure\": \"x\"}", "bad-parameter"),
    ] {
        server.post("/v1/meshes", &json, bad).problem(400, slug);
    }
    let absent = format!("{{\"structure\": \"{}\"}}", "0".repeat(64));
    server.post("/v1/meshes", &json, absent.as_bytes()).problem(404, "no-such-structure");
}

#[test]
fn estimates_report_the_cost_and_a_spacing_that_fits() {
    let server = real(|c| c.limits.mesh_bytes = 2_000_000);
    let estimate = |query: &str| {
        let reply = server.post(&format!("/v1/estimate{query}"), &[], SAMPLE);
        assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
        reply.json()
    };
    let fits = estimate("?resolution=1");
    let report = server.post("/v1/report?resolution=1", &[], SAMPLE).json();
    assert_eq!((&fits["accepted"], &fits["grid_points"]), (&true.into(), &report["grid_points"]));
    let ratio = fits["triangles"].as_f64().unwrap() / report["triangles"].as_f64().unwrap();
    assert!((0.8..1.25).contains(&ratio), "{ratio}");
    assert!(fits["seconds"].as_f64().unwrap() > 0.0);
    // The size is that of the file in the requested format.
    let stl = estimate("?resolution=1&format=stl");
    assert_eq!(stl["mesh_bytes"].as_u64(), stl["triangles"].as_u64().map(|n| 50 * n));
    assert_ne!(fits["mesh_bytes"], stl["mesh_bytes"], "the control");
    let refused = estimate("?resolution=0.3");
    assert_eq!(
        (&refused["accepted"], &refused["problem"]["type"]),
        (&false.into(), &"/problems/mesh-too-large".into())
    );
    let named = server.post("/v1/estimate?resolution=0.3", &[("x-request-id", "mine-43")], SAMPLE).json();
    assert_eq!(named["problem"]["instance"], "mine-43");
    let suggested = refused["problem"]["suggested_resolution"].as_f64().unwrap();
    assert_eq!(estimate(&format!("?resolution={suggested}"))["accepted"], true);
    server.post("/v1/estimate", &[], b"nothing").problem(422, "unreadable-structure");
    server.post("/v1/estimate?x=1", &[], SAMPLE).problem(400, "bad-parameter");
}
