//! `/livez`, `/readyz` and `/version`, for orchestrators. An orchestrator that removes a busy node moves its load to
//! the others, so readiness does not depend on the load.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::header::CACHE_CONTROL;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::openapi::problem_responses;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::Shared;
use super::stop::Stop;

const NO_STORE: [(axum::http::HeaderName, &str); 1] = [(CACHE_CONTROL, "no-store")];

/// Response to the liveness probe.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Health {
    /// Always `live`.
    status: &'static str,
}

/// Name and version of the program.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Version {
    /// Always `molmesh`.
    name: &'static str,
    /// Version of the program.
    version: &'static str,
}

/// Check that the process is alive
#[utoipa::path(get, path = "/livez", tag = "service", operation_id = "live",
    responses((status = 200, description = "The process is alive.", body = Health)))]
pub(super) async fn live() -> Response {
    (NO_STORE, Json(Health { status: "live" })).into_response()
}

/// Response to the readiness probe.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ReadyDocument {
    /// Always `ready`.
    status: &'static str,
    /// The readiness checks; all are `ok`.
    checks: Vec<ReadinessCheck>,
}

/// Readiness check.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ReadinessCheck {
    /// Name of the check: `accepting`, `devices`, `store`, `broker` or `records`.
    name: &'static str,
    /// True if the check passed.
    ok: bool,
    /// Explanation of the outcome.
    detail: String,
}

impl ReadinessCheck {
    fn new(name: &'static str, found: Result<String, String>) -> Self {
        let (ok, detail) = match found {
            Ok(detail) => (true, detail),
            Err(detail) => (false, detail),
        };
        Self { name, ok, detail }
    }
}

problem_responses!(ReadyProblems: [] NotReady);

/// Check that the service is ready for requests
///
/// The service is ready if it is not shutting down, has computed a first mesh, has a device or a fallback that accepts
/// jobs, can write and read the store, can dispatch jobs, and has read the records of unfinished jobs, of which none is
/// in quarantine. The response does not depend on the load.
#[utoipa::path(get, path = "/readyz", tag = "service", operation_id = "ready",
    responses((status = 200, description = "The service is ready.", body = ReadyDocument), ReadyProblems))]
pub(super) async fn ready(State(app): State<Shared>) -> Result<Response, Problem> {
    let checks = [accepting(&app), devices(&app), store(&app).await, broker(&app), records(&app).await];
    let failing = checks.iter().find(|check| !check.ok).map(|check| check.detail.clone());
    match failing {
        None => {
            let document = ReadyDocument { status: "ready", checks: checks.into() };
            Ok((NO_STORE, Json(document)).into_response())
        }
        Some(why) => {
            let checks = serde_json::to_value(checks).unwrap_or_default();
            Err(Problem::new(ProblemType::NotReady, why).with("checks", checks).retry_after(Duration::from_secs(1)))
        }
    }
}

fn accepting(app: &Shared) -> ReadinessCheck {
    let ending = *app.stopping.borrow() != Stop::Serve;
    let found = if ending { Err("the service is shutting down") } else { Ok("requests are accepted") };
    ReadinessCheck::new("accepting", found.map(str::to_owned).map_err(str::to_owned))
}

fn devices(app: &Shared) -> ReadinessCheck {
    let backend = app.pool.backend();
    let found = match app.first_mesh.get() {
        None => Err("the first mesh is being computed".to_owned()),
        Some(false) => Err("the first mesh failed; see the log".to_owned()),
        Some(true) if !backend.is_available() => Err("no device is in service, and there is no fallback".to_owned()),
        Some(true) => {
            let devices = backend.devices();
            let up = devices.iter().filter(|device| device.down.is_none()).count();
            let mut detail = format!("{} has computed its first mesh", backend.name());
            detail.extend((!devices.is_empty()).then(|| format!("; {up} of {} devices are in service", devices.len())));
            for device in &devices {
                detail.extend(device.down.iter().map(|why| format!("; {}: {why}", device.number)));
            }
            Ok(detail)
        }
    };
    ReadinessCheck::new("devices", found)
}

async fn store(app: &Shared) -> ReadinessCheck {
    let found = match app.store_health.failure(&app.store, &app.config.store).await {
        None => Ok("the store can be written and read".to_owned()),
        Some(why) => Err(format!("the store does not work: {why}")),
    };
    ReadinessCheck::new("store", found)
}

fn broker(app: &Shared) -> ReadinessCheck {
    let found = match app.job_store.broker().down() {
        None => Ok("jobs can be dispatched".to_owned()),
        Some(why) => Err(format!("jobs cannot be dispatched: {why}")),
    };
    ReadinessCheck::new("broker", found)
}

async fn records(app: &Shared) -> ReadinessCheck {
    if !app.job_store.has_read_records() {
        return ReadinessCheck::new("records", Err("the records of jobs are being read".to_owned()));
    }
    let found = match (app.store.quarantined().await, app.job_store.other_release_count()) {
        (Ok(0), 0) => Ok("no job record is in quarantine".to_owned()),
        (Ok(0), n) => Ok(format!("no job record is in quarantine; jobs left to the releases that wrote them: {n}")),
        (Ok(count), _) => Err(format!("{count} job records cannot be read and are in quarantine; see the log")),
        (Err(_logged), _) => Err("the quarantine of job records cannot be read".to_owned()),
    };
    ReadinessCheck::new("records", found)
}

/// Get the version of the program
#[utoipa::path(get, path = "/version", tag = "service", operation_id = "version",
    responses((status = 200, description = "Name and version.", body = Version)))]
pub(super) async fn version() -> Response {
    (NO_STORE, Json(Version { name: "molmesh", version: env!("CARGO_PKG_VERSION") })).into_response()
}
