//! The engine: runs the six stages on one device.
//!
//! Small jobs go through in one submission, several of them together, their output sized by an estimate. Larger ones are
//! counted first, and their output is then made in buffers of just the right size: the round trip between is nothing
//! against their transfer. What does not fit at once goes in chunks of tiles.

use std::cell::Cell;
use std::sync::Arc;
use std::time::Instant;

use wgpu::{Buffer, Device, Queue};

use super::error::GpuError;
use super::executor::{Executor, Finished, GpuJob};
use super::flight::VertexBytes;
use super::health::{Complaint, Health};
use super::landing::Landings;
use super::pipelines::{N_STAGES, Pipelines, Variant};
use super::record::Clock;
use super::share::Share;
use super::workspace::{Needs, OutputRows, ROW, Workspace};
use crate::surface::SurfaceError;
use crate::surface::chunks::{Chunk, ChunkLimits};
use crate::surface::lattice::LatticeAtom;
use crate::surface::layout::{self, Params};
use crate::surface::parts::Part;

/// Storage buffers that a stage binds at most.
const MOST_BINDINGS: u32 = 14;

/// What the engine may use of its device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Budget {
    /// Bytes of all buffers on the device.
    pub memory: u64,
    /// Bricks whose samples are held at once.
    pub chunk_bricks: u64,
    /// Bytes of the largest column that is made at once.
    pub piece_bytes: u64,
    /// Bytes of the largest landing.
    pub landing_bytes: u64,
    /// Bytes of landings that are kept for later jobs: between jobs that follow each other, where the largest meshes should
    /// find theirs again, as getting as much takes the system and the driver ten times as long as filling it; and once there
    /// has been nothing to do for a while.
    pub idle_bytes: [u64; 2],
    /// Jobs whose output is estimated at no more than this many bytes take one submission, together with others.
    pub small_bytes: u64,
    /// Vertices and triangles that a small job's buffers hold per brick. A surface crosses a brick of 8 × 8 × 8 cells with
    /// about 90 vertices and 180 triangles.
    pub rows_per_brick: [u64; 2],
}

impl Budget {
    /// What the limits of a device allow; of its memory, which they do not tell, 64 GiB at most.
    #[must_use]
    pub fn of(limits: &wgpu::Limits) -> Self {
        let binding = largest_binding(limits);
        Self {
            memory: 64 << 30,
            chunk_bricks: binding / (4 * layout::SAMPLES),
            piece_bytes: binding,
            landing_bytes: limits.max_buffer_size.min(8 << 30),
            idle_bytes: [8 << 30, 2 << 30],
            small_bytes: 16 << 20,
            rows_per_brick: [128, 256],
        }
    }
}

/// Runs jobs on one device.
#[derive(Debug)]
pub struct Engine {
    pub(super) device: Device,
    pub(super) queue: Queue,
    pub(super) budget: Budget,
    /// Bytes of the largest binding.
    binding: u64,
    pub(super) pipelines: Pipelines,
    pub(super) clock: Option<Clock>,
    cases: Buffer,
    /// Idle ones.
    pub(super) workspaces: Vec<Workspace>,
    pub(super) landings: Landings,
    health: Arc<Health>,
    pub(super) submissions: Cell<u64>,
}

/// A job on its way: its buffers are filled.
pub(super) struct Loaded<'a> {
    pub(super) job: &'a GpuJob,
    pub(super) workspace: Workspace,
    pub(super) chunks: Vec<Chunk>,
    pub(super) params: Params,
    pub(super) variant: Variant,
    pub(super) vertex: VertexBytes,
}

/// Device time per stage, ns.
pub(super) type Times = [u64; N_STAGES];

impl Engine {
    /// Compiles the stages on `device`. It needs no features; with `TIMESTAMP_QUERY` it tells the stages' times.
    ///
    /// # Errors
    /// [`GpuError::Failed`] where the device's limits are too low or a shader does not compile; [`GpuError::Lost`].
    pub fn new(device: Device, queue: Queue) -> Result<Self, GpuError> {
        let budget = Budget::of(&device.limits());
        Self::with_budget(device, queue, budget)
    }

