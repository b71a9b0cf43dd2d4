//! Settings of the broker, which dispatches asynchronous jobs.

use std::path::PathBuf;

use super::{Config, Role, Secret};

/// Shortest `broker.lease_ms`: workers extend their claims three times in it.
const MIN_LEASE_MS: u64 = 1000;

section! {
    /// Dispatch of asynchronous jobs.
    BrokerConfig;
    /// Servers of NATS JetStream that the nodes of a cluster share: one or more addresses such as
    /// `nats://nats.example:4222` or `tls://nats.example:4222`, separated by commas. Needs a shared `store.url`.
    /// Default `none`: the process dispatches its own jobs.
    url: Option<String> = None;
    /// User name for NATS. Default `none`: no authentication. Needs `password`.
    user: Option<String> = None;
    /// Password for NATS. Default `none`. Prefer the environment variable or `password_file` to the configuration file.
    password: Option<Secret> = None;
    /// File that contains the value of `password`; one line break at its end is ignored. Default `none`. Excludes
    /// `password`.
    password_file: Option<PathBuf> = None;
    /// First part of the names of stream and subjects. Default `molmesh`. Clusters that share a NATS server need
    /// different ones.
    #[schemars(regex(pattern = "^[A-Za-z0-9_-]+$"))]
    prefix: String = "molmesh".to_owned();
    /// Number of copies of the stream in a NATS cluster, from 1 to 5. Default 1. A lost stream loses no job; the jobs
    /// are dispatched again within a minute.
    replicas: usize = 1;
    /// Time after which another worker may claim a job whose worker has stopped, ms. Default 30,000: workers extend
    /// their claims three times in this time.
    lease_ms: u64 = 30_000;
    /// Number of asynchronous jobs that wait for a worker; with `url`, of jobs that wait or run. Default 10,000: at 0.1
    /// s per job on two workers the last one waits for eight minutes. Further requests for jobs get a 503 with an
    /// estimated `Retry-After`.
    queue: usize = 10_000;
}

impl Config {
    /// Checks the settings of a cluster, and returns the fault.
    pub(super) fn check_cluster(&self) -> Result<(), &'static str> {
        let (broker, url) = (&self.broker, self.store.url.as_deref());
        let folder = url.and_then(|url| url.strip_prefix("file://"));
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
        let why = match (&broker.url, url) {
            (None, _) if self.server.role != Role::All => "server.role needs broker.url: a node alone has every role",
            (None, _) if folder.is_some() => "a folder in store.url needs broker.url: without it, set server.data_dir",
            (None, _) => return Ok(()),
            (Some(_), None) => "broker.url needs store.url: the nodes of a cluster share one store",
            _ if folder.is_some_and(|path| !path.starts_with('/')) => "store.url: expected file:///absolute/path",
            _ if broker.prefix.is_empty() || !broker.prefix.chars().all(is_plain) => {
                "broker.prefix: expected letters, digits, `-` and `_`"
            }
            _ if broker.lease_ms < MIN_LEASE_MS => "broker.lease_ms: expected 1000 or more",
            _ if broker.user.is_some() != broker.password.is_some() => {
                "broker.user and broker.password belong together"
            }
            _ => return Ok(()),
        };
        Err(why)
    }
}
