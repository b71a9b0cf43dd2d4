//! `/metrics`, on a listener of its own.

use axum::Router;
use axum::http::header::CONTENT_TYPE;
use axum::middleware::from_fn;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use metrics_exporter_prometheus::PrometheusHandle;

use super::problem;

/// The metrics' router.
pub(super) fn router(handle: PrometheusHandle) -> Router {
    let show = move || {
        let text = handle.render();
        async move { answer(text) }
    };
    Router::new().route("/metrics", get(show)).layer(from_fn(problem::render))
}

fn answer(text: String) -> Response {
    ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}
