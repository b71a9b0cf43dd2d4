//! Quotas, the accounts that they apply to, and their usage.

use std::sync::Arc;
use std::time::Duration;

/// Length of the quota window of addresses, and of keys without their own, s: a used-up quota is restored within a
/// minute. The window begins with the client's first request, so that not all clients retry at the same time.
pub(super) const WINDOW_S: u64 = 60;

/// Limits of one client. `None` means unlimited.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Quota {
    /// Requests per window.
    pub requests: Option<u64>,
    /// Computing time of its jobs per window, s.
    pub work_s: Option<u64>,
    /// Concurrent requests, each counted until the last byte of its response.
    pub concurrent: Option<u64>,
    /// Length of the window, s, at least 1.
    pub window_s: u64,
}

impl Quota {
    /// Returns true if nothing is limited.
    #[must_use]
    pub fn is_unlimited(&self) -> bool {
        self.requests.is_none() && self.work_s.is_none() && self.concurrent.is_none()
    }

    /// Returns the length of the window, at least 1 s.
    pub(crate) fn window(&self) -> Duration {
        Duration::from_secs(self.window_s.max(1))
    }
}

/// Client whose requests are counted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Account {
    /// Number of the client, also recorded with its jobs.
    pub(crate) client: u64,
    /// True for an API key, false for an address. Addresses, of which there may be any number, are counted separately.
    pub(crate) is_key: bool,
    /// Limits of this client.
    pub(crate) quota: Arc<Quota>,
}

/// Usage of a quota in the current window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct QuotaUsage {
    /// Requests.
    pub(crate) requests: u64,
    /// Computing time.
    pub(crate) work: Duration,
    /// Requests that are running.
    pub(crate) running: u64,
    /// Time until the next window.
    pub(crate) left: Duration,
}

/// Error: a quota is used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct QuotaExceeded {
    /// Policy as named in the `RateLimit` fields: `requests`, `work` or `concurrency`.
    pub(crate) policy: &'static str,
    /// Limit of the policy.
    pub(crate) limit: u64,
    /// Time after which a retry may succeed.
    pub(crate) wait: Duration,
}
