//! Schemathesis generates valid and invalid requests from the OpenAPI document and checks the responses against it. The
//! seed is random and printed; `MOLMESH_SEED` repeats a run. The settings are in `tests/tools/schemathesis.toml`.

use crate::http_support;
use crate::tools;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use http_support::{Running, SAMPLE, start};
use molmesh::surface::CpuBackend;
use serde_json::{Value, json};

/// Starts a server with low limits, as generated requests are numerous.
fn server() -> Running {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |c| {
        c.limits.grid_points = 1 << 20;
        c.limits.mesh_bytes = 16 << 20;
        c.limits.output_bytes = 16 << 20;
        c.jobs.queue = 1000;
    });
    let folder = server.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
    // The settings name the structure by its digest.
    assert_eq!(server.post("/v1/structures", &[], SAMPLE).status, 201);
    server
}

/// Runs Schemathesis on a description. Returns success and output, or `None` if it is not installed.
fn schemathesis(server: &Running, description: &Path, more: &[&str]) -> Option<(bool, String)> {
    let Some(python) = tools::python_interpreter() else { return tools::missing("Schemathesis") };
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let seed = std::env::var("MOLMESH_SEED")
        .unwrap_or_else(|_unset| SystemTime::now().duration_since(UNIX_EPOCH).unwrap().subsec_nanos().to_string());
    let output = Command::new(&python)
        .arg(python.with_file_name("st"))
        .args(["--config-file", "schemathesis.toml", "--no-color", "run", "--seed", &seed])
        .arg(description)
        .args(["--url", &format!("http://{}", server.addr)])
        .args(more)
        .current_dir(root.join("tests/tools"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .unwrap();
    let printed = [output.stdout, output.stderr].concat();
    Some((output.status.success(), format!("MOLMESH_SEED={seed}\n{}", String::from_utf8_lossy(&printed))))
}

#[test]
fn the_server_conforms_to_its_description() {
    let server = server();
    let file = server.dir.path().join("openapi.json");
    std::fs::write(&file, server.get("/openapi.json").body).unwrap();
    let Some((good, printed)) = schemathesis(&server, &file, &[]) else { return };
    assert!(good, "{printed}");
    for phase in ["Coverage", "Fuzzing", "Stateful"] {
        assert!(printed.contains(phase), "no phase {phase}: {printed}");
    }
    assert_eq!(server.get("/livez").status, 200);
}

#[test]
fn wrong_descriptions_are_detected() {
    let server = server();
    let description = server.get("/openapi.json").json();
    let doctored = |change: &dyn Fn(&mut Value)| {
        let mut description = description.clone();
        change(&mut description["paths"]["/v1/jobs/{id}"]["get"]["responses"]);
        let file = server.dir.path().join("doctored.json");
        std::fs::write(&file, description.to_string()).unwrap();
        schemathesis(&server, &file, &["--include-operation-id", "showJob", "--phases", "coverage,fuzzing"])
    };
    let Some((good, printed)) = doctored(&|_| {}) else { return };
    assert!(good, "the unchanged description passes: {printed}");
    let (good, printed) = doctored(&|responses| drop(responses.as_object_mut().unwrap().remove("404"))).unwrap();
    assert!(!good && printed.contains("404"), "missing status: {printed}");
    let response =
        |media_type: &str, schema: Value| json!({ "description": "", "content": { media_type: { "schema": schema } } });
    let problem = json!({ "$ref": "#/components/schemas/Problem" });
    let (good, printed) =
        doctored(&|responses| responses["404"] = response("application/json", problem.clone())).unwrap();
    assert!(!good && printed.contains("application/problem+json"), "wrong media type: {printed}");
    let other = json!({ "properties": { "type": { "enum": ["/problems/no-such-thing"] } } });
    let (good, printed) =
        doctored(&|responses| responses["404"] = response("application/problem+json", other.clone())).unwrap();
    assert!(!good && printed.contains("no-such-thing"), "wrong schema: {printed}");
}
