//! Settings of the broker, which dispatches asynchronous jobs.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Secret;

/// Dispatch of asynchronous jobs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BrokerConfig {
    /// Servers of NATS JetStream that the nodes of a cluster share: one or more addresses such as
    /// `nats://nats.example:4222` or `tls://nats.example:4222`, separated by commas. Needs a shared `store.url`.
    /// Default `none`: the process dispatches its own jobs.
    pub url: Option<String>,
    /// User name for NATS. Default `none`: no authentication. Needs `password`.
    pub user: Option<String>,
    /// Password for NATS. Default `none`. Prefer the environment variable or `password_file` to the configuration file.
    pub password: Option<Secret>,
    /// File that contains the value of `password`; one line break at its end is ignored. Default `none`. Excludes
    /// `password`.
    pub password_file: Option<PathBuf>,
    /// First part of the names of stream and subjects. Default `molmesh`. Clusters that share a NATS server need
    /// different ones.
    #[schemars(regex(pattern = "^[A-Za-z0-9_-]+$"))]
    pub prefix: String,
    /// Number of copies of the stream in a NATS cluster, from 1 to 5. Default 1. A lost stream loses no job; the jobs
    /// are dispatched again within a minute.
    pub replicas: usize,
    /// Time after which another worker may claim a job whose worker has stopped, ms. Default 30,000: workers extend
    /// their claims three times in this time.
    pub lease_ms: u64,
    /// Estimated time in the queue of a node above which other nodes compute the meshes of its synchronous requests,
    /// ms. Default 1,000: a transfer takes some 20 ms. Nodes with the role `api` transfer all such requests.
    pub transfer_wait_ms: u64,
    /// Number of asynchronous jobs that wait for a worker; with `url`, of jobs that wait or run. Default 10,000: at 0.1
    /// s per job on two workers the last one waits for eight minutes. Further requests for jobs get a 503 with an
    /// estimated `Retry-After`.
    pub queue: usize,
}

impl Default for BrokerConfig {
    fn default() -> Self {
        Self {
            url: None,
            user: None,
            password: None,
            password_file: None,
            prefix: "molmesh".to_owned(),
            replicas: 1,
            lease_ms: 30_000,
            transfer_wait_ms: 1000,
            queue: 10_000,
        }
    }
}
