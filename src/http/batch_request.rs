//! Acceptance of a batch: reads its files once to check and name them, then again to accept the jobs of each.

use std::collections::HashSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use futures_util::stream::{self, BoxStream, StreamExt as _};
use tokio::sync::mpsc;

use super::batch_archive::{self, ArchiveEntry, ArchiveLimits};
use super::batch_plan::BatchPlan;
use super::guard::Caller;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::{Loaded, StructureSource};
use super::state::{Delivery, Shared};
use crate::jobs::{
    BatchFile, BatchRecord, Budget, Input, JobId, JobSpec, Lane, MAX_RECORD_BYTES, Rank, Room, Task, now_ms,
};
use crate::store::{Digest, Name, Pin};
use crate::structure::detect_format;
use crate::structure::stream::ScratchFile;
use crate::surface::Control;
use crate::telemetry::SpanParent;

/// Number of files whose jobs are accepted concurrently, since each waits for the disk.
const CONCURRENT_FILES: usize = 4;
/// Number of archive entries that are fetched concurrently: the default share of one client.
const CONCURRENT_ENTRIES: usize = 2;

/// Source of the files of a batch.
pub(super) enum BatchSource {
    /// Archive in the request.
    Archive(Arc<ScratchFile>),
    /// PDB ids.
    PdbIds(Vec<String>),
}

/// Request for a batch.
pub(super) struct NewBatch {
    pub(super) app: Shared,
    pub(super) caller: Caller,
    pub(super) source: BatchSource,
    pub(super) plan: BatchPlan,
    /// Parameters as the client wrote them.
    pub(super) pairs: Vec<(String, String)>,
    pub(super) idempotency_key: Option<String>,
    pub(super) rank: Rank,
    pub(super) parent: SpanParent,
}

/// File of a batch, or the reason for which it was refused.
struct CheckedFile {
    name: String,
    input: Result<Digest, Problem>,
}

impl NewBatch {
    /// Accepts the jobs of the batch and stores its record. `delivery` is held meanwhile. With an idempotency key, a
    /// request that is repeated after an error keeps the jobs that were accepted; without one they are cancelled.
    pub(super) async fn accept(self, delivery: Delivery) -> Result<BatchRecord, Problem> {
        let (jobs, namespace, client) = (&self.app.job_store, self.caller.namespace, self.caller.client);
        let key = self.idempotency_key.as_deref();
        let id = jobs.batch_id(client, namespace, key)?;
        let file = |CheckedFile { name, input }| match input {
            Ok(digest) => BatchFile { name, input: Some(digest), problem: None, jobs: Vec::new() },
            Err(problem) => {
                BatchFile { name, input: None, problem: Some(problem.record(id.as_str())), jobs: Vec::new() }
            }
        };
        let files = self.check_files().await?.into_iter().map(file).collect();
        let mut record =
            BatchRecord { id: id.clone(), namespace, created_ms: now_ms(), parameters: self.pairs.clone(), files };
        if key.is_some()
            && let Some(stored) = jobs.batch(&id, namespace).await?
        {
            return existing(stored, &record);
        }
        if record.encoded_bytes() > MAX_RECORD_BYTES {
            let detail = format!(
                "the names of the files and the reasons for rejections take more than {MAX_RECORD_BYTES} bytes; divide the batch"
            );
            return Err(Problem::new(ProblemType::BodyTooLarge, detail).with("limit", MAX_RECORD_BYTES));
        }
        self.check_room(&record, jobs.room())?;
        let admitted = jobs.admit_batch(&id).await?;
        let mut pins = Vec::new();
        let accepted = self.accept_jobs(&mut record, &mut pins).await;
        let stored = match accepted {
            Ok(()) => jobs.put_batch(record.clone(), admitted).await.map_err(Problem::from),
            Err(problem) => Err(problem),
        };
        drop((delivery, pins));
        match stored {
            Ok(stored) => existing(stored, &record),
            Err(problem) => {
                // Without a key, no later request can continue the batch.
                if key.is_none()
                    && let Err(error) = jobs.dismiss_batch(&record).await
                {
                    tracing::warn!(%error, "a job of a rejected batch is not cancelled");
                }
                Err(problem)
            }
        }
    }

    fn budget(&self) -> Budget {
        self.app.uploads.for_client(self.caller.client.0)
    }

    fn limits(&self) -> ArchiveLimits {
        let limits = &self.app.config.limits;
        ArchiveLimits { entry: limits.body_bytes, total: limits.inflated_bytes }
    }

