//! Routes of the service.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use axum::middleware::{Next, from_fn};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{MethodRouter, get, post};

use super::state::Shared;
use super::{
    api_document, areas, atoms, capabilities, colors, estimate, events, guard, health, jobs, meshes, middleware,
    negotiate, page, pdb, problems, results, scopes, structures, tilesets,
};
use crate::config::Role;

/// Margin of the backstop timeout over the sum of the regular timeouts.
const MARGIN: Duration = Duration::from_secs(10);

/// Paths that a worker of a cluster answers.
const OF_WORKERS: [&str; 3] = ["/livez", "/readyz", "/version"];

/// Builds the router with its middleware.
pub(super) fn router(app: &Shared) -> Router {
    let longest = Duration::from_millis(app.config.jobs.deadline_ms).max(Duration::from_secs(jobs::MAX_WAIT_S));
    let input = Duration::from_millis(app.config.server.body_timeout_ms.max(app.config.archive.timeout_ms));
    let timeout = input + longest + MARGIN;
    let is_worker = app.config.server.role == Role::Worker;
    let routes = routes().into_iter().filter(|(path, _)| !is_worker || OF_WORKERS.contains(path));
    let router = routes.fold(Router::new(), |router, (path, methods)| router.route(path, methods));
    let router = router.layer(from_fn(negotiate::relabel)).layer(from_fn(reject_parameters));
    let router = router.with_state(Arc::clone(app));
    middleware::apply(router, timeout, app)
}

/// Middleware: rejects query parameters of operations that have none.
async fn reject_parameters(request: Request, next: Next) -> Response {
    match scopes::check_parameters(&request) {
        Ok(()) => next.run(request).await,
        Err(problem) => {
            guard::discard_body(request).await;
            problem.into_response()
        }
    }
}

/// Paths with their methods. [`scopes::TABLE`](super::scopes::TABLE) has their scopes.
fn routes() -> Vec<(&'static str, MethodRouter<Shared>)> {
    vec![
        // Meshes.
        ("/v1/meshes", post(meshes::create)),
        ("/v1/report", post(meshes::report)),
        ("/v1/pdb/{id}/{file}", get(pdb::surface)),
        ("/v1/pdb/{id}/report.json", get(pdb::report)),
        ("/v1/pdb/{id}/atoms", get(atoms::of_entry)),
        ("/v1/pdb/{id}/areas", get(areas::of_entry)),
        ("/v1/pdb/{id}/colors", get(colors::of_entry)),
        ("/v1/structures", post(structures::create)),
        ("/v1/structures/{digest}", get(structures::show)),
        ("/v1/structures/{digest}/atoms", get(atoms::of_structure)),
        ("/v1/structures/{digest}/areas", get(areas::of_structure)),
        ("/v1/structures/{digest}/colors", get(colors::of_structure)),
        ("/v1/structures/{digest}/{file}", get(structures::surface)),
        ("/v1/structures/{digest}/report.json", get(structures::report)),
        ("/v1/pdb/{id}/tileset.json", get(tilesets::of_entry)),
        ("/v1/pdb/{id}/tileset.subtree", get(tilesets::subtree_of_entry)),
        ("/v1/structures/{digest}/tileset.json", get(tilesets::of_structure)),
        ("/v1/structures/{digest}/tileset.subtree", get(tilesets::subtree_of_structure)),
        ("/v1/estimate", post(estimate::create)),
        // Jobs and results.
        ("/v1/jobs/{id}", get(jobs::show).delete(jobs::dismiss)),
        ("/v1/jobs/{id}/events", get(events::show)),
        ("/v1/jobs/{id}/result", get(jobs::result)),
        ("/v1/results/{file}", get(results::show)),
        ("/v1/results/{key}/report.json", get(results::report)),
        // The service itself.
        ("/v1/capabilities", get(capabilities::show)),
        ("/problems", get(problems::list)),
        ("/problems/{slug}", get(problems::one)),
        ("/livez", get(health::live)),
        ("/readyz", get(health::ready)),
        ("/version", get(health::version)),
        ("/openapi.yaml", get(api_document::yaml)),
        ("/openapi.json", get(api_document::json)),
        ("/docs", get(page::docs)),
        ("/docs.js", get(page::docs_script)),
        ("/swagger-ui.css", get(page::swagger_style)),
        ("/swagger-ui-bundle.js", get(page::swagger_script)),
        // The web page.
        ("/", get(page::index)),
        ("/assets/{file}", get(page::asset)),
        ("/molmesh-viewer.js", get(page::component)),
        ("/sample.pdb", get(page::sample)),
    ]
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::scopes::TABLE;
    use super::routes;

    #[test]
    fn every_route_has_a_scope() {
        let routed: BTreeSet<&str> = routes().into_iter().map(|(path, _)| path).collect();
        let listed: BTreeSet<&str> = TABLE.iter().map(|row| row.path).collect();
        assert_eq!(routed, listed);
    }
}
