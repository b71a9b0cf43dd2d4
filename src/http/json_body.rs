//! JSON bodies: an object of parameters, one of which names a structure.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde_json::Value;

use super::kinds::Kind;
use super::problem::Problem;

/// Returns the members of an object in order, with their values as in a query. Omits members that are null, which
/// generated clients send for parameters without a value.
pub(super) fn members(bytes: &[u8]) -> Result<Vec<(String, String)>, Problem> {
    let Members(members) = serde_json::from_slice(bytes)
        .map_err(|e| bad(&e.to_string()).with("line", e.line()).with("column", e.column()))?;
    let pair = |(name, value): (String, Value)| match text(&value) {
        Some(text) => Ok((name, text)),
        None => Err(bad_member(&name)),
    };
    members.into_iter().filter(|(_, value)| !value.is_null()).map(pair).collect()
}

/// Returns the problem of a body that is not such a document.
pub(super) fn bad(detail: &str) -> Problem {
    Problem::new(Kind::BadRequest, format!("the JSON cannot be read: {detail}"))
        .with("expected", "{\"pdb_id\": \"4pti\", …}")
}

fn bad_member(name: &str) -> Problem {
    let name: String = name.chars().take(80).collect();
    let detail = format!("member `{name}` is neither text, number, true or false, nor a list of them");
    Problem::new(Kind::BadParameter, detail).with("parameter", name)
}

/// Returns a scalar, or a list of scalars separated by commas, as text. Returns `None` for any other value.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::Array(items) if !items.is_empty() => {
            items.iter().map(scalar).collect::<Option<Vec<_>>>().map(|items| items.join(","))
        }
        other => scalar(other),
    }
}

fn scalar(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Bool(_) | Value::Number(_) => Some(value.to_string()),
        Value::Null | Value::Array(_) | Value::Object(_) => None,
    }
}

/// Members of an object in order. Unlike a map, it keeps repeated names, which are errors.
struct Members(Vec<(String, Value)>);

impl<'de> Deserialize<'de> for Members {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Object;
        impl<'de> Visitor<'de> for Object {
            type Value = Members;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Members, A::Error> {
                let mut members = Vec::new();
                while let Some(member) = map.next_entry()? {
                    members.push(member);
                }
                Ok(Members(members))
            }
        }
        deserializer.deserialize_map(Object)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_become_texts() {
        let text =
            br#"{"a": "x", "b": [1, -2, 0.5, 1e3, true, "y,z"], "a": false, "n": null, "c": 18446744073709551615}"#;
        let expected = [("a", "x"), ("b", "1,-2,0.5,1000.0,true,y,z"), ("a", "false"), ("c", "18446744073709551615")];
        assert_eq!(members(text).ok().unwrap(), expected.map(|(n, v)| (n.to_owned(), v.to_owned())));
    }

    #[test]
    fn invalid_values_are_named() {
        for value in ["{}", "{\"b\": 1}", "[]", "[[]]", "[[1]]", "[null]", "[1, {}]"] {
            let problem = members(format!("{{\"a\": {value}}}").as_bytes()).unwrap_err();
            assert!(problem.is(Kind::BadParameter), "{value}");
            assert_eq!(problem.record("")["parameter"], "a", "{value}");
        }
        for bad in ["[]", "3", "{", "", "{\"a\": }", "{\"a\": 1} x"] {
            assert!(members(bad.as_bytes()).unwrap_err().is(Kind::BadRequest), "{bad}");
        }
        let deep = format!("{{\"a\": {}", "[".repeat(60_000));
        assert!(members(deep.as_bytes()).unwrap_err().is(Kind::BadRequest));
    }
}
