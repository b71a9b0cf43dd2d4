//! Single stages on a device with access to every buffer, for tests that compare them with the CPU's stages.

use molmesh_surface::Stage;

pub use super::buffers::BufferId;
use super::engine::Engine;
use super::error::GpuError;
use super::job::GpuJob;
use super::output_layout::{OutputRows, VertexBytes};
use super::pipelines::Variant;
use super::plan::Chunk;
use super::plan::layout::Params;
use super::recording::{Dispatch, workgroups};
use super::workspace::{BufferSizes, Workspace};

/// Capacity of the blocks of sheets: no brick needs more words per triangle than one with a single triangle.
const WORDS_PER_TRIANGLE: u32 = 17;

/// Buffers of a job on a device, and its stages.
pub struct SingleStages {
    engine: Engine,
    workspace: Workspace,
    variant: Variant,
    vertex: VertexBytes,
    /// Parameters of the stages. One chunk and one output piece hold the whole job.
    pub params: Params,
    chunk: Chunk,
}

impl SingleStages {
    /// Loads `job` with output buffers for `vertices` and `triangles`.
    ///
    /// # Errors
    /// [`GpuError`] if the job does not fit.
    pub fn new(mut engine: Engine, job: &GpuJob, vertices: u32, triangles: u32) -> Result<Self, GpuError> {
        let chunks = engine.chunks(job, None)?;
        let [chunk] = &chunks[..] else { return Err(GpuError::Failed("more than one chunk".to_owned())) };
        let chunk = chunk.clone();
        let n_bricks = job.prepared.plan.bricks.len() as u64;
        let capacity = OutputRows {
            vertices: vertices.into(),
            triangles: triangles.into(),
            sheet_words: n_bricks + u64::from(triangles) * u64::from(WORDS_PER_TRIANGLE),
        };
        let loaded = engine.load(job, None, chunks, capacity)?;
        let params = Params {
            piece_bricks: loaded.n_bricks(),
            vertex_capacity: vertices,
            triangle_capacity: triangles,
            sheet_capacity: loaded.n_bricks() + triangles * WORDS_PER_TRIANGLE,
            ..chunk.params(&loaded.params)
        };
        let (workspace, variant, vertex) = (loaded.workspace, loaded.variant, loaded.vertex);
        Ok(Self { engine, workspace, variant, vertex, params, chunk })
    }

    /// Bytes that the job needs of a buffer; the buffer may be larger.
    #[must_use]
    pub fn size(&self, job: &GpuJob, id: BufferId) -> u64 {
        let capacity = OutputRows {
            vertices: self.params.vertex_capacity.into(),
            triangles: self.params.triangle_capacity.into(),
            sheet_words: self.params.sheet_capacity.into(),
        };
        BufferSizes::new(&job.prepared.plan, std::slice::from_ref(&self.chunk), self.vertex, capacity).get(id)
    }

    /// Writes the start of a buffer.
    pub fn write(&self, id: BufferId, bytes: &[u8]) {
        self.engine.queue.write_buffer(self.workspace.buffer(id), 0, bytes);
    }

    /// Fills a buffer with a pattern that no stage writes.
    pub fn poison(&self, id: BufferId) {
        let size = usize::try_from(self.workspace.buffer(id).size()).unwrap_or_default();
        self.write(id, &vec![0xa5; size]);
    }

    /// Runs one stage.
    ///
    /// # Errors
    /// [`GpuError`] as the device reports it.
    pub fn run(&self, stage: Stage) -> Result<(), GpuError> {
        self.engine.write_params(&self.workspace, 0, &self.params);
        let workgroups = workgroups(stage, &self.params);
        let mut recording = self.engine.recording();
        recording.stage(stage, &[Dispatch { workspace: &self.workspace, row: 0, workgroups, variant: self.variant }]);
        self.engine.wait(self.engine.submit(recording, Vec::new())).map(drop)
    }

    /// Reads the first `bytes` bytes of a buffer.
    ///
    /// # Errors
    /// [`GpuError`] as the device reports it.
    pub fn read(&self, id: BufferId, bytes: u64) -> Result<Vec<u8>, GpuError> {
        let mapped = bytes.next_multiple_of(8);
        let readback = self.engine.readback.acquire(&self.engine.device, mapped);
        let mut recording = self.engine.recording();
        let target = &readback.buffer;
        recording.encoder.copy_buffer_to_buffer(self.workspace.buffer(id), 0, target, 0, bytes);
        let readback = self.engine.wait_one(self.engine.submit(recording, vec![(readback, mapped)]))?;
        let all: &[u8] = (*readback).as_ref();
        Ok(all[..usize::try_from(bytes).unwrap_or_default()].to_vec())
    }
}
