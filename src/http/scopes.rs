//! Scopes that the operations need. The OpenAPI document uses this table, and tests compare it with the router.

use axum::extract::{MatchedPath, Request};
use axum::http::Method;

use crate::access::Scope;

/// Operation with the scope that it needs; `None`: open to everybody.
pub(super) struct Row {
    pub(super) method: Method,
    pub(super) path: &'static str,
    pub(super) scope: Option<Scope>,
}

const fn row(method: Method, path: &'static str, scope: Option<Scope>) -> Row {
    Row { method, path, scope }
}

const MESH: Option<Scope> = Some(Scope::Mesh);
const READ: Option<Scope> = Some(Scope::Read);
const OPEN: Option<Scope> = None;

/// Every operation of the router.
#[rustfmt::skip]
pub(super) const TABLE: &[Row] = &[
    row(Method::POST, "/v1/meshes", MESH),
    row(Method::POST, "/v1/report", MESH),
    row(Method::GET, "/v1/pdb/{id}/{file}", MESH),
    row(Method::GET, "/v1/pdb/{id}/report.json", MESH),
    row(Method::GET, "/v1/pdb/{id}/atoms", MESH),
    row(Method::POST, "/v1/structures", MESH),
    row(Method::GET, "/v1/structures/{digest}", READ),
    row(Method::GET, "/v1/structures/{digest}/atoms", READ),
    row(Method::GET, "/v1/structures/{digest}/{file}", MESH),
    row(Method::GET, "/v1/structures/{digest}/report.json", MESH),
    row(Method::POST, "/v1/estimate", MESH),
    row(Method::GET, "/v1/jobs/{id}", READ),
    row(Method::DELETE, "/v1/jobs/{id}", MESH),
    row(Method::GET, "/v1/jobs/{id}/events", READ),
    row(Method::GET, "/v1/jobs/{id}/result", READ),
    row(Method::GET, "/v1/results/{file}", READ),
    row(Method::GET, "/v1/results/{key}/report.json", READ),
    row(Method::GET, "/v1/capabilities", READ),
    // Explanations, probes, pages.
    row(Method::GET, "/problems", OPEN),
    row(Method::GET, "/problems/{slug}", OPEN),
    row(Method::GET, "/livez", OPEN),
    row(Method::GET, "/readyz", OPEN),
    row(Method::GET, "/version", OPEN),
    row(Method::GET, "/openapi.yaml", OPEN),
    row(Method::GET, "/openapi.json", OPEN),
    row(Method::GET, "/docs", OPEN),
    row(Method::GET, "/docs.js", OPEN),
    row(Method::GET, "/swagger-ui.css", OPEN),
    row(Method::GET, "/swagger-ui-bundle.js", OPEN),
    row(Method::GET, "/", OPEN),
    row(Method::GET, "/assets/{file}", OPEN),
    row(Method::GET, "/molmesh-viewer.js", OPEN),
    row(Method::GET, "/sample.pdb", OPEN),
];

/// Returns the scope that a request needs; `None`: it is open.
pub(super) fn needed(request: &Request) -> Option<Scope> {
    let path = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
    // A request without a route is answered with 404.
    path.and_then(|path| of(request.method(), path))
}

/// Returns the scope of an operation. A route without a row needs `mesh`, so that it is not open by mistake.
fn of(method: &Method, path: &str) -> Option<Scope> {
    let method = if *method == Method::HEAD { &Method::GET } else { method };
    let mut rows = TABLE.iter().filter(|row| row.path == path);
    let same = rows.clone().find(|row| row.method == *method);
    match same.or_else(|| rows.next()) {
        Some(row) => row.scope,
        None => MESH,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_are_gets_and_what_is_unknown_is_closed() {
        assert_eq!(of(&Method::HEAD, "/v1/jobs/{id}"), READ);
        assert_eq!(of(&Method::DELETE, "/v1/jobs/{id}"), MESH);
        assert_eq!(of(&Method::TRACE, "/v1/meshes"), MESH);
        assert_eq!(of(&Method::GET, "/v2/secrets"), MESH);
        assert_eq!(of(&Method::GET, "/"), OPEN);
        // Everything under /v1 is closed.
        assert!(TABLE.iter().all(|row| row.path.starts_with("/v1/") == row.scope.is_some()));
    }
}
