//! `/v1/batches`: many structure files with one set of parameters. A batch is a list of durable jobs.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::header::{self, HeaderValue};
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use tokio::sync::watch;
use tracing::Instrument as _;

use super::batch_plan::BatchPlan;
use super::batch_request::{BatchSource, NewBatch};
use super::batch_state::{BatchCounts, BatchDocument, FoundBatch, Page, document, find};
use super::events::{FINAL_ID, LAST_EVENT_ID};
use super::guard::Caller;
use super::openapi::bodies::{ArchiveFile, BATCH_FILES};
use super::openapi::parameters::{BatchHeaders, BatchPageParameters, BatchParameters, BatchPath, LastEventIdHeader};
use super::openapi::problem_responses;
use super::parsed_request::Pairs;
use super::preferences::RequestPreferences;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::Shared;
use super::stop::{self, Stop};
use super::{delivery, json_body, upload};
use crate::jobs::{JobId, Rank, Status};
use crate::telemetry::SpanParent;

/// Urgency of the jobs of a batch at least: the lowest level, behind jobs that are sent one by one.
const URGENCY: u8 = 5;
/// Shortest time between two events.
const INTERVAL: Duration = Duration::from_secs(1);
/// Time between two events, as a multiple of the time that reading the state takes.
const INTERVAL_FACTOR: u32 = 20;

problem_responses!(CreateProblems: [BODY PARAMETERS SUBMITTING] InflatedTooLarge ArchiveUnavailable);
problem_responses!(ShowProblems: [RECORD]);
problem_responses!(DismissProblems: [RECORD] JobEnded StoreFull);

/// Start a batch
///
/// Accepts an archive of structure files, each of which gets the same parameters. `outputs` names the meshes, pictures
/// and tables of areas to make of each file. Files that cannot be used are listed with the reason; the others are
/// processed.
/// The jobs of a batch wait behind those that are sent one by one.
#[utoipa::path(post, path = "/v1/batches", tag = "jobs", operation_id = "createBatch",
    params(BatchParameters, BatchHeaders),
    request_body(content = ArchiveFile, description = BATCH_FILES, content_type = "application/octet-stream"),
    responses(
        (status = 202, description = "The batch was accepted.", body = BatchDocument,
            headers(("Location"), ("Retry-After")),
            links(
                ("batch" = (operation_id = "showBatch", parameters(("id" = "$response.body#/batchID")))),
                ("results" = (operation_id = "showBatchResults", parameters(("id" = "$response.body#/batchID")))),
                ("cancel" = (operation_id = "dismissBatch", parameters(("id" = "$response.body#/batchID")))),
            )),
        CreateProblems,
    ))]
pub(super) async fn create(
    State(app): State<Shared>,
    Pairs(mut pairs): Pairs,
    headers: HeaderMap,
    caller: Caller,
    body: Body,
) -> Result<Response, Problem> {
    let RequestPreferences { rank, idempotency_key, .. } = RequestPreferences::of(&headers, caller.client)?;
    app.admit_work(&caller)?;
    let slot = app.delivery(caller.client)?;
    let source = if upload::is_json(&headers) {
        let json = upload::receive_json(&app, &caller, &headers, body).await?;
        let members = tokio::task::spawn_blocking(move || json_body::members(&json)).await;
        let (ids, others): (Vec<_>, Vec<_>) =
            members.map_err(Problem::internal)??.into_iter().partition(|(name, _)| name == "pdb_ids");
        let [(_, ids)] = &ids[..] else {
            let problem = json_body::bad("it has no list `pdb_ids`, or more than one");
            return Err(problem.with("expected", "{\"pdb_ids\": [\"4pti\"], …}"));
        };
        pairs.extend(others);
        BatchSource::PdbIds(ids.split(',').map(|id| id.trim().to_owned()).collect())
    } else {
        // Invalid parameters are rejected before the body is received.
        BatchPlan::parse(&pairs)?.check(&app)?;
        BatchSource::Archive(Arc::new(upload::spool(&app, &caller, &headers, body).await?))
    };
    let plan = BatchPlan::parse(&pairs)?;
    plan.check(&app)?;
    let rank = Rank { batch: true, urgency: rank.urgency.max(URGENCY), ..rank };
    let (shared, payer, parent) = (Arc::clone(&app), caller.clone(), SpanParent::current());
    let batch = NewBatch { app: shared, caller: payer, source, plan, pairs, idempotency_key, rank, parent };
    // A client that disconnects now does not interrupt the acceptance.
    let record = tokio::spawn(batch.accept(slot).in_current_span()).await.map_err(Problem::internal)??;
    let mut response = answer(StatusCode::ACCEPTED, &document(&app, &record, Page::FIRST).await?);
    let location = delivery::text(&format!("/v1/batches/{}", record.id.as_str()));
    response.headers_mut().insert(header::LOCATION, location);
    Ok(response)
}

