//! Schema of the configuration file: the committed file matches the types, an external validator accepts it, and it
//! rejects the same files as the loader. `MOLMESH_BLESS=1 cargo test --test http config_schema` updates it.

use crate::tools;

use std::path::Path;

use molmesh::config::{load, schema};
use serde::Deserialize;
use serde_json::{Value, json};

/// Result of the external validator.
#[derive(Debug, Deserialize)]
struct Verdict {
    /// Error in the schema.
    schema: Option<String>,
    /// Errors in each document.
    documents: Vec<Vec<String>>,
}

/// Runs the external validator. Returns `None` if it is not installed.
fn validate(schema: &Value, documents: &[Value]) -> Option<Verdict> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("case.json");
    std::fs::write(&path, json!({ "schema": schema, "documents": documents }).to_string()).unwrap();
    tools::python::<Verdict>("check_schema.py", &[path])?.pop()
}

fn example() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("molmesh.example.toml")
}

fn document(toml: &str) -> Value {
    toml::from_str(toml).unwrap_or_else(|e| panic!("{toml}: {e}"))
}

#[test]
fn the_committed_schema_matches_the_types() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("molmesh.schema.json");
    let now = format!("{:#}\n", schema());
    if std::env::var_os("MOLMESH_BLESS").is_some() {
        std::fs::write(&path, &now).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let first = committed.lines().zip(now.lines()).position(|(a, b)| a != b);
    assert!(committed == now, "molmesh.schema.json differs from line {first:?}; MOLMESH_BLESS=1 updates it");
    assert_eq!(schema()["$schema"], "https://json-schema.org/draft/2020-12/schema");
}

#[test]
fn an_external_validator_accepts_the_schema_and_the_example() {
    let example = document(&std::fs::read_to_string(self::example()).unwrap());
    let effective = load(Some(&self::example()), [], &[]).unwrap().to_json();
    let Some(verdict) = validate(&schema(), &[example.clone(), effective["config"].clone(), json!({})]) else { return };
    assert_eq!((verdict.schema, verdict.documents), (None, vec![Vec::<String>::new(); 3]));
    // Control: an invalid schema, and one that the example violates.
    let mut broken = schema();
    broken["properties"]["jobs"]["properties"]["workers"]["type"] = "number of workers".into();
    assert!(validate(&broken, &[]).unwrap().schema.is_some());
    let mut narrow = schema();
    narrow["properties"]["jobs"]["properties"]["workers"]["maximum"] = 1.into();
    let errors = validate(&narrow, &[example]).unwrap().documents;
    assert!(errors[0].len() == 1 && errors[0][0].starts_with("$.jobs.workers"), "{errors:?}");
}

#[test]
fn the_schema_and_the_loader_reject_the_same_files() {
    let good = [
        "[limits]\nbody_bytes = \"64MiB\"\natoms = 5",
        "[limits]\nbody_bytes = \"1_000 KiB\"",
        "[server]\nmetrics_listen = \"none\"\ntermination_notice_ms = \"none\"",
        "[server]\nmetrics_listen = \"127.0.0.1:9090\"\ntermination_notice_ms = 1",
        "[devices]\nuse = \"0,2\"\nreadback_bytes = 0",
        "[archive]\nurl = [\"http://a/{id}\", \"https://b/{middle}/{id_upper}.cif\"]\nproxy = \"http://p:1\"",
        "[archive]\nurl = \"none\"\nproxy = \"none\"\ndir = \"/pdb\"",
        "[archive]\nurl = \"http://a/{id} https://b:8/{id}?x=1\"",
        "[store]\nsecret_access_key = \"x\"\nallow_http = true",
        "[log]\nformat = \"json\"\nfilter = \"debug\"",
    ];
    let bad = [
        "[limits]\nbody_byte = 1",
        "[limit]\natoms = 1",
        "queue = 3",
        "[jobs]\nworkers = 0",
        "[jobs]\nworkers = -1",
        "[jobs]\nworkers = 1.5",
        "[jobs]\nworkers = true",
        "[jobs]\nworkers = \"many\"",
        "[jobs]\nqueue = \"none\"",
        "[limits]\nbody_bytes = 0",
        "[limits]\nbody_bytes = \"0MiB\"",
        "[limits]\nbody_bytes = \"5 MB\"",
        "[limits]\nbody_bytes = \"none\"",
        "[server]\ntermination_notice_ms = 0",
        "[server]\nheader_timeout_ms = 15000",
        "[server]\nlisten = 8080",
        "[archive]\nallow_private = \"maybe\"",
        "[archive]\nurl = \"file:///pdb/{id}\"",
        "[archive]\nurl = \"https://h/4pti.cif\"",
        "[archive]\nurl = []",
        "[archive]\nproxy = \"proxy\"",
        "[store]\nsecret_access_key = 5",
        "[log]\nformat = \"xml\"",
    ];
    let loads = |text: &str| {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        load(Some(file.path()), [], &[]).is_ok()
    };
    for text in good {
        assert!(loads(text), "{text}");
    }
    for text in bad {
        assert!(!loads(text), "{text}");
    }
    let documents: Vec<Value> = good.iter().chain(&bad).map(|text| document(text)).collect();
    let Some(verdict) = validate(&schema(), &documents) else { return };
    for (n, (text, errors)) in good.iter().chain(&bad).zip(&verdict.documents).enumerate() {
        assert_eq!(errors.is_empty(), n < good.len(), "{text}: {errors:?}");
    }
}
