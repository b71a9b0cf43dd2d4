//! The schema of the configuration file: the committed one is what the types say, it is a schema in the eyes of others, and
//! it and the loader refuse the same files. `MOLMESH_BLESS=1 cargo test --test config_schema` writes it anew.
#![cfg(feature = "server")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

mod tools;

use std::path::Path;

use molmesh::config::{load, load_with_sources, schema};
use serde::Deserialize;
use serde_json::{Value, json};

/// What the judge says.
#[derive(Debug, Deserialize)]
struct Verdict {
    /// Why the schema is none.
    schema: Option<String>,
    /// What it has against each document.
    documents: Vec<Vec<String>>,
}

/// Asks the judge; none where it is not installed.
fn judge(schema: &Value, documents: &[Value]) -> Option<Verdict> {
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
fn the_committed_schema_is_what_the_types_say() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("molmesh.schema.json");
    let now = format!("{:#}\n", schema());
    if std::env::var_os("MOLMESH_BLESS").is_some() {
        std::fs::write(&path, &now).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let first = committed.lines().zip(now.lines()).position(|(a, b)| a != b);
    assert!(committed == now, "molmesh.schema.json differs from line {first:?} on; MOLMESH_BLESS=1 writes it anew");
    assert_eq!(schema()["$schema"], "https://json-schema.org/draft/2020-12/schema");
}

#[test]
fn others_take_it_for_a_schema_and_the_example_for_a_document() {
    let example = document(&std::fs::read_to_string(self::example()).unwrap());
    let effective = load_with_sources(Some(&self::example()), [], &[]).unwrap().to_json();
    let Some(verdict) = judge(&schema(), &[example.clone(), effective["config"].clone(), json!({})]) else { return };
    assert_eq!((verdict.schema, verdict.documents), (None, vec![Vec::<String>::new(); 3]));
    // The control: a schema that is none, and one that the example does not fit.
    let mut broken = schema();
    broken["properties"]["jobs"]["properties"]["workers"]["type"] = "number of workers".into();
    assert!(judge(&broken, &[]).unwrap().schema.is_some());
    let mut narrow = schema();
    narrow["properties"]["jobs"]["properties"]["workers"]["maximum"] = 1.into();
    let said = judge(&narrow, &[example]).unwrap().documents;
    assert!(said[0].len() == 1 && said[0][0].starts_with("$.jobs.workers"), "{said:?}");
}

#[test]
fn the_schema_and_the_loader_refuse_the_same_files() {
    let good = [
        "[limits]\nbody_bytes = \"64MiB\"\natoms = 5",
        "[limits]\nbody_bytes = \"1_000 KiB\"",
        "[server]\nmetrics_listen = \"none\"\ntermination_notice_ms = \"none\"\nhead_bytes = 8192",
        "[server]\nmetrics_listen = \"127.0.0.1:9090\"\ntermination_notice_ms = 1",
        "[devices]\nmin_partition_bricks = \"none\"\nuse = \"0,2\"",
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
        "[devices]\nmin_partition_bricks = 0",
        "[server]\nhead_bytes = 8191",
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
    let Some(verdict) = judge(&schema(), &documents) else { return };
    for (n, (text, said)) in good.iter().chain(&bad).zip(&verdict.documents).enumerate() {
        assert_eq!(said.is_empty(), n < good.len(), "{text}: {said:?}");
    }
}
