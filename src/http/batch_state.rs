//! State of a batch: that of its jobs, file by file.

use std::sync::Arc;

use futures_util::stream::{self, StreamExt as _, TryStreamExt as _};
use serde::Serialize;
use serde_json::{Map, Value};
use utoipa::ToSchema;

use super::batch_plan::BatchPlan;
use super::guard::Caller;
use super::job_list::{self, DEFAULT_LIMIT};
use super::jobs::{self, Link, StatusSchema, link};
use super::openapi::problems::ProblemDocument;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::Shared;
use crate::jobs::{BatchFile, BatchRecord, JobId, MemoryReservation, Status, rfc3339};
use crate::pipeline::params::{self, ParamError};
use crate::store::StoreError;

/// Concurrent reads of job records.
const CONCURRENT_READS: usize = 16;

/// Number of files in each state.
#[derive(Debug, Default, PartialEq, Serialize, ToSchema)]
pub(super) struct BatchCounts {
    /// Files whose jobs are queued.
    accepted: usize,
    /// Files with a job that runs or has ended, and one that has not.
    running: usize,
    /// Files of which all jobs have succeeded.
    successful: usize,
    /// Files that were refused, or of which a job has failed or was removed.
    failed: usize,
    /// Files of which a job was cancelled.
    dismissed: usize,
}

/// Job of a file.
#[derive(Debug, Serialize, ToSchema)]
struct MemberJob {
    /// Format of the result.
    format: &'static str,
    /// Id of the job, for `GET /v1/jobs/{id}`.
    #[serde(rename = "jobID")]
    job_id: String,
}

/// File of a batch.
#[derive(Debug, Serialize, ToSchema)]
struct BatchMember {
    /// Name in the archive, or PDB id.
    file: String,
    /// State of the file.
    #[schema(value_type = StatusSchema)]
    status: Status,
    /// SHA-256 digest of the structure, in hexadecimal; null if the file was refused.
    #[schema(required)]
    structure: Option<String>,
    /// Jobs of the file.
    jobs: Vec<MemberJob>,
    /// Reason for which the file was refused or failed; null otherwise.
    #[schema(required, value_type = Option<ProblemDocument>)]
    problem: Option<Value>,
}

/// State of a batch.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct BatchDocument {
    /// Id of the batch.
    #[serde(rename = "batchID")]
    batch_id: String,
    /// State of the batch: `successful` if all files have ended and at least one succeeded, `failed` if none did.
    #[schema(value_type = StatusSchema)]
    pub(super) status: Status,
    /// Files that have ended, in per cent.
    #[schema(minimum = 0, maximum = 100)]
    progress: usize,
    /// Time of acceptance.
    #[schema(format = DateTime)]
    created: String,
    /// Number of files.
    files: usize,
    /// Number of files in each state.
    pub(super) counts: BatchCounts,
    /// Outputs of each file.
    outputs: Vec<&'static str>,
    /// Parameters as given in the request.
    #[schema(value_type = std::collections::BTreeMap<String, String>)]
    parameters: Map<String, Value>,
    /// A page of the files, in the order of the request; empty in events.
    members: Vec<BatchMember>,
    /// Related resources, among them the `next` page unless this is the last one.
    links: Vec<Link>,
}

/// Page of the members of a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Page {
    /// Number of files to skip.
    offset: usize,
    /// Number of files to list.
    limit: usize,
}

impl Page {
    /// First page.
    pub(super) const FIRST: Self = Self { offset: 0, limit: DEFAULT_LIMIT };
    /// Page of events.
    pub(super) const NO_MEMBERS: Self = Self { offset: 0, limit: 0 };

    /// Parses the parameters of a page.
    pub(super) fn parse(pairs: &[(String, String)]) -> Result<Self, ParamError> {
        params::check_names(pairs, &["offset", "limit"])?;
        let offset = |text: &str| {
            text.parse().map_err(|_bad| ParamError::bad_value("offset", text, "the number of files to skip"))
        };
        Ok(Self {
            offset: job_list::single(pairs, "offset")?.map_or(Ok(0), offset)?,
            limit: job_list::parse_limit(pairs)?,
        })
    }
}

fn no_such_batch(id: &JobId) -> Problem {
    let detail = format!("there is no batch `{}`: batches are removed some time after their end", id.as_str());
    Problem::new(ProblemType::NoSuchJob, detail)
}

/// Batch of a caller, and the memory that its record takes.
pub(super) struct FoundBatch {
    pub(super) record: BatchRecord,
    _memory: MemoryReservation,
}

/// Memory of a record as a multiple of its stored size.
const RECORD_FACTOR: u64 = 4;

/// Returns a batch of the caller.
pub(super) async fn find(app: &Shared, caller: &Caller, id: &JobId) -> Result<FoundBatch, Problem> {
    let record = app.job_store.batch(id, caller.namespace).await?.ok_or_else(|| no_such_batch(id))?;
    let memory = app.memory(caller.client).reservation();
    memory.grow(RECORD_FACTOR * record.encoded_bytes() as u64)?;
    Ok(FoundBatch { record, _memory: memory })
}

