//! `/metrics`, on a separate listener.

use std::sync::Arc;

use axum::Router;
use axum::extract::Request;
use axum::http::header::CONTENT_TYPE;
use axum::middleware::{Next, from_fn};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use super::origin;
use super::problem::{self, Problem};
use crate::access::Sites;
use crate::telemetry::Recorder;

/// Builds the router of the metrics listener, which answers to the names of `sites`.
pub(super) fn router(recorder: Recorder, sites: Sites) -> Router {
    let sites = Arc::new(sites);
    let check_host = move |request: Request, next: Next| {
        let checked = origin::check_host(&sites, &request);
        async move {
            match checked {
                Ok(_) => next.run(request).await,
                Err(problem) => problem.into_response(),
            }
        }
    };
    let show = move || {
        let recorder = recorder.clone();
        async move {
            // Process metrics are read from files.
            tokio::task::spawn_blocking(move || recorder.render()).await.map(answer).map_err(Problem::internal)
        }
    };
    Router::new().route("/metrics", get(show)).layer(from_fn(check_host)).layer(from_fn(problem::render))
}

fn answer(text: String) -> Response {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}
