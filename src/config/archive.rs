//! Configuration of the structure archive: a local folder, and a remote archive for entries that it lacks.

use std::path::PathBuf;

use reqwest::Url;
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use super::{Templates, list};

/// Local folder, remote archive and copies of its entries.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ArchiveConfig {
    /// Local folder, flat or in wwPDB's `divided` layout. Default `none`: `archive` in the data folder, so that one
    /// mount is enough.
    pub dir: Option<PathBuf>,
    /// Time between checks of a local file for changes, ms. Fixed: a check costs a dozen system calls, and entries
    /// change rarely.
    #[serde(skip)]
    pub local_check_interval_ms: u64,
    /// URL templates of an entry, tried in order until one has it; `none` disables the remote archive. Default:
    /// compressed mmCIF from RCSB's download service, the smallest complete format.
    #[serde(with = "list")]
    #[schemars(schema_with = "Templates::schema")]
    pub url: Option<Templates>,
    /// Proxy for all requests to the remote archive. Default `none`. Environment variables such as `HTTPS_PROXY` are
    /// ignored: the check for private addresses does not apply behind a proxy, so a proxy must be set here
    /// explicitly.
    #[serde(deserialize_with = "proxy")]
    #[schemars(regex(pattern = "^(none|https?://.+)$"))]
    pub proxy: Option<String>,
    /// Allows host names that resolve to private, loopback and link-local addresses. Default false: DNS records that
    /// others control must not give access to the operator's machines. IP addresses in `url` are always allowed.
    pub allow_private: bool,
    /// Time for a connection, name resolution and TLS included, ms. Fixed: a host that needs longer is unreachable.
    #[serde(skip)]
    pub connect_timeout_ms: u64,
    /// Time for the head of a response, and the longest pause within its body, ms. Fixed: archives serve stored files.
    #[serde(skip)]
    pub first_byte_timeout_ms: u64,
    /// Total time for an entry, ms: waiting for other fetches, half of it for those of the same client, all attempts
    /// and pauses. Fixed: 100 MB at 14 Mbit/s, and the time that an upload may take.
    #[serde(skip)]
    pub timeout_ms: u64,
    /// Attempts per URL, the first included. Fixed: retries only bridge temporary failures, which are no connection,
    /// timeouts, damaged files, 429 and 5xx.
    #[serde(skip)]
    pub attempts: u32,
    /// Longest pause before the second attempt, ms. It doubles with every further attempt, and the pause is a random
    /// part of it, so that servers do not retry in step. Fixed: callers wait meanwhile.
    #[serde(skip)]
    pub backoff_ms: u64,
    /// Size of an entry as sent, bytes. Fixed: the largest PDB entries have about 100 MB compressed. At most
    /// `concurrent` entries are in memory.
    #[serde(skip)]
    pub max_bytes: u64,
    /// Number of concurrent fetches. Fixed: public archives ask for restraint.
    #[serde(skip)]
    pub concurrent: usize,
    /// Time for which a copy is used without revalidation, ms. Fixed to a day: entries are released and revised weekly.
    #[serde(skip)]
    pub revalidate_after_ms: u64,
    /// Time for which a missing entry is not requested again, ms. Fixed: a new entry is found within a minute.
    #[serde(skip)]
    pub retry_missing_after_ms: u64,
    /// Size of the copies on disk, bytes; the least recently used ones are evicted. Default 4 GiB: ten thousand typical
    /// entries.
    pub cache_bytes: u64,
    /// Consecutive failures after which requests to a host pause. Fixed: more than one fetch with all its attempts.
    #[serde(skip)]
    pub breaker_failures: u32,
    /// Length of the pause before one request tests the host, ms. Fixed: one request in this time burdens no host.
    #[serde(skip)]
    pub breaker_ms: u64,
}

impl Default for ArchiveConfig {
    fn default() -> Self {
        Self {
            dir: None,
            local_check_interval_ms: 1000,
            url: Some(Templates::default()),
            proxy: None,
            allow_private: false,
            connect_timeout_ms: 5000,
            first_byte_timeout_ms: 10_000,
            timeout_ms: 60_000,
            attempts: 3,
            backoff_ms: 200,
            max_bytes: 256 << 20,
            concurrent: 8,
            revalidate_after_ms: 86_400_000,
            retry_missing_after_ms: 60_000,
            cache_bytes: 4 << 30,
            breaker_failures: 5,
            breaker_ms: 30_000,
        }
    }
}

/// Deserializes the URL of a proxy.
fn proxy<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    let proxy: Option<String> = Option::deserialize(deserializer)?;
    let is_valid = |url: Url| ["http", "https"].contains(&url.scheme()) && url.has_host();
    if proxy.as_ref().is_none_or(|text| text.parse().is_ok_and(is_valid)) {
        Ok(proxy)
    } else {
        Err(serde::de::Error::custom("none, or http(s)://host:port"))
    }
}
