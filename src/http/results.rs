//! `GET /v1/results/{key}.{ext}` and `…/{key}/report.json`: stored results, byte for byte.

use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures_util::stream::BoxStream;
use futures_util::{StreamExt as _, TryStreamExt as _};
use metrics::counter;
use serde_json::Value;
use tracing::Instrument as _;

use super::guard::Caller;
use super::openapi::meshes::{NotModified, StoredMesh};
use super::openapi::parameters::{ConditionHeaders, RangeHeaders, ResultFile, ResultPath};
use super::openapi::problem_responses;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::{App, Shared};
use super::timing::SERVER_TIMING;
use super::{conditional, delivery};
use crate::formats::Format;
use crate::jobs::{self, ContentKey, Finished, REPORT};
use crate::pipeline::Report;
use crate::store::{ByteStream, Namespace, StoreError};
use crate::telemetry::{RESULTS_NOT_STORED, SpanKind, SpanParent, TraceSpan};

/// Caching of results, whose bytes follow from their key.
pub(super) const IMMUTABLE: HeaderValue = HeaderValue::from_static("public, max-age=31536000, immutable");
/// Maximum wait for a result that is being stored.
const MAX_SAVE_WAIT: Duration = Duration::from_secs(20);

/// Returns the address of a result.
pub(super) fn path(key: &ContentKey, extension: &str) -> String {
    format!("/v1/results/{key}.{extension}")
}

problem_responses!(ShowProblems: [PARAMETERS]
    NotFound PreconditionFailed RangeNotSatisfiable MemoryFull ShareExceeded StoreFailed
);
problem_responses!(ReportProblems: [PARAMETERS] NotFound PreconditionFailed StoreFailed);

/// Get a stored mesh
///
/// Results never change. They are kept for some time after their last use.
#[utoipa::path(
    get,
    path = "/v1/results/{file}",
    tag = "results",
    operation_id = "showResult",
    params(ResultFile, ConditionHeaders, RangeHeaders),
    responses(StoredMesh, ShowProblems)
)]
pub(super) async fn show(
    State(app): State<Shared>,
    caller: Caller,
    method: Method,
    path: Result<Path<String>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path(file) = path?;
    let (key, format) = parse(&file, caller.namespace).ok_or_else(|| no_such_result(&file))?;
    let etag = delivery::etag(&key);
    let expected = conditional::check_match(&headers, &etag);
    let is_unchanged = expected.is_ok() && conditional::is_unchanged(&headers, &etag);
    let not_modified =
        || (StatusCode::NOT_MODIFIED, [(header::ETAG, etag), (header::CACHE_CONTROL, IMMUTABLE)]).into_response();
    // A client that names the tag of a result has it, even if it is no longer stored.
    if is_unchanged && !conditional::names_any(&headers) {
        return Ok(not_modified());
    }
    wait_for_save(&app, &key).await;
    // `If-None-Match` comes before `Range`.
    let (method, sent) = if is_unchanged { (Method::HEAD, HeaderMap::new()) } else { (method, headers) };
    let found = stored(&app, &caller, &key, format, &method, &sent).await?.ok_or_else(|| no_such_result(&file))?;
    expected.map(|()| if is_unchanged { not_modified() } else { found })
}

/// Get the report of a stored mesh
#[utoipa::path(get, path = "/v1/results/{key}/report.json", tag = "results", operation_id = "showReport",
    params(ResultPath, ConditionHeaders),
    responses(
        (status = 200, description = "The report of the run that computed the mesh.", body = Report, headers(("ETag"))),
        NotModified, ReportProblems,
    ))]