    /// As [`Self::new`], within `budget`.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_budget(device: Device, queue: Queue, budget: Budget) -> Result<Self, GpuError> {
        let limits = device.limits();
        let bindings = limits.max_storage_buffers_per_shader_stage;
        if bindings < MOST_BINDINGS {
            return Err(GpuError::Failed(format!("{bindings} storage buffers a stage, {MOST_BINDINGS} are needed")));
        }
        let health = Health::of(&device);
        let pipelines = Pipelines::new(&device);
        let table = layout::case_table();
        let cases = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("molmesh.cases"),
            size: 4 * table.len() as u64,
            usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        queue.write_buffer(&cases, 0, bytemuck::cast_slice(&table));
        let clock = Clock::new(&device, &queue);
        let engine = Self {
            binding: largest_binding(&limits),
            workspaces: Vec::new(),
            landings: Landings::keeping(budget.idle_bytes),
            device,
            queue,
            budget,
            pipelines,
            clock,
            cases,
            health,
            submissions: Cell::new(0),
        };
        engine.healthy()?;
        Ok(engine)
    }

    /// Returns the number of submissions so far.
    #[must_use]
    pub const fn submissions(&self) -> u64 {
        self.submissions.get()
    }

    /// What was complained about since the last look, but for memory.
    pub(super) fn healthy(&self) -> Result<(), GpuError> {
        match self.health.complaint() {
            None => Ok(()),
            Some(Complaint::OutOfMemory) => Err(GpuError::Failed("out of memory".to_owned())),
            Some(Complaint::Lost(why)) => Err(GpuError::Lost(why)),
            Some(Complaint::Failed(why)) => Err(GpuError::Failed(why)),
        }
    }

    /// Likewise, where a job of `needed` bytes may have been too much.
    pub(super) fn healthy_with(&self, job: &GpuJob, needed: u64) -> Result<(), GpuError> {
        match self.health.complaint() {
            None => Ok(()),
            Some(Complaint::OutOfMemory) => Err(out_of_memory(job, needed, self.budget.memory.min(needed))),
            Some(Complaint::Lost(why)) => Err(GpuError::Lost(why)),
            Some(Complaint::Failed(why)) => Err(GpuError::Failed(why)),
        }
    }

    /// The chunks of a job, or of a part of it.
    pub(super) fn chunks(&self, job: &GpuJob, part: Option<&Part>) -> Result<Vec<Chunk>, GpuError> {
        let plan = &job.prepared.plan;
        let limits = ChunkLimits { bricks: self.budget.chunk_bricks, candidates: self.binding / 4 };
        plan.chunks_of(part.map_or(0..plan.tiles.len(), |part| part.tiles.clone()), limits).ok_or_else(|| {
            let tile = plan.candidates.iter().max().map_or(0, |n| 4 * n) + 512 * 4 * layout::SAMPLES;
            out_of_memory(job, tile, self.budget.chunk_bricks * 4 * layout::SAMPLES)
        })
    }

    /// Fills a workspace with a job, or with what a part of it needs.
    pub(super) fn load<'a>(
        &mut self,
        job: &'a GpuJob,
        part: Option<&Part>,
        chunks: Vec<Chunk>,
        rows: OutputRows,
    ) -> Result<Loaded<'a>, GpuError> {
        check(job)?;
        let (plan, lattice, params) = (&job.prepared.plan, &job.prepared.lattice, &job.prepared.params);
        let vertex = VertexBytes::of(params);
        let needs = Needs::new(plan, &chunks, vertex, rows);
        if needs.total() > self.budget.memory || needs.largest() > self.binding {
            let available = if needs.largest() > self.binding { self.binding } else { self.budget.memory };
            return Err(out_of_memory(job, needs.total().max(needs.largest()), available));
        }
        let workspace = self.workspace(&needs);
        let complaint = self.healthy_with(job, needs.total());
        if let Err(e) = complaint {
            // What else is idle may have been what took the memory.
            self.workspaces.clear();
            return Err(e);
        }
        let variant = Variant { kernel: params.kernel, nearest: params.atom_ids };
        let params = plan.params(lattice, params);
        let write = |name: &str, at: usize, bytes: &[u8]| {
            if !bytes.is_empty() {
                self.queue.write_buffer(workspace.buffer(name), at as u64, bytes);
            }
        };
        // The last brick ends with the last atom.
        let whole = || std::iter::once(0..plan.first_atoms.last().copied().unwrap_or_default()).collect();
        for run in part.map_or_else(whole, |part| plan.atoms_near(part, [params.back, params.ahead])) {
            let run = run.start as usize..run.end as usize;
            write("atoms", run.start * size_of::<LatticeAtom>(), bytemuck::cast_slice(&lattice.atoms[run.clone()]));
            write("reaches", run.start * 4, bytemuck::cast_slice(&plan.reaches[run]));
        }
        write("tiles", 0, bytemuck::cast_slice(&plan.tiles));
        write("bricks", 0, bytemuck::cast_slice(&plan.bricks));
        write("first_atoms", 0, bytemuck::cast_slice(&plan.first_atoms));
        Ok(Loaded { job, workspace, chunks, params, variant, vertex })
    }

    /// A workspace that meets `needs`: the idle one that lacks the least.
    fn workspace(&mut self, needs: &Needs) -> Workspace {
        let lacks = |w: &Workspace| (w.short_of(needs), w.bytes());
        let best = (0..self.workspaces.len()).min_by_key(|&i| lacks(&self.workspaces[i]));
        let mut workspace = match best {
            Some(i) => self.workspaces.swap_remove(i),
            None => Workspace::new(&self.device, &self.pipelines, &self.cases),
        };
        // Idle buffers make room before new ones are asked for.
        self.shed(needs.total());
        workspace.ensure(&self.device, &self.pipelines, needs, self.binding);
        workspace
    }

    /// Makes a job's buffers larger.
    pub(super) fn grow(&mut self, loaded: &mut Loaded<'_>, needs: &Needs) -> Result<(), GpuError> {
        if needs.total() > self.budget.memory || needs.largest() > self.binding {
            return Err(out_of_memory(loaded.job, needs.total(), self.budget.memory));
        }
        self.shed(needs.total());
        loaded.workspace.ensure(&self.device, &self.pipelines, needs, self.binding);
        self.healthy_with(loaded.job, needs.total())
    }

    /// Lets idle buffers go until `bytes` more keep within the budget.
    fn shed(&mut self, bytes: u64) {
        while !self.workspaces.is_empty()
            && bytes + self.workspaces.iter().map(Workspace::bytes).sum::<u64>() > self.budget.memory
        {
            self.workspaces.pop();
        }
    }

    /// Writes a chunk's borrowed bricks.
    pub(super) fn write_halo(&self, workspace: &Workspace, chunk: &Chunk) {
        if !chunk.halo.is_empty() {
            self.queue.write_buffer(workspace.buffer("halo"), 0, bytemuck::cast_slice(&chunk.halo_table()));
        }
    }

    /// Writes a row of parameters.
    pub(super) fn write_params(&self, workspace: &Workspace, row: u64, params: &Params) {
        self.queue.write_buffer(workspace.buffer("params"), row * ROW, bytemuck::bytes_of(params));
    }
}

