//! `GET /v1/pdb/{id}/surface.{ext}`: the mesh of an archive entry, under an address that can be cached.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::kinds::Kind;
use super::meshes::{Pairs, pairs};
use super::problem::Problem;
use super::state::Shared;
use super::{conditional, delivery};
use crate::formats::Format;
use crate::jobs::{ContentKey, Lease, Task};
use crate::pipeline::params;
use crate::store::Digest;
use crate::structure::{ArchiveError, EntryId};

/// Entries change a few times in their life, and then in details: a day is soon enough to notice.
const CACHE: HeaderValue = HeaderValue::from_static("public, max-age=86400, stale-while-revalidate=604800");

/// Meshes an entry.
pub(super) async fn surface(
    State(app): State<Shared>,
    method: Method,
    path: Result<Path<(String, String)>, PathRejection>,
    query: Pairs,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let start = Instant::now();
    let Path((id, file)) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let format = format_of(&file)?;
    let pairs = pairs(query)?;
    let request = params::parse(pairs)?;
    if let Some(other) = request.format {
        let value = other.extension();
        let detail = format!("parameter `format`: the address already says {}", format.extension());
        return Err(Problem::new(Kind::BadParameter, detail)
            .with("parameter", "format")
            .with("value", value)
            .with("expected", format!("no value here, or the address surface.{value}")));
    }
    params::suits(&request.job, format)?;
    let id = id.parse().map_err(|error| of_archive(&error))?;
    let (bytes, digest, lease) = fetch(Arc::clone(&app), id).await?;
    let received = start.elapsed();
    let key = ContentKey::new(&digest, &request.job, format, app.pool.backend().name());
    let etag = delivery::etag(&key);
    if !request.report {
        let caching = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, CACHE)];
        if conditional::is_unchanged(&headers, &etag) {
            return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
        }
        if method == Method::HEAD {
            // What a mesh would say about itself is known only after meshing, which HEAD is not worth.
            let media_type = HeaderValue::from_static(format.media_type());
            return Ok((caching, [(header::CONTENT_TYPE, media_type)]).into_response());
        }
    }
    let place = app.delivery()?;
    let job = request.job.clone();
    let deadline = Instant::now() + app.config.jobs.deadline();
    let (strict, lease) = (request.strict, Some(lease));
    let ticket = app.pool.submit(Task { input: bytes, digest: Some(digest), strict, job, deadline, lease })?;
    let finished = ticket.wait().await?;
    if request.report {
        return delivery::report(&finished, received);
    }
    // Another backend may have stood in for the chosen one, and its bytes are others.
    let key = ContentKey::new(&digest, &request.job, format, finished.product.report.backend);
    let mut response = delivery::mesh(&app, finished, format, &key, received, place).await?;
    response.headers_mut().insert(header::CACHE_CONTROL, CACHE);
    Ok(response)
}

/// The format that `surface.{ext}` names.
fn format_of(file: &str) -> Result<Format, Problem> {
    file.strip_prefix("surface.").and_then(|ext| Format::ALL.into_iter().find(|f| f.extension() == ext)).ok_or_else(
        || {
            let available: Vec<String> = Format::ALL.iter().map(|f| format!("surface.{}", f.extension())).collect();
            let detail = format!("an entry has no `{file}`; it has {}", available.join(", "));
            Problem::new(Kind::NotFound, detail).with("available", available)
        },
    )
}

/// Reads an entry and its digest, on a thread that may block.
async fn fetch(app: Shared, id: EntryId) -> Result<(Bytes, Digest, Lease), Problem> {
    let mut lease = app.pool.budget().lease();
    let reading = tokio::task::spawn_blocking(move || {
        let bytes = app.archive.fetch(&id)?;
        let digest = Digest::of(&bytes);
        Ok((Bytes::from(bytes), digest))
    });
    let (bytes, digest) =
        reading.await.map_err(Problem::internal)?.map_err(|error: ArchiveError| of_archive(&error))?;
    lease.grow(bytes.len() as u64)?;
    Ok((bytes, digest, lease))
}

/// The archive's errors; its folder, and the paths in it, are nobody's business.
fn of_archive(error: &ArchiveError) -> Problem {
    let detail = error.to_string();
    match error {
        ArchiveError::BadId { id } => Problem::new(Kind::BadParameter, detail)
            .with("parameter", "id")
            .with("value", id.as_str())
            .with("expected", "a PDB id such as 4pti or pdb_00004pti"),
        ArchiveError::NotFound { .. } => Problem::new(Kind::NotInArchive, detail),
        ArchiveError::TooLarge { bytes, limit, .. } => {
            Problem::new(Kind::InflatedTooLarge, detail).with("limit", *limit).with("actual", *bytes)
        }
        // The folder may be mounted later; until then it holds nothing.
        ArchiveError::Io(io) if io.kind() == std::io::ErrorKind::NotFound => {
            Problem::new(Kind::NotInArchive, "this server has no folder of structures")
        }
        ArchiveError::Io(io) => Problem::internal(format!("{error}: {io}")),
    }
}
