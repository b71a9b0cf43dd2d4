//! Generated clients send every default of the API description. The response must equal that without them.

use crate::http_support;
use crate::openapi_support;

use std::collections::BTreeMap;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, start};
use molmesh::formats::Format;
use molmesh::pipeline::params::{self, Domain, ParamError, TABLE};
use openapi_support::resolved;
use serde_json::{Map, Value};

/// Starts a server with an archive entry. Returns it with its API description.
fn server() -> (Running, Value) {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let folder = server.dir.path().join("archive");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("4pti.pdb"), SAMPLE).unwrap();
    let description = server.get("/openapi.json").json();
    (server, description)
}

/// Returns the declared defaults of an operation's query, and the `format`.
fn query(description: &Value, method: &str, path: &str, format: Option<&str>) -> Vec<(String, String)> {
    let parameters = description["paths"][path][method]["parameters"].as_array().unwrap();
    let of_query = parameters.iter().map(|p| resolved(description, p)).filter(|p| p["in"] == "query");
    let default = |schema| resolved(description, schema).get("default");
    let pairs = of_query.filter_map(|p| Some((p["name"].as_str()?.to_owned(), text(default(&p["schema"])?))));
    pairs.chain(format.map(|format| ("format".to_owned(), format.to_owned()))).collect()
}

/// Returns the declared defaults as members of a JSON document.
fn body(description: &Value, format: &str) -> Map<String, Value> {
    let schema = |name: &str| resolved(description, &description["components"]["parameters"][name]["schema"]).clone();
    let defaults = TABLE.iter().filter_map(|p| Some((p.name.to_owned(), schema(p.name).get("default")?.clone())));
    let mut defaults: Map<String, Value> = defaults.collect();
    assert!(defaults.len() > 10, "{defaults:?}");
    defaults.insert("format".to_owned(), format.into());
    defaults
}

fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

fn address(path: &str, pairs: &[(String, String)]) -> String {
    let query: Vec<_> = pairs.iter().map(|(name, value)| format!("{name}={value}")).collect();
    format!("{path}?{}", query.join("&"))
}

#[track_caller]
fn same(found: &Reply, plain: &Reply) {
    let said = || String::from_utf8_lossy(&found.body[..found.body.len().min(400)]).into_owned();
    assert_eq!((found.status, plain.status), (200, 200), "{}", said());
    assert!(plain.header("etag").is_some());
    assert_eq!(found.header("etag"), plain.header("etag"));
    assert!(found.body == plain.body, "the bodies differ");
}

#[test]
fn sending_all_defaults_changes_nothing() {
    let (server, description) = server();
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let json = [("content-type", "application/json")];
    let form = [("content-type", "multipart/form-data; boundary=b")];
    for format in Format::ALL.map(Format::name) {
        let plain = server.post(&format!("/v1/meshes?format={format}"), &[], SAMPLE);
        let defaults = query(&description, "post", "/v1/meshes", Some(format));
        assert!(defaults.len() > 10 && defaults.iter().any(|(name, _)| name == "azimuth"), "{defaults:?}");
        same(&server.post(&address("/v1/meshes", &defaults), &[], SAMPLE), &plain);
        for (template, path) in
            [("/v1/pdb/{id}/{file}", "/v1/pdb/4pti"), ("/v1/structures/{digest}/{file}", &structure)]
        {
            let defaults = query(&description, "get", template, None);
            assert!(defaults.len() > 10, "{defaults:?}");
            let path = format!("{path}/surface.{format}");
            same(&server.get(&address(&path, &defaults)), &plain);
        }
        let mut document = body(&description, format);
        document.insert("pdb_id".to_owned(), "4pti".into());
        same(&server.post("/v1/meshes", &json, Value::Object(document).to_string().as_bytes()), &plain);
        let field = |(name, value): (&str, String)| {
            format!("--b\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n{value}\r\n")
        };
        let fields = body(&description, format);
        let mut parts: String = fields.iter().map(|(name, value)| field((name, text(value)))).collect();
        parts.push_str(&field(("file", String::from_utf8(SAMPLE.to_vec()).unwrap())));
        parts.push_str("--b--\r\n");
        same(&server.post("/v1/meshes", &form, parts.as_bytes()), &plain);
        // An estimate has no ETag; times differ.
        let estimate = |path: &str| {
            let reply = server.post(path, &[], SAMPLE);
            assert_eq!(reply.status, 200, "{}", reply.text());
            let mut document: BTreeMap<String, Value> = serde_json::from_slice(&reply.body).unwrap();
            document.retain(|name, _| !["seconds", "wait_seconds"].contains(&name.as_str()));
            document
        };
        let defaults = query(&description, "post", "/v1/estimate", Some(format));
        let plain = estimate(&format!("/v1/estimate?format={format}"));
        assert_eq!(estimate(&address("/v1/estimate", &defaults)), plain);
    }
    let defaults = query(&description, "post", "/v1/meshes", None);
    for accept in ["*/*", "model/stl", "image/png"] {
        let accept = [("accept", accept)];
        same(
            &server.post(&address("/v1/meshes", &defaults), &accept, SAMPLE),
            &server.post("/v1/meshes", &accept, SAMPLE),
        );
    }
}

