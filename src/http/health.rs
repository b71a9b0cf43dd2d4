//! `/livez`, `/readyz`, `/version`: for orchestrators.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::header::CACHE_CONTROL;
use axum::response::{IntoResponse, Response};
use serde_json::json;

use super::kinds::Kind;
use super::problem::Problem;
use super::state::{Ready, Shared};

const NO_STORE: [(axum::http::HeaderName, &str); 1] = [(CACHE_CONTROL, "no-store")];

/// The process answers.
pub(super) async fn live() -> Response {
    (NO_STORE, Json(json!({ "status": "live" }))).into_response()
}

/// A mesh was computed and the service is not shutting down. Load does not change the answer.
pub(super) async fn ready(State(app): State<Shared>) -> Result<Response, Problem> {
    let why = match app.readiness.get() {
        Ready::Yes => return Ok((NO_STORE, Json(json!({ "status": "ready" }))).into_response()),
        Ready::Warming => "the first mesh is being computed",
        Ready::Broken => "the first mesh could not be computed; the log says why",
        Ready::ShuttingDown => "the service is shutting down",
    };
    Err(Problem::new(Kind::NotReady, why).retry_after(Duration::from_secs(1)))
}

/// What is running.
pub(super) async fn version() -> Response {
    (NO_STORE, Json(json!({ "name": "molmesh", "version": env!("CARGO_PKG_VERSION") }))).into_response()
}
