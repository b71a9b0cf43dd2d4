//! Post-processing of the OpenAPI document: moves repeated parameters and responses to `components`, and adds the
//! components that follow from no type, such as headers, and the example of a report.

use serde_json::{Map, Value, json};

use crate::http::delivery::{PICTURE, SUMMARY, SummaryHeader};
use crate::http::problem_types::PROBLEM_TYPES;
use crate::pipeline::params::areas;

/// Temporary extension of an error response with its problem types, from which [`share`] derives the name of the
/// component.
pub(super) const PROBLEM_TYPES_EXTENSION: &str = "x-problem-types";

/// Components that follow from no type and no table, as YAML.
const FIXED: &str = include_str!("components.yaml");
/// Example of a report, as JSON.
const REPORT_EXAMPLE: &str = include_str!("report_example.json");

/// Names of error responses with more than two problem types: status, problem types that only this response has, name.
/// The first row that matches applies.
const ERROR_NAMES: &[(&str, &[&str], &str)] = &[
    ("401", &[], "Unauthorized"),
    ("403", &[], "Forbidden"),
    ("413", &[], "TooLarge"),
    ("422", &["other-request"], "MeshRequestRejected"),
    ("422", &["mesh-too-large"], "MeshRejected"),
    ("422", &["picture-too-large"], "EstimateRejected"),
    ("422", &["grid-too-large"], "TilesetRejected"),
    ("422", &["too-many-copies"], "AtomsRejected"),
    ("422", &["empty-selection"], "SelectionRejected"),
    ("422", &[], "StructureRejected"),
    ("500", &[], "JobFailed"),
    ("503", &["too-many-jobs", "device-failed"], "MeshUnavailable"),
    ("503", &["too-many-jobs"], "BatchUnavailable"),
    ("503", &["device-failed", "queue-full", "store-failed"], "ReportUnavailable"),
    ("503", &["device-failed", "queue-full"], "EntryReportUnavailable"),
    ("503", &["shutting-down"], "JobResultUnavailable"),
    ("503", &["other-release", "store-full"], "JobUnavailable"),
    ("503", &["store-full"], "UploadUnavailable"),
    ("503", &["queue-full", "too-many-deliveries", "store-failed"], "StructureUnavailable"),
    ("503", &["too-many-deliveries", "store-failed"], "ListUnavailable"),
    ("503", &["too-many-deliveries"], "EntryUnavailable"),
    ("503", &["other-release", "share-exceeded"], "BatchResultsUnavailable"),
    ("503", &[], "ResultUnavailable"),
];

/// Replaces inline parameters, headers and the responses of several operations by references into `components`.
pub(super) fn share(document: &mut Value) -> Result<(), yaml_serde::Error> {
    let mut shared = Components::default();
    let operations = members(document, "paths").flat_map(|(path, item)| {
        let operations = item.as_object_mut().into_iter().flat_map(Map::values_mut);
        operations.map(move |operation| (path, operation))
    });
    for (path, operation) in operations {
        let parameters = operation.get_mut("parameters").and_then(Value::as_array_mut);
        for parameter in parameters.into_iter().flatten() {
            if let Some(parameter) = parameter.as_object_mut() {
                // False is the default.
                parameter.retain(|key, value| key != "required" || *value == true);
            }
            shared.replace("parameters", &parameter_name(path, parameter), parameter);
        }
        for (status, response) in members(operation, "responses") {
            for (name, header) in members(response, "headers") {
                *header = reference("headers", name);
            }
            if let Some(name) = response_name(status, response) {
                if let Some(response) = response.as_object_mut() {
                    response.remove(PROBLEM_TYPES_EXTENSION);
                }
                shared.replace("responses", &name, response);
            }
        }
    }
    let mut fixed: Value = yaml_serde::from_str(FIXED)?;
    for SummaryHeader { name, kind, doc, .. } in SUMMARY.iter().chain(&PICTURE) {
        fixed["headers"][*name] = json!({ "schema": { "type": kind }, "description": doc });
    }
    let types: Vec<&str> = PROBLEM_TYPES.iter().map(|row| row.r#type).collect();
    fixed["schemas"]["Problem"]["properties"]["type"]["enum"] = types.into();
    let components = &mut document["components"];
    members(components, "schemas").for_each(|(_, schema)| remove_least_counts(schema));
    // `json!` of the schema's attribute cannot expand an object of this size.
    components["schemas"]["Report"]["example"] = serde_json::from_str(REPORT_EXAMPLE).unwrap_or_default();
    for (kind, objects) in [fixed, Value::Object(shared.0)].iter_mut().filter_map(Value::as_object_mut).flatten() {
        match (&mut components[kind], objects.take()) {
            (Value::Object(present), Value::Object(mut objects)) => {
                present.append(&mut objects);
                present.sort_keys();
            }
            (absent, objects) => *absent = objects,
        }
    }
    Ok(())
}

/// Removes `minimum: 0` from a schema and its members. Counts are never negative, and the document becomes shorter.
fn remove_least_counts(schema: &mut Value) {
    match schema {
        Value::Object(members) => {
            members.retain(|key, value| key != "minimum" || *value != 0);
            members.values_mut().for_each(remove_least_counts);
        }
        Value::Array(items) => items.iter_mut().for_each(remove_least_counts),
        _ => {}
    }
}

/// Returns the members of an object below `value`; none if it is absent.
fn members<'a>(value: &'a mut Value, name: &str) -> impl Iterator<Item = (&'a String, &'a mut Value)> {
    value.get_mut(name).and_then(Value::as_object_mut).into_iter().flatten()
}

