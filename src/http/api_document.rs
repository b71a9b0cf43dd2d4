//! `/openapi.yaml` and `/openapi.json`: the OpenAPI document.

use std::sync::LazyLock;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::openapi;
use super::problem::Problem;

/// OpenAPI document as YAML and as JSON.
static TEXTS: LazyLock<Result<[Bytes; 2], String>> = LazyLock::new(openapi::texts);

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
