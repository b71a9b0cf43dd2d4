//! `/v1/jobs/{id}`: status of a durable job, with long polling; its result; its cancellation. Names and statuses are
//! those of OGC API Processes.

use std::time::Duration;

use axum::Json;
use axum::extract::rejection::QueryRejection;
use axum::extract::{FromRequestParts, Path, Query, State};
use axum::http::StatusCode;
use axum::http::header::{self, HeaderValue};
use axum::http::request::Parts;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::{IntoParams, ToSchema};

use super::delivery;
use super::guard::Caller;
use super::openapi::parameters::JobPath;
use super::openapi::problem_responses;
use super::openapi::problems::ProblemDocument;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::results;
use super::state::Shared;
use super::stop::{self, Stop};
use crate::jobs::{ContentKey, JobId, JobRecord, JobView, Status, is_stored, rfc3339};

/// Longest poll, s. Proxies commonly cut an exchange after a minute.
pub(super) const MAX_WAIT_S: u64 = 55;

/// Parameters of a long poll.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct Poll {
    /// Seconds to wait for the job to end, 0 to 55. Default: 0.
    #[param(minimum = 0, maximum = 55, nullable = false)]
    wait: Option<u64>,
}

/// Status of a job. Names and statuses follow OGC API Processes.
#[derive(Debug, Serialize, ToSchema)]
#[schema(example = json!({
    "jobID": "0123456789abcdef0123456789abcdef", "processID": "surface", "type": "process", "status": "running",
    "progress": 42, "fraction": 0.42, "stage": "field", "attempts": 1, "created": "2030-01-01T12:00:00.000Z",
    "started": "2030-01-01T12:00:00.100Z", "finished": null,
    "structure": "edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087", "format": "glb",
    "parameters": { "resolution": "0.3" }, "problem": null, "result": null,
    "links": [{ "rel": "self", "href": "/v1/jobs/0123456789abcdef0123456789abcdef", "type": "application/json" }],
}))]
pub(super) struct JobDocument {
    /// Id of the job.
    #[serde(rename = "jobID")]
    job_id: String,
    /// Always `surface`.
    #[serde(rename = "processID")]
    process_id: &'static str,
    /// Always `process`.
    r#type: &'static str,
    /// Status of the job. `successful`, `failed` and `dismissed` are final.
    #[schema(value_type = StatusSchema)]
    status: Status,
    /// Progress in per cent.
    #[schema(minimum = 0, maximum = 100)]
    progress: u64,
    /// Progress as a fraction.
    #[schema(minimum = 0, maximum = 1)]
    fraction: f64,
    /// Current stage; null unless the job is running.
    #[schema(required)]
    stage: Option<String>,
    /// Number of times the job was started.
    attempts: u32,
    /// Time of acceptance.
    #[schema(format = DateTime)]
    created: String,
    /// Time of the latest start; null before the first.
    #[schema(required, format = DateTime)]
    started: Option<String>,
    /// Time of the end; null before it.
    #[schema(required, format = DateTime)]
    finished: Option<String>,
    /// SHA-256 digest of the structure, in hexadecimal.
    structure: String,
    /// Mesh format, as a file name extension.
    format: String,
    /// Parameters as given in the request.
    #[schema(value_type = std::collections::BTreeMap<String, String>)]
    parameters: Map<String, Value>,
    /// Error of a failed job; null otherwise.
    #[schema(required, value_type = Option<ProblemDocument>)]
    problem: Option<Value>,
    /// File name of the result, for `GET /v1/results/{file}`; null unless the job has succeeded.
    #[schema(required)]
    result: Option<String>,
    /// Related resources.
    links: Vec<Link>,
}

/// Link to a related resource.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Link {
    /// Relation of the resource to this document.
    rel: &'static str,
    /// Path of the resource.
    href: String,
    /// Media type of the resource.
    r#type: &'static str,
}

/// Status of a job.
#[derive(Debug, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = JobStatus)]
#[expect(dead_code, reason = "for the schema alone: documents hold the status of the record")]
pub(super) enum StatusSchema {
    Accepted,
    Running,
    Successful,
    Failed,
    Dismissed,
}

impl Poll {
    /// Returns the seconds to wait.
    pub(super) fn wait(&self) -> u64 {
        self.wait.unwrap_or(0)
    }
}