pub(super) async fn report(
    State(app): State<Shared>,
    caller: Caller,
    path: Result<Path<String>, PathRejection>,
) -> Result<Response, Problem> {
    let Path(text) = path?;
    let key = ContentKey::parse(&text, caller.namespace).map_err(|_bad| no_such_result(&text))?;
    wait_for_save(&app, &key).await;
    let stored = app.store.get(&key.name(REPORT)?).await?;
    let bytes = stored.and_then(|stored| jobs::document(&stored.bytes)).ok_or_else(|| no_such_result(&text))?;
    // A report holds the times of one run, so its validator is its own digest, not its key.
    let headers = [(header::CACHE_CONTROL, "public, no-cache"), (header::CONTENT_TYPE, "application/json")];
    Ok((headers, bytes).into_response())
}

fn no_such_result(what: &str) -> Problem {
    let shown: String = what.chars().take(80).collect();
    Problem::new(
        ProblemType::NotFound,
        format!("there is no result `{shown}`: results are stored for some time; request the mesh again"),
    )
}

/// Parses the name of the file of a result.
pub(super) fn parse(file: &str, namespace: Namespace) -> Option<(ContentKey, Format)> {
    let (key, extension) = file.split_once('.')?;
    let format = Format::ALL.into_iter().find(|format| format.name() == extension)?;
    Some((ContentKey::parse(key, namespace).ok()?, format))
}

/// Returns a stored result, or the requested range of it; `None` if it is not stored.
pub(super) async fn stored(
    app: &App,
    caller: &Caller,
    key: &ContentKey,
    format: Format,
    method: &Method,
    headers: &HeaderMap,
) -> Result<Option<Response>, Problem> {
    let name = key.name(format.name())?;
    app.pool.settings().budget.check()?;
    let Some((meta, mut body)) = app.store.read(&name, None).await? else { return Ok(None) };
    if !app.store.is_known_intact(&name, meta) && !jobs::is_stored(&app.store, format, key).await? {
        return Ok(None);
    }
    let Some(headers_of_result) = result_headers(app, key, format).await? else { return Ok(None) };
    let mut out = HeaderMap::clone(&headers_of_result);
    let (part, status, more) = delivery::requested_part(headers, &delivery::etag(key), meta.size)?;
    out.extend(more);
    out.insert(header::CONTENT_LENGTH, HeaderValue::from(part.end - part.start));
    if method == Method::HEAD {
        return Ok(Some((status, out).into_response()));
    }
    if status == StatusCode::PARTIAL_CONTENT {
        let Some((_, part)) = app.store.read(&name, Some(part)).await? else { return Ok(None) };
        body = part;
    }
    let share = app.delivery_shares.take(caller.client.0)?;
    // The share is held until the body is dropped.
    let charged = charged(app, caller, body).inspect_ok(move |_| _ = &share);
    Ok(Some((status, out, Body::from_stream(charged)).into_response()))
}

/// Returns the size of a stored result in bytes, and its pieces, which are charged to the memory of a client; `None` if
/// it is not stored.
pub(super) async fn read(
    app: &App,
    caller: &Caller,
    key: &ContentKey,
    format: Format,
) -> Result<Option<(u64, BoxStream<'static, Result<Bytes, StoreError>>)>, Problem> {
    if !jobs::is_stored(&app.store, format, key).await? {
        return Ok(None);
    }
    let Some((meta, body)) = app.store.read(&key.name(format.name())?, None).await? else { return Ok(None) };
    Ok(Some((meta.size, charged(app, caller, body))))
}

/// Charges pieces of running responses regardless of the limit. While it is exceeded, new responses are rejected.
fn charged(app: &App, caller: &Caller, body: ByteStream) -> BoxStream<'static, Result<Bytes, StoreError>> {
    let budget = app.memory(caller.client);
    let charge = move |piece: Bytes| {
        let reservation = budget.reservation();
        reservation.force(piece.len() as u64);
        reservation.attach(piece)
    };
    body.map_ok(charge).boxed()
}

