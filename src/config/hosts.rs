//! Host names of the service.

use std::fmt;
use std::str::FromStr;

use schemars::{Schema, SchemaGenerator};

use super::list;

/// Host names without ports, at least one, in lower case: a string separated by white space, or a list of strings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hosts(Vec<String>);

impl Hosts {
    /// Returns the schema of an optional list of host names.
    pub(super) fn schema(_: &mut SchemaGenerator) -> Schema {
        list::schema(r"[0-9A-Za-z.:_\[\]-]+")
    }

    /// Returns true if `host`, which has no port, is listed.
    #[must_use]
    pub fn contains(&self, host: &str) -> bool {
        self.0.iter().any(|listed| listed.eq_ignore_ascii_case(host))
    }
}

impl FromStr for Hosts {
    type Err = String;

    /// Parses names and addresses separated by white space. The error states the expected form.
    fn from_str(text: &str) -> Result<Self, String> {
        const EXPECTED: &str = "none, or host names without ports such as meshes.example or [2001:db8::1]";
        let is_name = |word: &str| {
            let is_v6 = word.strip_prefix('[').and_then(|rest| rest.strip_suffix(']'));
            is_v6.is_some_and(|address| address.parse::<std::net::Ipv6Addr>().is_ok())
                || word.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b))
        };
        let words: Vec<&str> = text.split_whitespace().collect();
        if let Some(bad) = words.iter().find(|word| !is_name(word)) {
            return Err(format!("{EXPECTED}; `{bad}` is not one"));
        }
        if words.is_empty() {
            return Err(EXPECTED.to_owned());
        }
        Ok(Self(words.into_iter().map(str::to_ascii_lowercase).collect()))
    }
}

impl fmt::Display for Hosts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0.join(" "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_no_port() {
        let hosts: Hosts = "Meshes.example 192.0.2.7 [2001:db8::1]".parse().unwrap();
        assert_eq!(hosts.to_string(), "meshes.example 192.0.2.7 [2001:db8::1]");
        assert!(hosts.contains("MESHES.example") && !hosts.contains("example"));
        for bad in ["", "a.example:80", "http://a.example", "[::x]", "*"] {
            assert!(bad.parse::<Hosts>().is_err(), "{bad}");
        }
    }
}