problem_responses!(ShowProblems: [RECORD]);
problem_responses!(DismissProblems: [RECORD] JobEnded StoreFull);
problem_responses!(ResultProblems: [RECORD READING MESHING] NoResultYet JobDismissed ResultGone JobAbandoned StoreFull);

/// Reads the job id from the path.
impl FromRequestParts<Shared> for JobId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &Shared) -> Result<Self, Problem> {
        let Path(text) = Path::<String>::from_request_parts(parts, app).await?;
        text.parse().map_err(|_bad| no_such_job(&text))
    }
}

/// Returns the problem of an unknown job.
pub(super) fn no_such_job(id: &str) -> Problem {
    let shown: String = id.chars().take(40).collect();
    Problem::new(
        ProblemType::NoSuchJob,
        format!("there is no job `{shown}`: jobs are removed some time after their end"),
    )
}

/// Get the status of a job
///
/// With `wait`, the response is delayed until the job has ended or the time has passed.
#[utoipa::path(get, path = "/v1/jobs/{id}", tag = "jobs", operation_id = "showJob", params(JobPath, Poll),
    responses(
        (status = 200, description = "Status of the job.", body = JobDocument, headers(("Retry-After")),
            links(("result" = (operation_id = "showResult", parameters(("file" = "$response.body#/result")))))),
        ShowProblems,
    ))]
pub(super) async fn show(
    State(app): State<Shared>,
    caller: Caller,
    id: JobId,
    query: Result<Query<Poll>, QueryRejection>,
) -> Result<Response, Problem> {
    let expected = format!("a whole number of seconds up to {MAX_WAIT_S}");
    let bad = |detail: String| {
        Problem::new(ProblemType::BadParameter, detail).with("parameter", "wait").with("expected", expected.clone())
    };
    let poll = query
        .map(|Query(poll)| poll)
        .map_err(|_library_text| bad(format!("the only parameter of a job is `wait`, {expected}")))?;
    let wait = poll.wait();
    if wait > MAX_WAIT_S {
        let detail = format!("parameter `wait`: {wait} is more than {MAX_WAIT_S} s");
        return Err(bad(detail).with("value", wait).with("limit", MAX_WAIT_S));
    }
    let mut watched = app.job_store.watch(&id, caller.namespace).await?.ok_or_else(|| no_such_job(id.as_str()))?;
    let mut stopping = app.stopping.clone();
    let ended = async {
        tokio::select! {
            _ = watched.wait_for(|view| view.record.status.is_final()) => {}
            // The service stops. The client polls again after the restart.
            () = stop::reached(&mut stopping, Stop::Drain) => {}
        }
    };
    drop(tokio::time::timeout(Duration::from_secs(wait), ended).await);
    let view = watched.borrow().clone();
    Ok(answer(StatusCode::OK, &view, None))
}

/// Cancel a job
///
/// Returns the final status of the job, even if it was cancelled before. A job that succeeded or failed cannot be
/// cancelled (409 `job-ended`).
#[utoipa::path(delete, path = "/v1/jobs/{id}", tag = "jobs", operation_id = "dismissJob", params(JobPath),
    responses((status = 200, description = "The job is cancelled.", body = JobDocument), DismissProblems))]
pub(super) async fn dismiss(State(app): State<Shared>, caller: Caller, id: JobId) -> Result<Response, Problem> {
    let view = app.job_store.dismiss(&id, caller.namespace).await?.ok_or_else(|| no_such_job(id.as_str()))?;
    if view.record.status != Status::Dismissed {
        let detail = format!("the job is {} and cannot be cancelled", view.record.status.name());
        return Err(Problem::new(ProblemType::JobEnded, detail).with("status_name", view.record.status.name()));
    }
    Ok(answer(StatusCode::OK, &view, None))
}

/// Get the result of a job
///
/// Redirects to the mesh of a successful job. The target of a signed request is signed until the same time. For a
/// failed job the response is the error that the synchronous request would have returned.
#[utoipa::path(get, path = "/v1/jobs/{id}/result", tag = "jobs", operation_id = "showJobResult", params(JobPath),
    responses(
        (status = 303, description = "The job has succeeded.", headers(("Location"))),
        ResultProblems,
    ))]
