//! Configuration of the structure archive: a local folder, and a remote archive for entries that it lacks.

use std::path::PathBuf;

use reqwest::Url;
use serde::{Deserialize, Deserializer};

use super::{Templates, list};

section! {
    /// Local folder, remote archive and copies of its entries.
    ArchiveConfig;
    /// Local folder, flat or in wwPDB's `divided` layout. Default `none`: `archive` in the data folder, so that one
    /// mount is enough.
    dir: Option<PathBuf> = None;
    /// Time between checks of a local file for changes, ms. Fixed: a check costs a dozen system calls, and entries
    /// change rarely.
    #[serde(skip)]
    local_check_interval_ms: u64 = 1000;
    /// URL templates of an entry, tried in order until one has it; `none` disables the remote archive. Default:
    /// compressed mmCIF from RCSB's download service, the smallest complete format.
    #[serde(with = "list")]
    #[schemars(schema_with = "Templates::schema")]
    url: Option<Templates> = Some(Templates::default());
    /// Proxy for all requests to the remote archive. Default `none`. Environment variables such as `HTTPS_PROXY` are
    /// ignored: the check for private addresses does not apply behind a proxy, so a proxy must be set here
    /// explicitly.
    #[serde(deserialize_with = "proxy")]
    #[schemars(regex(pattern = "^(none|https?://.+)$"))]
    proxy: Option<String> = None;
    /// Allows host names that resolve to private, loopback and link-local addresses. Default false: DNS records that
    /// others control must not give access to the operator's machines. IP addresses in `url` are always allowed.
    allow_private: bool = false;
    /// Time for a connection, name resolution and TLS included, ms. Fixed: a host that needs longer is unreachable.
    #[serde(skip)]
    connect_timeout_ms: u64 = 5000;
    /// Time for the head of a response, and the longest pause within its body, ms. Fixed: archives serve stored files.
    #[serde(skip)]
    first_byte_timeout_ms: u64 = 10_000;
    /// Total time for an entry, ms: waiting for other fetches, half of it for those of the same client, all attempts
    /// and pauses. Fixed: 100 MB at 14 Mbit/s, and the time that an upload may take.
    #[serde(skip)]
    timeout_ms: u64 = 60_000;
    /// Attempts per URL, the first included. Fixed: retries only bridge temporary failures, which are no connection,
    /// timeouts, damaged files, 429 and 5xx.
    #[serde(skip)]
    attempts: u32 = 3;
    /// Longest pause before the second attempt, ms. It doubles with every further attempt, and the pause is a random
    /// part of it, so that servers do not retry in step. Fixed: callers wait meanwhile.
    #[serde(skip)]
    backoff_ms: u64 = 200;
    /// Size of an entry as sent, bytes. Fixed: the largest PDB entries have about 100 MB compressed. At most
    /// `concurrent` entries are in memory.
    #[serde(skip)]
    max_bytes: u64 = 256 << 20;
    /// Number of concurrent fetches. Fixed: public archives ask for restraint.
    #[serde(skip)]
    concurrent: usize = 8;
    /// Time for which a copy is used without revalidation, ms. Fixed to a day: entries are released and revised weekly.
    #[serde(skip)]
    revalidate_after_ms: u64 = 86_400_000;
    /// Time for which a missing entry is not requested again, ms. Fixed: a new entry is found within a minute.
    #[serde(skip)]
    retry_missing_after_ms: u64 = 60_000;
    /// Size of the copies on disk, bytes; the least recently used ones are evicted. Default 4 GiB: ten thousand typical
    /// entries.
    cache_bytes: u64 = 4 << 30;
    /// Consecutive failures after which requests to a host pause. Fixed: more than one fetch with all its attempts.
    #[serde(skip)]
    breaker_failures: u32 = 5;
    /// Length of the pause before one request tests the host, ms. Fixed: one request in this time burdens no host.
    #[serde(skip)]
    breaker_ms: u64 = 30_000;
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
