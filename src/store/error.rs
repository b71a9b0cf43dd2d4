//! Why something could not be kept or found.

use std::error::Error as StdError;
use std::io;

use thiserror::Error;

use super::name::BadName;

/// Errors of the store. Each names the place that somebody has to look at.
#[derive(Debug, Clone, Error)]
pub enum StoreError {
    /// The store cannot be used at all.
    #[error("cannot open the store at {place} ({key}): {reason}")]
    Open {
        /// The key of the configuration that says where it is.
        key: &'static str,
        /// Where it is.
        place: String,
        /// What is wrong with it.
        reason: String,
    },
    /// One object is larger than everything together may be.
    #[error("{bytes} bytes do not fit into the store, which keeps {max_bytes} at most (store.max_bytes)")]
    TooLarge {
        /// Bytes of the object, as far as they are known.
        bytes: u64,
        /// The cap.
        max_bytes: u64,
    },
    /// There is no room, and nothing that could be removed: everything is in use.
    #[error("no room for {bytes} bytes: {held} of {max_bytes} (store.max_bytes) are held by what is in use")]
    Full {
        /// Bytes asked for.
        bytes: u64,
        /// Bytes that are held.
        held: u64,
        /// The cap.
        max_bytes: u64,
    },
    /// The disk is full, or a quota is used up.
    #[error("no space left at {place} ({op}): {reason}")]
    NoSpace {
        /// What was done.
        op: &'static str,
        /// Where.
        place: String,
        /// The system's words.
        reason: String,
    },
    /// The system or the service does not let us.
    #[error("not permitted at {place} ({op}): {reason}")]
    Denied {
        /// What was done.
        op: &'static str,
        /// Where.
        place: String,
        /// The system's words.
        reason: String,
    },
    /// A range begins behind the end, or is empty.
    #[error("bytes {start} to {end} were asked for of {size}")]
    Range {
        /// First byte.
        start: u64,
        /// The byte after the last one.
        end: u64,
        /// Bytes that there are.
        size: u64,
    },
    /// A writer got more or fewer bytes than it was promised; nothing is kept.
    #[error("{written} bytes were written where {promised} were promised")]
    Length {
        /// Bytes promised.
        promised: u64,
        /// Bytes written, as far as they were counted.
        written: u64,
    },
    /// A writer was dropped before its end; nothing is kept.
    #[error("the object was given up before its end")]
    Abandoned,
    /// Not a name.
    #[error(transparent)]
    Name(#[from] BadName),
    /// Anything else that the disk or the service says.
    #[error("the store at {place} failed ({op}): {reason}")]
    Failed {
        /// What was done.
        op: &'static str,
        /// Where.
        place: String,
        /// The words of the system or the service.
        reason: String,
    },
}

impl StoreError {
    /// Whether a later attempt may succeed: the store may answer, permit it or have space again.
    #[must_use]
    pub fn is_temporary(&self) -> bool {
        matches!(self, Self::Full { .. } | Self::NoSpace { .. } | Self::Denied { .. } | Self::Failed { .. })
    }

    /// Sorts an error of the backend at `place` by what is to be done about it.
    pub(super) fn sort(op: &'static str, place: &str, error: &(dyn StdError + 'static)) -> Self {
        use object_store::Error as Os;
        let (place, reason) = (place.to_owned(), error.to_string());
        let denied = |e: &Os| matches!(e, Os::PermissionDenied { .. } | Os::Unauthenticated { .. });
        for cause in std::iter::successors(Some(error), |e| (*e).source()) {
            if cause.downcast_ref::<Os>().is_some_and(denied) {
                return Self::Denied { op, place, reason };
            }
            match cause.downcast_ref::<io::Error>().map(io::Error::kind) {
                Some(io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded) => {
                    return Self::NoSpace { op, place, reason };
                }
                Some(io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem) => {
                    return Self::Denied { op, place, reason };
                }
                _ => {}
            }
        }
        Self::Failed { op, place, reason }
    }
}

impl From<StoreError> for io::Error {
    fn from(error: StoreError) -> Self {
        let kind = match error {
            StoreError::NoSpace { .. } | StoreError::Full { .. } => io::ErrorKind::StorageFull,
            StoreError::TooLarge { .. } => io::ErrorKind::FileTooLarge,
            StoreError::Denied { .. } => io::ErrorKind::PermissionDenied,
            _ => io::ErrorKind::Other,
        };
        Self::new(kind, error)
    }
}
