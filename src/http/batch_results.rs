//! `GET /v1/batches/{id}/results.tar`: results of a batch in the order of its files, each as soon as its jobs have
//! ended, and a summary of all files at the end.

use std::io;
use std::time::Duration;

use axum::body::Body;
use axum::extract::State;
use axum::http::HeaderValue;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use bytes::{Bytes, BytesMut};
use futures_util::{TryStreamExt as _, stream};
use serde::Serialize;
use serde_json::Value;
use tokio::sync::mpsc;
use tracing::Instrument as _;

use super::batch_names::{SUMMARY, stem};
use super::batch_plan::AREAS_EXTENSION;
use super::batch_state::{find, plan};
use super::content_type::DeclaredType;
use super::guard::Caller;
use super::openapi::bodies::ArchiveFile;
use super::openapi::parameters::BatchPath;
use super::openapi::problem_responses;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::StructureSource;
use super::state::Shared;
use super::stop::{self, Stop};
use super::{areas, jobs, results};
use crate::jobs::{BatchFile, BatchRecord, ContentKey, JobId, JobRecord, MemoryReservation, Status};
use crate::pipeline::params::areas::AreasRequest;
use crate::store::{Digest, StoreError};

/// Number of buffered pieces per client.
const PIECES: usize = 4;
/// Size of the blocks of a tar archive, bytes.
const BLOCK: usize = 512;
/// Number of attempts to compute areas while the service is busy, and the pause between two.
const ATTEMPTS: usize = 60;
const PAUSE: Duration = Duration::from_secs(1);

/// Written file of a summary's line.
#[derive(Debug, Serialize)]
struct WrittenFile {
    file: String,
    bytes: u64,
    /// Path of the report of a mesh or a picture.
    #[serde(skip_serializing_if = "Option::is_none")]
    report: Option<String>,
}

/// Line of the summary: the members of `molmesh mesh --summary` that do not depend on a command, and the written files.
#[derive(Debug, Serialize)]
struct SummaryLine<'a> {
    input: &'a str,
    /// `written`, or `failed` if an output is missing.
    status: &'static str,
    /// Time of computing the meshes and pictures.
    seconds: f64,
    files: Vec<WrittenFile>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<Value>,
    /// First problem of the file.
    #[serde(skip_serializing_if = "Option::is_none")]
    problem: Option<Value>,
}

/// Reason for which the archive is not written to its end.
enum Abort {
    ClientLeft,
    Failed(String),
}

impl From<StoreError> for Abort {
    fn from(error: StoreError) -> Self {
        Self::Failed(error.to_string())
    }
}

problem_responses!(ResultsProblems: [RECORD] ShareExceeded);

/// Get the results of a batch
///
/// A tar archive that is sent while the batch runs: the results of each file in the order of the request, as soon as
/// its jobs have ended. Each name is that of the file with the extension of the format; tables of areas end in `.csv`.
/// The last entry, `summary.jsonl`, has a line for each file: the written files, or the problem. If the service stops
/// or fails meanwhile, the response is cut off and can be requested again.
#[utoipa::path(get, path = "/v1/batches/{id}/results.tar", tag = "jobs", operation_id = "showBatchResults",
    params(BatchPath),
    responses(
        (status = 200, description = "The archive.", body = ArchiveFile, content_type = "application/octet-stream"),
        ResultsProblems,
    ))]
pub(super) async fn show(State(app): State<Shared>, caller: Caller, id: JobId) -> Result<Response, Problem> {
    let batch = find(&app, &caller, &id).await?;
    let areas = plan(&batch.record)?.areas;
    if areas.is_some() {
        app.admit_work(&caller)?;
    }
    let share = app.delivery_shares.take(caller.client.0)?;
    let (sender, receiver) = mpsc::channel(PIECES);
    let summary = Summary { lines: BytesMut::new(), memory: app.memory(caller.client).reservation() };
    let writer = ResultsWriter { app, caller, sender, areas, summary };
    let write = async move {
        writer.write(&batch.record).await;
        // Held until the archive is written.
        drop((share, batch));
    };
    tokio::spawn(write.in_current_span());
    let body = stream::unfold(receiver, async |mut receiver| Some((receiver.recv().await?, receiver)));
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static("application/octet-stream")),
        (header::CONTENT_DISPOSITION, HeaderValue::from_static("attachment; filename=\"results.tar\"")),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
    ];
    Ok((headers, Body::from_stream(body)).into_response())
}