/// Returns the headers of a result, from its report.
async fn result_headers(app: &App, key: &ContentKey, format: Format) -> Result<Option<Arc<HeaderMap>>, Problem> {
    if let Some(headers) = app.result_headers.get(key) {
        return Ok(Some(headers));
    }
    let stored = app.store.get(&key.name(REPORT)?).await?;
    let Some(report) = stored.and_then(|stored| jobs::document(&stored.bytes)) else { return Ok(None) };
    let report: Value = serde_json::from_slice(&report).map_err(Problem::internal)?;
    let mut headers = delivery::summary_headers(&report);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()));
    headers.insert(header::CONTENT_DISPOSITION, delivery::disposition(report["id"].as_str(), format));
    headers.insert(header::ETAG, delivery::etag(key));
    headers.insert(header::CACHE_CONTROL, IMMUTABLE);
    headers.insert(header::CONTENT_LOCATION, delivery::text(&path(key, format.name())));
    headers.insert(SERVER_TIMING, HeaderValue::from_static("cache;desc=hit"));
    let headers = Arc::new(headers);
    app.result_headers.insert(*key, Arc::clone(&headers));
    Ok(Some(headers))
}

/// Stores the result of a synchronous request in the background. Returns false, and stores nothing, if too many results
/// are being stored already: [`concurrent_saves`](crate::config::JobsConfig), or one while jobs wait for a worker. The
/// mesh is encoded a second time: with a copy of the response, a slow client would delay the store, or a slow store the
/// client.
pub(super) fn save_later(app: &Shared, finished: &Arc<Finished>, format: Format, key: &ContentKey) -> bool {
    let _starting = app.save_start.lock().unwrap_or_else(PoisonError::into_inner);
    if app.saves.running(key).is_some() {
        return true;
    }
    let one_runs = app.save_permits.available_permits() < app.config.jobs.concurrent_saves;
    let may_start = !one_runs || !app.pool.has_waiting();
    let permit = may_start.then(|| Arc::clone(&app.save_permits).try_acquire_owned());
    let Some(Ok(permit)) = permit else {
        counter!(RESULTS_NOT_STORED, "reason" => "busy").increment(1);
        return false;
    };
    let (shared, finished, saved) = (Arc::clone(app), Arc::clone(finished), *key);
    let span = TraceSpan::start(&SpanParent::current(), "save", SpanKind::Internal, Instant::now());
    let save = async move {
        let limit = shared.config.limits.output_bytes;
        if let Err(error) = jobs::save(&shared.store, finished, format, &saved, limit, true).await {
            counter!(RESULTS_NOT_STORED, "reason" => "failed").increment(1);
            tracing::warn!(%error, "cannot store a result");
        }
        span.end();
        drop(permit);
    };
    drop(app.saves.run(key, || save.in_current_span()));
    true
}

/// Waits while a result is being stored.
async fn wait_for_save(app: &App, key: &ContentKey) {
    if let Some(mut saved) = app.saves.running(key) {
        drop(tokio::time::timeout(MAX_SAVE_WAIT, saved.recv()).await);
    }
}

/// Returns true if a result that is being stored will be found at its address. `headers` are those of its response.
/// Waits until it is stored only if the space may not suffice.
pub(super) async fn will_be_stored(app: &App, key: &ContentKey, format: Format, headers: &HeaderMap) -> bool {
    let bytes = headers.get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    if let Some(bytes) = bytes
        && app.store.has_space(bytes).await
    {
        return true;
    }
    wait_for_save(app, key).await;
    // The store has logged its error. The mesh is sent without its address.
    jobs::is_stored(&app.store, format, key).await.unwrap_or(false)
}

/// Waits until no result is being stored. No new results may be computed by then.
pub(super) async fn all_saved(app: &App) {
    let permits = u32::try_from(app.config.jobs.concurrent_saves).unwrap_or(u32::MAX);
    // The semaphore is never closed.
    drop(app.save_permits.acquire_many(permits).await);
}

/// Returns the number of results that are being stored.
pub(super) fn unsaved(app: &App) -> usize {
    app.config.jobs.concurrent_saves - app.save_permits.available_permits()
}
