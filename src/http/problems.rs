//! `/problems/{slug}`: explanations of problem types.

use axum::Json;
use axum::extract::Path;
use axum::extract::rejection::PathRejection;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::kinds::{KINDS, Kind, Row};
use super::openapi::refusals;
use super::problem::Problem;

/// Explanation of a problem type.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ProblemType {
    /// `type` of such problems, which is the address of this document.
    r#type: String,
    /// HTTP status.
    #[schema(minimum = 400, maximum = 599)]
    status: u16,
    /// Short description.
    title: &'static str,
    /// Meaning of the problem, and what the client can do.
    about: &'static str,
}

fn describe(row: &Row) -> ProblemType {
    ProblemType {
        r#type: format!("/problems/{}", row.slug),
        status: row.status.as_u16(),
        title: row.title,
        about: row.about,
    }
}

refusals!(OneRefusals: [[Kind::BadRequest, Kind::NotFound]]);

/// Lists all problem types.
#[utoipa::path(get, path = "/problems", tag = "service", operation_id = "listProblems",
    responses((status = 200, description = "All types.", body = Vec<ProblemType>)))]
pub(super) async fn list() -> Response {
    Json(KINDS.iter().map(describe).collect::<Vec<_>>()).into_response()
}

/// Explains one problem type.
#[utoipa::path(get, path = "/problems/{slug}", tag = "service", operation_id = "showProblem",
    params(("slug" = String, Path, description = "Last segment of a problem's `type`.", example = "grid-too-large")),
    responses((status = 200, description = "What it means.", body = ProblemType), OneRefusals))]
pub(super) async fn one(path: Result<Path<String>, PathRejection>) -> Result<Response, Problem> {
    let Path(slug) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let row = KINDS.iter().find(|row| row.slug == slug);
    row.map(|row| Json(describe(row)).into_response())
        .ok_or_else(|| Problem::new(Kind::NotFound, "there is no problem type with this name; /problems lists all"))
}
