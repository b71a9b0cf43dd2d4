//! `/problems/{slug}`: what the `type` of a problem means, in words.

use axum::Json;
use axum::extract::Path;
use axum::extract::rejection::PathRejection;
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};

use super::kinds::{KINDS, Kind, Row};
use super::problem::Problem;

fn describe(row: &Row) -> Value {
    json!({
        "type": format!("/problems/{}", row.slug),
        "status": row.status.as_u16(),
        "title": row.title,
        "about": row.about,
    })
}

/// All kinds.
pub(super) async fn list() -> Response {
    Json(KINDS.iter().map(describe).collect::<Vec<_>>()).into_response()
}

/// One kind.
pub(super) async fn one(path: Result<Path<String>, PathRejection>) -> Result<Response, Problem> {
    let Path(slug) = path.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    let row = KINDS.iter().find(|row| row.slug == slug);
    row.map(|row| Json(describe(row)).into_response())
        .ok_or_else(|| Problem::new(Kind::NotFound, "no problem has this name; /problems lists all"))
}
