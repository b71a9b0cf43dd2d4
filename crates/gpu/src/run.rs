//! Runs whole jobs: small ones together in one submission, large ones alone.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use molmesh_surface::Stage;

use super::buffers::BufferId;
use super::engine::{Engine, LoadedJob};
use super::error::GpuError;
use super::executor::{Executor, NextJob};
use super::job::{GpuJob, JobResult};
use super::job_state::{JobState, counters};
use super::output_layout::{OutputRows, ReadbackLayout, ReadbackRows, TRIANGLE_BYTES, VertexBytes, narrow};
use super::partition_handle::PartitionHandle;
use super::pipelines::N_STAGES;
use super::plan::Chunk;
use super::plan::layout::Params;
use super::readback::{ReadbackBuffer, reserved_sizes};
use super::workspace::BufferSizes;

/// Small job with the capacity of its output buffers.
type SmallJob = (LoadedJob, OutputRows);

impl Executor for Engine {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<JobResult> {
        if let Some(state) = self.take_begun(jobs) {
            return vec![self.run_large(state)];
        }
        let mut results: Vec<Option<JobResult>> = jobs.iter().map(|_| None).collect();
        let mut small = Vec::new();
        for (result, job) in results.iter_mut().zip(jobs) {
            let loaded = self.chunks(job, None).and_then(|chunks| {
                let estimate = self.small_capacity(job, &chunks);
                let loaded = self.load(job, None, chunks, estimate.unwrap_or_default())?;
                Ok((loaded, estimate))
            });
            match loaded {
                Ok((loaded, Some(capacity))) => small.push((result, (loaded, capacity))),
                Ok((loaded, None)) => *result = Some(self.run_large(JobState::new(loaded))),
                Err(error) => *result = Some(Err(error)),
            }
        }
        let (slots, jobs): (Vec<_>, Vec<_>) = small.into_iter().unzip();
        for (slot, result) in slots.into_iter().zip(self.run_small(jobs)) {
            *slot = Some(result);
        }
        let missing = || Err(GpuError::Failed("a job without a result".to_owned()));
        results.into_iter().map(|result| result.unwrap_or_else(missing)).collect()
    }

    fn run_partition(&mut self, job: &GpuJob, partition: &PartitionHandle) -> JobResult {
        self.run_partition_of(job, partition)
    }

    fn reserve_memory(&mut self, bytes: u64) {
        let sizes = reserved_sizes(bytes).filter(|size| *size <= self.budget.readback_bytes);
        for size in sizes {
            // If the device is lost, the next job reports it.
            if self.readback.reserve(&self.device, size, || self.check_errors()).is_err() {
                return;
            }
        }
    }

    fn set_next_job(&mut self, next: NextJob) {
        self.next_job = Some(next);
    }

    fn release_idle_memory(&mut self) {
        self.discard_begun();
        self.readback.release_idle();
    }

    fn submission_counter(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.submissions)
    }

    fn held_bytes(&self) -> u64 {
        self.device_bytes()
    }
}

impl Engine {
    /// Estimated output of a job. `None` unless the job is small.
    fn small_capacity(&self, job: &GpuJob, chunks: &[Chunk]) -> Option<OutputRows> {
        // The surface of a small structure crosses a larger share of its bricks; 8 bricks more cover that.
        let n_bricks = job.prepared.plan.bricks.len() as u64;
        let n = n_bricks + 8;
        let [vertices, triangles] = self.budget.rows_per_brick.map(|each| each * n);
        let vertex = VertexBytes::new(&job.prepared.params);
        let rows = OutputRows { vertices, triangles, sheet_words: n_bricks + self.budget.sheet_words_per_brick * n };
        let bytes = ReadbackLayout::new(rows, vertex).end;
        let largest = (vertex.positions * vertices).max(TRIANGLE_BYTES * triangles);
        let fits = largest <= self.budget.piece_bytes && bytes <= self.budget.readback_bytes;
        let small = chunks.len() == 1 && bytes <= self.budget.small_bytes && fits;
        small.then_some(rows)
    }

