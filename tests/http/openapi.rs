//! The OpenAPI document: it equals the committed file, lists all routes and parameters, and passes validators.
//! `MOLMESH_BLESS=1 cargo test --test http openapi` writes the file.

use crate::http_support;
use crate::openapi_support;
use crate::tools;

use std::collections::BTreeSet;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use http_support::{Fake, Mode, Running, send, start};
use molmesh::formats::Format;
use molmesh::pipeline::params::{Domain, TABLE};
use openapi_support::{operations, resolved};
use serde_json::{Value, json};

static SERVER: LazyLock<Running> = LazyLock::new(|| start(Fake::new(Mode::Octahedra), |_| {}));
static DESCRIPTION: LazyLock<Value> = LazyLock::new(|| SERVER.get("/openapi.json").json());

#[test]
fn the_committed_document_matches_the_code() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("openapi.yaml");
    let reply = SERVER.get("/openapi.yaml");
    assert_eq!((reply.status, reply.header("content-type")), (200, Some("application/yaml")));
    let served = reply.text();
    if std::env::var_os("MOLMESH_BLESS").is_some() {
        std::fs::write(&path, &served).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap();
    let first = committed.lines().zip(served.lines()).position(|(a, b)| a != b);
    assert!(
        committed == served,
        "openapi.yaml differs from line {} on; MOLMESH_BLESS=1 cargo test --test http openapi writes it",
        first.map_or_else(|| committed.lines().count().min(served.lines().count()) + 1, |n| n + 1)
    );
    assert!(served.starts_with("openapi: 3.1.0\n"), "{}", &served[..40]);
    assert!(served.len() < 205_000, "{} bytes", served.len());
    assert_eq!(DESCRIPTION["openapi"], "3.1.0");
    assert_eq!(DESCRIPTION["components"]["schemas"]["Report"]["example"]["euler"], 2);
    assert_eq!(DESCRIPTION["info"]["version"], env!("CARGO_PKG_VERSION"));
}

#[test]
fn the_document_has_the_methods_of_the_router() {
    let paths = DESCRIPTION["paths"].as_object().unwrap();
    assert!(paths.len() > 15, "{}", paths.len());
    for (path, item) in paths {
        let allow = send(SERVER.addr, "TRACE", &path.replace(['{', '}'], ""), &[], b"");
        let allow: BTreeSet<_> = allow.header("allow").unwrap().split(',').map(str::to_lowercase).collect();
        let allow: BTreeSet<_> = allow.iter().map(String::as_str).filter(|method| *method != "head").collect();
        assert_eq!(item.as_object().unwrap().keys().map(String::as_str).collect::<BTreeSet<_>>(), allow, "{path}");
    }
}

#[test]
fn the_parameters_are_those_of_the_table() {
    let names = |method: &str, path: &str| -> Vec<String> {
        let parameters = DESCRIPTION["paths"][path][method]["parameters"].as_array().unwrap();
        let of_query = parameters.iter().map(|p| resolved(&DESCRIPTION, p)).filter(|p| p["in"] == "query");
        of_query.map(|p| p["name"].as_str().unwrap().to_owned()).collect()
    };
    let all: Vec<&str> = TABLE.iter().map(|p| p.name).collect();
    let without_format: Vec<&str> = all.iter().copied().filter(|name| *name != "format").collect();
    assert_eq!(names("post", "/v1/meshes"), all);
    assert_eq!(names("post", "/v1/estimate"), all);
    assert_eq!(names("post", "/v1/report"), all);
    assert_eq!(names("get", "/v1/pdb/{id}/{file}"), without_format);
    assert_eq!(names("get", "/v1/structures/{digest}/{file}"), without_format);
    let parameter = |name: &str| &DESCRIPTION["components"]["parameters"][name];
    let schema = |name: &str| resolved(&DESCRIPTION, &parameter(name)["schema"]);
    assert_eq!((&schema("resolution")["type"], &schema("resolution")["default"]), (&json!("number"), &json!(0.5)));
    assert_eq!(schema("format")["enum"].as_array().unwrap().len(), Format::ALL.len());
    // A format that is sent takes precedence over `Accept`.
    assert_eq!((schema("format").get("default"), &schema("compress")["default"]), (None, &json!("none")));
    // Units and ranges are in the text as well.
    for p in TABLE {
        let Domain::Number { min, max, unit } = p.domain else { continue };
        let range = format!("Range: {}.", format!("{min} to {max} {unit}").trim());
        assert!(parameter(p.name)["description"].as_str().unwrap().contains(&range), "{}: {range}", p.name);
    }
}

