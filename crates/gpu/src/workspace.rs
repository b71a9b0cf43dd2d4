//! Device buffers of a job. A workspace is kept for later jobs, so small jobs allocate nothing.

use molmesh_surface::Stage;
use molmesh_surface::lattice::LatticeAtom;
use wgpu::{BindGroup, Buffer, BufferUsages, Device};

use super::buffers::{BufferId, buffer};
use super::output_layout::{OutputRows, TRIANGLE_BYTES, VertexBytes};
use super::pipelines::{Pipelines, ShaderIndex, Variant};
use super::plan::layout::{BRICK_POINTS, BrickRecord, CROSSING_BYTES, Counters, Params, Tile};
use super::plan::{Chunk, Plan};
use super::readback::size_class;
use super::shaders::Shader;

/// Distance of two rows of parameters: the largest alignment that a device requires of bindings.
pub(super) const ROW: u64 = 256;

/// Rows of parameters: one for the chunk and one for the output piece.
const PARAM_ROWS: u64 = 2;

/// Bytes that a job needs of each of its buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BufferSizes([u64; BufferId::OF_JOB.len()]);

impl BufferSizes {
    /// Sizes for a job of `plan` in `chunks`.
    pub(super) fn new(plan: &Plan, chunks: &[Chunk], vertex: VertexBytes, capacity: OutputRows) -> Self {
        let max = |of: &dyn Fn(&Chunk) -> u64| chunks.iter().map(of).max().unwrap_or_default();
        let bytes = |n: usize, each: usize| (n * each) as u64;
        let n_bricks = plan.bricks.len();
        let slots = max(&Chunk::n_slots);
        let size = |id: BufferId| match id {
            BufferId::Params => ROW * PARAM_ROWS,
            BufferId::Atoms => bytes(plan.n_atoms() + plan.arcs.len(), size_of::<LatticeAtom>()),
            BufferId::Reaches => bytes(plan.n_atoms() + plan.arcs.len(), 4),
            BufferId::Boundary => bytes(plan.arcs.rows.len(), 16) + plan.arcs.caps().len() as u64,
            BufferId::Tiles => bytes(plan.tiles.len(), size_of::<Tile>()),
            BufferId::Bricks | BufferId::Counts => bytes(n_bricks, 4),
            BufferId::FirstAtoms => bytes(plan.first_atoms.len() + plan.arcs.first.len(), 4),
            BufferId::Halo => max(&|c| 4 * c.halo_table_len()),
            BufferId::Lists => max(&|c| 4 * c.candidates),
            BufferId::Heads => 16 * slots * u64::from(plan.n_kinds()),
            BufferId::Field => 4 * BRICK_POINTS * slots,
            BufferId::Crossings => CROSSING_BYTES * slots,
            BufferId::Inside => bytes(n_bricks, 64),
            BufferId::Records => bytes(n_bricks, size_of::<BrickRecord>()),
            BufferId::Offsets => bytes(n_bricks, 8),
            BufferId::Groups => max(&|c| 16 * c.n_groups()),
            BufferId::Counters => size_of::<Counters>() as u64,
            BufferId::Positions => vertex.positions * capacity.vertices,
            BufferId::Normals => vertex.normals * capacity.vertices,
            BufferId::Sources => vertex.sources * capacity.vertices,
            BufferId::Triangles => TRIANGLE_BYTES * capacity.triangles,
            BufferId::Sheets => 4 * capacity.sheet_words,
            // Not a buffer of the job.
            BufferId::Cases => 0,
        };
        Self(BufferId::OF_JOB.map(size))
    }

    /// Bytes of one buffer; 0 for [`BufferId::Cases`].
    pub(super) fn get(&self, id: BufferId) -> u64 {
        self.0.get(id.index()).copied().unwrap_or_default()
    }

    /// Bytes of the largest buffer.
    pub(super) fn max(&self) -> u64 {
        self.0.iter().copied().max().unwrap_or_default()
    }

    /// Bytes of all buffers as they are allocated.
    pub(super) fn total(&self) -> u64 {
        self.0.iter().map(|&n| size_class(n)).sum()
    }
}

/// Buffers of a job with the bind groups of the stages.
#[derive(Debug)]
pub(super) struct Workspace {
    /// Buffers by [`BufferId::index`].
    buffers: Vec<Buffer>,
    bind_groups: Vec<BindGroup>,
}

impl Workspace {
    /// Creates a workspace of minimal buffers that shares the case table.
    pub(super) fn new(device: &Device, pipelines: &Pipelines, cases: &Buffer) -> Self {
        let of_job = BufferId::OF_JOB.iter().map(|&id| create_buffer(device, id, size_class(0)));
        let buffers = of_job.chain([cases.clone()]).collect();
        let mut workspace = Self { buffers, bind_groups: Vec::new() };
        workspace.bind(device, pipelines);
        workspace
    }

    /// Grows every buffer to at least its size in `sizes`, none beyond `limit` bytes unless required.
    pub(super) fn ensure(&mut self, device: &Device, pipelines: &Pipelines, sizes: &BufferSizes, limit: u64) {
        let mut grown = false;
        for id in BufferId::OF_JOB {
            let (buffer, size) = (&mut self.buffers[id.index()], sizes.get(id));
            if buffer.size() < size {
                // Freed first, so that both buffers are never held at once.
                buffer.destroy();
                *buffer = create_buffer(device, id, size_class(size).min(limit).max(size));
                grown = true;
            }
        }
        if grown {
            self.bind(device, pipelines);
        }
    }

    fn bind(&mut self, device: &Device, pipelines: &Pipelines) {
        let bind_group = |(index, shader): (ShaderIndex, &Shader<BufferId>)| {
            let entries: Vec<_> = shader
                .bindings
                .iter()
                .map(|binding| {
                    let mut resource = self.buffer(binding.buffer).as_entire_buffer_binding();
                    if binding.buffer == BufferId::Params {
                        resource.size = wgpu::BufferSize::new(size_of::<Params>() as u64);
                    }
                    wgpu::BindGroupEntry { binding: binding.number, resource: wgpu::BindingResource::Buffer(resource) }
                })
                .collect();
            device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some(shader.stage),
                layout: pipelines.layout(index),
                entries: &entries,
            })
        };
        self.bind_groups = ShaderIndex::all().map(bind_group).collect();
    }

    /// Returns a buffer.
    pub(super) fn buffer(&self, id: BufferId) -> &Buffer {
        &self.buffers[id.index()]
    }

    /// Returns the bind group of `stage`.
    pub(super) fn bind_group(&self, stage: Stage, variant: Variant) -> &BindGroup {
        &self.bind_groups[ShaderIndex::new(stage, variant).get()]
    }

    /// Bytes of all its buffers.
    pub(super) fn bytes(&self) -> u64 {
        self.buffers.iter().map(Buffer::size).sum()
    }

    /// Bytes that would have to be allocated for `sizes`.
    pub(super) fn missing_bytes(&self, sizes: &BufferSizes) -> u64 {
        let missing = |(buffer, &size): (&Buffer, &u64)| if buffer.size() < size { size } else { 0 };
        self.buffers.iter().zip(&sizes.0).map(missing).sum()
    }
}

fn create_buffer(device: &Device, id: BufferId, size: u64) -> Buffer {
    let usage = if id == BufferId::Params { BufferUsages::UNIFORM } else { BufferUsages::STORAGE };
    buffer(device, &format!("molmesh.{id:?}"), size, usage | BufferUsages::COPY_DST | BufferUsages::COPY_SRC)
}
