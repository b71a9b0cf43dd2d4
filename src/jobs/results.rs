//! Storing of results: the mesh file and its report, named by their content key.

use std::io::Write as _;
use std::sync::Arc;

use bytes::Bytes;
use thiserror::Error;

use super::{ContentKey, Finished};
use crate::formats::{Format, FormatError};
use crate::store::{Pin, Store, StoreError};

/// File name extension of a report.
pub(crate) const REPORT: &str = "json";

/// Error of [`save`].
#[derive(Debug, Clone, Error)]
pub(crate) enum SaveError {
    /// The format cannot hold the mesh.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The file would be too large.
    #[error("the file would take {bytes} bytes, the limit is {limit}")]
    TooLarge {
        /// Size of the file, bytes.
        bytes: u64,
        /// Allowed size, bytes.
        limit: u64,
    },
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Anything else.
    #[error("{0}")]
    Other(String),
}

impl SaveError {
    /// Returns true if a later attempt may succeed.
    pub(crate) fn is_temporary(&self) -> bool {
        matches!(self, Self::Store(error) if error.is_temporary())
    }
}

/// Returns true if a mesh and its report are stored. A mesh without its report counts as absent.
pub(crate) async fn is_stored(store: &Store, format: Format, key: &ContentKey) -> Result<bool, StoreError> {
    let (mesh, report) = (key.name(format.name())?, key.name(REPORT)?);
    Ok(store.head(&mesh).await?.is_some() && store.head(&report).await?.is_some())
}

/// Stores the report and the mesh as `format`, unless both are stored already. The report comes first, so that every
/// stored mesh has one. They are not removed before the returned pin is dropped.
pub(crate) async fn save(
    store: &Store,
    finished: Arc<Finished>,
    format: Format,
    key: &ContentKey,
    limit: u64,
) -> Result<Pin, SaveError> {
    let (mesh, report) = (key.name(format.name())?, key.name(REPORT)?);
    // Writing the mesh must not evict its report.
    let pin = store.pin(&mesh);
    if is_stored(store, format, key).await? {
        return Ok(pin);
    }
    let document = serde_json::to_vec(&finished.product.report).map_err(|e| SaveError::Other(e.to_string()))?;
    store.put(&report, Bytes::from(document)).await?;
    let (store, runtime) = (store.clone(), tokio::runtime::Handle::current());
    let encode = move || {
        let file = finished.product.file(format)?;
        let bytes = file.bytes_bound();
        if bytes > limit {
            return Err(SaveError::TooLarge { bytes, limit });
        }
        let write = || {
            let mut writer = store.writer(&mesh);
            file.write(&mut writer).and_then(|()| writer.flush()).map_err(from_io)?;
            Ok(writer.finish()?)
        };
        match write() {
            Err(SaveError::Store(StoreError::NoSpace { .. })) if runtime.block_on(store.evict_for(bytes)) => write(),
            done => done,
        }
    };
    tokio::task::spawn_blocking(encode).await.map_err(|e| SaveError::Other(e.to_string()))??;
    Ok(pin)
}

/// Converts an I/O error of a store writer back into the store's error.
fn from_io(error: std::io::Error) -> SaveError {
    match error.downcast::<StoreError>() {
        Ok(error) => error.into(),
        Err(error) => SaveError::Other(error.to_string()),
    }
}
