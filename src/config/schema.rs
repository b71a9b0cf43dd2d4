//! The JSON Schema (2020-12) of the configuration file, from the types that read it and their docstrings.

use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use super::Config;
use super::load::least;

/// What a size may be besides a number.
const SIZE: &str = r"^[0_]*[1-9][0-9_]*\s*(KiB|MiB|GiB)?$";

/// The schema of the configuration file: sections, keys, units and reasons, defaults. Keys that may be absent take the text
/// `none`, sizes take text such as `64MiB`, as the file does.
#[must_use]
pub fn schema() -> Value {
    let settings = SchemaSettings::draft2020_12().with(|settings| settings.inline_subschemas = true);
    let mut schema = settings.into_generator().into_root_schema_for::<Config>().to_value();
    let defaults = serde_json::to_value(Config::default()).unwrap_or_default();
    schema["title"] = "Configuration of molmesh".into();
    schema["description"] =
        "The file that `molmesh serve --config FILE` reads. A key that does not exist is refused; none \
                             is required."
            .into();
    for (section, of_section) in schema["properties"].as_object_mut().into_iter().flatten() {
        let Some(of_section) = of_section.as_object_mut() else { continue };
        of_section.remove("default");
        one_line(of_section);
        for (key, of_key) in of_section.get_mut("properties").and_then(Value::as_object_mut).into_iter().flatten() {
            if let Some(of_key) = of_key.as_object_mut() {
                finish(&format!("{section}.{key}"), of_key, &defaults[section][key]);
            }
        }
    }
    schema
}

/// What the file takes for a key, where it is not what the type says.
fn finish(key: &str, of_key: &mut Map<String, Value>, default: &Value) {
    one_line(of_key);
    let absent = drop_null(of_key);
    let of_type = |of_key: &Map<String, Value>, name: &str| of_key.get("type").is_some_and(|kind| kind == name);
    if of_type(of_key, "integer") {
        // Formats such as uint64 are nobody's but the generator's.
        of_key.remove("format");
        of_key.insert("minimum".to_owned(), least(key).into());
        let texts = match (key.ends_with("_bytes"), absent) {
            (true, false) => Some(SIZE.to_owned()),
            (true, true) => Some(format!("{SIZE}|^none$")),
            (false, true) => Some("^none$".to_owned()),
            (false, false) => None,
        };
        if let Some(pattern) = texts {
            of_key.insert("type".to_owned(), json!(["integer", "string"]));
            of_key.insert("pattern".to_owned(), pattern.into());
        }
    }
    if let Some(Value::Array(kinds)) = of_key.get_mut("anyOf")
        && absent
    {
        kinds.push(json!({ "const": "none" }));
    }
    of_key.remove("default");
    // What is shown of a default secret is nothing: there is none.
    let default = if default.is_null() { json!("none") } else { default.clone() };
    of_key.insert("default".to_owned(), default);
}

/// TOML has no null: absence is written `none`. True if the key may be absent.
fn drop_null(of_key: &mut Map<String, Value>) -> bool {
    match of_key.get_mut("type") {
        Some(Value::Array(kinds)) => {
            let before = kinds.len();
            kinds.retain(|kind| kind != "null");
            let absent = kinds.len() < before;
            if let [one] = kinds.as_slice() {
                let one = one.clone();
                of_key.insert("type".to_owned(), one);
            }
            return absent;
        }
        Some(_) => return false,
        None => {}
    }
    let Some(Value::Array(kinds)) = of_key.get_mut("anyOf") else { return false };
    let before = kinds.len();
    kinds.retain(|kind| *kind != json!({ "type": "null" }));
    let absent = kinds.len() < before;
    // One kind that is left stands for itself; one of several of its own is among them.
    if let [Value::Object(one)] = kinds.as_slice() {
        let one = one.clone();
        of_key.remove("anyOf");
        of_key.extend(one);
    }
    absent
}

/// Docstrings are wrapped where the source is.
fn one_line(of: &mut Map<String, Value>) {
    if let Some(Value::String(text)) = of.get_mut("description") {
        *text = text.split("\n\n").map(|part| part.replace('\n', " ")).collect::<Vec<_>>().join("\n\n");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_says_its_reason_and_its_default() {
        let schema = schema();
        let defaults = serde_json::to_value(Config::default()).unwrap();
        for (section, keys) in defaults.as_object().unwrap() {
            assert_eq!(schema["properties"][section]["additionalProperties"], false, "{section}");
            for (key, default) in keys.as_object().unwrap() {
                let of_key = &schema["properties"][section]["properties"][key];
                let said = of_key["description"].as_str().unwrap_or_default();
                assert!(said.contains("Default"), "{section}.{key} does not say why: {said}");
                assert!(!said.contains('\n') && !of_key.to_string().contains("null"), "{section}.{key}: {of_key}");
                let unit = if key.ends_with("_ms") { "ms" } else { "" };
                assert!(said.contains(unit), "{section}.{key} does not say its unit: {said}");
                assert_eq!(of_key["default"], if default.is_null() { json!("none") } else { default.clone() });
            }
        }
    }

    #[test]
    fn secrets_are_the_keys_that_are_never_read_back() {
        let schema = schema();
        let mut secret = Vec::new();
        for (section, keys) in schema["properties"].as_object().unwrap() {
            for (key, of_key) in keys["properties"].as_object().unwrap() {
                if of_key["writeOnly"] == true {
                    secret.push(format!("{section}.{key}"));
                    assert!(keys["properties"].get(format!("{key}_file")).is_some(), "{section}.{key}");
                }
            }
        }
        assert_eq!(secret, super::super::secrets::SECRETS);
    }
}
