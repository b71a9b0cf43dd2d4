//! What every request goes through, outermost first. This file is the documented order:
//!
//! 1. **request id**: everything below can name the request;
//! 2. **observe**: the place in the trace, the span, one log line, metrics, `Server-Timing`; it sees the final status;
//! 3. **problems**: errors of everything below become `application/problem+json`;
//! 4. **security headers**: also on problems that a layer below made;
//! 5. **CORS**: answers preflights; errors below carry its headers, so that scripts can read them;
//! 6. **panics**: a panic of a handler is a 500, and the connection lives on;
//! 7. **timeout**: a backstop above the body's timeout and the job's deadline, which are the ones that are met;
//! 8. the router. Limits of bodies, queue and memory are where the resource is used.

use std::panic::AssertUnwindSafe;
use std::time::Duration;

use axum::Router;
use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderValue, Method};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use futures_util::FutureExt as _;
use metrics::counter;
use tower::ServiceBuilder;
use tower_http::cors::{Any, CorsLayer};

use super::kinds::Kind;
use super::problem::{self, Problem};
use super::{delivery, observe, request_id, timing};
use crate::telemetry::{PANICS, Tracer};

/// Puts the layers around `router`.
pub(super) fn apply(router: Router, timeout: Duration, tracer: Tracer) -> Router {
    router.layer(
        ServiceBuilder::new()
            .layer(from_fn(request_id::assign))
            .layer(from_fn_with_state(tracer, observe::request))
            .layer(from_fn(problem::render))
            .layer(from_fn(security_headers))
            .layer(cors())
            .layer(from_fn(catch_panics))
            .layer(from_fn_with_state(timeout, backstop)),
    )
}

async fn security_headers(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    // Meshes are data: no browser should take one for a script or a page.
    response.headers_mut().insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    response
}

/// Any origin may read anything: there are no cookies and nothing private here.
fn cors() -> CorsLayer {
    let exposed = [
        header::ETAG,
        header::LOCATION,
        header::CONTENT_LOCATION,
        header::CONTENT_RANGE,
        header::ACCEPT_RANGES,
        header::CONTENT_DISPOSITION,
        header::RETRY_AFTER,
        timing::SERVER_TIMING,
        observe::TRACEPARENT,
        request_id::HEADER,
    ];
    CorsLayer::new()
        .allow_origin(Any)
        .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::DELETE])
        .allow_headers(Any)
        .expose_headers(
            exposed
                .into_iter()
                .chain(delivery::SUMMARY.iter().map(|name| HeaderName::from_static(name)))
                .collect::<Vec<_>>(),
        )
        .max_age(Duration::from_hours(24))
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