#[test]
fn every_reference_resolves_and_every_response_has_a_description() {
    fn references(value: &Value, found: &mut BTreeSet<String>) {
        match value {
            Value::Object(members) => {
                found.extend(members.get("$ref").and_then(Value::as_str).map(str::to_owned));
                members.values().for_each(|member| references(member, found));
            }
            Value::Array(items) => items.iter().for_each(|item| references(item, found)),
            _ => {}
        }
    }
    let mut found = BTreeSet::new();
    references(&DESCRIPTION, &mut found);
    assert!(found.len() > 15, "{found:?}");
    for reference in &found {
        assert!(DESCRIPTION.pointer(reference.trim_start_matches('#')).is_some(), "{reference}");
    }
    let mut ids = BTreeSet::new();
    for (operation, responses) in operations(&DESCRIPTION) {
        let (method, path) = operation.split_once(' ').unwrap();
        let id = &DESCRIPTION["paths"][path][method.to_lowercase()]["operationId"];
        assert!(ids.insert(id.as_str().unwrap()), "{operation}: {id} is not unique");
        for (status, response) in responses {
            assert!(response["description"].as_str().is_some_and(|d| !d.is_empty()), "{operation} {status}");
            let content = response["content"].as_object();
            let problem = content.is_some_and(|c| c.contains_key("application/problem+json"));
            assert_eq!(problem, status >= 400, "{operation} {status}");
        }
    }
}

/// Returns the components whose name ends in a number, or consists of a status only.
fn numbered(description: &Value) -> Vec<String> {
    let kinds = description["components"].as_object().unwrap().iter();
    let names = kinds.flat_map(|(kind, of_kind)| of_kind.as_object().unwrap().keys().map(move |name| (kind, name)));
    let is_numbered =
        |name: &str| name.starts_with("Error") || name.rsplit_once('-').is_some_and(|(_, n)| n.parse::<u32>().is_ok());
    names.filter(|(_, name)| is_numbered(name)).map(|(kind, name)| format!("{kind}/{name}")).collect()
}

#[test]
fn components_are_named_by_meaning() {
    assert_eq!(numbered(&DESCRIPTION), Vec::<String>::new());
    let bad = json!({ "components": { "headers": { "ETag-2": {}, "ETag": {} }, "responses": { "Error422": {} } } });
    assert_eq!(numbered(&bad), ["headers/ETag-2", "responses/Error422"]);
}

#[test]
fn the_json_body_is_a_component_with_a_valid_example() {
    let json = &DESCRIPTION["components"]["requestBodies"]["StructureByName"]["content"]["application/json"];
    let schema = resolved(&DESCRIPTION, &json["schema"]);
    let example = schema["examples"][0].to_string();
    let folder = SERVER.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), http_support::SAMPLE).unwrap();
    for path in ["/v1/meshes", "/v1/report", "/v1/estimate"] {
        let reply = send(SERVER.addr, "POST", path, &[("content-type", "application/json")], example.as_bytes());
        assert_eq!(reply.status, 200, "{path}: {}", String::from_utf8_lossy(&reply.body));
        let content = &DESCRIPTION["paths"][path]["post"]["requestBody"]["content"];
        let declared: Vec<&String> = content.as_object().unwrap().keys().collect();
        assert_eq!(declared, ["application/octet-stream"], "{path}");
    }
}