/// Returns the outputs of a batch on record.
pub(super) fn plan(record: &BatchRecord) -> Result<BatchPlan, Problem> {
    BatchPlan::parse(&record.parameters).map_err(|_other| Problem::other_release())
}

/// Returns the status of a file from those of its jobs.
fn file_status(file: &BatchFile, jobs: &[Option<Status>]) -> Status {
    let any = |found: Status| jobs.contains(&Some(found));
    let is_open = any(Status::Accepted) || any(Status::Running);
    if file.problem.is_some() {
        Status::Failed
    } else if is_open {
        if jobs.iter().all(|job| *job == Some(Status::Accepted)) { Status::Accepted } else { Status::Running }
    } else if any(Status::Dismissed) {
        Status::Dismissed
    } else if any(Status::Failed) || jobs.contains(&None) {
        Status::Failed
    } else {
        Status::Successful
    }
}

/// Returns the status of a batch.
fn batch_status(counts: &BatchCounts, files: usize) -> Status {
    let BatchCounts { accepted, running, successful, dismissed, .. } = *counts;
    if running > 0 || accepted > 0 && accepted + counts.failed < files {
        Status::Running
    } else if accepted > 0 {
        Status::Accepted
    } else if dismissed > 0 {
        Status::Dismissed
    } else if successful > 0 {
        Status::Successful
    } else {
        Status::Failed
    }
}

/// Returns the document of a batch with a page of its members.
pub(super) async fn document(app: &Shared, record: &BatchRecord, page: Page) -> Result<BatchDocument, Problem> {
    let plan = plan(record)?;
    let ids: Vec<JobId> = record.files.iter().flat_map(|file| file.jobs.iter().cloned()).collect();
    let read = stream::iter(ids).map(|id| {
        let (app, namespace) = (Arc::clone(app), record.namespace);
        async move { app.job_store.status(&id, namespace).await }
    });
    let jobs: Vec<Option<Status>> = read.buffered(CONCURRENT_READS).try_collect().await?;
    let (mut rest, mut counts) = (&jobs[..], BatchCounts::default());
    let mut statuses = Vec::with_capacity(record.files.len());
    for file in &record.files {
        let (own, others) = rest.split_at(file.jobs.len());
        rest = others;
        let status = file_status(file, own);
        *match status {
            Status::Accepted => &mut counts.accepted,
            Status::Running => &mut counts.running,
            Status::Successful => &mut counts.successful,
            Status::Failed => &mut counts.failed,
            Status::Dismissed => &mut counts.dismissed,
        } += 1;
        statuses.push(status);
    }
    let Page { offset, limit } = page;
    let mut members = Vec::new();
    for (file, status) in record.files.iter().zip(statuses).skip(offset).take(limit) {
        members.push(member(app, record, &plan, file, status).await?);
    }
    let end = offset.saturating_add(limit);
    let own = format!("/v1/batches/{}", record.id.as_str());
    let files = record.files.len();
    let mut links = vec![
        link("self", own.clone(), "application/json"),
        link("monitor", format!("{own}/events"), "text/event-stream"),
        link(
            "http://www.opengis.net/def/rel/ogc/1.0/results",
            format!("{own}/results.tar"),
            "application/octet-stream",
        ),
    ];
    if end < files && limit > 0 {
        links.push(link("next", format!("{own}?offset={end}&limit={limit}"), "application/json"));
    }
    Ok(BatchDocument {
        batch_id: record.id.as_str().to_owned(),
        status: batch_status(&counts, files),
        progress: 100 * (files - counts.accepted - counts.running) / files.max(1),
        created: rfc3339(record.created_ms),
        files,
        counts,
        outputs: plan.names(),
        parameters: record.parameters.iter().map(|(name, value)| (name.clone(), value.as_str().into())).collect(),
        members,
        links,
    })
}

async fn member(
    app: &Shared,
    record: &BatchRecord,
    plan: &BatchPlan,
    file: &BatchFile,
    status: Status,
) -> Result<BatchMember, Problem> {
    let mut problem = file.problem.clone();
    if status == Status::Failed {
        for id in &file.jobs {
            let view = match app.job_store.view_once(id, record.namespace).await {
                Err(StoreError::Quarantined { .. }) => None,
                view => view?,
            };
            problem = problem.or(view.and_then(|view| jobs::problem(&view.record)));
        }
    }
    let jobs = file.jobs.iter().zip(&plan.jobs);
    let jobs =
        jobs.map(|(id, output)| MemberJob { format: output.request.format.name(), job_id: id.as_str().to_owned() });
    Ok(BatchMember {
        file: file.name.clone(),
        status,
        structure: file.input.map(|digest| digest.to_string()),
        jobs: jobs.collect(),
        problem,
    })
}
