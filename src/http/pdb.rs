//! `GET /v1/pdb/{id}/surface.{ext}`: the mesh of an archive entry, under an address that can be cached.

use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{Extensions, HeaderValue, Method};
use axum::response::{IntoResponse, Response};

use super::ask::{Ask, Input};
use super::declared::Declared;
use super::delivery;
use super::kinds::Kind;
use super::meshes::{Pairs, pairs};
use super::openapi::meshes::{Addressed, Reported};
use super::openapi::parameters::{EntryPath, MeshParameters, Parts, SurfaceParameters, Unchanged, Wishes};
use super::openapi::problems::{ASKING, MESHING, PARAMETERS, READING};
use super::openapi::refusals;
use super::problem::Problem;
use super::state::{App, Shared};
use super::timing::Timing;
use super::wish::Wish;
use crate::archive::{Entry, FetchError, Memory, NoMemory, Share, Why};
use crate::formats::Format;
use crate::jobs::{Budget, Exhausted, Lease};
use crate::pipeline::params;
use crate::store::Digest;
use crate::structure::{ArchiveError, EntryId};

/// Entries change a few times in their life, and then in details: a day is soon enough to notice.
pub(super) const CACHE: HeaderValue = HeaderValue::from_static("public, max-age=86400, stale-while-revalidate=604800");

refusals!(SurfaceRefusals: [PARAMETERS, READING, MESHING, ASKING, [
    Kind::NotFound, Kind::NotInArchive, Kind::EntryTooLarge, Kind::RangeNotSatisfiable, Kind::ArchiveUnavailable,
]]);

/// Mesh an archive entry
///
/// The path names the format, so that the response can be cached and linked to.
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/{file}",
    tag = "meshes",
    operation_id = "meshEntry",
    params(EntryPath, SurfaceParameters, Wishes, Unchanged, Parts),
    responses(Addressed, SurfaceRefusals)
)]
pub(super) async fn surface(
    State(app): State<Shared>,
    method: Method,
    path: Result<Path<(String, String)>, PathRejection>,
    query: Pairs,
    headers: HeaderMap,
    extensions: Extensions,
) -> Result<Response, Problem> {
    let Path((id, file)) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let named = named(&app, Some(&file), query)?;
    answer(&app, &method, &id, named, &headers, &extensions).await
}

refusals!(ReportRefusals: [PARAMETERS, READING, MESHING, [
    Kind::NotInArchive, Kind::EntryTooLarge, Kind::ArchiveUnavailable, Kind::QueueFull, Kind::TooManyDeliveries,
]]);

/// Mesh an archive entry and return the report
#[utoipa::path(
    get,
    path = "/v1/pdb/{id}/report.json",
    tag = "meshes",
    operation_id = "reportEntry",
    params(EntryPath, MeshParameters),
    responses(Reported, ReportRefusals)
)]
pub(super) async fn report(
    State(app): State<Shared>,
    method: Method,
    path: Result<Path<String>, PathRejection>,
    query: Pairs,
    headers: HeaderMap,
    extensions: Extensions,
) -> Result<Response, Problem> {
    let Path(id) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let named = named(&app, None, query)?;
    answer(&app, &method, &id, named, &headers, &extensions).await
}

/// Answers a request for the mesh or the report of an entry.
async fn answer(
    app: &Shared,
    method: &Method,
    id: &str,
    named: Named,
    headers: &HeaderMap,
    extensions: &Extensions,
) -> Result<Response, Problem> {
    let mut timing = Timing::start();
    let id: EntryId = id.parse().map_err(|error| of_folder(&error))?;
    let digest = digest(app, &id).await?;
    let wish = Wish::of(headers, extensions)?;
    timing.lap("receive");
    let mut ask = named.ask(digest, wish, timing);
    if let Some(response) = ask.answer_without_work(app, method, headers).await? {
        return Ok(response);
    }
    ask.timing.lap("lookup");
    let input = input(app, &id).await?;
    ask.timing.lap("load");
    ask.make(app, input).await
}

/// What an address asks for.
pub(super) struct Named {
    pub(super) request: params::Request,
    pub(super) pairs: Vec<(String, String)>,
    pub(super) format: Format,
    pub(super) report: bool,
}

