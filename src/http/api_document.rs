//! `/openapi.yaml` and `/openapi.json`: the OpenAPI document, assembled from the annotations of the handlers. A test
//! keeps `openapi.yaml` in the repository equal to it.

use std::sync::LazyLock;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use utoipa::OpenApi;

use super::openapi::access::SecurityRequirements;
use super::openapi::parameters::ChoiceSchemas;
use super::openapi::{bodies, components, problems};
use super::problem::Problem;

const ABOUT: &str = "Watertight molecular-surface meshes from PDB, mmCIF, BinaryCIF, PQR and XYZ files.

Send a structure file to `POST /v1/meshes`; the response is a mesh (GLB by default). For a long job, send \
`Prefer: respond-async`: the response is 202 with a job, `GET /v1/jobs/{id}?wait=20` waits for its end, and \
`GET /v1/results/{file}` returns the mesh. Lengths are in ångström (Å).

Every error is a problem document (RFC 9457). Its `type` is the path of an explanation, and `GET /problems` lists all \
types. Any operation may also return 403 (`cross-site`), 405 (`method-not-allowed`), 421 (`wrong-host`), 500 \
(`internal`), 503 (`too-many-connections`) and 504 (`deadline`).

Every operation with `GET` also has `HEAD`. If the server has quotas, responses carry `RateLimit-Policy` and `RateLimit` \
(draft-ietf-httpapi-ratelimit-headers-11). API keys are optional: a server without keys ignores them and never returns \
401. Every response has an `X-Request-Id`: that of the request, if it has at most 64 letters, digits, `-`, `_` \
and `.`, or a new one.";

/// OpenAPI document.
#[derive(OpenApi)]
#[openapi(
    info(title = "molmesh", description = ABOUT, license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0")),
    servers((url = "/", description = "This server.")),
    tags(
        (name = "meshes", description = "Compute meshes, reports and estimates."),
        (name = "structures", description = "Upload structures and list their contents."),
        (name = "tilesets", description = "Levels of detail of large structures, in tiles."),
        (name = "jobs", description = "Follow asynchronous jobs."),
        (name = "results", description = "Fetch stored meshes and their reports."),
        (name = "service", description = "Capabilities, problem types and health."),
    ),
    paths(
        super::meshes::create, super::meshes::report, super::pdb::surface, super::pdb::report, super::estimate::create,
        super::structures::create, super::structures::show, super::structures::surface, super::structures::report,
        super::atoms::of_structure, super::atoms::of_entry, super::colors::of_structure, super::colors::of_entry,
        super::areas::of_structure, super::areas::of_entry,
        super::tilesets::of_structure, super::tilesets::of_entry,
        super::tilesets::subtree_of_structure, super::tilesets::subtree_of_entry,
        super::jobs::show, super::jobs::dismiss, super::jobs::result, super::events::show,
        super::results::show, super::results::report,
        super::capabilities::show, super::problems::list, super::problems::one,
        super::health::live, super::health::ready, super::health::version,
    ),
    components(schemas(
        problems::ProblemDocument, super::delivery::ReportDocument, bodies::NamedStructure, bodies::StructureForm,
    )),
    modifiers(&SecurityRequirements, &ChoiceSchemas),
)]
struct Description;

/// OpenAPI document as YAML and as JSON.
static TEXTS: LazyLock<Result<[Bytes; 2], String>> = LazyLock::new(|| {
    let mut document = serde_json::to_value(Description::openapi()).map_err(|error| error.to_string())?;
    components::share(&mut document);
    let yaml = components::to_yaml(&document).map_err(|error| error.to_string())?;
    Ok([yaml.into(), format!("{document:#}").into()])
});

fn answer(which: usize, media_type: &'static str) -> Result<Response, Problem> {
    let texts = TEXTS.as_ref().map_err(Problem::internal)?;
    Ok(([(CONTENT_TYPE, media_type), (CACHE_CONTROL, "no-cache")], texts[which].clone()).into_response())
}

/// Answers `GET /openapi.yaml`.
pub(super) async fn yaml() -> Result<Response, Problem> {
    answer(0, "application/yaml")
}

/// Answers `GET /openapi.json`.
pub(super) async fn json() -> Result<Response, Problem> {
    answer(1, "application/json")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::scopes::TABLE;
    use super::*;

    /// Operations outside the document: the web page, the document itself and the page that shows it.
    const PAGES: [&str; 10] = [
        "GET /",
        "GET /assets/{file}",
        "GET /docs",
        "GET /docs.js",
        "GET /molmesh-viewer.js",
        "GET /openapi.json",
        "GET /openapi.yaml",
        "GET /sample.pdb",
        "GET /swagger-ui-bundle.js",
        "GET /swagger-ui.css",
    ];

    #[test]
    fn the_document_has_every_operation() {
        let document = serde_json::to_value(Description::openapi()).unwrap();
        let paths = document["paths"].as_object().unwrap().iter();
        let described = paths.flat_map(|(path, item)| {
            item.as_object().unwrap().keys().map(move |method| format!("{} {path}", method.to_uppercase()))
        });
        let described: BTreeSet<String> = described.chain(PAGES.map(str::to_owned)).collect();
        let listed: BTreeSet<String> = TABLE.iter().map(|row| format!("{} {}", row.method, row.path)).collect();
        assert_eq!(described, listed);
        assert_eq!(listed.len(), TABLE.len(), "no duplicates");
    }
}
