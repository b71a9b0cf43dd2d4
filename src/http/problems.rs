//! `/problems/{slug}`: explanations of problem types.

use axum::Json;
use axum::extract::Path;
use axum::extract::rejection::PathRejection;
use axum::response::{IntoResponse, Response};

use super::openapi::parameters::ProblemPath;
use super::openapi::problem_responses;
use super::problem::Problem;
use super::problem_types::{PROBLEM_TYPES, ProblemEntry, ProblemType};

problem_responses!(OneProblems: [] BadRequest NotFound);

/// List all problem types
#[utoipa::path(get, path = "/problems", tag = "service", operation_id = "listProblems",
    responses((status = 200, description = "All problem types.", body = Vec<ProblemEntry>)))]
pub(super) async fn list() -> Response {
    Json(PROBLEM_TYPES).into_response()
}

/// Explain a problem type
#[utoipa::path(get, path = "/problems/{slug}", tag = "service", operation_id = "showProblem",
    params(ProblemPath),
    responses((status = 200, description = "The explanation.", body = ProblemEntry), OneProblems))]
pub(super) async fn one(path: Result<Path<String>, PathRejection>) -> Result<Response, Problem> {
    let Path(slug) = path?;
    ProblemEntry::find(&slug).map(|row| Json(row).into_response()).ok_or_else(|| {
        Problem::new(ProblemType::NotFound, "there is no problem type with this name; /problems lists all")
    })
}
