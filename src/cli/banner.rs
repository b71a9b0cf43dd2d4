//! Banner of a service at its start: addresses, an example command, the backend, and the reasons for which the others
//! are not used.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use super::page::Page;
use super::style::Style;
use super::survey::Availability;

/// Start of an example command. It fails with the problem document if the server returns an error.
const CURL: &str = "curl -sS --fail-with-body";

/// Facts that the banner shows.
pub(crate) struct Facts {
    /// Selected backend and its hardware.
    pub(crate) device: String,
    /// Reason of the selection.
    pub(crate) reason: String,
    /// All backends with their states.
    pub(crate) others: Vec<Availability>,
    /// True if requests need a key.
    pub(crate) keys: bool,
    /// True if the build contains the viewer.
    pub(crate) viewer: bool,
}

/// Returns the banner of a service that listens on `addr`.
pub(crate) fn text(addr: SocketAddr, metrics: Option<SocketAddr>, facts: &Facts, style: Style) -> String {
    let base = format!("http://{}", reachable(addr));
    let mut page = Page::new(style, "molmesh", env!("CARGO_PKG_VERSION"));
    page.row("viewer", &style.cyan(&format!("{base}/")));
    if !facts.viewer {
        page.row("", &style.dim("not in this build: run `make web` and build again (`make run` does both)"));
    }
    page.row("docs", &style.cyan(&format!("{base}/docs")));
    if let Some(metrics) = metrics {
        page.row("metrics", &style.cyan(&format!("http://{}/metrics", reachable(metrics))));
    }
    page.row("device", &format!("{} ({})", facts.device, facts.reason));
    for Availability { name, state } in &facts.others {
        if let Err(why) = state {
            page.row("", &style.dim(&format!("not {name}: {why}")));
        }
    }
    let key = if facts.keys { " -H \"X-Api-Key: $MOLMESH_KEY\"" } else { "" };
    page.row("try", &format!("{CURL} {base}/sample.pdb | {CURL}{key} --data-binary @- {base}/v1/meshes -o 4pti.glb"));
    page.finish()
}

/// Replaces the unspecified address, to which clients cannot connect, by the loopback address.
fn reachable(addr: SocketAddr) -> SocketAddr {
    let ip = match addr.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
        ip => ip,
    };
    SocketAddr::new(ip, addr.port())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shows_addresses_and_reasons() {
        let facts = Facts {
            device: "cpu: 2 threads".into(),
            reason: "auto".into(),
            others: vec![
                Availability { name: "cpu".into(), state: Ok("2 threads".into()) },
                Availability { name: "gpu".into(), state: Err("none found".into()) },
            ],
            keys: false,
            viewer: true,
        };
        let text = text("0.0.0.0:81".parse().unwrap(), Some("[::]:82".parse().unwrap()), &facts, Style::PLAIN);
        for part in [
            "http://127.0.0.1:81/\n",
            "http://127.0.0.1:81/docs\n",
            "http://[::1]:82/metrics",
            "cpu: 2 threads (auto)",
            "not gpu: none found",
            "| curl -sS --fail-with-body --data-binary @- http://127.0.0.1:81/v1/meshes",
        ] {
            assert!(text.contains(part), "no `{part}` in\n{text}");
        }
        let with_keys = Facts { keys: true, ..facts };
        let keyed = super::text("0.0.0.0:81".parse().unwrap(), None, &with_keys, Style::PLAIN);
        assert!(keyed.contains("curl -sS --fail-with-body -H \"X-Api-Key: $MOLMESH_KEY\" --data-binary"), "{keyed}");
        let bare = Facts { keys: false, viewer: false, ..with_keys };
        let bare = super::text("0.0.0.0:81".parse().unwrap(), None, &bare, Style::PLAIN);
        assert!(bare.contains("make web") && !text.contains("make web"), "{bare}");
        assert!(!text.contains("not cpu") && text.lines().count() <= 8, "{text}");
    }
}