struct ResultsWriter {
    app: Shared,
    caller: Caller,
    sender: mpsc::Sender<io::Result<Bytes>>,
    areas: Option<AreasRequest>,
    summary: Summary,
}

/// Lines of the summary so far, and the memory that they are charged to.
struct Summary {
    lines: BytesMut,
    memory: MemoryReservation,
}

impl ResultsWriter {
    /// Writes the archive. After an error the body fails, so that its beginning does not look complete.
    async fn write(mut self, record: &BatchRecord) {
        match self.write_files(record).await {
            Ok(()) => {}
            Err(Abort::ClientLeft) => tracing::debug!("the client left"),
            Err(Abort::Failed(why)) => {
                tracing::warn!(why, "the results of a batch were not sent to their end");
                drop(self.sender.send(Err(io::Error::other("the results could not be sent to their end"))).await);
            }
        }
    }

    async fn write_files(&mut self, record: &BatchRecord) -> Result<(), Abort> {
        for file in &record.files {
            let mut line = serde_json::to_vec(&self.write_file(file).await?).map_err(failed)?;
            line.push(b'\n');
            let Summary { lines, memory } = &mut self.summary;
            memory.extend(lines, &line, 0).map_err(failed)?;
        }
        let summary = std::mem::take(&mut self.summary.lines).freeze();
        let size = summary.len() as u64;
        self.send(entry_header(SUMMARY, size, record.created_ms)?).await?;
        self.send(summary).await?;
        // Two empty blocks end the archive.
        self.send(padding(size, 2)).await
    }

