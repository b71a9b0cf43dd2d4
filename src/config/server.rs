//! Addresses, connections and their timeouts.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{ForwardedHeader, Proxies};

/// The listeners and what a connection may do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ServerConfig {
    /// Address of the service. Default 127.0.0.1:8080: nothing is exposed until somebody says so. Port 0 takes
    /// any free port.
    pub listen: SocketAddr,
    /// Address of `/metrics`. Default `none`: there is no port that is free on every machine. It is apart from
    /// the service, so that a proxy in front cannot expose it by accident.
    pub metrics_listen: Option<SocketAddr>,
    /// Folder of everything that the service keeps; the archive is looked for in it. Default `molmesh-data` in the
    /// working folder: it can be written where the service can be started.
    pub data_dir: PathBuf,
    /// Connections at once. Default 1,024. One more is answered with 503 and closed. The hard limit of open files
    /// should be a few hundred higher; `molmesh doctor` compares them.
    pub connections: usize,
    /// Time for the head of a request, ms, from the connection or the answer before it: also how long an idle
    /// HTTP/1.1 connection is kept. Default 15,000: clients on slow lines need seconds, a minute serves only those
    /// who send one byte at a time.
    pub header_timeout_ms: u64,
    /// Time for the whole body of a request, ms. Default 60,000: 256 MiB at 36 Mbit/s.
    pub body_timeout_ms: u64,
    /// Time in which a client must take `write_bytes` of a response body, or all that is left of it, ms. Default
    /// 30,000: buffers and delivery slots are held until a body is sent. A client that has taken more may pause for
    /// longer, one second for each 16 KiB, four times this value at most. Event streams are exempt.
    pub write_timeout_ms: u64,
    /// Bytes of a response body that a client must take within `write_timeout_ms`. Default 16 KiB: half a kilobyte a
    /// second, so that a line of 8 KiB/s carries a dozen bodies at once.
    pub write_bytes: u64,
    /// Bytes of the head of a request: its line and its headers, 8 KiB at least. Default 64 KiB: browsers and proxies
    /// send a few; 431 beyond.
    pub head_bytes: u32,
    /// Requests at once on one HTTP/2 connection. Default 64: a page asks for a dozen; who wants more opens another
    /// connection, which is counted.
    pub streams: u32,
    /// Longest silence of an event stream, ms, before a sign of life is sent. Default 15,000: proxies commonly give up
    /// after half a minute.
    pub heartbeat_ms: u64,
    /// How long an idle HTTP/2 connection is kept, ms. Default 120,000: front-ends come back within that time.
    pub idle_timeout_ms: u64,
    /// Time after SIGTERM in which `/readyz` answers 503 while all requests are served, on new connections too, ms;
    /// `none` skips it. Default 3,000: load balancers and orchestrators need a second or two to stop sending requests.
    pub termination_notice_ms: Option<u64>,
    /// Time after `termination_notice_ms` for running requests and jobs to finish, ms. Default 20,000: orchestrators
    /// commonly kill after 30 seconds; with `termination_notice_ms` and one second for cancelled jobs a stop takes 24.
    pub drain_timeout_ms: u64,
    /// Proxies in front, by address or network, whose word about their clients is taken. Default `none`: whoever
    /// connects is the client, and what he says about others is not looked at.
    pub trusted_proxies: Option<Proxies>,
    /// The header in which they name their clients: `x-forwarded-for` or `forwarded` (RFC 7239). Default
    /// `x-forwarded-for`, which most proxies write. Only this one is looked at: the other one may be the client's own,
    /// passed on.
    pub forwarded_header: ForwardedHeader,
}

impl Default for ServerConfig {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 8080)),
            metrics_listen: None,
            data_dir: PathBuf::from("molmesh-data"),
            connections: 1024,
            header_timeout_ms: 15_000,
            body_timeout_ms: 60_000,
            write_timeout_ms: 30_000,
            write_bytes: 16 << 10,
            head_bytes: 64 << 10,
            streams: 64,
            heartbeat_ms: 15_000,
            idle_timeout_ms: 120_000,
            termination_notice_ms: Some(3000),
            drain_timeout_ms: 20_000,
            trusted_proxies: None,
            forwarded_header: ForwardedHeader::default(),
        }
    }
}

impl ServerConfig {
    /// Time for the head of a request.
    #[must_use]
    pub fn header_timeout(&self) -> Duration {
        Duration::from_millis(self.header_timeout_ms)
    }

    /// Time for the whole body of a request.
    #[must_use]
    pub fn body_timeout(&self) -> Duration {
        Duration::from_millis(self.body_timeout_ms)
    }

    /// Time in which a client must take `write_bytes` of a response body.
    #[must_use]
    pub fn write_timeout(&self) -> Duration {
        Duration::from_millis(self.write_timeout_ms)
    }

    /// How long an idle HTTP/2 connection is kept.
    #[must_use]
    pub fn idle_timeout(&self) -> Duration {
        Duration::from_millis(self.idle_timeout_ms)
    }

    /// Longest silence of an event stream.
    #[must_use]
    pub fn heartbeat(&self) -> Duration {
        Duration::from_millis(self.heartbeat_ms)
    }

    /// Time after SIGTERM in which all requests are served.
    #[must_use]
    pub fn termination_notice(&self) -> Duration {
        Duration::from_millis(self.termination_notice_ms.unwrap_or_default())
    }

    /// Time after the termination notice for running requests and jobs to finish.
    #[must_use]
    pub fn drain_timeout(&self) -> Duration {
        Duration::from_millis(self.drain_timeout_ms)
    }
}
