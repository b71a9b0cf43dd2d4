//! Results on their way into the store: the mesh file and its report, under the key of their contents.

use std::io::Write as _;
use std::sync::Arc;

use bytes::Bytes;
use thiserror::Error;

use super::{ContentKey, Finished};
use crate::formats::{Format, FormatError};
use crate::store::{Store, StoreError};

/// The extension of a result's report.
pub const REPORT: &str = "json";

/// Why a result was not kept.
#[derive(Debug, Clone, Error)]
pub enum SaveError {
    /// No file of this format can hold the mesh.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The file would be larger than allowed.
    #[error("the file would take {bytes} bytes, the limit is {limit}")]
    TooLarge {
        /// Its length.
        bytes: u64,
        /// Bytes allowed.
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
    /// Whether the same may go well later.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::Store(error) if error.is_transient())
    }
}

/// Keeps a finished job as `format`: its report first, so that a mesh that is there has one. What is there already stays.
///
/// # Errors
/// [`SaveError`].
pub async fn save(
    store: &Store,
    finished: Arc<Finished>,
    format: Format,
    key: &ContentKey,
    limit: u64,
) -> Result<(), SaveError> {
    let (mesh, report) = (key.name(format.extension())?, key.name(REPORT)?);
    if store.head(&mesh).await?.is_some() {
        return Ok(());
    }
    let document = serde_json::to_vec(&finished.product.report).map_err(|e| SaveError::Other(e.to_string()))?;
    store.put(&report, Bytes::from(document)).await?;
    let mut writer = store.writer(&mesh, None);
    let encode = move || {
        let file = finished.product.file(format)?;
        let bytes = file.bytes_bound();
        if bytes > limit {
            return Err(SaveError::TooLarge { bytes, limit });
        }
        file.write(&mut writer).and_then(|()| writer.flush()).map_err(of_io)?;
        Ok(writer.finish()?)
    };
    tokio::task::spawn_blocking(encode).await.map_err(|e| SaveError::Other(e.to_string()))?
}

/// What a writer of the store said, in the store's own words.
fn of_io(error: std::io::Error) -> SaveError {
    match error.downcast::<StoreError>() {
        Ok(error) => error.into(),
        Err(error) => SaveError::Other(error.to_string()),
    }
}
