//! Scopes that the operations need, and their query parameters. The OpenAPI document uses this table, and tests compare
//! it with the router.

use axum::extract::{MatchedPath, Query, Request};
use axum::http::Method;

use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::access::Scope;

/// Operation with the scope that it needs; `None`: open to everybody.
pub(super) struct OperationScope {
    pub(super) method: Method,
    pub(super) path: &'static str,
    pub(super) scope: Option<Scope>,
}

/// Query parameters of an operation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Parameters {
    /// Parameters of a mesh.
    Mesh,
    /// Parameters of the list of atoms.
    Atoms,
    /// Parameters of the areas of atoms.
    Areas,
    /// Parameters of the colours of atoms.
    Colors,
    /// Parameters of a tileset.
    Tileset,
    /// Parameters of a subtree.
    Subtree,
    /// `wait`.
    Wait,
    None,
}

impl OperationScope {
    /// Returns the query parameters of the operation.
    pub(super) fn parameters(&self) -> Parameters {
        let is_result = self.path.starts_with("/v1/results/");
        let is_file = self.path.ends_with("/{file}") || self.path.ends_with("/report.json");
        match self.path {
            "/v1/meshes" | "/v1/report" | "/v1/estimate" => Parameters::Mesh,
            "/v1/jobs/{id}" if self.method == Method::GET => Parameters::Wait,
            path if path.ends_with("/atoms") => Parameters::Atoms,
            path if path.ends_with("/areas") => Parameters::Areas,
            path if path.ends_with("/colors") => Parameters::Colors,
            path if path.ends_with("/tileset.json") => Parameters::Tileset,
            path if path.ends_with("/tileset.subtree") => Parameters::Subtree,
            _ if is_file && !is_result => Parameters::Mesh,
            _ => Parameters::None,
        }
    }
}

const fn row(method: Method, path: &'static str, scope: Option<Scope>) -> OperationScope {
    OperationScope { method, path, scope }
}

const MESH: Option<Scope> = Some(Scope::Mesh);
const READ: Option<Scope> = Some(Scope::Read);
const OPEN: Option<Scope> = None;

/// Every operation of the router.
#[rustfmt::skip]
pub(super) const TABLE: &[OperationScope] = &[
    row(Method::POST, "/v1/meshes", MESH),
    row(Method::POST, "/v1/report", MESH),
    row(Method::GET, "/v1/pdb/{id}/{file}", MESH),
    row(Method::GET, "/v1/pdb/{id}/report.json", MESH),
    row(Method::GET, "/v1/pdb/{id}/atoms", MESH),
    row(Method::GET, "/v1/pdb/{id}/areas", MESH),
    row(Method::GET, "/v1/pdb/{id}/colors", MESH),
    row(Method::POST, "/v1/structures", MESH),
    row(Method::GET, "/v1/structures/{digest}", READ),
    row(Method::GET, "/v1/structures/{digest}/atoms", READ),
    row(Method::GET, "/v1/structures/{digest}/areas", MESH),
    row(Method::GET, "/v1/structures/{digest}/colors", READ),
    row(Method::GET, "/v1/structures/{digest}/{file}", MESH),
    row(Method::GET, "/v1/structures/{digest}/report.json", MESH),
    row(Method::GET, "/v1/pdb/{id}/tileset.json", MESH),
    row(Method::GET, "/v1/pdb/{id}/tileset.subtree", MESH),
    row(Method::GET, "/v1/structures/{digest}/tileset.json", MESH),
    row(Method::GET, "/v1/structures/{digest}/tileset.subtree", MESH),
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

/// Rejects a query parameter of an operation that has none.
pub(super) fn check_parameters(request: &Request) -> Result<(), Problem> {
    let Some(path) = request.extensions().get::<MatchedPath>() else { return Ok(()) };
    let method = if request.method() == Method::HEAD { &Method::GET } else { request.method() };
    let mut rows = TABLE.iter().filter(|row| row.path == path.as_str() && row.method == *method);
    if !rows.any(|row| row.scope.is_some() && row.parameters() == Parameters::None) {
        return Ok(());
    }
    let pairs = Query::<Vec<(String, String)>>::try_from_uri(request.uri());
    let Query(pairs) = pairs.map_err(|error| Problem::new(ProblemType::BadRequest, error.body_text()))?;
    let Some((name, _)) = pairs.first() else { return Ok(()) };
    let name: String = name.chars().take(64).collect();
    let detail = format!("unknown parameter `{name}`; this path has none");
    Err(Problem::new(ProblemType::BadParameter, detail).with("parameter", name))
}

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
    fn head_needs_the_scope_of_get_and_unknown_operations_need_mesh() {
        assert_eq!(of(&Method::HEAD, "/v1/jobs/{id}"), READ);
        assert_eq!(of(&Method::DELETE, "/v1/jobs/{id}"), MESH);
        assert_eq!(of(&Method::TRACE, "/v1/meshes"), MESH);
        assert_eq!(of(&Method::GET, "/v2/secrets"), MESH);
        assert_eq!(of(&Method::GET, "/"), OPEN);
        // Everything under /v1 is closed.
        assert!(TABLE.iter().all(|row| row.path.starts_with("/v1/") == row.scope.is_some()));
    }
}
