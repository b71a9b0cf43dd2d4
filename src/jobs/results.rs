//! Storing of results: the mesh file and its report, named by their content key.

use std::io;
use std::sync::Arc;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{ContentKey, Finished};
use crate::formats::{Format, FormatError};
use crate::store::{Digest, Pin, Store, StoreError};
use crate::surface::{Exceeded, Limit};

/// File name extension of a report.
pub(crate) const REPORT: &str = "json";

/// Error of [`save`].
#[derive(Debug, Clone, Error)]
pub(crate) enum SaveError {
    /// The format cannot hold the mesh, or its file would be too large.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The store failed.
    #[error(transparent)]
    Store(StoreError),
    /// Anything else.
    #[error("{0}")]
    Other(String),
}

impl From<StoreError> for SaveError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::TooLarge(error) => {
                Self::Format(Exceeded { actual: error.actual, ..Exceeded::new(Limit::ResultBytes, error.max) }.error())
            }
            error => Self::Store(error),
        }
    }
}

impl SaveError {
    /// Returns true if a later attempt may succeed.
    pub(crate) fn is_temporary(&self) -> bool {
        matches!(self, Self::Store(error) if error.is_temporary())
    }
}

/// Size of a stored mesh, and digests of the mesh and its report, in the last line of the report's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct Sums {
    mesh_bytes: u64,
    mesh_sha256: Digest,
    report_sha256: Digest,
}

/// Returns the file of a report: the document, and a line with the digests of the document and of its mesh.
pub(super) fn report_file(mut document: Vec<u8>, mesh_bytes: u64, mesh_sha256: Digest) -> Result<Bytes, SaveError> {
    let report_sha256 = Digest::of(&document);
    document.push(b'\n');
    serde_json::to_writer(&mut document, &Sums { mesh_bytes, mesh_sha256, report_sha256 })
        .map_err(|e| SaveError::Other(e.to_string()))?;
    Ok(document.into())
}

/// Splits the file of a report into the document and the digests. `None` if it is damaged.
fn split(file: &Bytes) -> Option<(Bytes, Sums)> {
    let end = file.iter().rposition(|byte| *byte == b'\n')?;
    let sums: Sums = serde_json::from_slice(&file[end + 1..]).ok()?;
    let document = file.slice(..end);
    (Digest::of(&document) == sums.report_sha256).then_some((document, sums))
}

/// Returns the document in the file of a report; `None` if the file is damaged.
pub(crate) fn document(file: &Bytes) -> Option<Bytes> {
    split(file).map(|(document, _)| document)
}

/// Returns true if a mesh and its report are stored and undamaged. A mesh without its report counts as absent. The mesh
/// is read if this process has not checked it yet.
pub(crate) async fn is_stored(store: &Store, format: Format, key: &ContentKey) -> Result<bool, StoreError> {
    let (mesh, report) = (key.name(format.name())?, key.name(REPORT)?);
    if store.head(&mesh).await?.is_none() || store.head(&report).await?.is_none() {
        return Ok(false);
    }
    let Some((_, sums)) = store.peek(&report).await?.as_ref().and_then(split) else { return Ok(false) };
    store.is_intact(&mesh, sums.mesh_bytes, &sums.mesh_sha256).await
}

/// Stores the mesh as `format` and the report, unless both are stored already. The report comes last, because it
/// contains the digest of the mesh. They are not removed before the returned pin is dropped. Unless `is_cached`, the
/// mesh is not kept in memory.
pub(crate) async fn save(
    store: &Store,
    finished: Arc<Finished>,
    format: Format,
    key: &ContentKey,
    limit: u64,
    is_cached: bool,
) -> Result<Pin, SaveError> {
    let (mesh, report) = (key.name(format.name())?, key.name(REPORT)?);
    // Writing the report must not evict its mesh.
    let pin = store.pin(&mesh);
    if is_stored(store, format, key).await? {
        return Ok(pin);
    }
    let document = serde_json::to_vec(&finished.product.report).map_err(|e| SaveError::Other(e.to_string()))?;
    let (writing, runtime) = (store.clone(), tokio::runtime::Handle::current());
    let name = mesh.clone();
    let encode = move || {
        let file = finished.product.file(format)?;
        let bytes = file.bytes_bound();
        if bytes > limit {
            let error = Exceeded { actual: Some(bytes), ..Exceeded::new(Limit::FileBytes, limit) };
            return Err(SaveError::Format(error.error()));
        }
        let write = || {
            let mut writer = writing.writer(&name).cached(is_cached);
            file.write(&mut writer).map_err(from_io)?;
            let (mesh_bytes, mesh_sha256) = writer.finish()?;
            report_file(document.clone(), mesh_bytes, mesh_sha256)
        };
        match write() {
            Err(SaveError::Store(StoreError::NoSpace { .. })) if runtime.block_on(writing.evict_for(bytes)) => write(),
            done => done,
        }
    };
    let file = tokio::task::spawn_blocking(encode).await.map_err(|e| SaveError::Other(e.to_string()))??;
    store.set_intact(&mesh).await?;
    store.put(&report, file).await?;
    Ok(pin)
}

/// Converts an I/O error of a store writer back into the store's error.
fn from_io(error: io::Error) -> SaveError {
    match error.downcast::<StoreError>() {
        Ok(error) => error.into(),
        Err(error) => SaveError::Other(error.to_string()),
    }
}
