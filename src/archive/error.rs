//! Why an entry cannot be had, for every caller that waited for it.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use thiserror::Error;

use crate::structure::{ArchiveError, EntryId};

/// Why an entry cannot be had.
#[derive(Debug, Clone, Error)]
pub enum FetchError {
    /// Neither the folder nor any remote archive has it.
    #[error("entry {id} is not in the archive")]
    NotFound {
        /// The entry.
        id: EntryId,
    },
    /// The local folder or its file cannot be read, or the file is too large.
    #[error(transparent)]
    Local(Arc<ArchiveError>),
    /// The remote archive sends more than is allowed.
    #[error("entry {id} has more than {limit} bytes as the archive sends it")]
    TooLarge {
        /// The entry.
        id: EntryId,
        /// Bytes that the archive announced, if it did.
        bytes: Option<u64>,
        /// Bytes allowed.
        limit: u64,
    },
    /// The remote archive could not be asked, and there is no copy.
    #[error("the archive at {host} {why}")]
    Unavailable {
        /// The host, as the configuration names it.
        host: String,
        /// What happened.
        why: Why,
        /// When to try again; none where time alone will not help.
        retry_after: Option<Duration>,
    },
    /// There is no memory for it now.
    #[error("entry {id} is not fetched: {held} of {limit} bytes of memory for uploads and meshes are in use")]
    Memory {
        /// The entry.
        id: EntryId,
        /// Bytes allowed.
        limit: u64,
        /// Bytes in use.
        held: u64,
    },
    /// A defect of ours, or the service is being stopped.
    #[error("the entry could not be fetched: {0}")]
    Internal(&'static str),
}

/// What came between us and a remote archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Why {
    /// No connection: no such name, refused, no TLS.
    Connect,
    /// Nothing came in time.
    Timeout,
    /// The answer broke off, or was not as long as it said.
    Broken,
    /// What came is not the compressed file that its name promises.
    Damaged,
    /// It answered with this status.
    Status(u16),
    /// It sent us to another host, or around too often.
    Redirect,
    /// Its name leads to an address that must not be connected to.
    Private,
    /// It failed too often, and is left alone for a while.
    Paused,
    /// Too many entries were being fetched for too long.
    Busy,
    /// The client cannot be set up: no certificates, a bad proxy.
    Client,
}

impl Why {
    /// Whether another attempt may do better.
    #[must_use]
    pub fn is_temporary(self) -> bool {
        match self {
            Self::Connect | Self::Timeout | Self::Broken | Self::Damaged => true,
            Self::Status(status) => status == 429 || status >= 500,
            Self::Redirect | Self::Private | Self::Paused | Self::Busy | Self::Client => false,
        }
    }

    /// Whether the host did what hosts do, though not for us.
    pub(super) fn is_the_hosts_word(self) -> bool {
        matches!(self, Self::Redirect) || matches!(self, Self::Status(status) if status < 500)
    }
}

impl fmt::Display for Why {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Connect => "cannot be connected to",
            Self::Timeout => "does not answer in time",
            Self::Broken => "broke its answer off",
            Self::Damaged => "sent a damaged file",
            Self::Status(status) => return write!(f, "answered with status {status}"),
            Self::Redirect => "redirects to where it may not",
            Self::Private => "has an address that this server does not connect to",
            Self::Paused => "failed too often and is left alone for a while",
            Self::Busy => "is busy with other entries",
            Self::Client => "cannot be asked from this server",
        })
    }
}
