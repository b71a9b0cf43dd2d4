//! Who a client behind proxies is: the nearest one that is no proxy of ours.

use std::net::{IpAddr, SocketAddr};

use crate::config::{ForwardedHeader, Proxies};

/// The client of a request that came from `peer` with these values of `header`, in their order.
///
/// Every proxy adds at the end who it was asked by, so the list is read from there: as long as somebody is a proxy of ours,
/// what it says is believed. What comes before may be made up. Where a proxy does not name an address, it stands for its
/// clients itself.
pub fn client<'a>(
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

/// The elements of a list; commas within quotes separate nothing.
fn elements(value: &str) -> Vec<&str> {
    let mut quoted = false;
    let separates = move |c: char| {
        quoted ^= c == '"';
        c == ',' && !quoted
    };
    value.split(separates).map(str::trim).filter(|element| !element.is_empty()).collect()
}

/// The `for` of an element of `Forwarded`.
fn forwarded_for(element: &str) -> Option<&str> {
    element.split(';').find_map(|pair| {
        let (name, value) = pair.split_once('=')?;
        name.trim().eq_ignore_ascii_case("for").then(|| value.trim().trim_matches('"'))
    })
}

/// An address, perhaps in brackets, perhaps with a port.
fn address(text: &str) -> Option<IpAddr> {
    let bare = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(text);
    let address = bare.parse().ok().or_else(|| text.parse().ok().map(|socket: SocketAddr| socket.ip()));
    address.map(|address: IpAddr| address.to_canonical())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ForwardedHeader::{Forwarded, XForwardedFor};

    fn ask(peer: &str, header: ForwardedHeader, values: &[&str]) -> String {
        let trusted: Proxies = "10.0.0.0/8 fd00::/8".parse().unwrap();
        client(peer.parse().unwrap(), header, values.iter().copied(), Some(&trusted)).to_string()
    }

    #[test]
    fn only_proxies_of_ours_are_believed() {
        for (peer, header, values, expected) in [
            ("203.0.113.9", XForwardedFor, &["198.51.100.1"][..], "203.0.113.9"),
            ("10.0.0.1", XForwardedFor, &[], "10.0.0.1"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1"], "198.51.100.1"),
            // What the client itself made up lies further left.
            ("10.0.0.1", XForwardedFor, &["127.0.0.1, 198.51.100.1"], "198.51.100.1"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1, 10.0.0.2"], "198.51.100.1"),
            ("10.0.0.1", XForwardedFor, &["192.0.2.1", "198.51.100.1,10.0.0.2"], "198.51.100.1"),
            ("10.0.0.1", XForwardedFor, &["10.0.0.3, 10.0.0.2"], "10.0.0.3"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1:4711"], "198.51.100.1"),
            ("::ffff:10.0.0.1", XForwardedFor, &["[2001:db8::1]:4711"], "2001:db8::1"),
            ("fd00::1", XForwardedFor, &["::ffff:198.51.100.1"], "198.51.100.1"),
            // A name that is no address: the proxy stands for whom it hides, and nothing before is believed.
            ("10.0.0.1", XForwardedFor, &["198.51.100.1, unknown"], "10.0.0.1"),
            ("10.0.0.1", XForwardedFor, &["198.51.100.1, , "], "198.51.100.1"),
            ("10.0.0.1", Forwarded, &["for=198.51.100.1;proto=https;by=10.0.0.1"], "198.51.100.1"),
            ("10.0.0.1", Forwarded, &["For=\"[2001:db8::1]:4711\""], "2001:db8::1"),
            ("10.0.0.1", Forwarded, &["for=192.0.2.1, for=\"_a,b\", for=10.0.0.2"], "10.0.0.2"),
            ("10.0.0.1", Forwarded, &["proto=https"], "10.0.0.1"),
            ("10.0.0.1", Forwarded, &["198.51.100.1"], "10.0.0.1"),
        ] {
            assert_eq!(ask(peer, header, values), expected, "{peer} {header:?} {values:?}");
        }
        let nobody = client("10.0.0.1".parse().unwrap(), XForwardedFor, ["198.51.100.1"].into_iter(), None);
        assert_eq!(nobody.to_string(), "10.0.0.1");
    }
}
