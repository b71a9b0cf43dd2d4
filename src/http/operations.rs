//! Operations of the service: method, path, scope, query parameters and handler. The router, the guard and the OpenAPI
//! document use this table.

use axum::extract::{MatchedPath, Query, Request};
use axum::http::Method;
use axum::middleware::Next;
use axum::response::Response;
use axum::routing::{MethodFilter, MethodRouter, on};
use utoipa::OpenApi;

use super::guard::RequiredScope;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::Shared;
use super::{
    api_document, areas, atoms, batch_results, batches, capabilities, colors, estimate, events, health, job_list, jobs,
    meshes, page, problems, results, structures, tilesets,
};
use crate::access::Scope;

/// Operation of the service.
pub(super) struct Operation {
    pub(super) method: Method,
    pub(super) path: &'static str,
    /// Scope that the operation needs; `None`: open to everybody.
    pub(super) scope: Option<Scope>,
    pub(super) parameters: Parameters,
    /// Returns the handler.
    pub(super) handler: fn() -> MethodRouter<Shared>,
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
    /// Parameters of a tileset or its subtree.
    Tileset,
    /// Parameters of a list of jobs.
    Jobs,
    /// `wait`.
    Wait,
    /// Parameters of a batch.
    Batch,
    /// Page of a list.
    Page,
    None,
}

const MESH: Option<Scope> = Some(Scope::Mesh);
const READ: Option<Scope> = Some(Scope::Read);
const OPEN: Option<Scope> = None;

/// Declares [`TABLE`] and [`Descriptions`]. An operation of `each_structure` exists twice: below the path of an
/// uploaded structure, and below that of an archive entry, where it needs the scope `mesh`, because it may fetch the
/// entry.
macro_rules! operations {
    (
        single: { $($method:ident $path:literal $scope:ident $parameters:ident $module:ident::$handler:ident;)+ }
        each_structure: {
            $($end:literal $end_scope:ident $end_parameters:ident $end_module:ident::$end_handler:ident;)+
        }
        pages: { $($page:literal $page_module:ident::$page_handler:ident;)+ }
    ) => {
        /// Every operation of the router.
        pub(super) const TABLE: &[Operation] = &[
            $(operations!(row $method, $path, $scope, $parameters, $module::$handler),)+
            $(
                operations!(
                    row GET, concat!("/v1/structures/{digest}", $end), $end_scope, $end_parameters,
                    $end_module::$end_handler
                ),
                operations!(
                    row GET, concat!("/v1/pdb/{id}", $end), MESH, $end_parameters, $end_module::$end_handler
                ),
            )+
            $(operations!(row GET, $page, OPEN, None, $page_module::$page_handler),)+
        ];

        /// Descriptions of the operations except pages. Those of `each_structure` are for an uploaded structure.
        #[derive(OpenApi)]
        #[openapi(paths($($module::$handler,)+ $($end_module::$end_handler,)+))]
        pub(super) struct Descriptions;
    };
    (row $method:ident, $path:expr, $scope:ident, $parameters:ident, $module:ident::$handler:ident) => {
        Operation {
            method: Method::$method,
            path: $path,
            scope: $scope,
            parameters: Parameters::$parameters,
            handler: || on(MethodFilter::$method, $module::$handler),
        }
    };
}

