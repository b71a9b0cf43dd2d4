//! `GET /v1/results/{key}.{ext}` and `…/{key}/report.json`: what was made once, byte for byte, for ever.

use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::TryStreamExt as _;
use metrics::counter;
use serde_json::Value;
use tokio::sync::OwnedSemaphorePermit;
use tracing::Instrument as _;

use super::kinds::Kind;
use super::openapi::meshes::{Kept, NotModified};
use super::openapi::parameters::{Parts, ResultFile, ResultPath, Unchanged};
use super::openapi::refusals;
use super::problem::Problem;
use super::range::{self, Wanted};
use super::state::{App, Shared};
use super::timing::SERVER_TIMING;
use super::{conditional, delivery};
use crate::formats::Format;
use crate::jobs::{self, ContentKey, Finished, REPORT};
use crate::pipeline::Report;
use crate::telemetry::{Closing, RESULTS_NOT_KEPT, Scope};

/// The name says what the bytes are: they never change.
pub(super) const IMMUTABLE: HeaderValue = HeaderValue::from_static("public, max-age=31536000, immutable");
/// Patience with a result that is being kept at this moment.
const KEEPING: Duration = Duration::from_secs(20);

/// Where a result is found.
pub(super) fn path(key: &ContentKey, extension: &str) -> String {
    format!("/v1/results/{key}.{extension}")
}

refusals!(ShowRefusals: [[
    Kind::BadRequest, Kind::NotFound, Kind::RangeNotSatisfiable, Kind::MemoryFull, Kind::StoreFailed,
]]);
refusals!(ReportRefusals: [[Kind::BadRequest, Kind::NotFound, Kind::StoreFailed]]);

/// Get a stored mesh
///
/// Results never change. They are kept for some time after their last use.
#[utoipa::path(
    get,
    path = "/v1/results/{file}",
    tag = "results",
    operation_id = "showResult",
    params(ResultFile, Unchanged, Parts),
    responses(Kept, ShowRefusals)
)]
pub(super) async fn show(
    State(app): State<Shared>,
    method: Method,
    path: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(file) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let (key, format) = parse(&file).ok_or_else(|| none(&file))?;
    let etag = delivery::etag(&key);
    if conditional::is_unchanged(&headers, &etag) {
        return Ok(
            (StatusCode::NOT_MODIFIED, [(header::ETAG, etag), (header::CACHE_CONTROL, IMMUTABLE)]).into_response()
        );
    }
    app.kept(&key).await;
    stored(&app, &key, format, &method, &headers).await?.ok_or_else(|| none(&file))
}

/// Get the report of a stored mesh
#[utoipa::path(get, path = "/v1/results/{key}/report.json", tag = "results", operation_id = "showReport",
    params(ResultPath, Unchanged),
    responses(
        (status = 200, description = "The report of the run that computed the mesh.", body = Report,
            headers(("ETag" = String, description = "Strong validator of the document."))),
        NotModified, ReportRefusals,
    ))]
pub(super) async fn report(
    State(app): State<Shared>,
    path: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(text) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let key: ContentKey = text.parse().map_err(|_bad| none(&text))?;
    app.kept(&key).await;
    let bytes = app.store.get(&key.name(REPORT)?).await?.ok_or_else(|| none(&text))?.bytes;
    // Times are those of the run that made it, so a report has a name of its own.
    let etag =
        HeaderValue::from_str(&format!("\"{}\"", crate::store::Digest::of(&bytes))).map_err(Problem::internal)?;
    let caching = [(header::ETAG, etag.clone()), (header::CACHE_CONTROL, HeaderValue::from_static("public, no-cache"))];
    if conditional::is_unchanged(&headers, &etag) {
        return Ok((StatusCode::NOT_MODIFIED, caching).into_response());
    }
    Ok((caching, [(header::CONTENT_TYPE, "application/json")], bytes).into_response())
}

fn none(what: &str) -> Problem {
    let shown: String = what.chars().take(80).collect();
    Problem::new(
        Kind::NotFound,
        format!("there is no result `{shown}`: results are kept for some time; ask for the mesh again"),
    )
}

fn parse(file: &str) -> Option<(ContentKey, Format)> {
    let (key, extension) = file.split_once('.')?;
    let format = Format::ALL.into_iter().find(|format| format.extension() == extension)?;
    Some((key.parse().ok()?, format))
}

/// What a result's answers have in common.
#[derive(Debug)]
pub(super) struct Head {
    pub(super) headers: HeaderMap,
}

