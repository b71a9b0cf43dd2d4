//! Partitions of a large mesh, which the workers of a cluster compute as jobs of which no client knows.
//!
//! The worker that writes the mesh dispatches the partitions when it knows the number of spheres. It then computes those
//! that no other worker has begun, one at a time, and joins the results of the others from the store. Locks of the
//! broker prevent that two workers compute one partition. Results are named by their contents, so that a second attempt
//! finds the results of the first one.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use metrics::counter;
use tokio::sync::watch;

use super::broker::WorkLock;
use super::coalesced_job::work_key;
use super::job_store::JobStore;
use super::record::JobRecord;
use super::records::LoadError;
use super::{ContentKey, Input, JobSpec, JobView, OwnedJob, Status, Task, results};
use crate::formats::Format;
use crate::pipeline::{is_divisible, surface_work};
use crate::store::Digest;
use crate::surface::{Control, PartitionSource, PartitionStep, SurfaceError, SurfaceParams};
use crate::sync::{Handle, sleep};
use crate::telemetry::PARTITIONS;

/// Maximum number of partitions of a mesh.
const MAX_PARTITIONS: u32 = 64;
/// Interval at which the states of partitions that other workers compute are read.
const POLL: Duration = Duration::from_millis(50);

/// Partitions of the mesh of a task.
struct Partitions {
    jobs: JobStore,
    runtime: Handle,
    /// Record of the job that writes the mesh.
    record: JobRecord,
    file: Bytes,
    digest: Digest,
    format: Format,
    /// Expected time of a partition.
    time: Duration,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    begun: bool,
    /// Partitions without a step.
    open: Vec<OpenPartition>,
    /// Partition that this process computes, and its lock.
    own: Option<(OpenPartition, Option<WorkLock>)>,
}

/// Partition that is dispatched as a job.
struct OpenPartition {
    index: u32,
    /// Cancels the job when the partition is finished.
    _job: OwnedJob,
    state: watch::Receiver<JobView>,
    /// Identity of the work of the job.
    work: Digest,
    /// Key of the result.
    key: ContentKey,
}

impl fmt::Debug for Partitions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Partitions").field("job", &self.record.id).finish_non_exhaustive()
    }
}

impl JobStore {
    /// Returns the source of the partitions of a task with its input; `None` if its mesh cannot be divided, or if this
    /// process does not share its jobs.
    pub(super) fn partitions_of(
        &self,
        record: &JobRecord,
        task: &Task,
        format: Format,
    ) -> Option<Arc<dyn PartitionSource>> {
        let (time, file) = (self.0.partition_time?, task.input.file()?);
        // Partitions are computed on the CPU.
        if self.0.pool.backend().name() != "cpu" || !is_divisible(&task.job) {
            return None;
        }
        Some(Arc::new(Partitions {
            jobs: self.clone(),
            runtime: Handle::current(),
            record: record.clone(),
            file: file.clone(),
            digest: task.digest,
            format,
            time,
            state: Mutex::default(),
        }))
    }
}

impl Partitions {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Dispatches the partitions.
    async fn dispatch(&self, count: u32) -> Result<Vec<OpenPartition>, String> {
        let (jobs, arithmetic) = (&self.jobs, self.jobs.0.pool.backend().arithmetic());
        let mut open = Vec::new();
        for index in 0..count {
            let record = JobRecord { partition: Some([index, count]), ..self.record.clone() };
            let (task, format) = jobs.task_of(&record, self.digest)?;
            let task = Task { input: Input::File(self.file.clone()), id: None, ..task };
            let key = ContentKey::new(&self.digest, &task.job, format, &arithmetic, task.namespace);
            let (work, file, parameters) = (work_key(&task), self.file.clone(), record.parameters);
            let spec = JobSpec { task, file, map: None, parameters, format, idempotency_key: None };
            let view = jobs.accept(spec, None).await.map_err(|error| error.to_string())?;
            let job = OwnedJob::new(jobs.clone(), &view);
            let state = job.watch().await.map_err(|error| error.to_string())?.ok_or("its record was lost")?;
            open.push(OpenPartition { index, _job: job, state, work, key });
        }
        Ok(open)
    }

    /// Returns the result of a partition; `None` if it is not in the store.
    fn result(&self, partition: &OpenPartition, control: &Control<'_>) -> Result<Option<Vec<u8>>, SurfaceError> {
        let load = results::load(&self.jobs.0.store, self.format, &partition.key, control);
        match self.runtime.block_on(load) {
            Err(LoadError::Memory(error)) => Err(error.into()),
            Err(error) => {
                tracing::warn!(%error, "the result of a partition is computed again");
                Ok(None)
            }
            Ok(bytes) => Ok(bytes),
        }
    }

    /// Returns the next step that needs no wait.
    fn step(&self, state: &mut State, control: &Control<'_>) -> Result<Option<PartitionStep>, SurfaceError> {
        let status = |partition: &OpenPartition| partition.state.borrow().record.status;
        if let Some(at) = state.open.iter().position(|partition| status(partition) == Status::Successful) {
            let partition = state.open.remove(at);
            let (index, bytes) = (partition.index, self.result(&partition, control)?);
            state.own = Some((partition, None));
            return Ok(Some(bytes.map_or(PartitionStep::Compute(index), |bytes| PartitionStep::Join(index, bytes))));
        }
        for at in 0..state.open.len() {
            let lock = match status(&state.open[at]) {
                Status::Running | Status::Successful => continue,
                Status::Failed | Status::Dismissed => None,
                Status::Accepted => match self.runtime.block_on(self.jobs.0.broker.lock(&state.open[at].work)) {
                    Some(lock) => Some(lock),
                    None => continue,
                },
            };
            if status(&state.open[at]) == Status::Successful {
                // Another worker has finished it meanwhile.
                return self.step(state, control);
            }
            let partition = state.open.remove(at);
            let index = partition.index;
            state.own = Some((partition, lock));
            return Ok(Some(PartitionStep::Compute(index)));
        }
        Ok(None)
    }
}

impl PartitionSource for Partitions {
    fn begin(&self, spheres: usize, params: &SurfaceParams) -> Option<u32> {
        let mut state = self.lock();
        if std::mem::replace(&mut state.begun, true) {
            return None;
        }
        let seconds = self.jobs.0.pool.seconds(surface_work(spheres as f64, params));
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let count = (seconds / self.time.as_secs_f64()).clamp(0.0, f64::from(MAX_PARTITIONS)) as u32;
        if count < 2 || !self.runtime.block_on(self.jobs.has_workers()) {
            return None;
        }
        match self.runtime.block_on(self.dispatch(count)) {
            Ok(open) => {
                tracing::info!(partitions = count, "workers share a mesh");
                state.open = open;
                Some(count)
            }
            Err(error) => {
                tracing::warn!(error, "one worker computes a large mesh, because its partitions were not accepted");
                None
            }
        }
    }

    fn next(&self, control: &Control<'_>) -> Result<Option<PartitionStep>, SurfaceError> {
        let mut state = self.lock();
        while !state.open.is_empty() {
            control.check()?;
            if let Some(step) = self.step(&mut state, control)? {
                return Ok(Some(step));
            }
            self.runtime.block_on(async { sleep(POLL).await });
        }
        Ok(None)
    }

    fn finished(&self, index: u32, is_joined: bool) {
        let computed = if is_joined { "elsewhere" } else { "here" };
        counter!(PARTITIONS, "computed" => computed).increment(1);
        tracing::debug!(index, computed, "a partition is finished");
        self.lock().own = None;
    }
}