/// Component objects by kind and name.
#[derive(Default)]
struct Components(Map<String, Value>);

impl Components {
    /// Replaces `value` by a reference to a component. A number distinguishes different values with one name.
    fn replace(&mut self, kind: &str, name: &str, value: &mut Value) {
        let Value::Object(kind_components) = self.0.entry(kind).or_insert_with(|| json!({})) else { return };
        let mut key = name.to_owned();
        let mut number = 1;
        while kind_components.get(&key).is_some_and(|other| other != value) {
            number += 1;
            key = format!("{name}-{number}");
        }
        let reference = reference(kind, &key);
        kind_components.insert(key, std::mem::replace(value, reference));
    }
}

fn reference(kind: &str, name: &str) -> Value {
    json!({ "$ref": format!("#/components/{kind}/{name}") })
}

/// Returns a parameter's own name. The first segment after the version precedes that of a path parameter (`jobs-id`),
/// `areas` that of a parameter which areas define differently.
/// A component with the name `file` would hide the type `File` of TypeScript.
fn parameter_name(path: &str, parameter: &Value) -> String {
    let name = parameter["name"].as_str().unwrap_or_default();
    let segment = path.trim_start_matches("/v1").split('/').nth(1).unwrap_or_default();
    let is_areas_parameter = path.ends_with("/areas") && areas::REDEFINED.contains(&name);
    if parameter["in"] == "path" {
        format!("{segment}-{name}")
    } else if is_areas_parameter {
        format!("areas-{name}")
    } else {
        name.to_owned()
    }
}

/// Returns the component name of a response; `None` if the response stays with its operation.
fn response_name(status: &str, response: &Value) -> Option<String> {
    let Some(types) = response[PROBLEM_TYPES_EXTENSION].as_array() else {
        let document = &response["content"]["application/json"]["schema"]["$ref"];
        return match status {
            "200" if *document == "#/components/schemas/ReportDocument" => Some("MeshReport".to_owned()),
            "200" if response["content"].get("model/*").is_some() => Some("Mesh".to_owned()),
            "200" if response["headers"].get("molmesh-colors").is_some() => Some("AtomColors".to_owned()),
            "202" if *document == "#/components/schemas/JobDocument" => Some("JobAccepted".to_owned()),
            "206" if response["content"].get("model/*").is_some() => Some("PartialMesh".to_owned()),
            "206" => Some("PartialAtomColors".to_owned()),
            "304" => Some("NotModified".to_owned()),
            _ => None,
        };
    };
    let types: Vec<&str> = types.iter().filter_map(Value::as_str).collect();
    let named = ERROR_NAMES.iter().find(|(of, needed, _)| *of == status && needed.iter().all(|n| types.contains(n)));
    let joined = || types.iter().map(|name| pascal_case(name)).collect::<Vec<_>>().join("Or");
    Some(named.filter(|_| types.len() > 2).map_or_else(joined, |(_, _, name)| (*name).to_owned()))
}

/// Converts `no-such-job` or `max_triangles` to `NoSuchJob` or `MaxTriangles`.
pub(super) fn pascal_case(name: &str) -> String {
    let words = name.split(['-', '_']);
    words.map(|word| word[..1].to_ascii_uppercase() + &word[1..]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn different_values_with_one_name_get_numbers() {
        let operation =
            |doc: &str| json!({ "get": { "parameters": [{ "name": "id", "in": "path", "description": doc }] } });
        let mut document = json!({
            "paths": { "/jobs/{id}": operation("a"), "/jobs/{id}/x": operation("a"), "/jobs/{id}/y": operation("b") },
            "components": {},
        });
        share(&mut document).unwrap();
        let parameter = |path: &str| &document["paths"][path]["get"]["parameters"][0];
        for path in ["/jobs/{id}", "/jobs/{id}/x"] {
            assert_eq!(parameter(path), &json!({ "$ref": "#/components/parameters/jobs-id" }));
        }
        assert_eq!(parameter("/jobs/{id}/y"), &json!({ "$ref": "#/components/parameters/jobs-id-2" }));
        let shared = &document["components"]["parameters"];
        assert_eq!(
            (&shared["jobs-id"]["description"], &shared["jobs-id-2"]["description"]),
            (&json!("a"), &json!("b"))
        );
    }
}
