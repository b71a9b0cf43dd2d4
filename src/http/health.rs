//! `/livez`, `/readyz`, `/version`: for orchestrators.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::header::CACHE_CONTROL;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::kinds::Kind;
use super::openapi::refusals;
use super::problem::Problem;
use super::state::{Ready, Shared};

const NO_STORE: [(axum::http::HeaderName, &str); 1] = [(CACHE_CONTROL, "no-store")];

/// What a probe is told.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Health {
    /// `live` or `ready`.
    status: &'static str,
}

/// What is running.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Version {
    /// `molmesh`.
    name: &'static str,
    /// The program's version.
    version: &'static str,
}

/// The process answers.
#[utoipa::path(get, path = "/livez", tag = "service", operation_id = "live",
    responses((status = 200, description = "The process lives.", body = Health)))]
pub(super) async fn live() -> Response {
    (NO_STORE, Json(Health { status: "live" })).into_response()
}

refusals!(ReadyRefusals: [[Kind::NotReady]]);

/// Whether requests should come here.
///
/// A mesh was computed and the service is not shutting down. Load does not change the answer.
#[utoipa::path(get, path = "/readyz", tag = "service", operation_id = "ready",
    responses((status = 200, description = "The service takes requests.", body = Health), ReadyRefusals))]
pub(super) async fn ready(State(app): State<Shared>) -> Result<Response, Problem> {
    let why = match app.readiness.get() {
        Ready::Yes => return Ok((NO_STORE, Json(Health { status: "ready" })).into_response()),
        Ready::Warming => "the first mesh is being computed",
        Ready::Broken => "the first mesh could not be computed; the log says why",
        Ready::ShuttingDown => "the service is shutting down",
    };
    Err(Problem::new(Kind::NotReady, why).retry_after(Duration::from_secs(1)))
}

/// What is running.
#[utoipa::path(get, path = "/version", tag = "service", operation_id = "version",
    responses((status = 200, description = "Name and version.", body = Version)))]
pub(super) async fn version() -> Response {
    (NO_STORE, Json(Version { name: "molmesh", version: env!("CARGO_PKG_VERSION") })).into_response()
}
