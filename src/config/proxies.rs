//! Trusted proxies.

use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;

use ipnet::IpNet;
use schemars::{Schema, SchemaGenerator};

use super::list;

/// Addresses and networks of proxies, at least one: a string separated by white space, or a list of strings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Proxies(Vec<IpNet>);

impl Proxies {
    /// Returns the schema of an optional list of proxies.
    pub(super) fn schema(_: &mut SchemaGenerator) -> Schema {
        list::schema("[0-9A-Fa-f.:/]+")
    }

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