impl Executor for Engine {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
        let mut results: Vec<Option<Result<Finished, GpuError>>> = jobs.iter().map(|_| None).collect();
        let mut small = Vec::new();
        for (i, job) in jobs.iter().enumerate() {
            let loaded = check(job).and_then(|()| self.chunks(job, None)).and_then(|chunks| {
                let estimate = self.small_rows(job, &chunks);
                let loaded = self.load(job, None, chunks, estimate.unwrap_or_else(Self::no_rows))?;
                Ok((loaded, estimate))
            });
            match loaded {
                Ok((loaded, Some(rows))) => small.push((i, loaded, rows)),
                // What small jobs hold is not let go for a large one: they wait for nothing but their submission.
                Ok((loaded, None)) => results[i] = Some(self.alone(loaded)),
                Err(e) => results[i] = Some(Err(e)),
            }
        }
        for (i, result) in self.together(small) {
            results[i] = Some(result);
        }
        let unanswered = || Err(GpuError::Failed("a job without an answer".to_owned()));
        results.into_iter().map(|result| result.unwrap_or_else(unanswered)).collect()
    }

    fn part(&mut self, job: &GpuJob, share: &Share) -> Result<Finished, GpuError> {
        self.make_part(job, share)
    }

    fn rest(&mut self) {
        self.landings.rest();
    }

    fn held_bytes(&self) -> u64 {
        self.workspaces.iter().map(Workspace::bytes).sum::<u64>() + self.landings.held() + self.cases.size()
    }
}

/// Bytes of the largest binding: limits are at times a byte less than a power of two, and buffers are whole words.
fn largest_binding(limits: &wgpu::Limits) -> u64 {
    limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) & !(ROW - 1)
}

/// Scales ticks to ns.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
pub(super) fn scaled(ticks: u64, period: f64) -> u64 {
    (ticks as f64 * period) as u64
}

/// Whether the job is still wanted.
pub(super) fn check(job: &GpuJob) -> Result<(), GpuError> {
    if job.cancel.is_cancelled() {
        return Err(SurfaceError::Cancelled.into());
    }
    if job.deadline.is_some_and(|deadline| Instant::now() >= deadline) { Err(GpuError::Deadline) } else { Ok(()) }
}

/// The refusal of a job that needs `needed` bytes at once. What it needs grows with the inverse cube of the spacing.
pub(super) fn out_of_memory(job: &GpuJob, needed: u64, available: u64) -> GpuError {
    let excess = (needed as f64 / available.max(1) as f64).max(1.0);
    let fitting = job.prepared.lattice.spacing * excess.cbrt();
    GpuError::OutOfMemory { needed, available, suggested_resolution: (fitting * 105.0).ceil() / 100.0 }
}
