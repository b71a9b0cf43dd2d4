//! Single stages on a device, with every buffer open: what tests compare with the CPU's stages.

use super::engine::Engine;
use super::error::GpuError;
use super::executor::GpuJob;
use super::flight::VertexBytes;
use super::pipelines::Variant;
use super::record::Dispatch;
use super::workspace::{Needs, OutputRows, Workspace};
use crate::surface::Stage;
use crate::surface::chunks::Chunk;
use crate::surface::layout::{GROUP, Params};

/// A job's buffers on a device, and its stages to be run one by one.
#[derive(Debug)]
pub struct Bench {
    engine: Engine,
    workspace: Workspace,
    variant: Variant,
    vertex: VertexBytes,
    /// Row of parameters that the stages read: one chunk and one piece of output hold everything.
    pub params: Params,
    chunk: Chunk,
}

impl Bench {
    /// Loads `job`, with room for so many vertices and triangles.
    ///
    /// # Errors
    /// [`GpuError`] where it does not fit.
    pub fn new(mut engine: Engine, job: &GpuJob, vertices: u32, triangles: u32) -> Result<Self, GpuError> {
        let chunks = engine.chunks(job, None)?;
        let [chunk] = &chunks[..] else { return Err(GpuError::Failed("more than one chunk".to_owned())) };
        let chunk = chunk.clone();
        let rows = OutputRows { vertices: vertices.into(), triangles: triangles.into(), params: 1 };
        let loaded = engine.load(job, None, chunks, rows)?;
        let params = Params {
            piece_bricks: loaded.params.n_bricks,
            vertex_capacity: vertices,
            triangle_capacity: triangles,
            ..chunk.params(&loaded.params)
        };
        let (workspace, variant, vertex) = (loaded.workspace, loaded.variant, loaded.vertex);
        Ok(Self { engine, workspace, variant, vertex, params, chunk })
    }

    /// Bytes that the job needs of a buffer; the buffer may be larger.
    #[must_use]
    pub fn needed(&self, job: &GpuJob, name: &str) -> u64 {
        let rows = OutputRows {
            vertices: self.params.vertex_capacity.into(),
            triangles: self.params.triangle_capacity.into(),
            params: 1,
        };
        Needs::new(&job.prepared.plan, std::slice::from_ref(&self.chunk), self.vertex, rows).of(name)
    }

    /// Writes the start of a buffer.
    pub fn write(&self, name: &str, bytes: &[u8]) {
        self.engine.queue.write_buffer(self.workspace.buffer(name), 0, bytes);
    }

    /// Fills a buffer with what no stage writes.
    pub fn poison(&self, name: &str) {
        let size = usize::try_from(self.workspace.buffer(name).size()).unwrap_or_default();
        self.write(name, &vec![0xa5; size]);
    }

    /// Runs one stage.
    ///
    /// # Errors
    /// [`GpuError`] as the device reports it.
    pub fn run(&self, stage: Stage) -> Result<(), GpuError> {
        self.engine.write_params(&self.workspace, 0, &self.params);
        let workgroups = match stage {
            Stage::Bin | Stage::Field => self.params.n_own + self.params.n_halo,
            Stage::Classify => self.params.n_own.div_ceil(4),
            Stage::Scan => self.params.n_own.div_ceil(GROUP),
            _ => self.params.piece_bricks,
        };
        let mut recording = self.engine.recording();
        recording.stage(stage, &[Dispatch { workspace: &self.workspace, row: 0, workgroups, variant: self.variant }]);
        self.engine.fly(recording, Vec::new()).map(drop)
    }

    /// The first `bytes` bytes of a buffer.
    ///
    /// # Errors
    /// [`GpuError`] as the device reports it.
    pub fn read(&self, name: &str, bytes: u64) -> Result<Vec<u8>, GpuError> {
        let landing = self.engine.landings.get(&self.engine.device, bytes.next_multiple_of(8));
        let mut recording = self.engine.recording();
        let target = landing.buffer().map_err(GpuError::Failed)?;
        recording.encoder.copy_buffer_to_buffer(self.workspace.buffer(name), 0, target, 0, bytes);
        let landed = self.engine.fly(recording, vec![(landing, bytes.next_multiple_of(8))])?;
        let [landed] = &landed[..] else { return Err(GpuError::Failed("no landing".to_owned())) };
        let whole: &[u8] = (**landed).as_ref();
        Ok(whole[..usize::try_from(bytes).unwrap_or_default()].to_vec())
    }
}
