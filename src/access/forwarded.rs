//! Address of a client behind proxies.

use std::net::{IpAddr, SocketAddr};

use crate::config::Proxies;

/// Returns the client address of a request from `peer` with these values of `X-Forwarded-For`, in order.
///
/// Every proxy appends the address of its peer, so the list is read from the end while the address is a trusted proxy.
/// Earlier elements may be forged. If a trusted proxy names no valid address, its own address is the client.
pub(crate) fn client<'a>(
    peer: IpAddr,
    values: impl DoubleEndedIterator<Item = &'a str>,
    trusted: Option<&Proxies>,
) -> IpAddr {
    let mut client = peer.to_canonical();
    let Some(trusted) = trusted else { return client };
    let hops = values.rev().flat_map(|value| value.rsplit(',')).map(str::trim);
    for hop in hops.filter(|hop| !hop.is_empty()) {
        if !trusted.contains(client) {
            break;
        }
        match address(hop) {
            Some(address) => client = address,
            None => break,
        }
    }
    client
}

/// Returns true if `client`, which [`client`] has returned for a request from `peer`, stands for one client and not for
/// all clients of a proxy. `is_forwarded` is true if the request has a header of a proxy.
pub(crate) fn is_single(peer: IpAddr, client: IpAddr, is_forwarded: bool, trusted: Option<&Proxies>) -> bool {
    let is_proxy = trusted.is_some_and(|trusted| trusted.contains(client));
    !is_proxy && (client != peer.to_canonical() || !is_forwarded)
}

/// Parses an address with optional brackets and port.
fn address(text: &str) -> Option<IpAddr> {
    let bare = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(text);
    let address = bare.parse().ok().or_else(|| text.parse().ok().map(|socket: SocketAddr| socket.ip()));
    address.map(|address: IpAddr| address.to_canonical())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client_of(peer: &str, values: &[&str]) -> String {
        let trusted: Proxies = "10.0.0.0/8 fd00::/8".parse().unwrap();
        client(peer.parse().unwrap(), values.iter().copied(), Some(&trusted)).to_string()
    }

    #[test]
    fn only_trusted_proxies_are_believed() {
        for (peer, values, expected) in [
            ("203.0.113.9", &["198.51.100.1"][..], "203.0.113.9"),
            ("10.0.0.1", &[], "10.0.0.1"),
            ("10.0.0.1", &["198.51.100.1"], "198.51.100.1"),
            // Elements that the client forged are further left.
            ("10.0.0.1", &["127.0.0.1, 198.51.100.1"], "198.51.100.1"),
            ("10.0.0.1", &["198.51.100.1, 10.0.0.2"], "198.51.100.1"),
            ("10.0.0.1", &["192.0.2.1", "198.51.100.1,10.0.0.2"], "198.51.100.1"),
            ("10.0.0.1", &["10.0.0.3, 10.0.0.2"], "10.0.0.3"),
            ("10.0.0.1", &["198.51.100.1:4711"], "198.51.100.1"),
            ("::ffff:10.0.0.1", &["[2001:db8::1]:4711"], "2001:db8::1"),
            ("fd00::1", &["::ffff:198.51.100.1"], "198.51.100.1"),
            // The proxy hides the address: its own address counts, and earlier elements are ignored.
            ("10.0.0.1", &["198.51.100.1, unknown"], "10.0.0.1"),
            ("10.0.0.1", &["198.51.100.1, , "], "198.51.100.1"),
        ] {
            assert_eq!(client_of(peer, values), expected, "{peer} {values:?}");
        }
        let untrusted = client("10.0.0.1".parse().unwrap(), ["198.51.100.1"].into_iter(), None);
        assert_eq!(untrusted.to_string(), "10.0.0.1");
    }

    #[test]
    fn an_address_of_a_proxy_stands_for_many_clients() {
        let trusted: Proxies = "10.0.0.0/8".parse().unwrap();
        for (peer, values, is_forwarded, trusted, expected) in [
            ("203.0.113.9", &[][..], false, None, true),
            ("203.0.113.9", &["198.51.100.1"], true, None, false),
            ("203.0.113.9", &["198.51.100.1"], true, Some(&trusted), false),
            ("10.0.0.1", &["198.51.100.1"], true, Some(&trusted), true),
            ("10.0.0.1", &[], false, Some(&trusted), false),
            ("10.0.0.1", &["10.0.0.2"], true, Some(&trusted), false),
            ("10.0.0.1", &["unknown"], true, Some(&trusted), false),
        ] {
            let peer: IpAddr = peer.parse().unwrap();
            let found = client(peer, values.iter().copied(), trusted);
            assert_eq!(is_single(peer, found, is_forwarded, trusted), expected, "{peer} {values:?}");
        }
    }
}