    /// Returns all files, checked as far as possible without reading their atoms.
    async fn check_files(&self) -> Result<Vec<CheckedFile>, Problem> {
        let files = match &self.source {
            BatchSource::Archive(file) => {
                let (file, limits, budget) = (Arc::clone(file), self.limits(), self.budget());
                let extensions = self.plan.extensions();
                let read = self.app.read(&self.caller, (), move |control| {
                    let mut files = Vec::new();
                    let visit = |ArchiveEntry { name, content }: ArchiveEntry| {
                        let input = content.and_then(|bytes| {
                            detect_format(&bytes).map_err(Problem::from)?;
                            Ok(Digest::of(&bytes))
                        });
                        files.push(CheckedFile { name, input });
                        Ok(())
                    };
                    batch_archive::read(&file.file, limits, &extensions, &budget, control, visit).map(|()| files)
                });
                read.await??
            }
            BatchSource::PdbIds(ids) => {
                // Before anything is fetched.
                Self::check_size(ids.len() * self.plan.jobs.len().max(1), self.app.job_store.room())?;
                self.fetch_entries(ids).await?
            }
        };
        if files.is_empty() {
            return Err(Problem::new(ProblemType::BadRequest, "the batch has no files"));
        }
        Ok(files)
    }

    /// Fetches archive entries. A later request for them finds their copies.
    async fn fetch_entries(&self, ids: &[String]) -> Result<Vec<CheckedFile>, Problem> {
        let mut names = HashSet::new();
        let check = |id: &String| {
            let (name, app, caller) = (id.to_ascii_lowercase(), Arc::clone(&self.app), self.caller.clone());
            let source = if names.insert(name.clone()) {
                StructureSource::from_pdb_id(&name)
            } else {
                Err(Problem::new(ProblemType::BadRequest, "the batch has an earlier entry of this id"))
            };
            async move {
                let input = match source {
                    Ok(source) => source.digest(&app, &caller).await,
                    Err(problem) => Err(problem),
                };
                CheckedFile { name, input }
            }
        };
        let checks: Vec<_> = ids.iter().map(check).collect();
        let mut checks = stream::iter(checks).buffered(CONCURRENT_ENTRIES);
        let mut files = Vec::new();
        while let Some(checked) = checks.next().await {
            match checked.input {
                // A later attempt of the whole batch may succeed.
                Err(problem) if problem.is_temporary() || problem.is(ProblemType::Internal) => return Err(problem),
                input => files.push(CheckedFile { input, ..checked }),
            }
        }
        Ok(files)
    }

    /// Rejects a batch that could not run even alone.
    fn check_size(n: usize, Room { jobs: limit, .. }: Room) -> Result<(), Problem> {
        if n <= limit {
            return Ok(());
        }
        let keys = "jobs.records_per_client less one, or broker.queue";
        let detail = format!("the batch has {n} jobs, the limit is {limit} ({keys}); divide it");
        Err(Problem::new(ProblemType::BodyTooLarge, detail).with("limit", limit).with("actual", n))
    }

    /// Rejects a batch whose jobs do not fit into the queue.
    fn check_room(&self, record: &BatchRecord, room: Room) -> Result<(), Problem> {
        let files = record.files.iter().filter(|file| file.input.is_some()).count();
        let n = files * self.plan.jobs.len();
        Self::check_size(n, room)?;
        let Room { queued, queue, .. } = room;
        if queued + n > queue {
            let wait = self.app.pool.estimated_wait(Lane::Batch);
            let detail = format!("the batch has {n} jobs, and {queued} are waiting in a queue of {queue}");
            let problem = Problem::new(ProblemType::QueueFull, detail).with("limit", queue).with("actual", queued);
            return Err(problem.with("estimated_wait_s", wait.as_secs_f64()).retry_after(wait));
        }
        Ok(())
    }

    /// Accepts the jobs of all files and adds them to the record.
    async fn accept_jobs(&self, record: &mut BatchRecord, pins: &mut Vec<Pin>) -> Result<(), Problem> {
        let failed = AtomicBool::new(false);
        let id = record.id.clone();
        let accept = |(index, loaded): (usize, Result<Loaded, Problem>)| {
            let (id, failed) = (&id, &failed);
            async move {
                let mut jobs = Vec::new();
                let digest = loaded.as_ref().map(|loaded| loaded.digest).ok();
                let accepted = match loaded {
                    Ok(loaded) => self.accept_file(id, index, &loaded, &mut jobs).await,
                    Err(problem) => Err(problem),
                };
                failed.fetch_or(accepted.is_err(), Ordering::Relaxed);
                (index, digest, jobs, accepted)
            }
        };
        // After an error, no further file is read.
        let files = self.load(record).take_while(|_| std::future::ready(!failed.load(Ordering::Relaxed)));
        let mut accepting = files.map(accept).buffered(CONCURRENT_FILES);
        let mut outcome = Ok(());
        let mut accepted = Vec::new();
        while let Some((index, digest, jobs, ended)) = accepting.next().await {
            // At the cap of the client, the batch is rejected instead of losing its first results.
            pins.extend(
                jobs.iter()
                    .filter_map(|job: &JobId| Name::job(job.as_str()).ok())
                    .map(|name| self.app.store.pin(&name)),
            );
            accepted.push((index, digest, jobs));
            outcome = outcome.and(ended);
        }
        drop(accepting);
        for (index, digest, jobs) in accepted {
            let file = &mut record.files[index];
            // The archive may have another file of an entry now.
            file.input = digest.or(file.input);
            file.jobs.extend(jobs);
        }
        outcome
    }

