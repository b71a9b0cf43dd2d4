//! Objects, metadata and pins.

use std::time::SystemTime;

use bytes::Bytes;
use futures_util::stream::BoxStream;
use object_store::ObjectMeta;

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;

/// Metadata of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Meta {
    /// Size, bytes.
    pub size: u64,
    /// Time of the last write. S3 has a resolution of one second.
    pub modified: SystemTime,
}

impl From<&ObjectMeta> for Meta {
    fn from(meta: &ObjectMeta) -> Self {
        Self { size: meta.size, modified: meta.last_modified.into() }
    }
}

/// Object with its metadata.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stored {
    /// Content.
    pub bytes: Bytes,
    /// Metadata.
    pub meta: Meta,
}

/// Stream of the bytes of an object or of a range of it.
pub type ByteStream = BoxStream<'static, Result<Bytes, StoreError>>;

/// Usage of a folder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Total size of its objects, bytes.
    pub bytes: u64,
    /// Number of objects.
    pub objects: u64,
}

/// Protects an object from eviction; see [`Store::pin`].
#[derive(Debug)]
#[must_use = "dropping the pin releases the name"]
pub struct Pin {
    pub(super) store: Store,
    pub(super) name: Name,
}

impl Drop for Pin {
    fn drop(&mut self) {
        self.store.index().unpin(&self.name);
    }
}
