//! Origins whose pages may read responses, and host names under which the service is reached.

use std::net::{IpAddr, SocketAddr};

use crate::config::{Config, Hosts, Origins};

/// Origins and host names of a configuration.
#[derive(Debug)]
pub(crate) struct Sites {
    origins: Option<Origins>,
    hosts: Option<Hosts>,
    /// True if the service listens on a loopback address.
    on_loopback: bool,
}

impl Sites {
    pub(super) fn new(config: &Config) -> Self {
        let on_loopback = config.server.listen.ip().to_canonical().is_loopback();
        Self { origins: config.access.cors_origins.clone(), hosts: config.server.hosts.clone(), on_loopback }
    }

    /// Creates the sites of the metrics listener. On a loopback address it answers to the names of the service, and on
    /// another one to any name, such as the address of a pod.
    pub(crate) fn for_metrics(config: &Config, address: SocketAddr) -> Self {
        let on_loopback = address.ip().to_canonical().is_loopback();
        Self { origins: None, hosts: config.server.hosts.clone().filter(|_| on_loopback), on_loopback }
    }

    /// Returns true if pages of all origins may read responses.
    pub(crate) fn allows_any_origin(&self) -> bool {
        self.origins == Some(Origins::Any)
    }

    /// Returns true if pages of all loopback origins may read responses, and no others.
    pub(crate) fn allows_loopback_origins(&self) -> bool {
        self.on_loopback && self.origins == Some(Origins::Auto)
    }

    /// Returns true if no origin is configured although the service is exposed.
    pub(crate) fn lacks_origins(&self) -> bool {
        !self.on_loopback && self.origins == Some(Origins::Auto)
    }

    /// Returns true if pages of `origin` (the value of the header) may read responses.
    pub(crate) fn allows_origin(&self, origin: &str) -> bool {
        match &self.origins {
            Some(Origins::Any) => true,
            Some(Origins::Auto) => self.on_loopback && authority(origin).is_some_and(is_loopback),
            Some(Origins::These(origins)) => origins.iter().any(|listed| listed == origin),
            None => false,
        }
    }

    /// Returns true if the service answers requests for `authority`, a host with an optional port. On a loopback
    /// address it must be a name of this machine: any other name that resolves to it may belong to a page that
    /// uses DNS rebinding.
    pub(crate) fn answers(&self, authority: &str) -> bool {
        let listed = |hosts: &Hosts| hosts.contains(host(authority));
        let is_restricted = self.on_loopback || self.hosts.is_some();
        !is_restricted || is_loopback(authority) || self.hosts.as_ref().is_some_and(listed)
    }
}

/// Returns the authority of an origin such as `http://localhost:5173`.
pub(crate) fn authority(origin: &str) -> Option<&str> {
    ["http://", "https://"].into_iter().find_map(|scheme| origin.strip_prefix(scheme))
}

/// Removes the port from an authority.
fn host(authority: &str) -> &str {
    match authority.rsplit_once(':') {
        Some((host, port)) if port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => authority,
    }
}

fn is_loopback(authority: &str) -> bool {
    let host = host(authority);
    let bare = host.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(host);
    host.eq_ignore_ascii_case("localhost")
        || bare.parse().is_ok_and(|address: IpAddr| address.to_canonical().is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sites(listen: &str, origins: Option<&str>, hosts: Option<&str>) -> Sites {
        let mut config = Config::default();
        config.server.listen = listen.parse().unwrap();
        config.access.cors_origins = origins.map(|text| text.parse().unwrap());
        config.server.hosts = hosts.map(|text| text.parse().unwrap());
        Sites::new(&config)
    }

    #[test]
    fn automatic_origins_are_loopback_origins_of_a_loopback_service() {
        for listen in ["127.0.0.1:8080", "127.0.0.7:0", "[::1]:8080"] {
            let sites = sites(listen, Some("auto"), None);
            assert!(sites.allows_loopback_origins() && !sites.lacks_origins());
            for origin in ["http://localhost", "http://LOCALHOST:5173", "https://127.0.0.9:1", "http://[::1]:3000"] {
                assert!(sites.allows_origin(origin), "{origin}");
            }
            for origin in [
                "null",
                "",
                "http://evil.example",
                "http://localhost.evil.example",
                "http://127.0.0.1.evil.example",
                "http://evil.example:80",
                "http://192.168.0.1",
                "file://localhost",
                "localhost",
            ] {
                assert!(!sites.allows_origin(origin), "{origin}");
            }
        }
        let exposed = sites("0.0.0.0:8080", Some("auto"), None);
        assert!(exposed.lacks_origins() && !exposed.allows_origin("http://localhost:5173"));
        let listed = sites("0.0.0.0:8080", Some("https://a.example"), None);
        assert!(!listed.lacks_origins() && listed.allows_origin("https://a.example"));
        assert!(!listed.allows_origin("https://b.example"));
        assert!(sites("[::]:80", Some("*"), None).allows_origin("null"));
        assert!(!sites("127.0.0.1:80", None, None).allows_origin("http://localhost"));
    }

    #[test]
    fn a_loopback_service_answers_to_loopback_names_and_listed_ones() {
        let own = ["localhost", "localhost:81", "127.0.0.1:8080", "127.1.2.3", "[::1]", "[::1]:8080"];
        let foreign = ["evil.example", "localhost.evil.example:80", "192.0.2.1", "[2001:db8::1]:80", "", ":80"];
        for (sites, extra) in [
            (sites("127.0.0.1:8080", None, None), false),
            (sites("[::1]:8080", None, Some("meshes.example 192.0.2.7")), true),
            (sites("0.0.0.0:8080", None, Some("meshes.example 192.0.2.7")), true),
        ] {
            assert!(own.iter().all(|name| sites.answers(name)));
            assert!(!foreign.iter().any(|name| sites.answers(name)));
            assert_eq!(sites.answers("Meshes.Example:443"), extra);
            assert_eq!(sites.answers("192.0.2.7"), extra);
        }
        assert!(foreign.iter().all(|name| sites("0.0.0.0:8080", None, None).answers(name)));
    }
}