    /// Runs small jobs in one submission. Returns their results in order.
    fn run_small(&mut self, jobs: Vec<SmallJob>) -> Vec<JobResult> {
        if jobs.is_empty() {
            return Vec::new();
        }
        let n_bricks = jobs.iter().map(|(loaded, _)| f64::from(loaded.n_bricks())).sum::<f64>();
        let readbacks = match self.submit_small(&jobs) {
            Ok(readbacks) => readbacks.into_iter().map(Ok).collect(),
            Err(error) => vec![Err(error); jobs.len()],
        };
        let mut results = Vec::with_capacity(jobs.len());
        for ((loaded, capacity), readback) in jobs.into_iter().zip(readbacks) {
            // The times of the submission are divided in proportion to the bricks.
            let share = f64::from(loaded.n_bricks()) / n_bricks;
            let mut state = JobState::new(loaded);
            results.push(readback.and_then(|readback| self.finish_small(&mut state, capacity, &readback, share)));
            self.workspaces.push(state.loaded.workspace);
        }
        results
    }

    /// Submits all stages of all jobs and the copies of their estimated output, and waits.
    fn submit_small(&self, jobs: &[SmallJob]) -> Result<Vec<Arc<ReadbackBuffer>>, GpuError> {
        let mut recording = self.recording();
        let mut dispatches = Vec::with_capacity(jobs.len());
        for (loaded, capacity) in jobs {
            let params = Params {
                piece_bricks: loaded.n_bricks(),
                vertex_capacity: narrow(capacity.vertices)?,
                triangle_capacity: narrow(capacity.triangles)?,
                sheet_capacity: narrow(capacity.sheet_words)?,
                ..loaded.chunks[0].params(&loaded.params)
            };
            self.write_params(&loaded.workspace, 0, &params);
            dispatches.push((loaded.dispatch(0, params.piece_bricks), params));
        }
        recording.count_stages(&dispatches);
        let dispatches: Vec<_> = dispatches.into_iter().map(|(dispatch, _)| dispatch).collect();
        recording.stage(Stage::Interpolate, &dispatches);
        recording.stage(Stage::Emit, &dispatches);
        recording.stage(Stage::Measure, &dispatches);
        let mut readbacks = Vec::with_capacity(jobs.len());
        for (loaded, rows) in jobs {
            let layout = ReadbackLayout::new(*rows, loaded.vertex);
            let groups = 16 * loaded.chunks[0].n_groups();
            let readback = self.readback.acquire(&self.device, layout.end + groups);
            let target = &readback.buffer;
            recording.copy_timestamps(target);
            recording.copy_counters(&loaded.workspace, target);
            recording.copy_start(loaded.workspace.buffer(BufferId::Groups), target, layout.end, groups);
            recording.copy_output(&loaded.workspace, loaded.vertex, *rows, target, &layout);
            readbacks.push((readback, layout.end + groups));
        }
        self.wait(self.submit(recording, readbacks))
    }

    /// Assembles the mesh of a small job. Its output is computed again if the estimate was too low.
    fn finish_small(
        &mut self,
        state: &mut JobState,
        capacity: OutputRows,
        readback: &Arc<ReadbackBuffer>,
        share: f64,
    ) -> JobResult {
        let layout = ReadbackLayout::new(capacity, state.loaded.vertex);
        let counts = state.add_counts(readback, 0, layout.end)?;
        state.check_complete()?;
        let mut times = [0; N_STAGES];
        self.add_times(&mut times, readback, 0..N_STAGES)?;
        state.times = times.map(|ns| portion(ns, share));
        let counters = counters(readback)?;
        let [vertices, triangles] = state.total;
        let n_bricks = state.loaded.n_bricks();
        let sheet_words = u64::from(n_bricks) + u64::from(counters.sheet_words);
        let made = OutputRows { vertices, triangles, sheet_words };
        let rows = ReadbackRows { readback: readback.clone(), layout, rows: made };
        if made.sheet_words > capacity.sheet_words {
            self.make_output(state, &[(0, &counts)], Stage::Measure)?;
        } else {
            state.sheets.push((n_bricks, rows.clone()));
        }
        if vertices > capacity.vertices || triangles > capacity.triangles {
            self.make_output(state, &[(0, &counts)], Stage::Interpolate)?;
            self.make_triangles(state, &[counts])?;
        } else {
            state.add_counters(&counters);
            state.vertices.push(rows.clone());
            state.triangles.push(rows);
        }
        self.collect_output(state)?;
        state.finish()
    }