impl Named {
    /// What is asked of the structure with this digest; `timing` says how long that took to be known.
    pub(super) fn ask(self, digest: Digest, wish: Wish, timing: Timing) -> Ask {
        let Self { request, pairs, format, report } = self;
        Ask { digest, request, pairs, format, wish, report, cache: Some(CACHE), timing, declared: Declared::Neutral }
    }
}

/// Parses the request behind a path that ends in `surface.{ext}`, or in `report.json` (`file` is `None`).
pub(super) fn named(app: &App, file: Option<&str>, query: Pairs) -> Result<Named, Problem> {
    let format = file.map(format_of).transpose()?;
    let pairs = pairs(query)?;
    let mut request = params::parse(pairs.iter().map(|(n, v)| (n, v)))?;
    if let (Some(format), Some(other)) = (format, request.format) {
        let value = other.extension();
        let detail = format!("parameter `format`: the address already says {}", format.extension());
        return Err(Problem::new(Kind::BadParameter, detail)
            .with("parameter", "format")
            .with("value", value)
            .with("expected", format!("no value here, or the address surface.{value}")));
    }
    let report = format.is_none();
    let format = format.or(request.format).unwrap_or_default();
    params::settle(&mut request.job, format)?;
    app.accepts(&request.job)?;
    Ok(Named { request, pairs, format, report })
}

impl Ask {
    /// The answer that needs no mesh to be made: a known result, or that a `HEAD` gets.
    pub(super) async fn answer_without_work(
        &self,
        app: &Shared,
        method: &Method,
        headers: &HeaderMap,
    ) -> Result<Option<Response>, Problem> {
        if let Some(response) = self.known(app, method, headers).await? {
            return Ok(Some(response));
        }
        if method != Method::HEAD || self.report {
            return Ok(None);
        }
        // What a mesh would say about itself is known only after meshing, which HEAD is not worth.
        let media_type = HeaderValue::from_static(self.format.media_type());
        let mut response = [(header::CONTENT_TYPE, media_type)].into_response();
        response.headers_mut().insert(header::ETAG, delivery::etag(&self.key(app)));
        if let Some(cache) = &self.cache {
            response.headers_mut().insert(header::CACHE_CONTROL, cache.clone());
        }
        Ok(Some(response))
    }
}

/// The format that `surface.{ext}` names.
fn format_of(file: &str) -> Result<Format, Problem> {
    file.strip_prefix("surface.").and_then(|ext| Format::ALL.into_iter().find(|f| f.extension() == ext)).ok_or_else(
        || {
            let available: Vec<String> = Format::ALL.iter().map(|f| format!("surface.{}", f.extension())).collect();
            let detail = format!("a structure has no `{file}`; it has {}", available.join(", "));
            Problem::new(Kind::NotFound, detail).with("available", available)
        },
    )
}

/// The digest of an entry's file.
pub(super) async fn digest(app: &Shared, id: &EntryId) -> Result<Digest, Problem> {
    app.archive.digest(id).await.map_err(|error| of_archive(&error))
}

/// An entry's file.
pub(super) async fn input(app: &Shared, id: &EntryId) -> Result<Input, Problem> {
    let Entry { bytes, digest, .. } = app.archive.fetch(id).await.map_err(|error| of_archive(&error))?;
    Input::new(app, bytes, digest)
}

/// The service's memory, for what an archive sends.
#[derive(Debug)]
pub(super) struct Fetching(pub(super) Budget);

impl Memory for Fetching {
    fn begin(&self) -> Box<dyn Share> {
        Box::new(self.0.lease())
    }
}

impl Share for Lease {
    fn grow(&mut self, bytes: u64) -> Result<(), NoMemory> {
        Self::grow(self, bytes).map_err(|Exhausted { limit, held }| NoMemory { limit, held })
    }
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
        FetchError::Memory { limit, held, .. } => Exhausted { limit: *limit, held: *held }.into(),
        FetchError::Internal(_) => Problem::internal(detail),
    }
}

/// The local folder's errors; the folder, and the paths in it, are nobody's business.
pub(super) fn of_folder(error: &ArchiveError) -> Problem {
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
