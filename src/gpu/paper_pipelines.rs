//! The 2010 program's pipelines, and its dispatches with the time that they take.

use std::ops::Range;

use wgpu::{Buffer, BufferUsages, ComputePipeline, Device, QuerySet};

use super::recording::Recording;
use super::shaders::{PAPER, Shader};

/// Workgroups along a dispatch's first dimension: the most that every device takes.
const MOST_WORKGROUPS: u32 = 65_535;

/// The part of a buffer that a shader sees under a name.
#[derive(Debug, Clone)]
pub(super) struct Bound {
    pub(super) name: &'static str,
    pub(super) buffer: Buffer,
    pub(super) bytes: u64,
}

impl Bound {
    pub(super) fn renamed(&self, name: &'static str) -> Self {
        Self { name, ..self.clone() }
    }
}

#[derive(Debug)]
struct Clock {
    queries: QuerySet,
    resolved: Buffer,
}

/// The pipelines; `field` has one for each kernel.
#[derive(Debug)]
pub(super) struct PaperPipelines {
    pipelines: Vec<Vec<ComputePipeline>>,
    clock: Option<Clock>,
}

impl PaperPipelines {
    /// Compiles everything. Errors reach the device's callback.
    pub(super) fn new(device: &Device) -> Self {
        let clock = device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Clock {
            queries: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("molmesh.paper.clock"),
                ty: wgpu::QueryType::Timestamp,
                count: 12,
            }),
            resolved: device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("molmesh.paper.clock"),
                size: 256,
                usage: BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
        });
        Self { pipelines: PAPER.iter().map(|shader| compile(device, shader)).collect(), clock }
    }

    /// A pass of one dispatch. `bound` has what the shader declares and perhaps more; `times` are the queries at the
    /// pass's begin and end, `u32::MAX` for none.
    #[expect(clippy::too_many_arguments, reason = "everything that a dispatch is made of")]
    pub(super) fn pass(
        &self,
        device: &Device,
        recording: &mut Recording<'_>,
        name: &str,
        variant: usize,
        bound: &[Bound],
        workgroups: u32,
        times: Option<[u32; 2]>,
    ) {
        let number = PAPER.iter().position(|shader| shader.stage == name).unwrap_or_default();
        let pipeline = &self.pipelines[number][variant];
        let entries: Vec<_> = PAPER[number]
            .bindings
            .iter()
            .filter_map(|binding| {
                let found = bound.iter().find(|b| b.name == binding.buffer)?;
                let resource = wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                    buffer: &found.buffer,
                    offset: 0,
                    size: wgpu::BufferSize::new(found.bytes),
                });
                Some(wgpu::BindGroupEntry { binding: binding.number, resource })
            })
            .collect();
        let layout = pipeline.get_bind_group_layout(0);
        let descriptor = wgpu::BindGroupDescriptor { label: Some(name), layout: &layout, entries: &entries };
        let group = device.create_bind_group(&descriptor);
        let query = |q: u32| (q != u32::MAX).then_some(q);
        let timestamp_writes =
            self.clock.as_ref().zip(times).map(|(clock, [begin, end])| wgpu::ComputePassTimestampWrites {
                query_set: &clock.queries,
                beginning_of_pass_write_index: query(begin),
                end_of_pass_write_index: query(end),
            });
        let descriptor = wgpu::ComputePassDescriptor { label: Some(name), timestamp_writes };
        let mut pass = recording.encoder.begin_compute_pass(&descriptor);
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(workgroups.min(MOST_WORKGROUPS), workgroups.div_ceil(MOST_WORKGROUPS), 1);
    }

    /// Copies some timestamps to their place at the start of `target`.
    pub(super) fn read_clock(&self, recording: &mut Recording<'_>, queries: Range<u32>, target: &Buffer) {
        let Some(clock) = &self.clock else { return };
        let (at, bytes) = (8 * u64::from(queries.start), 8 * u64::from(queries.end - queries.start));
        recording.encoder.resolve_query_set(&clock.queries, queries, &clock.resolved, 0);
        recording.encoder.copy_buffer_to_buffer(&clock.resolved, 0, target, at, bytes);
    }
}

fn compile(device: &Device, shader: &Shader) -> Vec<ComputePipeline> {
    let label = format!("molmesh.paper.{}", shader.stage);
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(&label),
        source: wgpu::ShaderSource::Wgsl(shader.source.into()),
    });
    let kernels: &[f64] = if shader.stage == "field" { &[0.0, 1.0, 2.0] } else { &[0.0] };
    let build = |kernel: &f64| {
        let constant = [("KERNEL", *kernel)];
        device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(&label),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants: if shader.stage == "field" { &constant } else { &[] },
                // Every shader writes what it reads.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        })
    };
    kernels.iter().map(build).collect()
}
