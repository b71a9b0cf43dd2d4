//! Bounded object store for inputs, jobs and results, in a folder or on S3.
//!
//! [`Store`] is the whole interface. `backend.rs` accesses folder or bucket, `index.rs` tracks objects and their use,
//! `clock.rs` gives the times of use, `memory.rs` caches small results, `eviction.rs` frees space, `upload.rs` writes
//! objects, large ones in parts, and `writer.rs` accepts data from blocking threads. `inputs.rs` checks the digests of
//! structure files, `records.rs` limits the number of job records, `quarantine.rs` keeps what is damaged, and `lock.rs`
//! protects the data folder against a second service. `shared.rs` is for stores that several nodes use.
//!
//! A write or removal reserves space first and then holds the lock of the name (`Store::write_lock`), so it never waits
//! for space under a lock. Reads take no lock. Their results enter index and cache only if the name has not changed.

mod backend;
mod check;
mod clock;
mod digest;
mod error;
mod eviction;
#[cfg(test)]
pub(crate) mod faulty;
mod handle;
mod index;
mod inputs;
#[cfg(test)]
#[cfg(feature = "shuttle")]
pub(crate) mod interleavings;
mod lock;
mod memory;
mod name;
mod namespace;
mod object;
mod quarantine;
mod records;
mod results;
mod s3;
mod secret;
mod shared;
mod stale;
mod stream;
#[cfg(test)]
mod tests;
mod upload;
mod writer;

pub use backend::link_of;
pub(crate) use digest::Hasher;
pub use digest::{BadDigest, Digest};
pub use error::StoreError;
pub use eviction::Swept;
pub use handle::Store;
pub use lock::{FolderLock, LockError};
pub(crate) use name::OWNER_DIGITS;
pub use name::{BadName, Folder, Name};
pub(crate) use namespace::derive;
pub use namespace::{BadNamespace, Namespace};
pub use object::{ByteStream, Meta, Pin, Stored, Usage};
pub(crate) use records::RecordReservation;
pub(crate) use secret::Secret;
pub use writer::Writer;