    /// Runs one job of any size.
    fn run_large(&mut self, mut state: JobState) -> JobResult {
        let result = self.run_chunks(&mut state);
        if !matches!(result, Err(GpuError::OutOfMemory(_))) {
            self.workspaces.push(state.loaded.workspace);
            return result;
        }
        if self.workspaces.is_empty() {
            return result;
        }
        // An idle workspace may hold the missing memory.
        self.workspaces.clear();
        let job = state.loaded.job.clone();
        drop(state);
        let chunks = self.chunks(&job, None)?;
        let loaded = self.load(&job, None, chunks, OutputRows::default())?;
        self.run_large(JobState::new(loaded))
    }

    fn run_chunks(&mut self, state: &mut JobState) -> JobResult {
        let counts = self.count_chunks(state, |_, state, _| state.check_limits().map(|()| true))?;
        state.check_complete()?;
        self.make_triangles(state, &counts)?;
        // Errors after this check belong to the next job.
        self.check_errors()?;
        self.begin_next(state.loaded.workspace.bytes());
        self.collect_output(state)?;
        state.finish()
    }

    /// Loads and counts the next job of the pool while the device transfers the results of the current one, whose
    /// workspace takes `in_use` bytes. Does nothing if the next job is small, or if the memory cannot hold both. If the
    /// next job fails here, its regular run starts from the beginning.
    fn begin_next(&mut self, in_use: u64) -> Option<()> {
        let job = self.next_job.as_ref().and_then(|next| next())?;
        let chunks = self.chunks(&job, None).ok()?;
        if self.small_capacity(&job, &chunks).is_some() {
            return None;
        }
        let (plan, vertex) = (&job.prepared.plan, VertexBytes::new(&job.prepared.params));
        let bytes = in_use + BufferSizes::new(plan, &chunks, vertex, OutputRows::default()).total();
        if bytes > self.budget.memory {
            return None;
        }
        self.free_workspaces(bytes);
        let loaded = self.load(&job, None, chunks, OutputRows::default()).ok()?;
        let state = JobState::new(loaded);
        let counting = self.submit_count(&state, 0).ok()?;
        self.check_errors().ok()?;
        self.begun = Some((state.loaded, counting));
        Some(())
    }

    /// Returns the state of the only job in `jobs` if [`Self::begin_next`] has begun it.
    fn take_begun(&mut self, jobs: &[GpuJob]) -> Option<JobState> {
        let is_of = |loaded: &LoadedJob| matches!(jobs, [job] if Arc::ptr_eq(&job.prepared, &loaded.job.prepared));
        if let Some((loaded, counting)) = self.begun.take_if(|(loaded, _)| is_of(loaded)) {
            let mut state = JobState::new(loaded);
            state.counting = Some(counting);
            return Some(state);
        }
        self.discard_begun();
        None
    }

    /// Discards the job that [`Self::begin_next`] has begun. Keeps its workspace for other jobs.
    pub(super) fn discard_begun(&mut self) {
        self.workspaces.extend(self.begun.take().map(|(loaded, _)| loaded.workspace));
    }
}

/// Part of a time, in ns.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as intended")]
fn portion(ns: u64, share: f64) -> u64 {
    (ns as f64 * share) as u64
}