/// Returns every value of each choice that is not its default, with the parameter that it needs.
pub(crate) fn choices() -> Vec<Vec<(&'static str, &'static str)>> {
    let colored = |name| ["palette", "color_blend"].contains(&name).then_some(("color", "bfactor"));
    let mut all = Vec::new();
    for parameter in TABLE.iter().filter(|parameter| parameter.name != "format") {
        let Domain::Choice(words) = parameter.domain else { continue };
        let others = words.iter().filter(|word| !parameter.is_default(word));
        all.extend(others.map(|word| [(parameter.name, *word)].into_iter().chain(colored(parameter.name)).collect()));
    }
    all
}

/// Reads a request as the canonical text of its parameters.
fn read(pairs: &[(&str, &str)], format: Format) -> Result<String, ParamError> {
    let request = params::parse_with(pairs.iter().copied(), |_| Ok::<_, ParamError>(format))?;
    Ok(format!("{} {}", params::canonical(&request.options), request.strict))
}

#[test]
fn a_default_is_valid_with_every_parameter() {
    let (_server, description) = server();
    let defaults = query(&description, "post", "/v1/meshes", None);
    let others = [
        &[][..],
        &[("surface", "ses"), ("probe", "2")],
        &[("resolution", "0.7")],
        &[("detail", "3")],
        &[("max_triangles", "5000")],
        &[("smoothness", "2")],
        &[("isovalue", "2")],
        &[("radius_scale", "2")],
        &[("radius_offset", "0.25")],
        &[("cutoff_tolerance", "0.02")],
        &[("paper_a", "1"), ("paper_b", "2")],
        &[("paper_a", "1"), ("paper_b", "2"), ("surface", "soft-object")],
        &[("paper_c", "0.5"), ("paper_b", "3"), ("surface", "inverse-square")],
        &[("atom_ids", "true")],
        &[("exact", "true"), ("surface", "sas")],
        &[("exact", "true"), ("surface", "ses"), ("interface", "A,B")],
        &[("cavities", "drop"), ("surface", "ses")],
        &[("pockets", "true"), ("pocket_probe", "5")],
        &[("simplify", "0.1")],
        &[("simplify", "0.2"), ("max_triangles", "20000")],
        &[("tile", "0/0/0/0")],
        &[("color", "pocket")],
        &[("color", "chain")],
        &[("color", "bfactor"), ("palette", "blue-white-red"), ("color_range", "0,50")],
        &[("color", "map"), ("color_offset", "2")],
        &[("model", "1")],
        &[("chains", "A")],
        &[("select", "ligand")],
        &[("altloc", "B")],
        &[("assembly", "1")],
        &[("instances", "true"), ("assembly", "1")],
        &[("unit", "1"), ("assembly", "1")],
        &[("width", "40")],
        &[("height", "40")],
        &[("azimuth", "20")],
        &[("elevation", "20")],
        &[("background", "white")],
    ];
    let others: Vec<_> = others.into_iter().map(<[_]>::to_vec).chain(choices()).collect();
    let tried: Vec<&str> = others.iter().flat_map(|other| other.iter().map(|(name, _)| *name)).collect();
    for parameter in TABLE.iter().filter(|p| p.name != "format") {
        assert!(tried.contains(&parameter.name), "{} is not tested", parameter.name);
    }
    for other in others.iter().map(Vec::as_slice) {
        let mut formats = 0;
        for format in Format::ALL {
            let Ok(plain) = read(other, format) else { continue };
            formats += 1;
            let free = |name: &str| other.iter().all(|(given, _)| *given != name);
            let all: Vec<(&str, &str)> =
                defaults.iter().filter(|(name, _)| free(name)).map(|(name, value)| (&**name, &**value)).collect();
            for beside in all.iter().map(std::slice::from_ref).chain([&all[..]]) {
                for pairs in [[other, beside].concat(), [beside, other].concat()] {
                    assert_eq!(read(&pairs, format), Ok(plain.clone()), "{pairs:?} {format}");
                }
            }
        }
        assert!(formats > 0, "{other:?} is valid for no format");
    }
    // Numbers are compared by value.
    for (name, value) in [("azimuth", "-0.0"), ("resolution", "0.50"), ("width", "+512"), ("background", "#00000000")] {
        assert!(read(&[(name, value), ("detail", "3")], Format::Stl).is_ok(), "{name}={value}");
    }
}

