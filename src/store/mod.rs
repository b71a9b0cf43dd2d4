//! What the service keeps, by the names of contents: in a folder or on S3, bounded, and swept.
//!
//! [`Store`] is the whole interface. `backend.rs` knows where bytes lie, `index.rs` what there is and what goes first,
//! `memory.rs` keeps small results at hand, `tidy.rs` makes room, `writer.rs` takes what threads write. `lock.rs` locks
//! the data folder against a second service.
//!
//! Who writes or removes a name holds its lock (`Store::stripe`), after room has been made for it: so nobody waits for
//! room with a lock in hand. Readers hold none; what they bring back enters index and memory only if the name has not
//! changed meanwhile.

mod backend;
mod digest;
mod error;
#[cfg(test)]
pub(crate) mod faulty;
mod handle;
mod index;
mod lock;
mod memory;
mod name;
mod object;
mod s3;
mod secret;
mod stale;
mod stream;
#[cfg(test)]
mod tests;
mod tidy;
mod upload;
mod writer;

pub use digest::{BadDigest, Digest};
pub use error::StoreError;
pub use handle::Store;
pub use lock::{FolderLock, LockError};
pub use name::{BadName, Folder, Name};
pub use object::{ByteStream, Meta, Pin, Stored, Usage};
pub(crate) use secret::Secret;
pub use tidy::Swept;
pub use writer::Writer;
