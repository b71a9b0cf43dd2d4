//! Who may ask for what, and how much of it: keys, quotas, signed addresses, and which pages may read answers.

use std::borrow::Cow;
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use reqwest::Url;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

use super::Secret;

/// Keys, quotas, signed addresses; what browsers are told.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AccessConfig {
    /// TOML file of keys, which `molmesh key new` writes the lines of. Default `none`: no key is asked for. The file is read
    /// again when it changes, and on SIGHUP.
    pub keys_file: Option<PathBuf>,
    /// Keys that sign addresses, as `ID:SECRET` with blanks or line breaks between them; the first one signs, all are
    /// accepted, so that one can take over from another. Default `none`: no signature is accepted.
    pub signing_secret: Option<Secret>,
    /// File with `signing_secret`, in its place. Default `none`.
    pub signing_secret_file: Option<PathBuf>,
    /// Requests of one address in a window. Default `none`: any number. Those who present a key have the key's quota instead.
    #[serde(deserialize_with = "count")]
    pub address_requests: Option<u64>,
    /// Seconds in a window that workers spend on the jobs of one address. Default `none`: any number.
    #[serde(deserialize_with = "count")]
    pub address_work_s: Option<u64>,
    /// Requests of one address at once, to the last byte of the answer. Default `none`: any number.
    #[serde(deserialize_with = "count")]
    pub address_concurrent: Option<u64>,
    /// Length of a window, s, for addresses and for keys that do not say their own. Default 60: who has used his quota up is
    /// back within a minute. It begins with the client's first request, not with the clock's minute, so that clients do not
    /// all come back at once.
    pub window_s: u64,
    /// Addresses whose quota is counted one by one. Default 10,000, some 2 MB. Those beyond share one quota, as forgetting
    /// somebody would give him a new one.
    pub clients: usize,
    /// Origins whose pages may read answers: `*`, or a list such as `https://viewer.example`. Default `*`: there are no
    /// cookies here, and a key is sent only by a page that has it. `none`: pages of this server alone.
    pub cors_origins: Option<Origins>,
    /// Whether pages of these origins may send what the browser keeps, such as the cookies of a proxy in front. Default
    /// false. It cannot go with `*`.
    pub cors_credentials: bool,
    /// Seconds for which browsers are told to use https alone. Default `none`: not at all, as TLS is a proxy's, and the
    /// promise cannot be taken back.
    #[serde(deserialize_with = "count")]
    pub hsts_s: Option<u64>,
}

impl Default for AccessConfig {
    fn default() -> Self {
        Self {
            keys_file: None,
            signing_secret: None,
            signing_secret_file: None,
            address_requests: None,
            address_work_s: None,
            address_concurrent: None,
            window_s: 60,
            clients: 10_000,
            cors_origins: Some(Origins::Any),
            cors_credentials: false,
            hsts_s: None,
        }
    }
}

/// A count that may be absent: its default says nothing about its type, so text is read here.
fn count<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
    let number = match Value::deserialize(deserializer)? {
        Value::Null => return Ok(None),
        Value::Number(number) => number.as_u64(),
        Value::String(text) => text.trim().replace('_', "").parse().ok(),
        _ => None,
    };
    let number = number.filter(|number| *number >= 1);
    number.map(Some).ok_or_else(|| serde::de::Error::custom("none, or a whole number of 1 or more"))
}

/// Whose pages may read answers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origins {
    /// Anybody's.
    Any,
    /// Those of these origins, each as a browser writes it; at least one.
    These(Vec<String>),
}

impl FromStr for Origins {
    type Err = String;

    /// The error says what was expected.
    fn from_str(text: &str) -> Result<Self, String> {
        let all: Vec<&str> = text.split_whitespace().collect();
        if all == ["*"] {
            return Ok(Self::Any);
        }
        let as_written = |origin: &&str| {
            let url = origin.parse::<Url>().ok().filter(|url| ["http", "https"].contains(&url.scheme()));
            url.is_some_and(|url| url.origin().ascii_serialization() == **origin)
        };
        if let Some(bad) = all.iter().find(|origin| !as_written(origin)) {
            return Err(format!(
                "*, none, or origins such as https://viewer.example without a path, which `{bad}` is not"
            ));
        }
        if all.is_empty() {
            return Err("*, none, or origins such as https://viewer.example".to_owned());
        }
        Ok(Self::These(all.into_iter().map(str::to_owned).collect()))
    }
}

impl fmt::Display for Origins {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => f.write_str("*"),
            Self::These(origins) => f.write_str(&origins.join(" ")),
        }
    }
}

impl Serialize for Origins {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl JsonSchema for Origins {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "Origins".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "anyOf": [
            { "type": "string", "pattern": r"^\s*(\*|https?://\S+(\s+https?://\S+)*)\s*$" },
            { "type": "array", "minItems": 1, "items": { "type": "string", "pattern": r"^(\*|https?://\S+)$" } },
        ] })
    }
}

impl<'de> Deserialize<'de> for Origins {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        super::words(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins_are_as_browsers_write_them() {
        assert_eq!("*".parse(), Ok(Origins::Any));
        let two = "https://a.example http://localhost:3000";
        assert_eq!(two.parse::<Origins>().unwrap().to_string(), two);
        for bad in ["", "https://a.example/", "https://a.example:443", "a.example", "null", "ftp://a", "* https://a.b"]
        {
            assert!(bad.parse::<Origins>().is_err(), "{bad}");
        }
    }
}
