//! `POST /v1/meshes`: the mesh of an upload.

use std::time::Instant;

use axum::body::Body;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::HeaderValue;
use axum::http::header::{self, HeaderMap};
use axum::response::Response;

use super::kinds::Kind;
use super::problem::Problem;
use super::state::Shared;
use super::upload::{self, Upload};
use super::{delivery, negotiate};
use crate::jobs::{ContentKey, Task};
use crate::pipeline::params;

/// A query as pairs, in order.
pub(super) type Pairs = Result<Query<Vec<(String, String)>>, QueryRejection>;

/// The pairs of a query.
pub(super) fn pairs(query: Pairs) -> Result<Vec<(String, String)>, Problem> {
    let Query(pairs) = query.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    Ok(pairs)
}

/// Meshes the body.
pub(super) async fn create(
    State(app): State<Shared>,
    query: Pairs,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    let start = Instant::now();
    let mut pairs = pairs(query)?;
    // A request that will be refused is refused before its body is received.
    let mut request = params::parse(pairs.iter().map(|(n, v)| (n, v)))?;
    let accepted = match (request.format, request.report) {
        (None, false) if !upload::is_multipart(&headers) => Some(negotiate::format(&headers)?),
        _ => None,
    };
    accepted.map_or(Ok(()), |format| params::suits(&request.job, format))?;
    let Upload { bytes, lease, fields, declared } = upload::receive(&app, &headers, body).await?;
    if !fields.is_empty() {
        pairs.extend(fields);
        request = params::parse(pairs)?;
    }
    let format = match (request.format, accepted, request.report) {
        (Some(format), ..) | (None, Some(format), _) => format,
        (None, None, true) => crate::formats::Format::default(),
        (None, None, false) => negotiate::format(&headers)?,
    };
    if !request.report {
        params::suits(&request.job, format)?;
    }
    let received = start.elapsed();
    let place = app.delivery()?;
    let job = request.job.clone();
    let deadline = Instant::now() + app.config.jobs.deadline();
    let ticket = app.pool.submit(Task {
        input: bytes,
        digest: None,
        strict: request.strict,
        job,
        deadline,
        lease: Some(lease),
    })?;
    let finished = ticket.wait().await.map_err(|failure| declared.explain(failure))?;
    declared.check_format(finished.product.report.source_format)?;
    if request.report {
        return delivery::report(&finished, received);
    }
    let key = ContentKey::new(&finished.digest, &request.job, format, finished.product.report.backend);
    let mut response = delivery::mesh(&app, finished, format, &key, received, place).await?;
    response.headers_mut().append(header::VARY, HeaderValue::from_static("accept"));
    Ok(response)
}
