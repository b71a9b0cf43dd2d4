//! JSON bodies: an object of parameters, one of which names a structure. Parsed into names and texts without a tree, so
//! a body within `limits.json_bytes` takes less than a millisecond.

use std::fmt;

use serde::de::{Deserialize, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};

use super::kinds::Kind;
use super::problem::Problem;

/// Returns the members of an object in order, with their values as in a query.
pub(super) fn members(bytes: &[u8]) -> Result<Vec<(String, String)>, Problem> {
    let Members(members) = serde_json::from_slice(bytes)
        .map_err(|e| bad(&e.to_string()).with("line", e.line()).with("column", e.column()))?;
    let text = |(name, Member(text)): (String, Member)| match text {
        Some(text) => Ok((name, text)),
        None => Err(bad_member(&name)),
    };
    members.into_iter().map(text).collect()
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

struct Members(Vec<(String, Member)>);

/// Scalar or list of scalars as text; `None` for any other value.
struct Member(Option<String>);

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

impl<'de> Deserialize<'de> for Member {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Scalars { is_item: false }).map(Self)
    }
}

/// Visitor that reads a value as text. Nested lists are rejected.
#[derive(Clone, Copy)]
struct Scalars {
    is_item: bool,
}

impl<'de> Visitor<'de> for Scalars {
    type Value = Option<String>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Option<String>, E> {
        Ok(Some(text.to_owned()))
    }

    fn visit_bool<E: Error>(self, flag: bool) -> Result<Option<String>, E> {
        Ok(Some(flag.to_string()))
    }

    fn visit_u64<E: Error>(self, number: u64) -> Result<Option<String>, E> {
        Ok(Some(number.to_string()))
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<Option<String>, E> {
        Ok(Some(number.to_string()))
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<Option<String>, E> {
        Ok(serde_json::Number::from_f64(number).map(|number| number.to_string()))
    }

    fn visit_unit<E: Error>(self) -> Result<Option<String>, E> {
        Ok(None)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Option<String>, A::Error> {
        while map.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
        Ok(None)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Option<String>, A::Error> {
        let mut text: Option<String> = None;
        let mut fits = !self.is_item;
        while let Some(item) = list.next_element_seed(Item)? {
            match (item, &mut text) {
                (Some(item), Some(text)) => {
                    text.push(',');
                    text.push_str(&item);
                }
                (Some(item), None) => text = Some(item),
                (None, _) => fits = false,
            }
        }
        Ok(text.filter(|_| fits))
    }
}

/// Item of a list.
struct Item;

impl<'de> serde::de::DeserializeSeed<'de> for Item {
    type Value = Option<String>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Option<String>, D::Error> {
        deserializer.deserialize_any(Scalars { is_item: true })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_become_texts() {
        let text = br#"{"a": "x", "b": [1, -2, 0.5, 1e3, true, "y,z"], "a": false, "c": 18446744073709551615}"#;
        let expected = [("a", "x"), ("b", "1,-2,0.5,1000.0,true,y,z"), ("a", "false"), ("c", "18446744073709551615")];
        assert_eq!(members(text).ok().unwrap(), expected.map(|(n, v)| (n.to_owned(), v.to_owned())));
    }

    #[test]
    fn invalid_values_are_named() {
        for value in ["null", "{}", "{\"b\": 1}", "[]", "[[]]", "[[1]]", "[null]", "[1, {}]"] {
            let problem = members(format!("{{\"a\": {value}}}").as_bytes()).unwrap_err();
            assert!(problem.is(Kind::BadParameter), "{value}");
            assert_eq!(problem.record()["parameter"], "a", "{value}");
        }
        for bad in ["[]", "3", "{", "", "{\"a\": }", "{\"a\": 1} x"] {
            assert!(members(bad.as_bytes()).unwrap_err().is(Kind::BadRequest), "{bad}");
        }
        let deep = format!("{{\"a\": {}", "[".repeat(60_000));
        assert!(members(deep.as_bytes()).unwrap_err().is(Kind::BadRequest));
    }
}
