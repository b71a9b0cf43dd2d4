//! `/problems/{slug}`: explanations of problem types.

use axum::Json;
use axum::extract::Path;
use axum::extract::rejection::PathRejection;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::openapi::parameters::ProblemPath;
use super::openapi::problem_responses;
use super::problem::Problem;
use super::problem_types::{PROBLEM_TYPES, ProblemEntry, ProblemType};

/// Explanation of a problem type.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ProblemDescription {
    /// `type` of the problems, and the path of this document.
    r#type: String,
    /// HTTP status of the problems.
    #[schema(minimum = 400, maximum = 599)]
    status: u16,
    /// Short summary.
    title: &'static str,
    /// Meaning and remedy.
    about: &'static str,
}

fn describe(row: &ProblemEntry) -> ProblemDescription {
    ProblemDescription {
        r#type: format!("/problems/{}", row.slug),
        status: row.status.as_u16(),
        title: row.title,
        about: row.about,
    }
}

problem_responses!(OneProblems: [[ProblemType::BadRequest, ProblemType::NotFound]]);

/// List all problem types
#[utoipa::path(get, path = "/problems", tag = "service", operation_id = "listProblems",
    responses((status = 200, description = "All problem types.", body = Vec<ProblemDescription>)))]
pub(super) async fn list() -> Response {
    Json(PROBLEM_TYPES.iter().map(describe).collect::<Vec<_>>()).into_response()
}

/// Explain a problem type
#[utoipa::path(get, path = "/problems/{slug}", tag = "service", operation_id = "showProblem",
    params(ProblemPath),
    responses((status = 200, description = "The explanation.", body = ProblemDescription), OneProblems))]
pub(super) async fn one(path: Result<Path<String>, PathRejection>) -> Result<Response, Problem> {
    let Path(slug) = path?;
    let row = ProblemEntry::find(&slug);
    row.map(|row| Json(describe(row)).into_response()).ok_or_else(|| {
        Problem::new(ProblemType::NotFound, "there is no problem type with this name; /problems lists all")
    })
}
