//! The OpenAPI document, assembled from the annotations of the handlers and the table of operations. A test keeps
//! `openapi.yaml` in the repository equal to it.

use bytes::Bytes;
use utoipa::OpenApi;

use super::{access, components, entries, parameters, problems, yaml};
use crate::http::operations;

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

/// General part of the OpenAPI document.
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
    components(schemas(problems::ProblemDocument, crate::http::delivery::ReportDocument)),
)]
struct Description;

/// Texts of the document.
pub(in crate::http) struct DocumentTexts {
    pub(in crate::http) yaml: Bytes,
    pub(in crate::http) json: Bytes,
}

/// Returns the texts of the document.
pub(in crate::http) fn texts() -> Result<DocumentTexts, String> {
    let mut api = Description::openapi().merge_from(operations::Descriptions::openapi());
    entries::describe(&mut api);
    access::restrict_operations(&mut api);
    parameters::add_choices(&mut api);
    let mut document = serde_json::to_value(api).map_err(|error| error.to_string())?;
    components::share(&mut document).map_err(|error| error.to_string())?;
    let yaml = yaml::to_yaml(&document).map_err(|error| error.to_string())?;
    Ok(DocumentTexts { yaml: yaml.into(), json: format!("{document:#}").into() })
}
