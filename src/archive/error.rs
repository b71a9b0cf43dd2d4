//! Errors of fetching an entry, shared by all callers that waited for it.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use thiserror::Error;

use crate::structure::{ArchiveError, EntryId};
use crate::surface::{Exceeded, OutOfMemory};

/// Errors of fetching an entry.
#[derive(Debug, Clone, Error)]
pub enum FetchError {
    /// Neither the folder nor any remote archive has it.
    #[error("entry {id} is not in the archive")]
    NotFound {
        /// Requested entry.
        id: EntryId,
    },
    /// The local folder or its file cannot be read, or the file is too large.
    #[error(transparent)]
    Local(Arc<ArchiveError>),
    /// The file of the remote archive is too large.
    #[error(transparent)]
    TooLarge(Box<Exceeded>),
    /// The remote archive is unavailable, and there is no copy.
    #[error("the archive at {host} {reason}")]
    Unavailable {
        /// Host as in the configuration.
        host: String,
        /// Cause.
        reason: UnavailableReason,
        /// Time until a retry is useful; `None` if retries will not help.
        retry_after: Option<Duration>,
    },
    /// The memory limit is reached.
    #[error("entry {id} cannot be fetched now: {error}")]
    Memory {
        /// Requested entry.
        id: EntryId,
        /// Limit and use of the memory.
        error: OutOfMemory,
    },
    /// Reading could not begin in time, because all readers were busy.
    #[error("entry {id} could not be read within {} ms, because too many other structures are being read", limit.as_millis())]
    Busy {
        /// Requested entry.
        id: EntryId,
        /// Maximum time that the request may wait.
        limit: Duration,
        /// Estimated time until a reader is free.
        wait: Duration,
    },
    /// The client was fetching its share of entries for half a minute.
    #[error("entry {id} cannot be fetched now: this client is fetching {limit} entries, which is its share")]
    Share {
        /// Requested entry.
        id: EntryId,
        /// Number of entries.
        limit: usize,
    },
    /// Internal error, or the service is stopping.
    #[error("the entry could not be fetched: {0}")]
    Internal(&'static str),
}

/// Cause of a failed request to a remote archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnavailableReason {
    /// No connection: unknown name, refused, TLS error.
    Connect,
    /// Timeout.
    Timeout,
    /// The response was truncated, or its length differs from the announced one.
    Broken,
    /// The file is not a valid gzip file.
    Damaged,
    /// Unexpected HTTP status.
    Status(u16),
    /// Redirect to another host, or too many redirects.
    Redirect,
    /// The host name has only private addresses.
    Private,
    /// The circuit breaker is open after repeated failures.
    Paused,
    /// No fetch could start in time, because too many others were running.
    Busy,
    /// The HTTP client cannot be created: no certificates, invalid proxy.
    Client,
}

impl UnavailableReason {
    /// Returns true if a retry may succeed.
    #[must_use]
    pub fn is_temporary(self) -> bool {
        match self {
            Self::Connect | Self::Timeout | Self::Broken | Self::Damaged => true,
            Self::Status(status) => status == 429 || status >= 500,
            Self::Redirect | Self::Private | Self::Paused | Self::Busy | Self::Client => false,
        }
    }

    /// Returns true if the host works but declined the request, so that the circuit breaker does not count a failure.
    pub(super) fn is_host_response(self) -> bool {
        matches!(self, Self::Redirect) || matches!(self, Self::Status(status) if status < 500)
    }
}

impl fmt::Display for UnavailableReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Connect => "cannot be connected to",
            Self::Timeout => "did not respond in time",
            Self::Broken => "sent an incomplete response",
            Self::Damaged => "sent a damaged file",
            Self::Status(status) => return write!(f, "answered with status {status}"),
            Self::Redirect => "sent a redirect that is not allowed",
            Self::Private => "has a private address (archive.allow_private)",
            Self::Paused => "failed repeatedly; requests to it are paused",
            Self::Busy => "cannot be queried: too many other fetches are running",
            Self::Client => "cannot be queried from this server",
        })
    }
}
