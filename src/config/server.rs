//! Configuration of the server: addresses, connections and timeouts.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Hosts, Proxies, list, telemetry};

/// Role of a node of a cluster.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Requests and asynchronous jobs.
    #[default]
    All,
    /// Requests.
    Api,
    /// Asynchronous jobs.
    Worker,
}

section! {
    /// Listeners and limits of connections.
    ServerConfig;
    /// Address of the service. Default 127.0.0.1:8080: the service is not exposed unless configured. Port 0 selects a
    /// free port.
    listen: SocketAddr = SocketAddr::from((Ipv4Addr::LOCALHOST, 8080));
    /// Role of this node: `all`, `api` (answers requests, claims no asynchronous jobs) or `worker` (claims asynchronous
    /// jobs, answers only probes and `/version`). Default `all`. The others need `broker.url`.
    role: Role = Role::default();
    /// Host names by which clients reach the service, without ports, besides the names of the loopback addresses.
    /// Default `none`: a service that listens on a loopback address answers requests for any other name with a 421, so
    /// that a web page cannot reach it through its own host name. With a list, this applies to every address.
    #[serde(with = "list")]
    #[schemars(schema_with = "Hosts::schema")]
    hosts: Option<Hosts> = None;
    /// Address of `/metrics`. Default `none`: no port is free on every machine. The address is separate, so that a
    /// proxy cannot expose the metrics by accident.
    metrics_listen: Option<SocketAddr> = None;
    /// Folder of all stored data, and by default of the archive. Default `molmesh-data` in the working folder, which is
    /// usually writable.
    data_dir: PathBuf = PathBuf::from("molmesh-data");
    /// Number of open connections. Default 1,024. Further ones get a 503 and are closed. The hard limit of open files
    /// should be a few hundred higher; `molmesh doctor` compares them.
    connections: usize = 1024;
    /// Share of one client in each of five limits, as a fraction from 0 to 1. A share has at least one slot. In
    /// `server.connections`, clients are told apart by the address of the peer; `trusted_proxies` have no share. In the
    /// 256 meshes in progress, the 8 fetches from the archive and the threads that read structures outside of jobs
    /// (`jobs.workers`), they are told apart by key, or by address without a key. Default 0.25: one client cannot
    /// occupy the service, and three others find free slots. With 1 a client may use all slots. Connections and meshes
    /// beyond the share get a 503. Fetches wait for half a minute first, and readers for half of `jobs.deadline_ms`. Of
    /// `limits.memory_bytes`, a client whose other requests hold more than the share leaves as much to others.
    #[serde(deserialize_with = "telemetry::ratio")]
    #[schemars(range(min = 0, max = 1))]
    client_share: f64 = 0.25;
    /// Time for the head of a request, ms, counted from the connection or the previous response; also the time that an
    /// idle HTTP/1.1 connection is kept. Fixed: slow clients need seconds, only attackers need a minute.
    #[serde(skip)]
    header_timeout_ms: u64 = 15_000;
    /// Time for the whole body of a request, ms. Fixed: 256 MiB at 36 Mbit/s.
    #[serde(skip)]
    body_timeout_ms: u64 = 60_000;
    /// Time in which a client must receive 16 KiB of a response body, or the rest of it, ms. Fixed: buffers and
    /// delivery slots are held until a body is sent. A client that has received more may pause longer, one second per
    /// 16 KiB, up to four times this value. Event streams are exempt.
    #[serde(skip)]
    write_timeout_ms: u64 = 30_000;
    /// Longest silence of an event stream before a comment is sent, ms. Fixed: proxies commonly close idle connections
    /// after half a minute.
    #[serde(skip)]
    heartbeat_ms: u64 = 15_000;
    /// Time that an idle HTTP/2 connection is kept, ms. Fixed: proxies usually reuse it within that time.
    #[serde(skip)]
    idle_timeout_ms: u64 = 120_000;
    /// Time after SIGTERM in which `/readyz` answers 503 while all requests are served, on new connections too, ms;
    /// `none` skips it. Default 3,000: load balancers and orchestrators need a second or two to stop sending requests.
    termination_notice_ms: Option<u64> = Some(3000);
    /// Time after `termination_notice_ms` for running requests and jobs to finish, ms. Default 20,000: orchestrators
    /// commonly kill after 30 seconds; with `termination_notice_ms` and one second for cancelled jobs a stop takes 24.
    drain_timeout_ms: u64 = 20_000;
    /// Trusted proxies, by address or network, whose `X-Forwarded-For` names the client. Default `none`: the peer is
    /// the client, and the header is ignored.
    #[serde(with = "list")]
    #[schemars(schema_with = "Proxies::schema")]
    trusted_proxies: Option<Proxies> = None;
}
