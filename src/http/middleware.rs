//! What every request goes through, outermost first. This file is the documented order:
//!
//! 1. **request id**: everything below can name the request;
//! 2. **observe**: the place in the trace, the span, one log line, metrics, `Server-Timing`; it sees the final status;
//! 3. **problems**: errors of everything below become `application/problem+json`;
//! 4. **browsers**: what they must not do with an answer, also with problems that a layer below made;
//! 5. **CORS**: answers preflights; errors below carry its headers, so that scripts can read them;
//! 6. **panics**: a panic of a handler is a 500, and the connection lives on;
//! 7. **guard**: keys, signed addresses, quotas; nothing below sees a key or a signature;
//! 8. **timeout**: a backstop above the body's timeout and the job's deadline, which are the ones that are met;
//! 9. the router. Limits of bodies, queue and memory are where the resource is used.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::{Request, State};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use futures_util::FutureExt as _;
use metrics::counter;
use tower::ServiceBuilder;

use super::kinds::Kind;
use super::problem::{self, Problem};
use super::state::Shared;
use super::{browsers, guard, observe, request_id};
use crate::telemetry::PANICS;

/// Puts the layers around `router`.
pub(super) fn apply(router: Router, timeout: Duration, app: &Shared) -> Router {
    router.layer(
        ServiceBuilder::new()
            .layer(from_fn(request_id::assign))
            .layer(from_fn_with_state(app.tracer.clone(), observe::request))
            .layer(from_fn(problem::render))
            .layer(from_fn_with_state(Arc::clone(app), browsers::restrain))
            .layer(browsers::cors(&app.access))
            .layer(from_fn(catch_panics))
            .layer(from_fn_with_state(Arc::clone(app), guard::check))
            .layer(from_fn_with_state(timeout, backstop)),
    )
}

async fn catch_panics(request: Request, next: Next) -> Response {
    match AssertUnwindSafe(next.run(request)).catch_unwind().await {
        Ok(response) => response,
        Err(_payload) => {
            // The panic hook has logged what and where.
            counter!(PANICS, "place" => "http").increment(1);
            Problem::internal("a handler panicked").into_response()
        }
    }
}

async fn backstop(State(limit): State<Duration>, request: Request, next: Next) -> Response {
    match tokio::time::timeout(limit, next.run(request)).await {
        Ok(response) => response,
        Err(_elapsed) => {
            let limit = u64::try_from(limit.as_millis()).unwrap_or(u64::MAX);
            Problem::new(Kind::Deadline, format!("no answer within {limit} ms")).with("limit", limit).into_response()
        }
    }
}