#[test]
fn errors_of_conflicts_name_the_sent_parameters() {
    for (pairs, format, names) in [
        (&[("resolution", "0.6"), ("detail", "3")][..], Format::Glb, &["`detail`", "`resolution`"][..]),
        (
            &[("max_triangles", "500"), ("resolution", "0.5"), ("detail", "3")],
            Format::Glb,
            &["`detail`", "`max_triangles`"],
        ),
        (&[("surface", "soft-object"), ("cutoff_tolerance", "0.02")], Format::Glb, &["`cutoff_tolerance`"]),
        (&[("surface", "soft-object"), ("preset", "blinn")], Format::Glb, &["`preset`"]),
        (&[("surface", "ses"), ("isovalue", "2")], Format::Glb, &["`isovalue`"]),
        (&[("surface", "vdw"), ("probe", "2")], Format::Glb, &["`probe`"]),
        (&[("paper_a", "1"), ("paper_b", "2"), ("radius_scale", "2")], Format::Glb, &["`radius_scale`"]),
        (&[("width", "512"), ("azimuth", "1")], Format::Stl, &["`azimuth`"]),
        (&[("azimuth", "0"), ("style", "gouraud")], Format::Obj, &["`style`"]),
        (&[("compress", "quantize")], Format::Ply, &["`compress`"]),
        (&[("compress", "meshopt")], Format::Gltf, &["`compress`"]),
        (&[("instances", "true"), ("assembly", "1")], Format::Stl, &["`instances`"]),
        (&[("instances", "true")], Format::Glb, &["`instances`"]),
    ] {
        let refused = read(pairs, format).unwrap_err().to_string();
        for name in names {
            assert!(refused.contains(name), "no {name} in {refused}");
        }
        for parameter in TABLE.iter().filter(|p| pairs.iter().all(|(name, _)| *name != p.name)) {
            assert!(!refused.contains(&format!("`{}`", parameter.name)), "{} was not sent: {refused}", parameter.name);
        }
    }
    // Other values are still checked, and repeated parameters are rejected even if they are defaults.
    assert!(read(&[("check", "absent")], Format::Glb).is_err());
    assert!(read(&[("azimuth", "0"), ("azimuth", "0")], Format::Png).is_err());
    // The defaults of chains and alternative locations are words that may also be names.
    assert_ne!(read(&[("chains", "all")], Format::Glb), read(&[], Format::Glb));
}
