//! Where structures are looked up by PDB id: a folder, and an archive that is asked over HTTP for what it lacks.

use std::path::PathBuf;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{ProxyUrl, Templates};

/// The folder of structures, the remote archive, and the copies that are kept of it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ArchiveConfig {
    /// The folder, flat or in wwPDB's `divided` layout. Default `none`: `archive` in the data folder, so that one folder is
    /// all that an operator has to mount.
    pub dir: Option<PathBuf>,
    /// How long a file of the folder is believed to be as it was, ms. Default 1,000: looking at it again costs a
    /// dozen system calls, and nobody replaces an entry more often.
    pub check_ms: u64,
    /// Addresses of an entry, asked in order until one has it; `none` asks nobody. Default: compressed mmCIF from
    /// RCSB's download service, the smallest of the complete forms.
    pub url: Option<Templates>,
    /// A proxy for every remote request. Default `none`. The variables of the environment (`HTTPS_PROXY` and the
    /// like) are not looked at: with a proxy it is the proxy that connects, so that the check of addresses is the
    /// proxy's too, which should be somebody's decision.
    pub proxy: Option<ProxyUrl>,
    /// Whether names may lead to private, loopback and link-local addresses. Default false: who controls a name must
    /// not choose among the operator's own machines. Addresses that `url` writes out as numbers are always allowed.
    pub allow_private: bool,
    /// Time for a connection, name and TLS included, ms. Default 5,000.
    pub connect_timeout_ms: u64,
    /// Time for the head of an answer, and the longest pause within its body, ms. Default 10,000: archives build
    /// nothing on request.
    pub first_byte_timeout_ms: u64,
    /// Time for an entry altogether, ms: waiting for a place, every attempt, every pause. Default 60,000: 100 MB at
    /// 14 Mbit/s.
    pub timeout_ms: u64,
    /// Attempts for each address, the first included. Default 3. Only what may pass is tried again: no connection,
    /// timeouts, 429 and 5xx.
    pub attempts: u32,
    /// Longest pause before the second attempt, ms; it doubles with every further one, and the pause is a random part
    /// of it, so that many servers do not come back at once. Default 200.
    pub backoff_ms: u64,
    /// Longest wait that the archive may ask for with `Retry-After` before it counts as out of reach until then, ms.
    /// Default 5,000: callers wait meanwhile.
    pub retry_after_ms: u64,
    /// Bytes of an entry as it is sent. Default 256 MiB, as for uploads. They are held in memory, `concurrent` times
    /// at most.
    pub max_bytes: u64,
    /// Entries that are fetched at once. Default 8: public archives ask for restraint.
    pub concurrent: usize,
    /// How long a copy is used without asking again, ms. Default 86,400,000, a day: entries are released and revised
    /// weekly.
    pub fresh_ms: u64,
    /// How long an entry that nobody has is not asked for again, ms. Default 60,000.
    pub absent_ms: u64,
    /// Bytes of copies on disk; those not used for longest go first. Default 4 GiB: ten thousand entries of the
    /// usual size.
    pub cache_bytes: u64,
    /// Failures in a row after which a host is left alone. Default 5.
    pub breaker_failures: u32,
    /// How long it is left alone before one request tries again, ms. Default 30,000.
    pub breaker_ms: u64,
}

impl Default for ArchiveConfig {
    fn default() -> Self {
        Self {
            dir: None,
            check_ms: 1000,
            url: Some(Templates::default()),
            proxy: None,
            allow_private: false,
            connect_timeout_ms: 5000,
            first_byte_timeout_ms: 10_000,
            timeout_ms: 60_000,
            attempts: 3,
            backoff_ms: 200,
            retry_after_ms: 5000,
            max_bytes: 256 << 20,
            concurrent: 8,
            fresh_ms: 86_400_000,
            absent_ms: 60_000,
            cache_bytes: 4 << 30,
            breaker_failures: 5,
            breaker_ms: 30_000,
        }
    }
}

impl ArchiveConfig {
    /// How long a file of the folder is believed to be as it was.
    #[must_use]
    pub fn check(&self) -> Duration {
        Duration::from_millis(self.check_ms)
    }

    /// Time for a connection.
    #[must_use]
    pub fn connect_timeout(&self) -> Duration {
        Duration::from_millis(self.connect_timeout_ms)
    }

    /// Time for the head of an answer, and the longest pause within its body.
    #[must_use]
    pub fn first_byte_timeout(&self) -> Duration {
        Duration::from_millis(self.first_byte_timeout_ms)
    }

    /// Time for an entry altogether.
    #[must_use]
    pub fn timeout(&self) -> Duration {
        Duration::from_millis(self.timeout_ms)
    }

    /// Longest pause before the second attempt.
    #[must_use]
    pub fn backoff(&self) -> Duration {
        Duration::from_millis(self.backoff_ms)
    }

    /// Longest wait that is granted to a `Retry-After`.
    #[must_use]
    pub fn retry_after(&self) -> Duration {
        Duration::from_millis(self.retry_after_ms)
    }

    /// How long a copy is used without asking again.
    #[must_use]
    pub fn fresh(&self) -> Duration {
        Duration::from_millis(self.fresh_ms)
    }

    /// How long an entry that nobody has is not asked for again.
    #[must_use]
    pub fn absent(&self) -> Duration {
        Duration::from_millis(self.absent_ms)
    }

    /// How long a host that fails is left alone.
    #[must_use]
    pub fn breaker(&self) -> Duration {
        Duration::from_millis(self.breaker_ms)
    }
}
