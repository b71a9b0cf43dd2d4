//! DNS resolver that returns public addresses only. The HTTP client connects to the addresses checked here, so a later
//! change of the name has no effect.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use thiserror::Error;

/// Error: a name has no permitted address.
#[derive(Debug, Error)]
#[error("{name} is {address}, which is not a public address; set archive.allow_private to allow it")]
pub(super) struct Refused {
    name: String,
    address: IpAddr,
}

/// System resolver that drops addresses that are not public, unless `allow_private` is set.
pub(super) struct PublicResolver {
    pub(super) allow_private: bool,
}

impl Resolve for PublicResolver {
    fn resolve(&self, name: Name) -> Resolving {
        let allow_private = self.allow_private;
        Box::pin(async move {
            let found: Vec<SocketAddr> = tokio::net::lookup_host((name.as_str(), 0)).await?.collect();
            let Some(first) = found.first().map(SocketAddr::ip) else {
                return Err(io::Error::new(io::ErrorKind::NotFound, "the name has no address").into());
            };
            let permitted: Vec<SocketAddr> =
                found.into_iter().filter(|found| allow_private || is_public(found.ip())).collect();
            if permitted.is_empty() {
                return Err(Refused { name: name.as_str().to_owned(), address: first }.into());
            }
            Ok(Box::new(permitted.into_iter()) as Addrs)
        })
    }
}

/// Returns true if the address is globally reachable according to IANA's registries of special-purpose addresses. IPv6
/// addresses that embed an IPv4 address are as public as that one.
pub(super) fn is_public(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => is_public_v4(v4),
        IpAddr::V6(v6) => is_public_v6(v6),
    }
}

fn is_public_v4(v4: Ipv4Addr) -> bool {
    let [a, b, c, _] = v4.octets();
    let special = v4.is_private()
        || v4.is_loopback()
        || v4.is_link_local()
        || v4.is_multicast()
        || v4.is_documentation()
        // "This network", carrier-grade NAT, protocol assignments, benchmarks, reserved and broadcast.
        || a == 0
        || (a == 100 && (64..128).contains(&b))
        || (a, b, c) == (192, 0, 0)
        || (a == 198 && (18..20).contains(&b))
        || a >= 240;
    !special
}

fn is_public_v6(v6: Ipv6Addr) -> bool {
    let [a, b, c, d, e, f, g, h] = v6.segments();
    let embedded = |high: u16, low: u16| {
        let ([a, b], [c, d]) = (high.to_be_bytes(), low.to_be_bytes());
        is_public_v4(Ipv4Addr::new(a, b, c, d))
    };
    match (a, b, c, d, e, f) {
        // Mapped, translated and 6to4. The unspecified address and loopback have the deprecated "compatible" form.
        (0, 0, 0, 0, 0, 0 | 0xffff) | (0x64, 0xff9b, 0, 0, 0, 0) => embedded(g, h),
        (0x2002, ..) => embedded(b, c),
        // Global unicast is 2000::/3 without protocol assignments (such as Teredo) and documentation.
        _ => {
            (a & 0xe000) == 0x2000
                && !(a == 0x2001 && b < 0x200)
                && !(a == 0x2001 && b == 0xdb8)
                && !(a == 0x3fff && b < 0x1000)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn special_addresses_are_not_public() {
        let public = "8.8.8.8 128.6.159.248 172.32.0.1 100.128.0.1 2607:f8b0::1 2a00:1450::1 \
                      ::ffff:8.8.8.8 64:ff9b::808:808 2002:808:808::1";
        let special = "127.0.0.1 127.9.9.9 0.0.0.0 0.1.2.3 10.1.2.3 172.16.0.1 172.31.255.255 192.168.1.1 \
                       169.254.169.254 100.64.0.1 192.0.0.8 192.0.2.1 198.18.0.1 203.0.113.9 224.0.0.1 240.0.0.1 \
                       255.255.255.255 :: ::1 ::7f00:1 fe80::1 fc00::1 fd12:3456::1 ff02::1 fec0::1 2001:db8::1 \
                       2001::1 100::1 ::ffff:127.0.0.1 ::ffff:10.0.0.1 64:ff9b::7f00:1 64:ff9b:1::1 2002:7f00:1::1 \
                       2002:a00:1:: 3fff::1";
        for (addresses, expected) in [(public, true), (special, false)] {
            for address in addresses.split_whitespace() {
                assert_eq!(is_public(address.parse().unwrap()), expected, "{address}");
            }
        }
    }
}
