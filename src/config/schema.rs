//! JSON Schema (2020-12) of the configuration file, generated from its types and their docstrings.

use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use super::Config;
use super::load::minimum;

/// Pattern of sizes written as text.
const SIZE: &str = r"^[0_]*[1-9][0-9_]*\s*(KiB|MiB|GiB)?$";

/// Returns the schema of the configuration file. Optional keys accept the text `none` and sizes text such as `64MiB`,
/// as the loader does.
#[must_use]
pub fn schema() -> Value {
    let settings = SchemaSettings::draft2020_12().with(|settings| settings.inline_subschemas = true);
    let mut schema = settings.into_generator().into_root_schema_for::<Config>().to_value();
    let defaults = serde_json::to_value(Config::default()).unwrap_or_default();
    schema["title"] = "Configuration of molmesh".into();
    schema["description"] =
        "The file that `molmesh serve --config FILE` reads. All keys are optional; unknown keys are rejected.".into();
    for (section, section_schema) in schema["properties"].as_object_mut().into_iter().flatten() {
        let Some(section_schema) = section_schema.as_object_mut() else { continue };
        section_schema.remove("default");
        one_line(section_schema);
        for (key, key_schema) in
            section_schema.get_mut("properties").and_then(Value::as_object_mut).into_iter().flatten()
        {
            if let Some(key_schema) = key_schema.as_object_mut() {
                finish(&format!("{section}.{key}"), key_schema, &defaults[section][key]);
            }
        }
    }
    schema
}

/// Adapts the schema of a key to the loader: optional values, sizes, minimum and default.
fn finish(key: &str, key_schema: &mut Map<String, Value>, default: &Value) {
    one_line(key_schema);
    let absent = drop_null(key_schema);
    // Formats such as uint64 are not standard.
    key_schema.remove("format");
    let of_type = |key_schema: &Map<String, Value>, name: &str| key_schema.get("type").is_some_and(|kind| kind == name);
    if of_type(key_schema, "integer") {
        key_schema.insert("minimum".to_owned(), minimum(key).into());
        let texts = match (key.ends_with("_bytes"), absent) {
            (true, false) => Some(SIZE.to_owned()),
            (true, true) => Some(format!("{SIZE}|^none$")),
            (false, true) => Some("^none$".to_owned()),
            (false, false) => None,
        };
        if let Some(pattern) = texts {
            key_schema.insert("type".to_owned(), json!(["integer", "string"]));
            key_schema.insert("pattern".to_owned(), pattern.into());
        }
    }
    if let Some(Value::Array(kinds)) = key_schema.get_mut("anyOf")
        && absent
    {
        kinds.push(json!({ "const": "none" }));
    }
    key_schema.remove("default");
    let default = if default.is_null() { json!("none") } else { default.clone() };
    key_schema.insert("default".to_owned(), default);
}

/// Removes `null` from the schema of a key, because TOML has none. Returns true if the key is optional.
fn drop_null(key_schema: &mut Map<String, Value>) -> bool {
    let (key, null) =
        if key_schema.contains_key("anyOf") { ("anyOf", json!({ "type": "null" })) } else { ("type", json!("null")) };
    let Some(Value::Array(kinds)) = key_schema.get_mut(key) else { return false };
    let before = kinds.len();
    kinds.retain(|kind| *kind != null);
    let absent = kinds.len() < before;
    if let [one] = kinds.as_slice() {
        let one = one.clone();
        key_schema.insert(key.to_owned(), one);
    }
    absent
}

/// Joins the lines of a description; docstrings are wrapped like the source.
fn one_line(of: &mut Map<String, Value>) {
    if let Some(Value::String(text)) = of.get_mut("description") {
        *text = text.split("\n\n").map(|part| part.replace('\n', " ")).collect::<Vec<_>>().join("\n\n");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_documents_its_unit_and_default() {
        let schema = schema();
        let defaults = serde_json::to_value(Config::default()).unwrap();
        for (section, keys) in defaults.as_object().unwrap() {
            assert_eq!(schema["properties"][section]["additionalProperties"], false, "{section}");
            for (key, default) in keys.as_object().unwrap() {
                let key_schema = &schema["properties"][section]["properties"][key];
                let text = key_schema["description"].as_str().unwrap_or_default();
                assert!(text.contains("Default"), "{section}.{key} has no default: {text}");
                assert!(
                    !text.contains('\n') && !key_schema.to_string().contains("null"),
                    "{section}.{key}: {key_schema}"
                );
                let unit = if key.ends_with("_ms") { "ms" } else { "" };
                assert!(text.contains(unit), "{section}.{key} has no unit: {text}");
                assert_eq!(key_schema["default"], if default.is_null() { json!("none") } else { default.clone() });
            }
        }
    }

    #[test]
    fn write_only_keys_are_the_secrets() {
        let schema = schema();
        let mut secret = Vec::new();
        for (section, keys) in schema["properties"].as_object().unwrap() {
            for (key, key_schema) in keys["properties"].as_object().unwrap() {
                if key_schema["writeOnly"] == true {
                    secret.push(format!("{section}.{key}"));
                    assert!(keys["properties"].get(format!("{key}_file")).is_some(), "{section}.{key}");
                }
            }
        }
        assert_eq!(secret, super::super::secrets::SECRETS);
    }
}
