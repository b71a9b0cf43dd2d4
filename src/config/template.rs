//! Addresses of a remote archive, with places for an entry's id.

use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

use reqwest::Url;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::structure::EntryId;

/// RCSB's download service: compressed mmCIF.
const RCSB: &str = "https://files.rcsb.org/download/{id}.cif.gz";

/// What stands for the id, and what for parts and forms of it.
const PLACES: [&str; 3] = ["{id}", "{id_upper}", "{middle}"];

/// The address of an entry: an http or https URL whose path or query holds `{id}` or `{id_upper}` (the id in its
/// shortest form, such as `4pti` or `pdb_12345678`) and perhaps `{middle}` (the two characters by which mirrors divide).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Template {
    text: String,
    host: String,
}

impl Template {
    /// The host that is asked, as the URL says it.
    #[must_use]
    pub fn host(&self) -> &str {
        &self.host
    }

    /// The address of an entry. Ids have only letters, digits and `_`, which need no escapes.
    #[must_use]
    pub fn url(&self, id: &EntryId) -> Option<Url> {
        fill(&self.text, id.as_str(), id.middle()).parse().ok()
    }
}

fn fill(text: &str, id: &str, middle: &str) -> String {
    text.replace("{id}", id).replace("{id_upper}", &id.to_ascii_uppercase()).replace("{middle}", middle)
}

impl FromStr for Template {
    type Err = String;

    /// The error says what was expected.
    fn from_str(text: &str) -> Result<Self, String> {
        let refused = |why: &str| format!("http(s)://host/…{{id}}…, which `{text}` is not: {why}");
        if !text.contains(PLACES[0]) && !text.contains(PLACES[1]) {
            return Err(refused("it has no place for the id"));
        }
        // Two ids that differ everywhere must give addresses that differ in path and query alone.
        let parse = |id: &str, middle: &str| -> Result<Url, String> {
            let url: Url = fill(text, id, middle).parse().map_err(|e| refused(&format!("{e}")))?;
            if url.path().contains("%7B") || url.query().is_some_and(|q| q.contains('{')) {
                return Err(refused("of places there are {id}, {id_upper} and {middle}"));
            }
            Ok(url)
        };
        let (url, other) = (parse("1aaa", "aa")?, parse("2bbb", "bb")?);
        if !["http", "https"].contains(&url.scheme()) {
            return Err(refused("it is neither http nor https"));
        }
        if url.username() != "" || url.password().is_some() {
            return Err(refused("it holds a name or a password, which would end up in logs"));
        }
        if url.fragment().is_some() {
            return Err(refused("a fragment is never sent"));
        }
        let place = |url: &Url| (url.scheme().to_owned(), url.host_str().map(str::to_owned), url.port());
        if place(&url) != place(&other) {
            return Err(refused("the id belongs into the path or the query"));
        }
        let host = url.host_str().ok_or_else(|| refused("it has no host"))?.to_owned();
        Ok(Self { text: text.to_owned(), host })
    }
}

impl fmt::Display for Template {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// Templates in the order in which they are asked; at least one. Text with blanks between them, or a list of texts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Templates(Vec<Template>);

impl Default for Templates {
    fn default() -> Self {
        Self(RCSB.parse().into_iter().collect())
    }
}

impl Templates {
    /// The templates in order.
    #[must_use]
    pub fn as_slice(&self) -> &[Template] {
        &self.0
    }
}

impl FromStr for Templates {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let templates = text.split_whitespace().map(str::parse).collect::<Result<Vec<_>, String>>()?;
        if templates.is_empty() { Err("none, or addresses with {id}".to_owned()) } else { Ok(Self(templates)) }
    }
}

impl fmt::Display for Templates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let texts: Vec<&str> = self.0.iter().map(|t| t.text.as_str()).collect();
        f.write_str(&texts.join(" "))
    }
}

impl Serialize for Templates {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl JsonSchema for Templates {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "Templates".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let one = r"https?://[^/\s]+/\S*\{id(_upper)?\}\S*";
        json_schema!({ "anyOf": [
            { "type": "string", "pattern": format!(r"^\s*{one}(\s+{one})*\s*$") },
            { "type": "array", "minItems": 1, "items": { "type": "string", "pattern": format!("^{one}$") } },
        ] })
    }
}

impl<'de> Deserialize<'de> for Templates {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        super::words(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// The address of a proxy: `http://host:port` or `https://host:port`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct ProxyUrl(String);

impl ProxyUrl {
    /// The address.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl JsonSchema for ProxyUrl {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "ProxyUrl".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": "^(none|https?://.+)$" })
    }
}

impl<'de> Deserialize<'de> for ProxyUrl {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let good = text.parse().is_ok_and(|url: Url| ["http", "https"].contains(&url.scheme()) && url.has_host());
        if good { Ok(Self(text)) } else { Err(serde::de::Error::custom("none, or http(s)://host:port")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn url(template: &str, id: &str) -> String {
        template.parse::<Template>().unwrap().url(&id.parse().unwrap()).unwrap().to_string()
    }

    #[test]
    fn old_ids_take_the_short_form_and_extended_ones_the_long() {
        for (id, expected) in [
            ("4PTI", "https://files.rcsb.org/download/4pti.cif.gz"),
            ("pdb_00004pti", "https://files.rcsb.org/download/4pti.cif.gz"),
            ("PDB_12345678", "https://files.rcsb.org/download/pdb_12345678.cif.gz"),
        ] {
            assert_eq!(url(RCSB, id), expected);
        }
        assert_eq!(url("http://h/{middle}/pdb{id}.ent?x={id_upper}", "4pti"), "http://h/pt/pdb4pti.ent?x=4PTI");
        assert_eq!(url("http://h/{middle}/{id}", "pdb_12345678"), "http://h/67/pdb_12345678");
    }

    #[test]
    fn what_is_no_address_of_an_entry_is_refused() {
        for bad in [
            "https://h/4pti.cif",
            "file:///pdb/{id}",
            "ftp://h/{id}",
            "h/{id}",
            "https://{id}.h/x",
            "https://h:{id}/x",
            "https://h{middle}/{id}",
            "{id}://h/x",
            "https://h/{id}/{what}",
            "https://h/?{id}={what}",
            "https://user:secret@h/{id}",
            "https://h/x#{id}",
            "https:///{id}",
        ] {
            assert!(bad.parse::<Template>().is_err_and(|why| why.contains(bad)), "{bad}");
        }
        assert!("http://[::1]:8080/{id}".parse::<Template>().is_ok_and(|t| t.host() == "[::1]"));
        assert!("".parse::<Templates>().is_err() && " ".parse::<Templates>().is_err());
        let two: Templates = "http://a/{id}  http://b/{id}".parse().unwrap();
        assert_eq!((two.as_slice().len(), two.to_string().as_str()), (2, "http://a/{id} http://b/{id}"));
    }
}
