//! `GET /v1/jobs/{id}/events`: status of a job as server-sent events. Each event holds the whole state, so a client
//! that reconnects with `Last-Event-ID` needs no earlier events.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::State;
use axum::http::header::HeaderName;
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use tokio::sync::watch;

use super::guard::Caller;
use super::jobs;
use super::openapi::parameters::{JobPath, LastEventIdHeader};
use super::openapi::problem_responses;
use super::problem::Problem;
use super::state::Shared;
use super::stop::{self, Stop};
use crate::jobs::{JobId, JobView};

/// `Last-Event-ID`.
pub(super) const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");
/// Id of the final event, on every node. Ids of other events are numbers.
pub(super) const FINAL_ID: &str = "end";

/// State of one event stream.
struct Listener {
    watched: watch::Receiver<JobView>,
    stopping: watch::Receiver<Stop>,
    /// Version of the last state that the client has.
    seen: u64,
    /// Id of the last event.
    id: u64,
    over: bool,
}

problem_responses!(EventsProblems: [RECORD]);

/// Follow a job as server-sent events
///
/// Each event carries the whole status document of the job as `data` and its status as `event`. The stream ends with
/// the job.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", tag = "jobs", operation_id = "watchJob",
    params(JobPath, LastEventIdHeader),
    responses(
        (status = 200, description = "Server-sent events until the job ends.",
            body = serde_json::Value, content_type = "text/event-stream"),
        (status = 204, description = "`Last-Event-ID` names the final event; no more events follow."),
        EventsProblems,
    ))]
pub(super) async fn show(
    State(app): State<Shared>,
    caller: Caller,
    id: JobId,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let watched = app.job_store.watch(&id, caller.namespace).await?.ok_or_else(|| jobs::no_such_job(id.as_str()))?;
    let last = headers.get(LAST_EVENT_ID).and_then(|id| id.to_str().ok()).map_or("", str::trim);
    if last == FINAL_ID && watched.borrow().record.status.is_final() {
        // A 204 stops browsers from reconnecting.
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let id = last.parse().unwrap_or(0);
    // An id from the future is that of a node whose clock is ahead: this node sends its state.
    let seen = if id <= watched.borrow().version { id } else { 0 };
    let listener = Listener { watched, stopping: app.stopping.clone(), seen, id, over: false };
    let events = stream::unfold(listener, |mut listener| async move {
        let event = listener.next().await?;
        Some((Ok::<_, Infallible>(event), listener))
    });
    let heartbeat = Duration::from_millis(app.config.server.heartbeat_ms);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(heartbeat)).into_response())
}

impl Listener {
    async fn next(&mut self) -> Option<Event> {
        if self.over {
            return None;
        }
        let seen = self.seen;
        tokio::select! {
            news = self.watched.wait_for(|view| view.version > seen || view.record.status.is_final()) => {
                let view = news.ok()?;
                (self.seen, self.over) = (view.version, view.record.status.is_final());
                // Greater than every id that the client has, although the clocks of nodes differ.
                self.id = self.id.saturating_add(1).max(view.version);
                let id = if self.over { FINAL_ID.to_owned() } else { self.id.to_string() };
                let event = Event::default().id(id).event(view.record.status.name());
                Some(event.data(serde_json::to_string(&jobs::document(&view)).unwrap_or_default()))
            }
            // The stream ends with the service; clients reconnect.
            () = stop::reached(&mut self.stopping, Stop::Drain) => None,
        }
    }
}