    /// Writes the outputs of a file and returns its line of the summary.
    async fn write_file<'a>(&self, file: &'a BatchFile) -> Result<SummaryLine<'a>, Abort> {
        let stem = stem(&file.name);
        let (mut files, mut problem, mut ms) = (Vec::new(), file.problem.clone(), 0);
        for id in &file.jobs {
            match self.wait_for_end(id).await? {
                Ok(record) => {
                    ms += record.finished_ms.unwrap_or(0).saturating_sub(record.started_ms.unwrap_or(u64::MAX));
                    match self.write_result(stem, &record).await? {
                        Ok(written) => files.push(written),
                        Err(missing) => problem = problem.or(Some(missing)),
                    }
                }
                Err(missing) => problem = problem.or(Some(missing)),
            }
        }
        if let (Some(areas), Some(digest)) = (&self.areas, file.input) {
            match self.write_areas(stem, digest, areas).await? {
                Ok(written) => files.push(written),
                Err(missing) => problem = problem.or(Some(missing)),
            }
        }
        let error = problem.as_ref().map(|problem| problem["detail"].clone());
        let status = if error.is_some() { "failed" } else { "written" };
        #[expect(clippy::cast_precision_loss, reason = "a time in seconds")]
        let seconds = ms as f64 / 1e3;
        Ok(SummaryLine { input: &file.name, status, seconds, files, error, problem })
    }

    /// Returns the reason to stop waiting, once there is one. The client asks again after a restart.
    async fn interruption(&self) -> Abort {
        let mut stopping = self.app.stopping.clone();
        tokio::select! {
            () = self.sender.closed() => Abort::ClientLeft,
            () = stop::reached(&mut stopping, Stop::Drain) => Abort::Failed("the service stops".to_owned()),
        }
    }

    /// Waits for the end of a job. Returns its record, or its problem.
    async fn wait_for_end(&self, id: &JobId) -> Result<Result<JobRecord, Value>, Abort> {
        let gone = || Problem::new(ProblemType::ResultGone, "the record of the job was removed after some time");
        let watched = match self.app.job_store.watch(id, self.caller.namespace).await {
            Ok(watched) => watched,
            Err(StoreError::Quarantined { .. }) => None,
            Err(error) => return Err(error.into()),
        };
        let Some(mut watched) = watched else { return Ok(Err(gone().record(id.as_str()))) };
        tokio::select! {
            ended = watched.wait_for(|view| view.record.status.is_final()) => drop(ended.map_err(failed)?),
            why = self.interruption() => return Err(why),
        }
        let record = watched.borrow().record.clone();
        Ok(match record.status {
            Status::Successful => Ok(record),
            Status::Failed => Err(jobs::problem(&record).unwrap_or_default()),
            _ => Err(Problem::new(ProblemType::JobDismissed, "the job was cancelled").record(id.as_str())),
        })
    }

    /// Writes the result of a job, or returns the problem of a result that is not stored any more.
    async fn write_result(&self, stem: &str, record: &JobRecord) -> Result<Result<WrittenFile, Value>, Abort> {
        let format = record.format.parse().map_err(failed)?;
        let key = ContentKey::parse(record.result.as_deref().unwrap_or_default(), record.namespace).map_err(failed)?;
        let stored = results::read(&self.app, &self.caller, &key, format).await;
        let Some((size, mut pieces)) = stored.map_err(|problem| failed(problem.into_detail()))? else {
            let gone = Problem::new(ProblemType::ResultGone, "the result was removed after some time");
            return Ok(Err(gone.record(record.id.as_str())));
        };
        let file = format!("{stem}.{}", record.format);
        self.send(entry_header(&file, size, record.finished_ms.unwrap_or(0))?).await?;
        let mut sent = 0;
        while let Some(piece) = pieces.try_next().await? {
            sent += piece.len() as u64;
            self.send(piece).await?;
        }
        if sent != size {
            return Err(Abort::Failed(format!("a result has {sent} bytes instead of {size}")));
        }
        self.send(padding(size, 0)).await?;
        Ok(Ok(WrittenFile { file, bytes: size, report: Some(format!("/v1/results/{key}/report.json")) }))
    }

    /// Computes the areas of a stored structure and writes their table, or returns the problem.
    async fn write_areas(
        &self,
        stem: &str,
        digest: Digest,
        request: &AreasRequest,
    ) -> Result<Result<WrittenFile, Value>, Abort> {
        let mut left = ATTEMPTS;
        let table = loop {
            left -= 1;
            match self.table(digest, request).await {
                Ok(table) => break table,
                Err(problem) if problem.is_temporary() && left > 0 => {}
                Err(problem) => return Ok(Err(problem.record(&digest.to_string()))),
            }
            tokio::select! {
                () = tokio::time::sleep(PAUSE) => {}
                why = self.interruption() => return Err(why),
            }
        };
        let (file, bytes) = (format!("{stem}.{AREAS_EXTENSION}"), table.len() as u64);
        self.send(entry_header(&file, bytes, crate::jobs::now_ms())?).await?;
        self.send(table).await?;
        self.send(padding(bytes, 0)).await?;
        Ok(Ok(WrittenFile { file, bytes, report: None }))
    }

    async fn table(&self, digest: Digest, request: &AreasRequest) -> Result<Bytes, Problem> {
        let Self { app, caller, .. } = self;
        let delivery = app.delivery(caller.client)?;
        let loaded = StructureSource::Stored(digest).load(app, caller).await?;
        areas::table(app, caller, loaded, delivery, request, DeclaredType::Neutral).await
    }

    async fn send(&self, bytes: Bytes) -> Result<(), Abort> {
        if bytes.is_empty() {
            return Ok(());
        }
        self.sender.send(Ok(bytes)).await.map_err(|_gone| Abort::ClientLeft)
    }
}

fn failed(error: impl std::fmt::Display) -> Abort {
    Abort::Failed(error.to_string())
}

/// Returns the header of an entry of `size` bytes.
fn entry_header(name: &str, size: u64, modified_ms: u64) -> Result<Bytes, Abort> {
    let mut header = tar::Header::new_gnu();
    header.set_size(size);
    header.set_mode(0o644);
    header.set_mtime(modified_ms / 1000);
    let mut builder = tar::Builder::new(Vec::new());
    // The content follows later.
    builder.append_data(&mut header, name, io::empty()).map_err(failed)?;
    Ok(Bytes::copy_from_slice(builder.get_ref()))
}

/// Returns the zeros after an entry of `size` bytes, and `more` empty blocks.
fn padding(size: u64, more: usize) -> Bytes {
    let past = usize::try_from(size % BLOCK as u64).unwrap_or(0);
    Bytes::from_static(&[0; 3 * BLOCK]).slice(..(BLOCK - past) % BLOCK + more * BLOCK)
}
