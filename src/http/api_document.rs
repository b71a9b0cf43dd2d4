//! `/openapi.yaml` and `/openapi.json`: the OpenAPI document, assembled from the annotations of the handlers. A test
//! keeps `openapi.yaml` in the repository equal to it.

use std::sync::LazyLock;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use utoipa::OpenApi;

use super::openapi::access::Rights;
use super::openapi::problems;
use super::problem::Problem;

const ABOUT: &str = "Molecules in, surface meshes out.

Send a PDB, mmCIF or BinaryCIF file to `POST /v1/meshes` and get a closed, oriented mesh. Whatever is not a success is a problem \
document (RFC 9457); its `type` is an address with an explanation.

Beyond what each operation lists: `HEAD` is answered wherever `GET` is. A server that holds as many connections as it \
may answers 503 (`too-many-connections`) to the next one before it has read a request. A 500 or a 504 \
where none is listed means a defect of the server. Where a quota applies, answers have `RateLimit-Policy` and `RateLimit` \
(draft-ietf-httpapi-ratelimit-headers-11). Whether keys are asked for is the operator's choice: without that no answer is \
401 or 403, and every key is ignored. Every answer has an `X-Request-Id`: the client's own, if it sent one of 64 letters, \
digits, `-`, `_` or `.` at most. Lengths are in ångström (Å).";

/// OpenAPI document.
#[derive(OpenApi)]
#[openapi(
    info(title = "molmesh", description = ABOUT, license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0")),
    servers((url = "/", description = "This server.")),
    tags(
        (name = "meshes", description = "Structures to meshes."),
        (name = "structures", description = "Structures that are uploaded once."),
        (name = "jobs", description = "Asynchronous jobs."),
        (name = "results", description = "Meshes that were made, for as long as they are kept."),
        (name = "service", description = "About the service."),
        (name = "page", description = "The pages and what they consist of."),
    ),
    paths(
        super::meshes::create, super::pdb::surface, super::estimate::create,
        super::structures::create, super::structures::show, super::structures::surface,
        super::atoms::of_structure, super::atoms::of_entry,
        super::jobs::show, super::jobs::dismiss, super::jobs::result, super::events::show,
        super::results::show, super::results::report,
        super::capabilities::show, super::problems::list, super::problems::one,
        super::health::live, super::health::ready, super::health::version,
        super::page::index, super::page::asset, super::page::component, super::page::sample,
        super::docs::index, super::docs::start, super::docs::style, super::docs::bundle, yaml, json,
    ),
    components(schemas(problems::ProblemDocument, super::delivery::ReportDocument)),
    modifiers(&Rights),
)]
struct Description;

/// OpenAPI document as YAML and as JSON.
static TEXTS: LazyLock<Result<[Bytes; 2], String>> = LazyLock::new(|| {
    let description = Description::openapi();
    let yaml = description.to_yaml().map_err(|error| error.to_string())?;
    let json = description.to_pretty_json().map_err(|error| error.to_string())?;
    Ok([yaml.into(), json.into()])
});

fn answer(which: usize, media_type: &'static str) -> Result<Response, Problem> {
    let texts = TEXTS.as_ref().map_err(Problem::internal)?;
    Ok(([(CONTENT_TYPE, media_type), (CACHE_CONTROL, "no-cache")], texts[which].clone()).into_response())
}

/// Returns this document as YAML.
#[utoipa::path(get, path = "/openapi.yaml", tag = "service", operation_id = "describeYaml",
    responses((status = 200, description = "The description.", body = Object, content_type = "application/yaml")))]
pub(super) async fn yaml() -> Result<Response, Problem> {
    answer(0, "application/yaml")
}

/// Returns this document as JSON.
#[utoipa::path(get, path = "/openapi.json", tag = "service", operation_id = "describeJson",
    responses((status = 200, description = "The description.", body = Object, content_type = "application/json")))]
pub(super) async fn json() -> Result<Response, Problem> {
    answer(1, "application/json")
}
