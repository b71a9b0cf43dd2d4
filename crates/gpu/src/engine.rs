//! Engine of one device: its budget, pipelines and buffers, and the upload of jobs.
//!
//! Several small jobs share a submission, with output buffers whose size is estimated: reading the counts back first
//! would take longer than the job. A larger job takes two submissions: the first counts its vertices and triangles, the
//! second writes them to buffers of exact size. A job that exceeds the budget is cut into chunks of tiles.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use molmesh_surface::lattice::{LatticeAtom, to_u32};
use molmesh_surface::limit::{Exceeded, Limit, slightly_coarser};
use wgpu::{Buffer, BufferUsages, Device, Queue};

use super::buffers::{BufferId, buffer};
use super::device_errors::DeviceErrors;
use super::error::GpuError;
use super::executor::NextJob;
use super::job::GpuJob;
use super::output_layout::{OutputRows, VertexBytes};
use super::pipelines::{Pipelines, Variant};
use super::plan::layout::{self, Params};
use super::plan::{Chunk, ChunkLimits, Partition};
use super::readback::ReadbackPool;
use super::recording::{Dispatch, PendingSubmission, Recording, StageTimer};
use super::workspace::{BufferSizes, ROW, Workspace};

/// Resources that the engine may use of its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceLimits {
    /// Bytes of all buffers on the device.
    pub memory: u64,
    /// Maximum number of bricks whose densities are held at once.
    pub chunk_bricks: u64,
    /// Bytes of the largest output column of a piece.
    pub piece_bytes: u64,
    /// Bytes of the largest readback buffer.
    pub readback_bytes: u64,
    /// Bytes of idle readback buffers that are kept while jobs follow each other, and after a period without jobs.
    /// Allocating such a buffer takes ten times as long as filling it, so large meshes reuse that of the previous one.
    pub idle_bytes: [u64; 2],
    /// Maximum estimated output of a small job, which shares a submission with others.
    pub small_bytes: u64,
    /// Number of vertices and triangles per brick that the buffers of a small job hold. A surface crosses a brick of
    /// 8 × 8 × 8 cells with about 90 vertices and 180 triangles.
    pub rows_per_brick: [u64; 2],
    /// Initial capacity of the buffers of sheets: number of words per brick that the surface intersects. A brick of one
    /// sheet takes 17. A brick of several sheets takes 12 more per additional sheet, and one per shared vertex.
    pub sheet_words_per_brick: u64,
}

impl DeviceLimits {
    /// Budget for a device with these limits. WebGPU does not report the memory size; 64 GiB are assumed.
    #[must_use]
    pub fn of(limits: &wgpu::Limits) -> Self {
        let binding = max_binding(limits);
        Self {
            memory: 64 << 30,
            chunk_bricks: binding / layout::CROSSING_BYTES,
            piece_bytes: binding,
            readback_bytes: limits.max_buffer_size.min(8 << 30),
            idle_bytes: [8 << 30, 2 << 30],
            small_bytes: 16 << 20,
            rows_per_brick: [128, 256],
            sheet_words_per_brick: 64,
        }
    }
}

/// Runs jobs on one device.
pub struct Engine {
    pub(super) device: Device,
    pub(super) queue: Queue,
    pub(super) budget: DeviceLimits,
    /// Bytes of the largest binding.
    max_binding: u64,
    pub(super) pipelines: Pipelines,
    pub(super) timer: Option<StageTimer>,
    cases: Buffer,
    /// Idle workspaces.
    pub(super) workspaces: Vec<Workspace>,
    pub(super) readback: ReadbackPool,
    /// Source of the job that follows the running one.
    pub(super) next_job: Option<NextJob>,
    /// Next job, if it has been started, with the submission that counts its first chunk.
    pub(super) begun: Option<(LoadedJob, PendingSubmission)>,
    errors: Arc<DeviceErrors>,
    /// Number of submissions so far.
    pub(super) submissions: Arc<AtomicU64>,
}

/// Job whose buffers are allocated and filled.
pub(super) struct LoadedJob {
    pub(super) job: GpuJob,
    pub(super) workspace: Workspace,
    pub(super) chunks: Vec<Chunk>,
    pub(super) params: Params,
    pub(super) variant: Variant,
    pub(super) vertex: VertexBytes,
}

impl LoadedJob {
    /// Number of bricks of the job.
    pub(super) fn n_bricks(&self) -> u32 {
        to_u32(self.job.prepared.plan.bricks.len())
    }

    pub(super) fn dispatch(&self, row: u64, workgroups: u32) -> Dispatch<'_> {
        Dispatch { workspace: &self.workspace, row, workgroups, variant: self.variant }
    }
}

