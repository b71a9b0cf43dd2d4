//! Trusted proxies and the header in which they name their clients.

use std::borrow::Cow;
use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;

use ipnet::IpNet;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Addresses and networks of proxies, at least one: a string separated by white space, or a list of strings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Proxies(Vec<IpNet>);

impl Proxies {
    /// Returns true if `address` is a trusted proxy. IPv4-mapped IPv6 addresses count as IPv4.
    #[must_use]
    pub fn contains(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        self.0.iter().any(|net| net.contains(&address))
    }
}

impl FromStr for Proxies {
    type Err = String;

    /// Parses addresses and networks separated by white space. The error states the expected form.
    fn from_str(text: &str) -> Result<Self, String> {
        const EXPECTED: &str = "none, or addresses and networks such as 10.0.0.7 or 10.0.0.0/8";
        let net = |word: &str| {
            let net = word.parse::<IpNet>().ok().or_else(|| word.parse::<IpAddr>().ok().map(IpNet::from));
            net.ok_or_else(|| format!("{EXPECTED}; `{word}` is neither"))
        };
        let nets = text.split_whitespace().map(net).collect::<Result<Vec<_>, _>>()?;
        if nets.is_empty() { Err(EXPECTED.to_owned()) } else { Ok(Self(nets)) }
    }
}

impl fmt::Display for Proxies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let texts: Vec<String> = self.0.iter().map(ToString::to_string).collect();
        f.write_str(&texts.join(" "))
    }
}

impl Serialize for Proxies {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl JsonSchema for Proxies {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "Proxies".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "anyOf": [
            { "type": "string", "pattern": r"^\s*[0-9A-Fa-f.:/]+(\s+[0-9A-Fa-f.:/]+)*\s*$" },
            { "type": "array", "minItems": 1, "items": { "type": "string", "pattern": "^[0-9A-Fa-f.:/]+$" } },
        ] })
    }
}

impl<'de> Deserialize<'de> for Proxies {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        super::joined(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// Header in which proxies name their clients.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ForwardedHeader {
    /// `X-Forwarded-For`, which most proxies write.
    #[default]
    XForwardedFor,
    /// `Forwarded` (RFC 7239).
    Forwarded,
}

impl ForwardedHeader {
    /// Returns the name of the header.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::XForwardedFor => "x-forwarded-for",
            Self::Forwarded => "forwarded",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contains_listed_addresses_and_networks_only() {
        let proxies: Proxies = "10.0.0.0/8 192.0.2.7 2001:db8::/32".parse().unwrap();
        for (address, trusted) in [
            ("10.1.2.3", true),
            ("::ffff:10.1.2.3", true),
            ("11.0.0.1", false),
            ("192.0.2.7", true),
            ("192.0.2.8", false),
            ("2001:db8::1", true),
            ("2001:db9::1", false),
        ] {
            assert_eq!(proxies.contains(address.parse().unwrap()), trusted, "{address}");
        }
        for bad in ["", "proxy", "10.0.0.0/33", "10.0.0.0/8,11.0.0.0/8"] {
            assert!(bad.parse::<Proxies>().is_err(), "{bad}");
        }
    }
}
