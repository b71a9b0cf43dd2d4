//! Partitions of a large mesh, which the workers of a cluster share.
//!
//! The worker that writes the mesh dispatches helpers, jobs of which no client knows, when it knows the number of
//! spheres. It and its helpers lock, compute and release one partition after another. Helpers put their results into
//! the store; the writer joins them, and computes what no helper has begun or finished. Results are named by their
//! contents, so a second attempt finds the results of the first one.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use metrics::counter;
use tokio::sync::watch;

use super::broker::WorkLock;
use super::job_store::JobStore;
use super::record::{Helper, JobRecord};
use super::records::LoadError;
use super::{ContentKey, Input, JobSpec, JobView, OwnedJob, Status, Task};
use crate::formats::Format;
use crate::pipeline::{Job, is_divisible, surface_work};
use crate::store::{Digest, Namespace, Pin};
use crate::surface::{Control, PartitionSource, PartitionStep, SurfaceError, SurfaceParams};
use crate::sync::{Handle, sleep};
use crate::telemetry::PARTITIONS;

/// Maximum number of partitions of a mesh.
const MAX_PARTITIONS: u32 = 64;
/// Number of helpers of a job. Surplus ones end on nodes that work on the mesh already.
const HELPERS: u32 = 16;
/// Interval at which the writer looks for partitions that its helpers have finished.
const POLL: Duration = Duration::from_millis(50);
/// File name extension of the results of a partition.
const EXTENSION: &str = "partition";
/// Length of a digest as text, bytes.
const DIGEST_BYTES: usize = 64;

/// Partitions of the mesh of a job.
struct Partitions {
    jobs: JobStore,
    runtime: Handle,
    /// Record of the job, or of the helper.
    record: JobRecord,
    file: Bytes,
    digest: Digest,
    /// Key of the mesh.
    key: ContentKey,
    format: Format,
    /// Expected time of a partition.
    time: Duration,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    begun: bool,
    /// True if this mesh is one of [`JobStoreState::shared_meshes`](super::job_store::JobStoreState::shared_meshes)
    /// because of these partitions.
    is_listed: bool,
    count: u32,
    /// Partitions without a step.
    open: VecDeque<u32>,
    /// True while results of a helper are joined.
    is_joining: bool,
    /// Partitions whose results were joined.
    joined: Vec<u32>,
    /// Locks of partitions: of the writer, those that it has begun, so that no helper computes them again; of a helper,
    /// that which it computes.
    locks: Vec<WorkLock>,
    /// Helpers of the writer, which end with it.
    helpers: Vec<(OwnedJob, watch::Receiver<JobView>)>,
}

impl fmt::Debug for Partitions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Partitions").field("job", &self.record.id).finish_non_exhaustive()
    }
}

impl JobStore {
    /// Returns the key of the mesh of a task; `None` if the mesh cannot be divided, or if this process does not share
    /// its jobs.
    fn key_of_mesh(&self, task: &Task, format: Format) -> Option<ContentKey> {
        let (backend, mesh) = (self.0.pool.backend(), Job { helper: None, ..task.job.clone() });
        // Partitions are computed on the CPU.
        let can_divide = self.0.partition_time.is_some() && backend.name() == "cpu" && is_divisible(&mesh);
        let key = || ContentKey::new(&task.digest, &mesh, format, &backend.arithmetic(), task.namespace);
        can_divide.then(key)
    }

    /// Returns true if a helper can compute partitions here: this node has the algorithms and the arithmetic of the
    /// writer, and no other job of this process, which has the same processor, works on the mesh.
    pub(super) fn can_help(&self, helper: &Helper, task: &Task, format: Format) -> bool {
        let key = self.key_of_mesh(task, format);
        key.is_some_and(|key| key.to_string() == helper.mesh && !lock(&self.0.shared_meshes).contains(&key))
    }

    /// Returns the end of a helper, whose results are its partitions: the key of the mesh, pinned.
    pub(super) fn end_of_helper(
        &self,
        helper: &Helper,
        format: Format,
        namespace: Namespace,
    ) -> Result<(String, Pin), String> {
        let key = ContentKey::parse(&helper.mesh, namespace).map_err(|error| error.to_string())?;
        let name = key.name(format.name()).map_err(|error| error.to_string())?;
        Ok((helper.mesh.clone(), self.0.store.pin(&name)))
    }

