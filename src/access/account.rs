//! A quota, whom it is counted for, and how he stands.

use std::sync::Arc;
use std::time::Duration;

/// How much a client may have; none of a thing: any amount.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Quota {
    /// Requests in a window.
    pub requests: Option<u64>,
    /// Seconds in a window that workers spend on its jobs.
    pub work_s: Option<u64>,
    /// Requests at once, to the last byte of the answer.
    pub concurrent: Option<u64>,
    /// Length of a window, s, at least 1.
    pub window_s: u64,
}

impl Quota {
    /// Whether nothing is limited.
    #[must_use]
    pub fn is_unlimited(&self) -> bool {
        self.requests.is_none() && self.work_s.is_none() && self.concurrent.is_none()
    }

    /// Length of a window.
    #[must_use]
    pub fn window(&self) -> Duration {
        Duration::from_secs(self.window_s.max(1))
    }
}

/// Whom requests are counted for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Account {
    /// The client's number, which its jobs have as well.
    pub client: u64,
    /// It is a key's. Addresses, of which there may be any number, are counted apart from keys.
    pub is_key: bool,
    /// How much it may have.
    pub quota: Arc<Quota>,
}

/// How an account stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Standing {
    /// Requests in this window.
    pub requests: u64,
    /// Time in this window that workers spent.
    pub work: Duration,
    /// Requests at this moment.
    pub running: u64,
    /// Time until the next window.
    pub left: Duration,
}

/// A quota is used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exceeded {
    /// Which one, as the fields name it: `requests`, `work`, `concurrency`.
    pub policy: &'static str,
    /// How much of it there is.
    pub limit: u64,
    /// When trying again is worth it.
    pub wait: Duration,
}