/// The answer with a result of the store, if it is there: all of it or the part that is asked for.
pub(super) async fn stored(
    app: &App,
    key: &ContentKey,
    format: Format,
    method: &Method,
    headers: &HeaderMap,
) -> Result<Option<Response>, Problem> {
    let name = key.name(format.extension())?;
    app.pool.budget().check()?;
    let Some((meta, mut body)) = app.store.read(&name, None).await? else { return Ok(None) };
    let Some(head) = head(app, key, format).await? else { return Ok(None) };
    let mut out = head.headers.clone();
    let wanted = match range::wanted(headers, &delivery::etag(key), meta.size) {
        Wanted::All => None,
        Wanted::Part(range) => Some(range),
        Wanted::Nothing => {
            return Err(Problem::new(Kind::RangeNotSatisfiable, format!("the file has {} bytes", meta.size))
                .with("actual", meta.size)
                .header(header::CONTENT_RANGE, &format!("bytes */{}", meta.size)));
        }
    };
    let length = wanted.as_ref().map_or(meta.size, |r: &Range<u64>| r.end - r.start);
    out.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    let status = match &wanted {
        Some(r) => {
            let text = format!("bytes {}-{}/{}", r.start, r.end - 1, meta.size);
            out.insert(header::CONTENT_RANGE, delivery::text(&text));
            StatusCode::PARTIAL_CONTENT
        }
        None => StatusCode::OK,
    };
    if method == Method::HEAD {
        return Ok(Some((status, out).into_response()));
    }
    if let Some(part) = wanted {
        let Some((_, part)) = app.store.read(&name, Some(part)).await? else { return Ok(None) };
        body = part;
    }
    // Pieces of bodies that have begun are held in any case; new bodies wait until there is room.
    let budget = app.pool.budget().clone();
    let charged = body.map_ok(move |piece| {
        let mut lease = budget.lease();
        lease.force(piece.len() as u64);
        lease.attach(piece)
    });
    Ok(Some((status, out, Body::from_stream(charged)).into_response()))
}

/// The headers of a result, from its report.
async fn head(app: &App, key: &ContentKey, format: Format) -> Result<Option<Arc<Head>>, Problem> {
    if let Some(head) = app.heads.get(key) {
        return Ok(Some(head));
    }
    let Some(report) = app.store.get(&key.name(REPORT)?).await? else { return Ok(None) };
    let report: Value = serde_json::from_slice(&report.bytes).map_err(Problem::internal)?;
    let mut headers = delivery::summary(&report);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(header::CONTENT_DISPOSITION, delivery::disposition(report["id"].as_str(), format));
    headers.insert(header::ETAG, delivery::etag(key));
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(header::CACHE_CONTROL, IMMUTABLE);
    headers.insert(header::CONTENT_LOCATION, delivery::text(&path(key, format.extension())));
    headers.insert(SERVER_TIMING, HeaderValue::from_static("cache;desc=hit"));
    let head = Arc::new(Head { headers });
    app.heads.insert(*key, Arc::clone(&head));
    Ok(Some(head))
}

/// Keeps the result of a synchronous request, beside the answer. False if too many are being kept already: then it is made
/// again when somebody asks for it. What is being kept at this moment is not kept twice.
pub(super) fn keep_later(app: &Shared, finished: &Arc<Finished>, format: Format, key: &ContentKey) -> bool {
    let keeping = match app.begin_keeping(key) {
        Begun::Yes(keeping) => keeping,
        Begun::Already => return true,
        Begun::NoPlace => {
            counter!(RESULTS_NOT_KEPT, "reason" => "busy").increment(1);
            return false;
        }
    };
    let (app, finished, key) = (Arc::clone(app), Arc::clone(finished), *key);
    let scope = Scope::open(&Scope::current_origin(), Instant::now());
    let keep = async move {
        let limit = app.config.limits.output_bytes;
        if let Err(error) = jobs::save(&app.store, finished, format, &key, limit).await {
            counter!(RESULTS_NOT_KEPT, "reason" => "failed").increment(1);
            tracing::warn!(%error, "a result cannot be kept");
        }
        scope.close(|| Closing::of("keep"));
        drop(keeping);
    };
    tokio::spawn(keep.in_current_span());
    true
}

impl App {
    /// Waits for a result that is being kept.
    async fn kept(&self, key: &ContentKey) {
        let waiting = self.keeping.lock().unwrap_or_else(std::sync::PoisonError::into_inner).get(key).cloned();
        if let Some(mut done) = waiting {
            // The sender never sends; it is dropped.
            drop(tokio::time::timeout(KEEPING, done.changed()).await);
        }
    }

    /// Waits until no result is being kept. Nothing new may be made by then.
    pub(super) async fn all_kept(&self) {
        let places = u32::try_from(self.config.jobs.keepers).unwrap_or(u32::MAX);
        // It is never closed.
        drop(self.keepers.acquire_many(places).await);
    }

    fn begin_keeping(self: &Arc<Self>, key: &ContentKey) -> Begun {
        let mut kept = self.keeping.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if kept.contains_key(key) {
            return Begun::Already;
        }
        let Ok(place) = Arc::clone(&self.keepers).try_acquire_owned() else { return Begun::NoPlace };
        let (done, waiting) = tokio::sync::watch::channel(());
        kept.insert(*key, waiting);
        Begun::Yes(Keeping { app: Arc::clone(self), key: *key, place: Some(place), _done: done })
    }
}

/// Whether a result is kept from now on.
enum Begun {
    Yes(Keeping),
    Already,
    NoPlace,
}

/// A result that is being kept, as long as this lives.
struct Keeping {
    app: Shared,
    key: ContentKey,
    place: Option<OwnedSemaphorePermit>,
    _done: tokio::sync::watch::Sender<()>,
}

impl Drop for Keeping {
    fn drop(&mut self) {
        // Whoever hears that it is kept finds its place free.
        drop(self.place.take());
        self.app.keeping.lock().unwrap_or_else(std::sync::PoisonError::into_inner).remove(&self.key);
    }
}
