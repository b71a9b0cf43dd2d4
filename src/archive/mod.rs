//! The id of an entry to the bytes of its file: from the local folder, from a copy on disk, from a remote archive, in
//! this order.
//!
//! The folder is the operator's and always right. A copy is used as it is for a day, then asked about; where the
//! archive cannot be reached it serves for longer. Whoever asks for an entry that is being fetched waits for that one
//! fetch. Ids become parts of paths and addresses only as [`EntryId`](crate::structure::EntryId)s.

mod address;
mod breaker;
mod client;
mod disk;
mod entries;
mod error;
mod flight;
mod memory;
mod remote;
mod whole;

pub use entries::{Archive, Entry, Source};
pub use error::{FetchError, Why};
pub use memory::{Memory, NoMemory, Share, Uncounted};
