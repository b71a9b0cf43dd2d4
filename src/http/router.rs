//! Every resource of the service: the table of contents.

use std::time::Duration;

use axum::Router;
use axum::routing::{get, post};

use super::state::Shared;
use super::{capabilities, health, meshes, middleware, page, pdb, problems};

/// Time beyond the limits that are met in order, before the backstop: reading the archive, writing the head.
const MARGIN: Duration = Duration::from_secs(10);

/// The service.
pub(super) fn router(app: Shared) -> Router {
    let input = app.config.server.body_timeout().max(app.config.archive.timeout());
    let timeout = input + app.config.jobs.deadline() + MARGIN;
    let router = Router::new()
        // Meshes.
        .route("/v1/meshes", post(meshes::create))
        .route("/v1/pdb/{id}/{file}", get(pdb::surface))
        // About the service.
        .route("/v1/capabilities", get(capabilities::show))
        .route("/problems", get(problems::list))
        .route("/problems/{slug}", get(problems::one))
        .route("/livez", get(health::live))
        .route("/readyz", get(health::ready))
        .route("/version", get(health::version))
        // The page.
        .route("/", get(page::index))
        .route("/app.css", get(page::style))
        .route("/app.js", get(page::script))
        .route("/viewer.js", get(page::viewer))
        .route("/icon.svg", get(page::icon))
        .route("/sample.pdb", get(page::sample))
        .with_state(app);
    middleware::apply(router, timeout)
}
