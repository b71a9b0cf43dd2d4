//! Router of the service, from the table of operations.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse as _, Response};

use super::state::Shared;
use super::{coding, conditional, guard, jobs, middleware, negotiate, operations};
use crate::config::Role;

/// Margin of the backstop timeout over the sum of the regular timeouts.
const MARGIN: Duration = Duration::from_secs(10);

/// Paths that a worker of a cluster answers.
const WORKER_PATHS: [&str; 3] = ["/livez", "/readyz", "/version"];

/// Builds the router with its middleware.
pub(super) fn router(app: &Shared) -> Router {
    let longest = Duration::from_millis(app.config.jobs.deadline_ms).max(Duration::from_secs(jobs::MAX_WAIT_S));
    let input = Duration::from_millis(app.config.server.body_timeout_ms.max(app.config.archive.timeout_ms));
    let timeout = input + longest + MARGIN;
    let is_worker = app.config.server.role == Role::Worker;
    let rows = operations::TABLE.iter().filter(|row| !is_worker || WORKER_PATHS.contains(&row.path));
    let router = rows.fold(Router::new(), |router, row| router.route(row.path, (row.handler)()));
    let router = router.layer(from_fn(conditional::validate));
    let router = router.layer(from_fn_with_state(Arc::clone(app), coding::negotiate));
    let router = router.layer(from_fn(negotiate::relabel)).layer(from_fn(reject_parameters));
    let router = router.with_state(Arc::clone(app));
    middleware::apply(router, timeout, app)
}

/// Middleware: rejects query parameters of operations that have none.
async fn reject_parameters(request: Request, next: Next) -> Response {
    match operations::check_parameters(&request) {
        Ok(()) => next.run(request).await,
        Err(problem) => {
            guard::discard_body(request).await;
            problem.into_response()
        }
    }
}