operations! {
    single: {
        POST "/v1/meshes" MESH Mesh meshes::create;
        POST "/v1/report" MESH Mesh meshes::report;
        POST "/v1/estimate" MESH Mesh estimate::create;
        POST "/v1/structures" MESH None structures::create;
        GET "/v1/structures/{digest}" READ None structures::show;
        POST "/v1/areas" MESH Areas areas::create;
        GET "/v1/jobs" READ Jobs job_list::list;
        GET "/v1/jobs/{id}" READ Wait jobs::show;
        DELETE "/v1/jobs/{id}" MESH None jobs::dismiss;
        GET "/v1/jobs/{id}/events" READ None events::show;
        GET "/v1/jobs/{id}/result" READ None jobs::result;
        POST "/v1/batches" MESH Batch batches::create;
        GET "/v1/batches/{id}" READ Page batches::show;
        DELETE "/v1/batches/{id}" MESH None batches::dismiss;
        GET "/v1/batches/{id}/events" READ None batches::events;
        GET "/v1/batches/{id}/results.tar" READ None batch_results::show;
        GET "/v1/results/{file}" READ None results::show;
        GET "/v1/results/{key}/report.json" READ None results::report;
        GET "/v1/capabilities" READ None capabilities::show;
        GET "/problems" OPEN None problems::list;
        GET "/problems/{slug}" OPEN None problems::one;
        GET "/livez" OPEN None health::live;
        GET "/readyz" OPEN None health::ready;
        GET "/version" OPEN None health::version;
    }
    each_structure: {
        // The tiles of `/tileset.json` are `/surface.glb?tile=…`.
        "/{file}" MESH Mesh structures::surface;
        "/report.json" MESH Mesh structures::report;
        "/atoms" READ Atoms atoms::list;
        "/areas" MESH Areas areas::list;
        "/colors" READ Colors colors::list;
        "/tileset.json" MESH Tileset tilesets::show;
        "/tileset.subtree" MESH Tileset tilesets::show_subtree;
    }
    pages: {
        "/openapi.yaml" api_document::yaml;
        "/openapi.json" api_document::json;
        "/docs" page::docs;
        "/docs.js" page::docs_script;
        "/swagger-ui.css" page::swagger_style;
        "/swagger-ui-bundle.js" page::swagger_script;
        "/" page::index;
        "/assets/{file}" page::asset;
        "/molmesh-viewer.js" page::component;
        "/sample.pdb" page::sample;
    }
}

/// Rejects a query parameter of an operation that has none.
pub(super) fn check_parameters(request: &Request) -> Result<(), Problem> {
    let Some(path) = request.extensions().get::<MatchedPath>() else { return Ok(()) };
    let method = get_for_head(request.method());
    let mut rows = TABLE.iter().filter(|row| row.path == path.as_str() && row.method == *method);
    if !rows.any(|row| row.scope.is_some() && row.parameters == Parameters::None) {
        return Ok(());
    }
    let pairs = Query::<Vec<(String, String)>>::try_from_uri(request.uri());
    let Query(pairs) = pairs.map_err(|error| Problem::new(ProblemType::BadRequest, error.body_text()))?;
    let Some((name, _)) = pairs.first() else { return Ok(()) };
    let name: String = name.chars().take(64).collect();
    let detail = format!("unknown parameter `{name}`; this path has none");
    Err(Problem::new(ProblemType::BadParameter, detail).with("parameter", name))
}

/// Middleware: records the scope that a request needs.
pub(super) async fn require_scope(mut request: Request, next: Next) -> Response {
    let path = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
    // A request without a route is answered with 404.
    let scope = path.and_then(|path| required_scope(request.method(), path));
    request.extensions_mut().insert(RequiredScope(scope));
    next.run(request).await
}

/// Returns the scope of an operation. A route without a row needs `mesh`, so that it is not open by mistake.
fn required_scope(method: &Method, path: &str) -> Option<Scope> {
    let method = get_for_head(method);
    let mut rows = TABLE.iter().filter(|row| row.path == path);
    let same = rows.clone().find(|row| row.method == *method);
    match same.or_else(|| rows.next()) {
        Some(row) => row.scope,
        None => MESH,
    }
}

fn get_for_head(method: &Method) -> &Method {
    if *method == Method::HEAD { &Method::GET } else { method }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn head_needs_the_scope_of_get_and_unknown_operations_need_mesh() {
        assert_eq!(required_scope(&Method::HEAD, "/v1/jobs/{id}"), READ);
        assert_eq!(required_scope(&Method::DELETE, "/v1/jobs/{id}"), MESH);
        assert_eq!(required_scope(&Method::TRACE, "/v1/meshes"), MESH);
        assert_eq!(required_scope(&Method::GET, "/v2/secrets"), MESH);
        assert_eq!(required_scope(&Method::GET, "/"), OPEN);
        // Lists of an archive entry may fetch it.
        assert_eq!(required_scope(&Method::GET, "/v1/structures/{digest}/atoms"), READ);
        assert_eq!(required_scope(&Method::GET, "/v1/pdb/{id}/atoms"), MESH);
        // Everything under /v1 is closed.
        assert!(TABLE.iter().all(|row| row.path.starts_with("/v1/") == row.scope.is_some()));
    }
}
