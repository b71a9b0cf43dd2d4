//! JSON bodies: an object of parameters, one of which names a structure.

use std::fmt;

use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::Number;

use super::problem::Problem;
use super::problem_types::ProblemType;

/// Returns the members of an object in order, with their values as in a query. Omits members that are null, which
/// generated clients send for parameters without a value.
pub(super) fn members(bytes: &[u8]) -> Result<Vec<(String, String)>, Problem> {
    let Members(members) = serde_json::from_slice(bytes)
        .map_err(|e| bad(&e.to_string()).with("line", e.line()).with("column", e.column()))?;
    let pair = |(name, value): (String, Value)| match value {
        Value::Scalar(text) | Value::List(text) => Some(Ok((name, text))),
        Value::Null => None,
        Value::Other => Some(Err(bad_member(&name))),
    };
    members.into_iter().filter_map(pair).collect()
}

/// Returns the problem of a body that is not such a document.
pub(super) fn bad(detail: &str) -> Problem {
    Problem::new(ProblemType::BadRequest, format!("the JSON cannot be read: {detail}"))
        .with("expected", "{\"pdb_id\": \"4pti\", …}")
}

fn bad_member(name: &str) -> Problem {
    let name: String = name.chars().take(80).collect();
    let detail = format!("member `{name}` is neither text, number, true or false, nor a list of them");
    Problem::new(ProblemType::BadParameter, detail).with("parameter", name)
}

/// Value of a member as text. Other values are skipped and not stored.
enum Value {
    Null,
    Scalar(String),
    /// Scalars separated by commas.
    List(String),
    Other,
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Value;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a value")
            }

            fn visit_unit<E>(self) -> Result<Value, E> {
                Ok(Value::Null)
            }

            fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
                Ok(Value::Scalar(value.to_string()))
            }

            fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
                Ok(Value::Scalar(value.to_string()))
            }

            fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
                Ok(Value::Scalar(value.to_string()))
            }

            fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
                Ok(Number::from_f64(value).map_or(Value::Other, |number| Value::Scalar(number.to_string())))
            }

            fn visit_str<E>(self, value: &str) -> Result<Value, E> {
                Ok(Value::Scalar(value.to_owned()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
                let mut list: Option<String> = None;
                while let Some(item) = items.next_element()? {
                    let Value::Scalar(item) = item else {
                        while items.next_element::<IgnoredAny>()?.is_some() {}
                        return Ok(Value::Other);
                    };
                    list = Some(match list {
                        None => item,
                        Some(list) => list + "," + &item,
                    });
                }
                Ok(list.map_or(Value::Other, Value::List))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Value, A::Error> {
                while members.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
                Ok(Value::Other)
            }
        }
        deserializer.deserialize_any(Any)
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
            assert!(problem.is(ProblemType::BadParameter), "{value}");
            assert_eq!(problem.record("")["parameter"], "a", "{value}");
        }
        for bad in ["[]", "3", "{", "", "{\"a\": }", "{\"a\": 1} x"] {
            assert!(members(bad.as_bytes()).unwrap_err().is(ProblemType::BadRequest), "{bad}");
        }
        let deep = format!("{{\"a\": {}", "[".repeat(60_000));
        assert!(members(deep.as_bytes()).unwrap_err().is(ProblemType::BadRequest));
    }
}
