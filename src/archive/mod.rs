//! Archive entries by id: from the local folder, else from a copy on disk, else from a remote archive.
//!
//! The folder belongs to the operator and always takes precedence. A copy is used for a day, then revalidated; if the
//! remote archive is unreachable, a stale copy is used. Concurrent requests for one entry share one fetch. Ids become
//! parts of paths and addresses only as [`EntryId`](crate::structure::EntryId)s.

mod address;
mod breaker;
mod client;
mod disk;
mod entries;
mod error;
mod files;
mod remote;

pub use entries::{Archive, Entry, Source};
pub use error::{FetchError, UnavailableReason};
