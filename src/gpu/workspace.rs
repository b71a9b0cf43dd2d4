//! The buffers that a job needs on its device. A workspace is kept and used again: small jobs then allocate nothing.

use wgpu::{BindGroup, Buffer, BufferUsages, Device};

use super::flight::{TRIANGLE_BYTES, VertexBytes};
use super::landing::size_class;
use super::pipelines::{Pipelines, STAGES, number};
use super::shaders::SHADERS;
use crate::surface::Stage;
use crate::surface::chunks::Chunk;
use crate::surface::lattice::LatticeAtom;
use crate::surface::layout::{GROUP, Params, Record, SAMPLES, Tally, Tile};
use crate::surface::plan::Plan;

/// Distance of two rows of parameters: what every device aligns bindings to.
pub(super) const ROW: u64 = 256;

/// Every buffer, by the name that the shaders give it.
pub(super) const NAMES: [&str; 21] = [
    "params",
    "atoms",
    "reaches",
    "tiles",
    "bricks",
    "first_atoms",
    "halo",
    "lists",
    "heads",
    "field",
    "inside",
    "records",
    "counts",
    "offsets",
    "groups",
    "tally",
    "positions",
    "normals",
    "sources",
    "triangles",
    "cases",
];
/// The case table, which is no job's own.
const CASES: usize = 20;

/// Place of a buffer by name.
pub(super) fn place(name: &str) -> usize {
    NAMES.iter().position(|n| *n == name).unwrap_or(CASES)
}

/// Bytes that a job needs of each buffer, in the order of [`NAMES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Needs([u64; 20]);

/// Rows of output that the buffers hold at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct OutputRows {
    pub(super) vertices: u64,
    pub(super) triangles: u64,
    /// Rows of parameters.
    pub(super) params: u64,
}

impl Needs {
    /// For a job of `plan` in `chunks`.
    pub(super) fn new(plan: &Plan, chunks: &[Chunk], vertex: VertexBytes, rows: OutputRows) -> Self {
        let most = |of: &dyn Fn(&Chunk) -> u64| chunks.iter().map(of).max().unwrap_or_default();
        let bytes = |n: usize, each: usize| (n * each) as u64;
        let n_bricks = plan.bricks.len();
        let slots = most(&Chunk::n_slots);
        let mut needs = [0; 20];
        for (name, size) in [
            ("params", ROW * rows.params),
            ("atoms", bytes(plan.reaches.len(), size_of::<LatticeAtom>())),
            ("reaches", bytes(plan.reaches.len(), 4)),
            ("tiles", bytes(plan.tiles.len(), size_of::<Tile>())),
            ("bricks", bytes(n_bricks, 4)),
            ("first_atoms", bytes(n_bricks + 1, 4)),
            ("halo", most(&|c| 4 * c.halo_table_len())),
            ("lists", most(&|c| 4 * c.candidates)),
            ("heads", 16 * slots),
            ("field", 4 * SAMPLES * slots),
            ("inside", bytes(n_bricks, 64)),
            ("records", bytes(n_bricks, size_of::<Record>())),
            ("counts", bytes(n_bricks, 4)),
            ("offsets", bytes(n_bricks, 8)),
            ("groups", most(&|c| 16 * u64::from(c.n_own.div_ceil(GROUP)))),
            ("tally", size_of::<Tally>() as u64),
            ("positions", vertex.positions * rows.vertices),
            ("normals", vertex.normals * rows.vertices),
            ("sources", vertex.sources * rows.vertices),
            ("triangles", TRIANGLE_BYTES * rows.triangles),
        ] {
            needs[place(name)] = size;
        }
        Self(needs)
    }

    /// Bytes of one buffer.
    pub(super) fn of(&self, name: &str) -> u64 {
        self.0[place(name)]
    }

    /// The largest of all buffers.
    pub(super) fn largest(&self) -> u64 {
        self.0.iter().copied().max().unwrap_or_default()
    }

    /// Bytes of all buffers.
    pub(super) fn total(&self) -> u64 {
        self.0.iter().map(|&n| size_class(n)).sum()
    }
}

/// A job's buffers.
#[derive(Debug)]
pub(super) struct Workspace {
    buffers: Vec<Buffer>,
    groups: Vec<BindGroup>,
}

impl Workspace {
    /// Empty buffers; `cases` is the case table.
    pub(super) fn new(device: &Device, pipelines: &Pipelines, cases: &Buffer) -> Self {
        let buffers = NAMES.iter().take(CASES).map(|name| buffer(device, name, size_class(0))).chain([cases.clone()]);
        let mut workspace = Self { buffers: buffers.collect(), groups: Vec::new() };
        workspace.bind(device, pipelines);
        workspace
    }

    /// Makes every buffer at least as large as needed, none larger than `most`.
    pub(super) fn ensure(&mut self, device: &Device, pipelines: &Pipelines, needs: &Needs, most: u64) {
        let mut grown = false;
        for (i, &need) in needs.0.iter().enumerate() {
            if self.buffers[i].size() < need {
                // What is replaced goes first, so that both are never held at once.
                self.buffers[i].destroy();
                self.buffers[i] = buffer(device, NAMES[i], size_class(need).min(most).max(need));
                grown = true;
            }
        }
        if grown {
            self.bind(device, pipelines);
        }
    }

    fn bind(&mut self, device: &Device, pipelines: &Pipelines) {
        let bound = |stage: &Stage| {
            let shader = &SHADERS[number(*stage)];
            let entries: Vec<_> = shader
                .bindings
                .iter()
                .map(|binding| {
                    let mut resource = self.buffers[place(binding.name)].as_entire_buffer_binding();
                    if binding.name == "params" {
                        resource.size = wgpu::BufferSize::new(size_of::<Params>() as u64);
                    }
                    wgpu::BindGroupEntry { binding: binding.number, resource: wgpu::BindingResource::Buffer(resource) }
                })
                .collect();
            device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some(shader.stage),
                layout: pipelines.layout(*stage),
                entries: &entries,
            })
        };
        self.groups = STAGES.iter().map(bound).collect();
    }

    /// A buffer by name.
    pub(super) fn buffer(&self, name: &str) -> &Buffer {
        &self.buffers[place(name)]
    }

    /// What `stage` binds.
    pub(super) fn group(&self, stage: Stage) -> &BindGroup {
        &self.groups[number(stage)]
    }

    /// Bytes of all its buffers.
    pub(super) fn bytes(&self) -> u64 {
        self.buffers.iter().map(Buffer::size).sum()
    }

    /// Bytes that would have to be allocated to meet `needs`.
    pub(super) fn short_of(&self, needs: &Needs) -> u64 {
        let short = |(buffer, &need): (&Buffer, &u64)| if buffer.size() < need { need } else { 0 };
        self.buffers.iter().zip(&needs.0).map(short).sum()
    }
}

fn buffer(device: &Device, name: &str, size: u64) -> Buffer {
    let usage = if name == "params" { BufferUsages::UNIFORM } else { BufferUsages::STORAGE };
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(&format!("molmesh.{name}")),
        size,
        usage: usage | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_of_a_shader_is_a_buffer() {
        for shader in &SHADERS {
            for binding in shader.bindings {
                assert!(NAMES.contains(&binding.name), "{}: {}", shader.stage, binding.name);
            }
        }
        assert_eq!(NAMES[CASES], "cases");
    }
}