/// Get the state of a batch
#[utoipa::path(get, path = "/v1/batches/{id}", tag = "jobs", operation_id = "showBatch", params(BatchPath, BatchPageParameters),
    responses(
        (status = 200, description = "State of the batch.", body = BatchDocument, headers(("Retry-After"))),
        ShowProblems,
    ))]
pub(super) async fn show(
    State(app): State<Shared>,
    caller: Caller,
    id: JobId,
    query: Pairs,
) -> Result<Response, Problem> {
    let page = Page::parse(&query.0)?;
    let batch = find(&app, &caller, &id).await?;
    Ok(answer(StatusCode::OK, &document(&app, &batch.record, page).await?))
}

/// Cancel a batch
///
/// Cancels all jobs that have not ended, and returns the state of the batch. A batch that has ended cannot be cancelled
/// (409 `job-ended`).
#[utoipa::path(delete, path = "/v1/batches/{id}", tag = "jobs", operation_id = "dismissBatch", params(BatchPath),
    responses((status = 200, description = "The batch is cancelled.", body = BatchDocument), DismissProblems))]
pub(super) async fn dismiss(State(app): State<Shared>, caller: Caller, id: JobId) -> Result<Response, Problem> {
    let FoundBatch { record, .. } = &find(&app, &caller, &id).await?;
    let before = document(&app, record, Page::FIRST).await?;
    if before.status.is_final() && before.status != Status::Dismissed {
        let detail = format!("the batch is {} and cannot be cancelled", before.status.name());
        return Err(Problem::new(ProblemType::JobEnded, detail).with("status_name", before.status.name()));
    }
    app.job_store.dismiss_batch(record).await?;
    Ok(answer(StatusCode::OK, &document(&app, record, Page::FIRST).await?))
}

/// Follow a batch as server-sent events
///
/// Each event carries the state of the batch, without its members, as `data` and its status as `event`. The stream ends
/// with the batch.
#[utoipa::path(get, path = "/v1/batches/{id}/events", tag = "jobs", operation_id = "watchBatch",
    params(BatchPath, LastEventIdHeader),
    responses(
        (status = 200, description = "Server-sent events until the batch ends.",
            body = serde_json::Value, content_type = "text/event-stream"),
        (status = 204, description = "`Last-Event-ID` names the final event; no more events follow."),
        ShowProblems,
    ))]
pub(super) async fn events(
    State(app): State<Shared>,
    caller: Caller,
    id: JobId,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let batch = find(&app, &caller, &id).await?;
    let last = headers.get(LAST_EVENT_ID).and_then(|id| id.to_str().ok()).map_or("", str::trim);
    if last == FINAL_ID && document(&app, &batch.record, Page::NO_MEMBERS).await?.status.is_final() {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let id = last.parse().unwrap_or(0);
    let heartbeat = Duration::from_millis(app.config.server.heartbeat_ms);
    let stopping = app.stopping.clone();
    let listener = Listener { app, batch, stopping, sent: None, pause: Duration::ZERO, id };
    let events = stream::unfold(Some(listener), async |listener| listener?.next().await);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(heartbeat)).into_response())
}

/// State of one event stream. The state of the batch is read at intervals: it may have thousands of jobs, and other
/// nodes may run them.
struct Listener {
    app: Shared,
    batch: FoundBatch,
    stopping: watch::Receiver<Stop>,
    /// Counts of the last event.
    sent: Option<BatchCounts>,
    pause: Duration,
    /// Id of the last event.
    id: u64,
}

impl Listener {
    /// Returns the next event, and the listener unless it was the last one.
    async fn next(mut self) -> Option<(Result<Event, Infallible>, Option<Self>)> {
        loop {
            tokio::select! {
                () = tokio::time::sleep(self.pause) => {}
                // The stream ends with the service; clients reconnect.
                () = stop::reached(&mut self.stopping, Stop::Drain) => return None,
            }
            let begun = Instant::now();
            let read = document(&self.app, &self.batch.record, Page::NO_MEMBERS).await;
            self.pause = INTERVAL.max(begun.elapsed().saturating_mul(INTERVAL_FACTOR));
            // While the store fails, the client waits.
            let Ok(document) = read else { continue };
            if self.sent.as_ref() == Some(&document.counts) {
                continue;
            }
            self.id = self.id.saturating_add(1);
            let (status, is_last) = (document.status.name(), document.status.is_final());
            let id = if is_last { FINAL_ID.to_owned() } else { self.id.to_string() };
            let data = serde_json::to_string(&document).unwrap_or_default();
            self.sent = Some(document.counts);
            return Some((Ok(Event::default().id(id).event(status).data(data)), (!is_last).then_some(self)));
        }
    }
}

fn answer(status: StatusCode, document: &BatchDocument) -> Response {
    let mut response = (status, Json(document)).into_response();
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if !document.status.is_final() {
        response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
    }
    response
}
