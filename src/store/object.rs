//! What the store hands out.

use std::ops::Range;
use std::time::SystemTime;

use bytes::Bytes;
use futures_util::stream::BoxStream;
use object_store::ObjectMeta;

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;

/// What is known of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Meta {
    /// Bytes.
    pub size: u64,
    /// When it was written; S3 says it to the second.
    pub modified: SystemTime,
}

impl From<&ObjectMeta> for Meta {
    fn from(meta: &ObjectMeta) -> Self {
        Self { size: meta.size, modified: meta.last_modified.into() }
    }
}

/// A whole object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stored {
    /// Its bytes.
    pub bytes: Bytes,
    /// What is known of it.
    pub meta: Meta,
}

/// The bytes of an object or of a part of it, in pieces.
pub type ByteStream = BoxStream<'static, Result<Bytes, StoreError>>;

/// What a folder holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    /// Bytes of all objects.
    pub bytes: u64,
    /// Objects.
    pub objects: u64,
}

/// Keeps a name from being tidied away; see [`Store::pin`].
#[derive(Debug)]
#[must_use = "the name is let go when the pin is dropped"]
pub struct Pin {
    store: Store,
    name: Name,
}

impl Pin {
    /// For a name that the index has noted.
    pub(super) fn new(store: Store, name: Name) -> Self {
        Self { store, name }
    }

    /// Bytes of the pinned object, which must still be the one that `meta` describes.
    pub(super) async fn piece(&self, meta: Meta, range: Range<u64>) -> Result<Bytes, StoreError> {
        self.store.piece(&self.name, meta, range).await
    }
}

impl Drop for Pin {
    fn drop(&mut self) {
        self.store.index().unpin(&self.name);
    }
}
