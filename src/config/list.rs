//! Serialization and schema of lists, such as origins: a string with white space between the items, or an array.

use std::fmt::Display;
use std::str::FromStr;

use schemars::{Schema, json_schema};
use serde::{Deserialize, Deserializer, Serializer};

#[derive(Deserialize)]
#[serde(untagged)]
enum StringOrArray {
    String(String),
    Array(Vec<String>),
}

/// Serializes a list as a string.
#[expect(clippy::ref_option, reason = "the signature that serde requires")]
pub(super) fn serialize<T: Display, S: Serializer>(list: &Option<T>, serializer: S) -> Result<S::Ok, S::Error> {
    match list {
        Some(list) => serializer.collect_str(list),
        None => serializer.serialize_none(),
    }
}

/// Deserializes a list from a string or an array.
pub(super) fn deserialize<'de, T, D>(deserializer: D) -> Result<Option<T>, D::Error>
where
    T: FromStr<Err = String>,
    D: Deserializer<'de>,
{
    let text = match Option::deserialize(deserializer)? {
        Some(StringOrArray::String(text)) => text,
        Some(StringOrArray::Array(items)) => items.join(" "),
        None => return Ok(None),
    };
    text.parse().map(Some).map_err(serde::de::Error::custom)
}

/// Returns the schema of an optional list whose items match the pattern `item`.
pub(super) fn schema(item: &str) -> Schema {
    json_schema!({ "anyOf": [
        { "type": "string", "pattern": format!(r"^\s*{item}(\s+{item})*\s*$") },
        { "type": "array", "minItems": 1, "items": { "type": "string", "pattern": format!("^{item}$") } },
        { "type": "null" },
    ] })
}
