//! Middleware of every request, outermost first:
//!
//! 1. **request id**, which everything below uses;
//! 2. **observe**: trace context, span, log line, metrics, `Server-Timing`; sees the final status;
//! 3. **problems**: errors of everything below become `application/problem+json`;
//! 4. **browsers**: security headers, also on problems of the layers below;
//! 5. **CORS**: answers preflights and adds headers, also to errors of the layers below;
//! 6. **panics**: a panic of a handler becomes a 500, and the connection stays open;
//! 7. **operations**: records the scope that the operation needs;
//! 8. **origin**: rejects other hosts and pages of other sites;
//! 9. **guard**: keys, signed URLs, quotas; removes keys and signatures from the request;
//! 10. **timeout**: a backstop above the body timeout and the job deadline;
//! 11. **reject parameters** (in `router`): rejects query parameters of operations that have none;
//! 12. **relabel** (in `router`): sends a mesh as bytes if `Accept` prefers them;
//! 13. **codings** (in `router`): compresses the response for clients that accept it;
//! 14. **validate** (in `router`): adds an `ETag` to documents, and answers clients that have them;
//! 15. the router. Limits of bodies, queue and memory apply where the resource is used.

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

use super::problem::{self, Problem};
use super::problem_types::ProblemType;
use super::state::Shared;
use super::{browsers, guard, observe, operations, origin, request_id};
use crate::telemetry::PANICS;

/// Adds the layers to `router`.
pub(super) fn apply(router: Router, timeout: Duration, app: &Shared) -> Router {
    router.layer(
        ServiceBuilder::new()
            .layer(from_fn(request_id::assign))
            .layer(from_fn_with_state(app.tracer.clone(), observe::request))
            .layer(from_fn(problem::render))
            .layer(from_fn_with_state(Arc::clone(app), browsers::restrain))
            .layer(browsers::cors(&app.access))
            .layer(from_fn(catch_panics))
            .layer(from_fn(operations::require_scope))
            .layer(from_fn_with_state(Arc::clone(app), origin::check))
            .layer(from_fn_with_state(Arc::clone(app), guard::check))
            .layer(from_fn_with_state(timeout, backstop)),
    )
}

async fn catch_panics(request: Request, next: Next) -> Response {
    match AssertUnwindSafe(next.run(request)).catch_unwind().await {
        Ok(response) => response,
        Err(_payload) => {
            // The panic hook has logged the message and the location.
            counter!(PANICS, "component" => "http").increment(1);
            Problem::internal("a handler panicked").into_response()
        }
    }
}

async fn backstop(State(limit): State<Duration>, request: Request, next: Next) -> Response {
    match tokio::time::timeout(limit, next.run(request)).await {
        Ok(response) => response,
        Err(_elapsed) => {
            let limit = u64::try_from(limit.as_millis()).unwrap_or(u64::MAX);
            Problem::new(ProblemType::Deadline, format!("no response within {limit} ms"))
                .with("limit", limit)
                .into_response()
        }
    }
}