    /// Returns the end of a helper whose mesh is stored; `None` if it is not, or if the store fails.
    pub(super) async fn needless_helper(&self, record: &JobRecord, format: Format) -> Option<(String, Pin)> {
        let helper = record.helper.as_ref()?;
        let key = ContentKey::parse(&helper.mesh, record.namespace).ok()?;
        self.0.store.head(&key.name(format.name()).ok()?).await.ok()??;
        self.end_of_helper(helper, format, record.namespace).ok()
    }

    /// Returns the source of the partitions of a task with its input; `None` if its mesh cannot be divided, or if this
    /// process does not share its jobs.
    pub(super) fn partitions_of(
        &self,
        record: &JobRecord,
        task: &Task,
        format: Format,
    ) -> Option<Arc<dyn PartitionSource>> {
        let (key, time, file) = (self.key_of_mesh(task, format)?, self.0.partition_time?, task.input.file()?);
        Some(Arc::new(Partitions {
            jobs: self.clone(),
            runtime: Handle::current(),
            record: record.clone(),
            file: file.clone(),
            digest: task.digest,
            key,
            format,
            time,
            state: Mutex::default(),
        }))
    }
}

impl Drop for Partitions {
    fn drop(&mut self) {
        let mut state = self.lock();
        self.release(&mut state);
        if state.is_listed {
            lock(&self.jobs.0.shared_meshes).remove(&self.key);
        }
        let names = state.joined.iter().map(|index| self.key.of_partition(*index, state.count).name(EXTENSION));
        for name in names.flatten() {
            let store = self.jobs.0.store.clone();
            self.runtime.spawn(async move {
                if let Err(error) = store.delete(&name).await {
                    tracing::debug!(%error, "the results of a partition are removed later");
                }
            });
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Partitions {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Returns the number of partitions of a mesh; `None` if one worker computes it.
    fn count(&self, spheres: usize, params: &SurfaceParams) -> Option<u32> {
        let seconds = self.jobs.0.pool.seconds(surface_work(spheres as f64, params));
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let count = (seconds / self.time.as_secs_f64()).clamp(0.0, f64::from(MAX_PARTITIONS)) as u32;
        (count > 1 && self.runtime.block_on(self.jobs.has_workers())).then_some(count)
    }

    /// Dispatches helpers, which share the work with this process. They may be fewer than wanted.
    async fn dispatch(&self, partitions: u32) -> Vec<(OwnedJob, watch::Receiver<JobView>)> {
        let mut helpers = Vec::new();
        for number in 0..HELPERS {
            match self.dispatch_helper(number, partitions).await {
                Ok(helper) => helpers.push(helper),
                Err(error) => {
                    tracing::warn!(error, helpers = number, "a large mesh has fewer helpers");
                    break;
                }
            }
        }
        helpers
    }

    async fn dispatch_helper(
        &self,
        number: u32,
        partitions: u32,
    ) -> Result<(OwnedJob, watch::Receiver<JobView>), String> {
        let (jobs, helper) = (&self.jobs, Some(Helper { number, partitions, mesh: self.key.to_string() }));
        let record = JobRecord { helper: helper.clone(), ..self.record.clone() };
        let (task, format) = jobs.task_of(&record, self.digest)?;
        let task = Task { input: Input::File(self.file.clone()), id: None, ..task };
        let (file, parameters) = (self.file.clone(), record.parameters);
        let spec = JobSpec { task, file, map: None, parameters, format, idempotency_key: None, helper };
        let view = jobs.accept(spec, None).await.map_err(|error| error.to_string())?;
        let job = OwnedJob::new(jobs.clone(), &view);
        let state = job.watch().await.map_err(|error| error.to_string())?.ok_or("its record was lost")?;
        Ok((job, state))
    }

    /// Reads the results of a partition, whose last bytes are their digest; `None` if they are not stored or damaged.
    async fn stored(&self, key: &ContentKey, control: &Control<'_>) -> Result<Option<Vec<u8>>, LoadError> {
        let Some((meta, mut body)) = self.jobs.0.store.read(&key.name(EXTENSION)?, None).await? else {
            return Ok(None);
        };
        let _space = control.reserve(meta.size)?;
        let mut bytes = Vec::with_capacity(usize::try_from(meta.size).unwrap_or_default());
        while let Some(piece) = body.try_next().await? {
            bytes.extend_from_slice(&piece);
        }
        let digest = bytes.len().checked_sub(DIGEST_BYTES).map(|end| bytes.split_off(end));
        let is_intact = digest.as_deref() == Some(Digest::of(&bytes).to_string().as_bytes());
        if !is_intact {
            tracing::warn!(%key, "the results of a partition are damaged, so it is computed again");
        }
        Ok(is_intact.then_some(bytes))
    }

    /// Locks the next partition that needs a step. Returns its results if this process joins them and they are stored.
    fn step(&self, state: &mut State, control: &Control<'_>) -> Result<Option<PartitionStep>, SurfaceError> {
        for _ in 0..state.open.len() {
            let Some(index) = state.open.pop_front() else { break };
            let key = self.key.of_partition(index, state.count);
            let Some(lock) = self.runtime.block_on(self.jobs.0.broker.lock(&key.work())) else {
                state.open.push_back(index);
                continue;
            };
            state.locks.push(lock);
            match self.runtime.block_on(self.stored(&key, control)) {
                Ok(None) => return Ok(Some(PartitionStep::Compute(index))),
                Ok(Some(bytes)) if self.record.helper.is_none() => {
                    state.is_joining = true;
                    return Ok(Some(PartitionStep::Join(index, bytes)));
                }
                // The writer joins it.
                Ok(Some(_)) => self.release(state),
                Err(LoadError::Memory(error)) => return Err(error.into()),
                Err(error) => {
                    tracing::warn!(%error, "a partition is computed again");
                    return Ok(Some(PartitionStep::Compute(index)));
                }
            }
        }
        Ok(None)
    }

    /// Releases the locks. The broker needs the runtime for this.
    fn release(&self, state: &mut State) {
        let locks = std::mem::take(&mut state.locks);
        if !locks.is_empty() {
            self.runtime.block_on(async { drop(locks) });
        }
    }
}

impl PartitionSource for Partitions {
    fn is_divided(&self) -> bool {
        self.lock().count > 0
    }

    fn begin(&self, spheres: usize, params: &SurfaceParams) -> Option<u32> {
        let mut state = self.lock();
        if std::mem::replace(&mut state.begun, true) {
            return None;
        }
        let (count, first) = match &self.record.helper {
            // The writer and its helpers begin at different partitions.
            Some(Helper { number, partitions, .. }) => (*partitions, partitions * (number + 1) / (HELPERS + 1)),
            None => (self.count(spheres, params)?, 0),
        };
        state.is_listed = lock(&self.jobs.0.shared_meshes).insert(self.key);
        if self.record.helper.is_some() && !state.is_listed {
            return None;
        }
        if self.record.helper.is_none() {
            state.helpers = self.runtime.block_on(self.dispatch(count));
            if state.helpers.is_empty() {
                return None;
            }
            tracing::debug!(partitions = count, "workers share a mesh");
        }
        (state.count, state.open) = (count, (first..count).chain(0..first).collect());
        Some(count)
    }

    fn next(&self, control: &Control<'_>) -> Result<Option<PartitionStep>, SurfaceError> {
        let mut state = self.lock();
        while !state.open.is_empty() {
            control.check()?;
            // Another attempt of the writer may have finished the mesh.
            if self.runtime.block_on(self.jobs.needless_helper(&self.record, self.format)).is_some() {
                return Ok(None);
            }
            if let Some(step) = self.step(&mut state, control)? {
                return Ok(Some(step));
            }
            if self.record.helper.is_some() {
                return Ok(None);
            }
            // Nothing is left for helpers that have not begun.
            state.helpers.retain(|(_, view)| view.borrow().record.status != Status::Accepted);
            self.runtime.block_on(async { sleep(POLL).await });
        }
        Ok(None)
    }

    fn publish(&self, index: u32, mut results: Vec<u8>) {
        let (store, key) = (&self.jobs.0.store, self.key.of_partition(index, self.lock().count));
        let digest = Digest::of(&results).to_string();
        // Otherwise the capacity would double.
        results.reserve_exact(DIGEST_BYTES);
        results.extend_from_slice(digest.as_bytes());
        let put = async { store.put(&key.name(EXTENSION)?, results.into()).await };
        if let Err(error) = self.runtime.block_on(put) {
            tracing::warn!(%error, "the results of a partition were not stored, so it is computed again");
        }
    }

    fn finished(&self, index: u32, is_joined: bool) {
        let computed = if is_joined { "elsewhere" } else { "here" };
        tracing::debug!(index, computed, "a partition is finished");
        let mut state = self.lock();
        if std::mem::take(&mut state.is_joining) && !is_joined {
            tracing::warn!(index, "the results of a partition did not match, so it was computed again");
        }
        if is_joined {
            state.joined.push(index);
        }
        if self.record.helper.is_some() {
            self.release(&mut state);
        } else {
            counter!(PARTITIONS, "computed" => computed).increment(1);
        }
    }
}
