//! Routes of the service.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::middleware::from_fn;
use axum::routing::{get, post};

use super::state::Shared;
use super::{
    api_document, atoms, capabilities, estimate, events, health, jobs, meshes, middleware, negotiate, page, pdb,
    problems, results, structures,
};

/// Margin of the backstop timeout over the sum of the regular timeouts.
const MARGIN: Duration = Duration::from_secs(10);

/// Builds the router with its middleware.
pub(super) fn router(app: &Shared) -> Router {
    let longest = Duration::from_millis(app.config.jobs.deadline_ms).max(Duration::from_secs(jobs::MAX_WAIT_S));
    let input = Duration::from_millis(app.config.server.body_timeout_ms.max(app.config.archive.timeout_ms));
    let timeout = input + longest + MARGIN;
    let router = Router::new()
        // Meshes.
        .route("/v1/meshes", post(meshes::create))
        .route("/v1/report", post(meshes::report))
        .route("/v1/pdb/{id}/{file}", get(pdb::surface))
        .route("/v1/pdb/{id}/report.json", get(pdb::report))
        .route("/v1/pdb/{id}/atoms", get(atoms::of_entry))
        .route("/v1/structures", post(structures::create))
        .route("/v1/structures/{digest}", get(structures::show))
        .route("/v1/structures/{digest}/atoms", get(atoms::of_structure))
        .route("/v1/structures/{digest}/{file}", get(structures::surface))
        .route("/v1/structures/{digest}/report.json", get(structures::report))
        .route("/v1/estimate", post(estimate::create))
        // Jobs and results.
        .route("/v1/jobs/{id}", get(jobs::show).delete(jobs::dismiss))
        .route("/v1/jobs/{id}/events", get(events::show))
        .route("/v1/jobs/{id}/result", get(jobs::result))
        .route("/v1/results/{file}", get(results::show))
        .route("/v1/results/{key}/report.json", get(results::report))
        // The service itself.
        .route("/v1/capabilities", get(capabilities::show))
        .route("/problems", get(problems::list))
        .route("/problems/{slug}", get(problems::one))
        .route("/livez", get(health::live))
        .route("/readyz", get(health::ready))
        .route("/version", get(health::version))
        .route("/openapi.yaml", get(api_document::yaml))
        .route("/openapi.json", get(api_document::json))
        .route("/docs", get(page::docs))
        .route("/docs.js", get(page::docs_script))
        .route("/swagger-ui.css", get(page::swagger_style))
        .route("/swagger-ui-bundle.js", get(page::swagger_script))
        // The web page.
        .route("/", get(page::index))
        .route("/assets/{file}", get(page::asset))
        .route("/molmesh-viewer.js", get(page::component))
        .route("/sample.pdb", get(page::sample))
        .layer(from_fn(negotiate::relabel))
        .with_state(Arc::clone(app));
    middleware::apply(router, timeout, app)
}
