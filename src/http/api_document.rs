//! `/openapi.yaml` and `/openapi.json`: the OpenAPI document.

use std::sync::LazyLock;

use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::openapi::{self, DocumentTexts};
use super::problem::Problem;

static TEXTS: LazyLock<Result<DocumentTexts, String>> = LazyLock::new(openapi::texts);

fn answer(text: impl FnOnce(&DocumentTexts) -> &Bytes, media_type: &'static str) -> Result<Response, Problem> {
    let texts = TEXTS.as_ref().map_err(Problem::internal)?;
    Ok(([(CONTENT_TYPE, media_type), (CACHE_CONTROL, "no-cache")], text(texts).clone()).into_response())
}

/// Answers `GET /openapi.yaml`.
pub(super) async fn yaml() -> Result<Response, Problem> {
    answer(|texts| &texts.yaml, "application/yaml")
}

/// Answers `GET /openapi.json`.
pub(super) async fn json() -> Result<Response, Problem> {
    answer(|texts| &texts.json, "application/json")
}
