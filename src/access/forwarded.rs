//! Address of a client behind proxies.

use std::net::{IpAddr, SocketAddr};

use crate::config::{ForwardedHeader, Proxies};

/// Returns the client address of a request from `peer` with these values of `header`, in order.
///
/// Every proxy appends the address of its peer, so the list is read from the end while the address is a trusted proxy.
/// Earlier elements may be forged. If a trusted proxy names no valid address, its own address is the client.
pub(crate) fn client<'a>(
    peer: IpAddr,
    header: ForwardedHeader,
    values: impl DoubleEndedIterator<Item = &'a str>,
    trusted: Option<&Proxies>,
) -> IpAddr {
    let mut client = peer.to_canonical();
    let Some(trusted) = trusted else { return client };
    for hop in values.rev().flat_map(|value| elements(value).into_iter().rev()) {
        if !trusted.contains(client) {
            break;
        }
        let named = match header {
            ForwardedHeader::XForwardedFor => address(hop),
            ForwardedHeader::Forwarded => forwarded_for(hop).and_then(address),
        };
        match named {
            Some(address) => client = address,
            None => break,
        }
    }
    client
}

/// Splits a list at its commas, except those within quotes.
fn elements(value: &str) -> Vec<&str> {
    let mut quoted = false;
    let separates = move |c: char| {
        quoted ^= c == '"';
        c == ',' && !quoted
    };
    value.split(separates).map(str::trim).filter(|element| !element.is_empty()).collect()
}

/// Returns the `for` parameter of a `Forwarded` element.
fn forwarded_for(element: &str) -> Option<&str> {
    element.split(';').find_map(|pair| {
        let (name, value) = pair.split_once('=')?;
        name.trim().eq_ignore_ascii_case("for").then(|| value.trim().trim_matches('"'))
    })
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
    use ForwardedHeader::{Forwarded, XForwardedFor};

    fn client_of(peer: &str, header: ForwardedHeader, values: &[&str]) -> String {
        let trusted: Proxies = "10.0.0.0/8 fd00::/8".parse().unwrap();
        client(peer.parse().unwrap(), header, values.iter().copied(), Some(&trusted)).to_string()
    }

    #[test]
    fn only_trusted_proxies_are_believed() {
        for (peer, header, values, expected) in [
            ("203.0.113.9", XForwardedFor, &["198.51.100.1"][..], "203.0.113.9"),
            ("10.0.0.1", XForwardedFor, &[], "10.0.0.1"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1"], "198.51.100.1"),
            // Elements that the client forged are further left.
            ("10.0.0.1", XForwardedFor, &["127.0.0.1, 198.51.100.1"], "198.51.100.1"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1, 10.0.0.2"], "198.51.100.1"),
            ("10.0.0.1", XForwardedFor, &["192.0.2.1", "198.51.100.1,10.0.0.2"], "198.51.100.1"),
            ("10.0.0.1", XForwardedFor, &["10.0.0.3, 10.0.0.2"], "10.0.0.3"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1:4711"], "198.51.100.1"),
            ("::ffff:10.0.0.1", XForwardedFor, &["[2001:db8::1]:4711"], "2001:db8::1"),
            ("fd00::1", XForwardedFor, &["::ffff:198.51.100.1"], "198.51.100.1"),
            // The proxy hides the address: its own address counts, and earlier elements are ignored.
            ("10.0.0.1", XForwardedFor, &["198.51.100.1, unknown"], "10.0.0.1"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1, , "], "198.51.100.1"),
            ("10.0.0.1", Forwarded, &["for=198.51.100.1;proto=https;by=10.0.0.1"], "198.51.100.1"),
            ("10.0.0.1", Forwarded, &["For=\"[2001:db8::1]:4711\""], "2001:db8::1"),
            ("10.0.0.1", Forwarded, &["for=192.0.2.1, for=\"_a,b\", for=10.0.0.2"], "10.0.0.2"),
            ("10.0.0.1", Forwarded, &["proto=https"], "10.0.0.1"),
            ("10.0.0.1", Forwarded, &["198.51.100.1"], "10.0.0.1"),
        ] {
            assert_eq!(client_of(peer, header, values), expected, "{peer} {header:?} {values:?}");
        }
        let untrusted = client("10.0.0.1".parse().unwrap(), XForwardedFor, ["198.51.100.1"].into_iter(), None);
        assert_eq!(untrusted.to_string(), "10.0.0.1");
    }
}