impl Engine {
    /// Compiles the stages on `device`. Reports stage times if the device has the feature `TIMESTAMP_QUERY`.
    ///
    /// # Errors
    /// [`GpuError::Failed`] if the limits of the device are too low or a shader does not compile; [`GpuError::Lost`].
    pub fn new(device: Device, queue: Queue) -> Result<Self, GpuError> {
        let budget = DeviceLimits::of(&device.limits());
        Self::with_budget(device, queue, budget)
    }

    /// Compiles the stages on `device` for use within `budget`.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn with_budget(device: Device, queue: Queue, budget: DeviceLimits) -> Result<Self, GpuError> {
        let limits = device.limits();
        let errors = DeviceErrors::listen(&device);
        let pipelines = Pipelines::new(&device);
        let table = layout::case_table();
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let cases = buffer(&device, "molmesh.Cases", 4 * table.len() as u64, usage);
        queue.write_buffer(&cases, 0, bytemuck::cast_slice(&table));
        let engine = Self {
            max_binding: max_binding(&limits),
            workspaces: Vec::new(),
            readback: ReadbackPool::new(budget.idle_bytes),
            next_job: None,
            begun: None,
            timer: StageTimer::new(&device, &queue),
            device,
            queue,
            budget,
            pipelines,
            cases,
            errors,
            submissions: Arc::default(),
        };
        engine.check_errors()?;
        Ok(engine)
    }

    /// Returns the number of submissions so far.
    #[must_use]
    pub fn submissions(&self) -> u64 {
        self.submissions.load(Ordering::Relaxed)
    }

    /// Bytes of device memory, in use and pooled.
    pub(super) fn device_bytes(&self) -> u64 {
        let begun = self.begun.iter().map(|(loaded, _)| &loaded.workspace);
        let workspaces = self.workspaces.iter().chain(begun).map(Workspace::bytes).sum::<u64>();
        workspaces + self.readback.held_bytes() + self.cases.size()
    }

    /// Fails if the graphics API has reported an error since the last check.
    pub(super) fn check_errors(&self) -> Result<(), GpuError> {
        self.errors.check(|| GpuError::Failed("out of memory".to_owned()))
    }

    /// Fails like [`Self::check_errors`], after an allocation of `needed` bytes for `job`.
    fn check_allocation(&self, job: &GpuJob, needed: u64) -> Result<(), GpuError> {
        self.errors.check(|| out_of_memory(job, needed, self.budget.memory.min(needed)))
    }

    /// Starts a recording.
    pub(super) fn recording(&self) -> Recording<'_> {
        Recording::new(&self.device, &self.pipelines, self.timer.as_ref())
    }

    /// Cuts a job, or one partition of it, into chunks.
    pub(super) fn chunks(&self, job: &GpuJob, partition: Option<&Partition>) -> Result<Vec<Chunk>, GpuError> {
        let plan = &job.prepared.plan;
        let limits = ChunkLimits { bricks: self.budget.chunk_bricks, candidates: self.max_binding / 4 };
        let tiles = partition.map_or(0..plan.tiles.len(), |partition| partition.tiles.clone());
        plan.chunks(tiles, limits).ok_or_else(|| {
            let tile = plan.candidates.iter().max().map_or(0, |n| 4 * n) + 512 * layout::CROSSING_BYTES;
            out_of_memory(job, tile, self.budget.chunk_bricks * layout::CROSSING_BYTES)
        })
    }

    /// Allocates the buffers of a job and uploads its input, or that of one partition.
    pub(super) fn load(
        &mut self,
        job: &GpuJob,
        partition: Option<&Partition>,
        chunks: Vec<Chunk>,
        capacity: OutputRows,
    ) -> Result<LoadedJob, GpuError> {
        job.check()?;
        let (plan, lattice, params) = (&job.prepared.plan, &job.prepared.lattice, &job.prepared.params);
        let vertex = VertexBytes::new(params);
        let sizes = BufferSizes::new(plan, &chunks, vertex, capacity);
        self.check_sizes(job, &sizes)?;
        let workspace = self.workspace(&sizes);
        let allocated = self.check_allocation(job, sizes.total());
        if let Err(error) = allocated {
            // Idle workspaces may hold the missing memory.
            self.workspaces.clear();
            return Err(error);
        }
        let variant = Variant { kernel: params.surface.kernel(), nearest: params.atom_ids };
        let params = plan.params(lattice, params);
        let write = |id: BufferId, offset: usize, bytes: &[u8]| {
            if !bytes.is_empty() {
                self.queue.write_buffer(workspace.buffer(id), offset as u64, bytes);
            }
        };
        let all_atoms = || std::iter::once(0..plan.first_atoms.last().copied().unwrap_or_default()).collect();
        let runs =
            partition.map_or_else(all_atoms, |partition| plan.atoms_near(partition, [params.back, params.ahead]));
        for run in runs {
            let run = run.start as usize..run.end as usize;
            let atoms = bytemuck::cast_slice(&lattice.atoms[run.clone()]);
            write(BufferId::Atoms, run.start * size_of::<LatticeAtom>(), atoms);
            write(BufferId::Reaches, run.start * 4, bytemuck::cast_slice(&plan.reaches[run]));
        }
        let arcs = &plan.arcs;
        write(BufferId::Atoms, size_of_val(&lattice.atoms[..]), bytemuck::cast_slice(&arcs.bounds));
        write(BufferId::Reaches, size_of_val(&plan.reaches[..]), bytemuck::cast_slice(&arcs.reaches));
        write(BufferId::FirstAtoms, size_of_val(&plan.first_atoms[..]), bytemuck::cast_slice(&arcs.first));
        write(BufferId::Boundary, 0, bytemuck::cast_slice(&arcs.rows));
        write(BufferId::Boundary, size_of_val(&arcs.rows[..]), arcs.caps());
        write(BufferId::Tiles, 0, bytemuck::cast_slice(&plan.tiles));
        write(BufferId::Bricks, 0, bytemuck::cast_slice(&plan.bricks));
        write(BufferId::FirstAtoms, 0, bytemuck::cast_slice(&plan.first_atoms));
        Ok(LoadedJob { job: job.clone(), workspace, chunks, params, variant, vertex })
    }

    /// Returns a workspace of at least `sizes`: the idle one that needs the fewest new bytes, or a new one.
    fn workspace(&mut self, sizes: &BufferSizes) -> Workspace {
        let missing = |w: &Workspace| (w.missing_bytes(sizes), w.bytes());
        let best = (0..self.workspaces.len()).min_by_key(|&i| missing(&self.workspaces[i]));
        let mut workspace = match best {
            Some(i) => self.workspaces.swap_remove(i),
            None => Workspace::new(&self.device, &self.pipelines, &self.cases),
        };
        self.free_workspaces(sizes.total());
        workspace.ensure(&self.device, &self.pipelines, sizes, self.max_binding);
        workspace
    }

    /// Grows the buffers of a job.
    pub(super) fn grow(&mut self, loaded: &mut LoadedJob, sizes: &BufferSizes) -> Result<(), GpuError> {
        self.check_sizes(&loaded.job, sizes)?;
        self.free_workspaces(sizes.total());
        loaded.workspace.ensure(&self.device, &self.pipelines, sizes, self.max_binding);
        self.check_allocation(&loaded.job, sizes.total())
    }

    /// Rejects buffers that exceed the budget or the largest binding.
    fn check_sizes(&self, job: &GpuJob, sizes: &BufferSizes) -> Result<(), GpuError> {
        if sizes.max() > self.max_binding {
            return Err(out_of_memory(job, sizes.total(), self.max_binding));
        }
        if sizes.total() > self.budget.memory {
            return Err(out_of_memory(job, sizes.total(), self.budget.memory));
        }
        Ok(())
    }

    /// Frees idle workspaces until `bytes` more fit the budget.
    pub(super) fn free_workspaces(&mut self, bytes: u64) {
        while !self.workspaces.is_empty()
            && bytes + self.workspaces.iter().map(Workspace::bytes).sum::<u64>() > self.budget.memory
        {
            self.workspaces.pop();
        }
    }

    /// Uploads the halo of a chunk.
    pub(super) fn write_halo(&self, workspace: &Workspace, chunk: &Chunk) {
        if !chunk.halo.is_empty() {
            let table = chunk.halo_table();
            self.queue.write_buffer(workspace.buffer(BufferId::Halo), 0, bytemuck::cast_slice(&table));
        }
    }

    /// Uploads a row of parameters.
    pub(super) fn write_params(&self, workspace: &Workspace, row: u64, params: &Params) {
        self.queue.write_buffer(workspace.buffer(BufferId::Params), row * ROW, bytemuck::bytes_of(params));
    }
}

/// Bytes of the largest binding, rounded down to whole rows: some limits are one byte below a power of two.
fn max_binding(limits: &wgpu::Limits) -> u64 {
    limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) & !(ROW - 1)
}

/// Returns the error of a job that needs `needed` bytes at once. The memory grows with the inverse cube of the spacing.
fn out_of_memory(job: &GpuJob, needed: u64, available: u64) -> GpuError {
    let excess = (needed as f64 / available.max(1) as f64).max(1.0);
    let error = Exceeded { actual: Some(needed), ..Exceeded::new(Limit::DeviceBytes, available) };
    GpuError::OutOfMemory(Box::new(error.suggest(slightly_coarser(job.prepared.lattice.spacing * excess.cbrt()))))
}
