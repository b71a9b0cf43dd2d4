//! Errors of the store.

use std::error::Error as StdError;
use std::io;

use thiserror::Error;

use super::digest::Digest;
use super::name::BadName;
use crate::surface::Exceeded;

/// Errors of the store. Each names the location concerned.
#[derive(Debug, Clone, Error)]
pub enum StoreError {
    /// The store cannot be opened.
    #[error("cannot open the store at {location} ({key}): {reason}")]
    Open {
        /// Configuration key of the location.
        key: &'static str,
        /// Location.
        location: String,
        /// Cause.
        reason: String,
    },
    /// The object is larger than the capacity of the store.
    #[error("{}", .0.message(.0.key()))]
    TooLarge(Box<Exceeded>),
    /// The store is full, and all its objects are in use.
    #[error("no space for {bytes} bytes: objects in use take {held} of {max_bytes} bytes (store.max_bytes)")]
    Full {
        /// Requested bytes.
        bytes: u64,
        /// Bytes of objects in use and of reservations.
        held: u64,
        /// Capacity of the store, bytes.
        max_bytes: u64,
    },
    /// The disk is full, or a quota is used up.
    #[error("no space left at {location} ({op}): {reason}")]
    NoSpace {
        /// Failed operation.
        op: &'static str,
        /// Location.
        location: String,
        /// Message of the system or the service.
        reason: String,
    },
    /// The system or the storage service denies access.
    #[error("not permitted at {location} ({op}): {reason}")]
    Denied {
        /// Failed operation.
        op: &'static str,
        /// Location.
        location: String,
        /// Message of the system or the service.
        reason: String,
    },
    /// The range is empty or begins after the end.
    #[error("requested bytes {start} to {end} of {size}")]
    Range {
        /// First byte.
        start: u64,
        /// End of the range, exclusive.
        end: u64,
        /// Size of the object, bytes.
        size: u64,
    },
    /// A writer is used after one of its writes failed. Nothing is stored.
    #[error("an earlier write of the object failed")]
    WriterFailed,
    /// A job record could not be read and is in quarantine.
    #[error("{name} cannot be read and is in the folder `quarantine` of the store")]
    Quarantined {
        /// Name of the record.
        name: String,
    },
    /// Another release wrote a job record, which this one cannot read.
    #[error("another release wrote the record of the job: {why}")]
    OtherRelease {
        /// Field, parameter or version that this release does not know.
        why: String,
    },
    /// A structure file is damaged and is in quarantine.
    #[error("the stored structure {digest} was damaged and is in the folder `quarantine` of the store")]
    Damaged {
        /// Digest of the undamaged file.
        digest: Digest,
    },
    /// The limit of jobs on record is reached, and all of them are open.
    #[error("{}", .0.message(.0.key()))]
    TooManyRecords(Box<Exceeded>),
    /// The name is invalid.
    #[error(transparent)]
    Name(#[from] BadName),
    /// Any other error of the disk or the storage service.
    #[error("the store at {location} failed ({op}): {reason}")]
    Failed {
        /// Failed operation.
        op: &'static str,
        /// Location.
        location: String,
        /// Message of the system or the service.
        reason: String,
    },
}

impl StoreError {
    /// Returns true if a retry may succeed: the store may become reachable or permitted, or have space again.
    #[must_use]
    pub fn is_temporary(&self) -> bool {
        matches!(self, Self::Full { .. } | Self::NoSpace { .. } | Self::Denied { .. } | Self::Failed { .. })
    }

    /// Classifies an error of the backend at `location`.
    pub(super) fn classify(op: &'static str, location: &str, error: &(dyn StdError + 'static)) -> Self {
        use object_store::Error as Os;
        let (location, reason) = (location.to_owned(), error.to_string());
        let denied = |e: &Os| matches!(e, Os::PermissionDenied { .. } | Os::Unauthenticated { .. });
        for cause in std::iter::successors(Some(error), |e| (*e).source()) {
            if cause.downcast_ref::<Os>().is_some_and(denied) {
                return Self::Denied { op, location, reason };
            }
            match cause.downcast_ref::<io::Error>().map(io::Error::kind) {
                Some(io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded) => {
                    return Self::NoSpace { op, location, reason };
                }
                Some(io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem) => {
                    return Self::Denied { op, location, reason };
                }
                _ => {}
            }
        }
        Self::Failed { op, location, reason }
    }
}

impl From<StoreError> for io::Error {
    fn from(error: StoreError) -> Self {
        let kind = match error {
            StoreError::NoSpace { .. } | StoreError::Full { .. } => io::ErrorKind::StorageFull,
            StoreError::TooLarge(_) => io::ErrorKind::FileTooLarge,
            StoreError::Denied { .. } => io::ErrorKind::PermissionDenied,
            _ => io::ErrorKind::Other,
        };
        Self::new(kind, error)
    }
}