    /// Accepts the jobs of a file and adds their ids to `accepted`.
    async fn accept_file(
        &self,
        batch: &JobId,
        index: usize,
        loaded: &Loaded,
        accepted: &mut Vec<JobId>,
    ) -> Result<(), Problem> {
        let Some(file) = loaded.input.file() else { return Err(Problem::internal("a file was not loaded")) };
        let namespace = self.caller.namespace;
        // The areas are computed when the results are sent.
        if self.plan.areas.is_some() {
            self.app.store.put_input(&loaded.digest, namespace, file.clone()).await?;
        }
        for output in &self.plan.jobs {
            let spec = JobSpec {
                task: Task {
                    input: Input::File(file.clone()),
                    digest: loaded.digest,
                    namespace,
                    request: output.request.clone(),
                    rank: self.rank,
                    reservation: Some(Arc::clone(&loaded.reservation)),
                    parent: self.parent.clone(),
                    id: None,
                },
                file: file.clone(),
                map: None,
                parameters: output.pairs.clone(),
                // A key of a client has no tab.
                idempotency_key: Some(format!("{}\t{index}\t{}", batch.as_str(), output.request.format.name())),
                batch: Some(batch.clone()),
            };
            accepted.push(self.app.job_store.accept(spec, None).await?.record.id);
        }
        Ok(())
    }

    /// Loads the files that were not refused, with their indices.
    fn load(&self, record: &BatchRecord) -> BoxStream<'_, (usize, Result<Loaded, Problem>)> {
        let inputs: Vec<Option<Digest>> = record.files.iter().map(|file| file.input).collect();
        match &self.source {
            BatchSource::Archive(file) => {
                let (sender, receiver) = mpsc::channel(1);
                let (file, limits, budget) = (Arc::clone(file), self.limits(), self.budget());
                let extensions = self.plan.extensions();
                tokio::task::spawn_blocking(move || send_files(&file, limits, &extensions, &budget, &inputs, &sender));
                stream::unfold(receiver, |mut receiver| async { Some((receiver.recv().await?, receiver)) }).boxed()
            }
            BatchSource::PdbIds(_) => {
                let files = record.files.iter().enumerate().filter(|(_, file)| file.input.is_some());
                let accepted: Vec<_> = files.map(|(index, file)| (index, file.name.clone())).collect();
                let load = move |(index, name): (usize, String)| async move {
                    let loaded = async { StructureSource::from_pdb_id(&name)?.load(&self.app, &self.caller).await };
                    (index, loaded.await)
                };
                stream::iter(accepted).then(load).boxed()
            }
        }
    }
}

/// Sends the files of an archive that were not refused.
fn send_files(
    file: &ScratchFile,
    limits: ArchiveLimits,
    extensions: &[&'static str],
    budget: &Budget,
    inputs: &[Option<Digest>],
    sender: &mpsc::Sender<(usize, Result<Loaded, Problem>)>,
) {
    let mut index = 0;
    let gone = |_| Problem::new(ProblemType::Internal, "the batch is not accepted any more");
    let loaded = |bytes: Bytes, digest| Loaded::file(bytes, digest, budget.reservation());
    let visit = |ArchiveEntry { content, .. }: ArchiveEntry| {
        let sent = match inputs.get(index).copied().flatten() {
            Some(digest) => sender.blocking_send((index, content.map(|bytes| loaded(bytes, digest)))).map_err(gone),
            None => Ok(()),
        };
        index += 1;
        sent
    };
    if let Err(problem) = batch_archive::read(&file.file, limits, extensions, budget, &Control::default(), visit) {
        // The files that were not read are missing otherwise.
        drop(sender.blocking_send((index.min(inputs.len().saturating_sub(1)), Err(problem))));
    }
}

/// Returns the stored batch if it has the request of `record`.
fn existing(stored: BatchRecord, record: &BatchRecord) -> Result<BatchRecord, Problem> {
    if stored.is_same_request(record) {
        return Ok(stored);
    }
    let detail = "the idempotency key was used for another batch";
    Err(Problem::new(ProblemType::OtherRequest, detail).with("parameter", "Idempotency-Key"))
}