/// Runs the validators on a document: the specification, its examples, and YAML 1.1 against JSON.
fn validated(name: &str, description: &Value, yaml: &str) -> Option<Result<(), String>> {
    let Some(python) = tools::python_interpreter() else { return tools::missing("openapi-spec-validator") };
    let folder = tempfile::tempdir().unwrap();
    let files: [PathBuf; 2] = ["json", "yaml"].map(|extension| folder.path().join(format!("{name}.{extension}")));
    std::fs::write(&files[0], description.to_string()).unwrap();
    std::fs::write(&files[1], yaml).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/openapi_clients/validate.py");
    let output = Command::new(python).arg(script).args(files).output().unwrap();
    Some(if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).into_owned()) })
}

#[test]
fn validators_accept_the_document_its_examples_and_its_yaml() {
    let yaml = SERVER.get("/openapi.yaml").text();
    let Some(found) = validated("good", &DESCRIPTION, &yaml) else { return };
    assert_eq!(found, Ok(()));
    // The control: three documents with one error each.
    let refused = |change: &dyn Fn(&mut Value, &mut String), words: &str| {
        let (mut description, mut yaml) = (DESCRIPTION.clone(), yaml.clone());
        change(&mut description, &mut yaml);
        let error = validated("bad", &description, &yaml).unwrap().unwrap_err();
        assert!(error.contains(words), "{words}: {error}");
    };
    refused(&|_, yaml| *yaml = yaml.replace("1.0e-6", "1e-6"), "YAML");
    refused(&|d, _| d["info"] = json!({}), "title");
    refused(&|d, _| d["components"]["schemas"]["JobDocument"]["example"]["progress"] = json!(200), "JobDocument");
}

#[test]
fn swagger_ui_loads_nothing_from_other_hosts() {
    let page = SERVER.get("/docs");
    assert_eq!(page.header("content-type"), Some("text/html; charset=utf-8"));
    let policy = page.header("content-security-policy").unwrap();
    assert!(policy.contains("default-src 'none'") && !policy.contains("unsafe"), "{policy}");
    let html = page.text();
    assert!(!html.contains("<style") && !html.contains("<script>") && html.contains("/swagger-ui-bundle.js"));
    let attributes = ["src=\"", "href=\""];
    let links = attributes.iter().flat_map(|attribute| html.split(attribute).skip(1));
    let links: Vec<&str> = links.map(|rest| rest.split('"').next().unwrap()).collect();
    assert!(links.len() >= 6, "{links:?}");
    for link in links {
        assert!(link.starts_with('/') && !link.starts_with("//"), "{link}");
        assert_eq!(SERVER.get(link).status, 200, "{link}");
    }
    assert!(SERVER.get("/").text().contains("href=\"/docs\""));
}

#[test]
fn swagger_ui_matches_its_note_compressed_and_uncompressed() {
    let note = include_str!("../../web/swagger/README.md");
    for file in ["swagger-ui-bundle.js", "swagger-ui.css"] {
        let path = format!("/{file}");
        let plain = SERVER.get(&path);
        assert_eq!((plain.status, plain.header("content-encoding")), (200, None));
        let digest = molmesh::store::Digest::of(&plain.body).to_string();
        assert!(note.contains(&format!("{digest}  {file}\n")), "{file} is {digest}");
        for (accept, coding) in
            [("gzip, br", Some("gzip")), ("br;q=1, *;q=0.1", Some("gzip")), ("gzip;q=0", None), ("identity", None)]
        {
            let reply = send(SERVER.addr, "GET", &path, &[("accept-encoding", accept)], b"");
            assert_eq!(reply.header("content-encoding"), coding, "{accept}");
            let mut inflated = Vec::new();
            if coding.is_some() {
                flate2::read::GzDecoder::new(&reply.body[..]).read_to_end(&mut inflated).unwrap();
            } else {
                inflated = reply.body;
            }
            assert!(inflated == plain.body, "{file} {accept}");
        }
    }
}