pub(super) async fn result(State(app): State<Shared>, caller: Caller, id: JobId) -> Result<Response, Problem> {
    let view = app.job_store.view(&id, caller.namespace).await?.ok_or_else(|| no_such_job(id.as_str()))?;
    let record = &view.record;
    match (record.status, &record.result) {
        (Status::Successful, Some(key)) => {
            let gone = || {
                Problem::new(ProblemType::ResultGone, "the result was removed after some time; request the mesh again")
            };
            let key = ContentKey::parse(key, caller.namespace).map_err(|_bad| gone())?;
            let format = record.format.parse().map_err(|_unknown| Problem::other_release())?;
            if !is_stored(&app.store, format, &key).await? {
                return Err(gone());
            }
            let location = delivery::text(&results::path(&key, &record.format));
            Ok((StatusCode::SEE_OTHER, [(header::LOCATION, location)]).into_response())
        }
        (Status::Failed, _) => Err(Problem::recorded(record.problem.as_ref())),
        (Status::Dismissed, _) => {
            Err(Problem::new(ProblemType::JobDismissed, "the job was cancelled and has no result"))
        }
        _ => {
            Err(Problem::new(ProblemType::NoResultYet, "the job has not ended; poll with `?wait=` or read its events")
                .retry_after(Duration::from_secs(1)))
        }
    }
}

/// Answers a request with a job that takes about `wait`.
pub(super) fn accepted(view: &JobView, wait: Duration) -> Response {
    answer(StatusCode::ACCEPTED, view, Some(wait))
}

fn answer(status: StatusCode, view: &JobView, wait: Option<Duration>) -> Response {
    let mut response = (status, Json(document(view))).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if status == StatusCode::ACCEPTED {
        headers.insert(header::LOCATION, delivery::text(&format!("/v1/jobs/{}", view.record.id.as_str())));
    }
    if !view.record.status.is_final() {
        let seconds = wait.map_or(1, |wait| wait.saturating_add(Duration::from_millis(999)).as_secs().clamp(1, 600));
        headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    response
}

/// Returns a link to a resource of this media type.
pub(super) fn link(rel: &'static str, href: String, media_type: &'static str) -> Link {
    Link { rel, href, r#type: media_type }
}

/// Returns the problem of a failed job. Its instance is the request that created the job.
pub(super) fn problem(record: &JobRecord) -> Option<Value> {
    let mut problem = record.problem.clone()?;
    let request = record.requester.request.as_deref().unwrap_or(record.id.as_str());
    problem.as_object_mut()?.insert("instance".to_owned(), request.into());
    Some(problem)
}

/// Returns the document of a job.
pub(super) fn document(view: &JobView) -> JobDocument {
    let record = &view.record;
    let own = format!("/v1/jobs/{}", record.id.as_str());
    let mut links = vec![link("self", own.clone(), "application/json")];
    if !record.status.is_final() {
        links.push(link("monitor", format!("{own}/events"), "text/event-stream"));
    }
    if let Some(batch) = &record.batch {
        links.push(link("collection", format!("/v1/batches/{}", batch.as_str()), "application/json"));
    }
    if let Some(key) = &record.result {
        let results = "http://www.opengis.net/def/rel/ogc/1.0/results";
        links.push(link(results, format!("{own}/result"), "application/octet-stream"));
        links.push(link("describedby", format!("/v1/results/{key}/report.json"), "application/json"));
    }
    let parameters = record.parameters.iter().map(|(name, value)| (name.clone(), value.as_str().into())).collect();
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction")]
    let progress = (view.fraction * 100.0) as u64;
    JobDocument {
        job_id: record.id.as_str().to_owned(),
        process_id: "surface",
        r#type: "process",
        status: record.status,
        progress,
        fraction: view.fraction,
        stage: view.stage.as_deref().map(str::to_owned),
        attempts: record.attempts,
        created: rfc3339(record.created_ms),
        started: record.started_ms.map(rfc3339),
        finished: record.finished_ms.map(rfc3339),
        structure: record.input.to_string(),
        format: record.format.clone(),
        parameters,
        problem: problem(record),
        result: record.result.as_ref().map(|key| format!("{key}.{}", record.format)),
        links,
    }
}
