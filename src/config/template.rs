//! URL templates of a remote archive.

use std::fmt;
use std::str::FromStr;

use reqwest::Url;
use schemars::{Schema, SchemaGenerator};

use super::list;
use crate::structure::EntryId;

/// RCSB's download service: compressed mmCIF.
const RCSB: &str = "https://files.rcsb.org/download/{id}.cif.gz";

/// Placeholders for the id.
const PLACEHOLDERS: [&str; 3] = ["{id}", "{id_upper}", "{middle}"];

/// URL template of an entry: an http or https URL whose path or query contains `{id}` or `{id_upper}` (the id in its
/// shortest form, such as `4pti` or `pdb_12345678`) and optionally `{middle}` (the two characters by which mirrors are
/// divided).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Template {
    text: String,
    host: String,
}

impl Template {
    /// Returns the host as written in the URL.
    pub(crate) fn host(&self) -> &str {
        &self.host
    }

    /// Returns the URL of an entry. Ids contain only letters, digits and `_`, which need no escapes.
    pub(crate) fn url(&self, id: &EntryId) -> Option<Url> {
        fill(&self.text, id.as_str(), id.middle()).parse().ok()
    }
}

fn fill(text: &str, id: &str, middle: &str) -> String {
    text.replace("{id}", id).replace("{id_upper}", &id.to_ascii_uppercase()).replace("{middle}", middle)
}

impl FromStr for Template {
    type Err = String;

    /// Parses a template. The error states the expected form and the cause.
    fn from_str(text: &str) -> Result<Self, String> {
        let refused = |why: &str| format!("http(s)://host/…{{id}}…, but `{text}` is invalid: {why}");
        if !text.contains(PLACEHOLDERS[0]) && !text.contains(PLACEHOLDERS[1]) {
            return Err(refused("it has neither {id} nor {id_upper}"));
        }
        // URLs of two ids without common characters may differ in path and query only.
        let parse = |id: &str, middle: &str| -> Result<Url, String> {
            let url: Url = fill(text, id, middle).parse().map_err(|e| refused(&format!("{e}")))?;
            if url.path().contains("%7B") || url.query().is_some_and(|q| q.contains('{')) {
                return Err(refused("the placeholders are {id}, {id_upper} and {middle}"));
            }
            Ok(url)
        };
        let (url, other) = (parse("1aaa", "aa")?, parse("2bbb", "bb")?);
        if !["http", "https"].contains(&url.scheme()) {
            return Err(refused("it is neither http nor https"));
        }
        if url.username() != "" || url.password().is_some() {
            return Err(refused("it contains a user name or password, which would appear in logs"));
        }
        if url.fragment().is_some() {
            return Err(refused("fragments are never sent"));
        }
        let origin = |url: &Url| (url.scheme().to_owned(), url.host_str().map(str::to_owned), url.port());
        if origin(&url) != origin(&other) {
            return Err(refused("placeholders are allowed in the path and query only"));
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

/// Templates in the order of requests, at least one: a string separated by white space, or a list of strings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Templates(Vec<Template>);

impl Default for Templates {
    fn default() -> Self {
        Self(RCSB.parse().into_iter().collect())
    }
}

impl Templates {
    /// Returns the schema of an optional list of templates.
    pub(super) fn schema(_: &mut SchemaGenerator) -> Schema {
        list::schema(r"https?://[^/\s]+/\S*\{id(_upper)?\}\S*")
    }

    /// Returns the templates in order.
    pub(crate) fn as_slice(&self) -> &[Template] {
        &self.0
    }
}

impl FromStr for Templates {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let templates = text.split_whitespace().map(str::parse).collect::<Result<Vec<_>, String>>()?;
        if templates.is_empty() { Err("none, or URLs with {id}".to_owned()) } else { Ok(Self(templates)) }
    }
}

impl fmt::Display for Templates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let texts: Vec<&str> = self.0.iter().map(|t| t.text.as_str()).collect();
        f.write_str(&texts.join(" "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn url(template: &str, id: &str) -> String {
        template.parse::<Template>().unwrap().url(&id.parse().unwrap()).unwrap().to_string()
    }

    #[test]
    fn old_ids_use_the_short_form_and_extended_ids_the_long() {
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
    fn invalid_templates_are_rejected() {
        let bad = "https://h/4pti.cif file:///pdb/{id} ftp://h/{id} h/{id} https://{id}.h/x https://h:{id}/x \
                   https://h{middle}/{id} {id}://h/x https://h/{id}/{what} https://h/?{id}={what} \
                   https://user:secret@h/{id} https://h/x#{id} https:///{id}";
        for bad in bad.split_whitespace() {
            assert!(bad.parse::<Template>().is_err_and(|why| why.contains(bad)), "{bad}");
        }
        assert!("http://[::1]:8080/{id}".parse::<Template>().is_ok_and(|t| t.host() == "[::1]"));
        assert!("".parse::<Templates>().is_err() && " ".parse::<Templates>().is_err());
        let two: Templates = "http://a/{id}  http://b/{id}".parse().unwrap();
        assert_eq!((two.as_slice().len(), two.to_string().as_str()), (2, "http://a/{id} http://b/{id}"));
    }
}
