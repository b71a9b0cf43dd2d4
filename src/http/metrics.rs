//! `/metrics`, on a separate listener.

use axum::Router;
use axum::http::header::CONTENT_TYPE;
use axum::middleware::from_fn;
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use super::problem::{self, Problem};
use crate::telemetry::Recorder;

/// Builds the router of the metrics listener.
pub(super) fn router(recorder: Recorder) -> Router {
    let show = move || {
        let recorder = recorder.clone();
        async move {
            // Process metrics are read from files.
            tokio::task::spawn_blocking(move || recorder.render()).await.map(answer).map_err(Problem::internal)
        }
    };
    Router::new().route("/metrics", get(show)).layer(from_fn(problem::render))
}

fn answer(text: String) -> Response {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}
