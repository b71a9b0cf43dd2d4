//! Settings of the broker, which dispatches asynchronous jobs.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Dispatch of asynchronous jobs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BrokerConfig {
    /// Number of asynchronous jobs that wait for a worker. Default 10,000: at 0.1 s per job on two workers the last one
    /// waits for eight minutes. Further requests for jobs get a 503 with an estimated `Retry-After`.
    pub queue: usize,
}

impl Default for BrokerConfig {
    fn default() -> Self {
        Self { queue: 10_000 }
    }
}
