//! What the service keeps, by the names of contents.

mod digest;

pub use digest::{BadDigest, Digest};
