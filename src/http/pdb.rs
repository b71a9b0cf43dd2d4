//! `GET /v1/pdb/{id}/surface.{ext}`: the mesh of an archive entry, under an address that can be cached.

use std::time::Instant;

use super::kinds::Kind;
use super::meshes::{Pairs, pairs};
use super::problem::Problem;
use super::state::{App, Shared};
use super::{conditional, delivery};
use crate::archive::{Entry, FetchError, Why};
use crate::formats::Format;
use crate::jobs::{ContentKey, Lease, Task};
use crate::pipeline::{Job, params};
use crate::store::Digest;
use crate::structure::{ArchiveError, EntryId};
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};

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
    let id: EntryId = id.parse().map_err(|error| of_folder(&error))?;
    let short = |digest| {
        let is_mesh = !request.report;
        is_mesh.then(|| without_meshing(&app, &method, &headers, &digest, &request.job, format)).flatten()
    };
    // A client that has the mesh already is answered without touching the entry.
    if let Some(answer) = app.archive.known(&id).await.and_then(short) {
        return Ok(answer);
    }
    let (Entry { bytes, digest, .. }, lease) = fetch(&app, &id).await?;
    let received = start.elapsed();
    if let Some(answer) = short(digest) {
        return Ok(answer);
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

/// The answer to whoever has the mesh, or wants no more than its head; none where the mesh is wanted.
fn without_meshing(
    app: &App,
    method: &Method,
    headers: &HeaderMap,
    digest: &Digest,
    job: &Job,
    format: Format,
) -> Option<Response> {
    let etag = delivery::etag(&ContentKey::new(digest, job, format, app.pool.backend().name()));
    let unchanged = conditional::is_unchanged(headers, &etag);
    let caching = [(header::ETAG, etag), (header::CACHE_CONTROL, CACHE)];
    if unchanged {
        return Some((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    // What a mesh would say about itself is known only after meshing, which HEAD is not worth.
    let media_type = HeaderValue::from_static(format.media_type());
    (*method == Method::HEAD).then(|| (caching, [(header::CONTENT_TYPE, media_type)]).into_response())
}

/// An entry, and a lease of the memory that it takes.
async fn fetch(app: &App, id: &EntryId) -> Result<(Entry, Lease), Problem> {
    let mut lease = app.pool.budget().lease();
    let entry = app.archive.fetch(id).await.map_err(|error| of_archive(&error))?;
    lease.grow(entry.bytes.len() as u64)?;
    Ok((entry, lease))
}

/// The archive's errors.
fn of_archive(error: &FetchError) -> Problem {
    let detail = error.to_string();
    match error {
        FetchError::NotFound { .. } => Problem::new(Kind::NotInArchive, detail),
        FetchError::Local(error) => of_folder(error),
        FetchError::TooLarge { bytes, limit, .. } => {
            let problem = Problem::new(Kind::EntryTooLarge, detail).with("limit", *limit);
            bytes.iter().fold(problem, |problem, bytes| problem.with("actual", *bytes))
        }
        FetchError::Unavailable { host, why, retry_after } => {
            let problem = Problem::new(Kind::ArchiveUnavailable, detail).with("host", host.as_str());
            let problem = match why {
                Why::Status(status) => problem.with("found", *status),
                _ => problem,
            };
            retry_after.iter().fold(problem, |problem, wait| problem.retry_after(*wait))
        }
        FetchError::Internal(_) => Problem::internal(detail),
    }
}

/// The local folder's errors; the folder, and the paths in it, are nobody's business.
fn of_folder(error: &ArchiveError) -> Problem {
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
        ArchiveError::Io(io) => Problem::internal(format!("{error}: {io}")),
    }
}
