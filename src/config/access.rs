//! Configuration of access: keys, quotas, signed URLs and cross-origin requests.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use reqwest::Url;
use schemars::{Schema, SchemaGenerator};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::{Secret, list};

section! {
    /// Keys, quotas, signed URLs and headers for browsers.
    AccessConfig;
    /// TOML file of keys; `molmesh key new` prints entries for it. Default `none`: no key is required. The file is
    /// reloaded when it changes, and on SIGHUP.
    keys_file: Option<PathBuf> = None;
    /// Keys that sign URLs, as `ID:SECRET` or `ID@GROUP:SECRET` separated by white space. The first one signs, all are
    /// accepted, so that keys can be rotated. A signed URL opens what the keys of the group hold. Default `none`: no
    /// signature is accepted.
    signing_secret: Option<Secret> = None;
    /// File that contains the value of `signing_secret`. Default `none`.
    signing_secret_file: Option<PathBuf> = None;
    /// Requests of one address per minute. Default `none`: unlimited. Requests with a key have the key's quota instead.
    #[serde(deserialize_with = "count")]
    address_requests: Option<u64> = None;
    /// Computing time for the jobs of one address per minute, s. Default `none`: unlimited.
    #[serde(deserialize_with = "count")]
    address_work_s: Option<u64> = None;
    /// Origins whose pages may read responses and send requests without a key: `auto`, `*`, or a list such as
    /// `https://viewer.example`. Default `auto`: loopback origins if the service listens on a loopback address, no
    /// others. `none`: only pages of this server.
    #[serde(with = "list")]
    #[schemars(schema_with = "Origins::schema")]
    cors_origins: Option<Origins> = Some(Origins::Auto);
    /// Allows pages of these origins to send credentials, such as the cookies of a proxy. Default false. Excludes `*`.
    cors_credentials: bool = false;
}

/// Deserializes an optional count from a number or text; its default `none` does not tell the loader the type.
fn count<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
    let number = match Value::deserialize(deserializer)? {
        Value::Null => return Ok(None),
        Value::Number(number) => number.as_u64(),
        Value::String(text) => text.trim().replace('_', "").parse().ok(),
        _ => None,
    };
    let number = number.filter(|number| *number >= 1);
    number.map(Some).ok_or_else(|| serde::de::Error::custom("none, or a positive integer"))
}

/// Origins whose pages may read responses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origins {
    /// Loopback origins if the service listens on a loopback address; otherwise none.
    Auto,
    /// All origins.
    Any,
    /// These origins, at least one, each in the form of the `Origin` header.
    These(Vec<String>),
}

impl Origins {
    fn schema(_: &mut SchemaGenerator) -> Schema {
        list::schema(r"(auto|\*|https?://\S+)")
    }
}

impl FromStr for Origins {
    type Err = String;

    /// Parses `auto`, `*`, or origins separated by white space. The error states the expected form.
    fn from_str(text: &str) -> Result<Self, String> {
        let all: Vec<&str> = text.split_whitespace().collect();
        match all.as_slice() {
            ["auto"] => return Ok(Self::Auto),
            ["*"] => return Ok(Self::Any),
            _ => {}
        }
        let is_origin = |origin: &&str| {
            let url = origin.parse::<Url>().ok().filter(|url| ["http", "https"].contains(&url.scheme()));
            url.is_some_and(|url| url.origin().ascii_serialization() == **origin)
        };
        if let Some(bad) = all.iter().find(|origin| !is_origin(origin)) {
            return Err(format!(
                "auto, *, none, or origins such as https://viewer.example without a path; `{bad}` is not one"
            ));
        }
        if all.is_empty() {
            return Err("auto, *, none, or origins such as https://viewer.example".to_owned());
        }
        Ok(Self::These(all.into_iter().map(str::to_owned).collect()))
    }
}

impl fmt::Display for Origins {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Any => f.write_str("*"),
            Self::These(origins) => f.write_str(&origins.join(" ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_origins_in_the_form_of_the_header() {
        assert_eq!("*".parse(), Ok(Origins::Any));
        assert_eq!("auto".parse(), Ok(Origins::Auto));
        let two = "https://a.example http://localhost:3000";
        assert_eq!(two.parse::<Origins>().unwrap().to_string(), two);
        for bad in [
            "",
            "https://a.example/",
            "https://a.example:443",
            "a.example",
            "null",
            "ftp://a",
            "* https://a.b",
            "auto *",
        ] {
            assert!(bad.parse::<Origins>().is_err(), "{bad}");
        }
    }
}
