//! Compute pipelines of the stages, compiled once. Stages that depend on the kernel have one pipeline per kernel.

use wgpu::{BindGroupLayout, ComputePipeline, Device};

use super::buffers::BufferId;
use super::shaders::{Binding, SHADERS, Shader};
use crate::surface::{Kernel, Stage};

/// Number of stages that run on a device.
pub(super) const N_STAGES: usize = 7;
/// Stages that run on a device, in order.
pub(super) const STAGES: [Stage; N_STAGES] =
    [Stage::Bin, Stage::Field, Stage::Classify, Stage::Scan, Stage::Interpolate, Stage::Emit, Stage::Measure];

/// Bytes of the timestamps of a submission: begin and end of every stage.
pub(super) const TIMESTAMP_BYTES: u64 = 16 * N_STAGES as u64;

/// One pipeline per stage and variant.
#[derive(Debug)]
pub(super) struct Pipelines {
    layouts: Vec<BindGroupLayout>,
    /// Variants per stage: one per kernel, and for `interpolate` a second one that computes the nearest atoms.
    variants: Vec<Vec<ComputePipeline>>,
}

/// Properties of a job that select the variants of its pipelines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Variant {
    pub(super) kernel: Kernel,
    pub(super) nearest: bool,
}

impl Variant {
    const fn kernel_number(self) -> usize {
        match self.kernel {
            Kernel::Gaussian => 0,
            Kernel::SoftObject => 1,
            Kernel::InverseSquare => 2,
        }
    }

    fn index(self, stage: Stage) -> usize {
        match stage {
            Stage::Field => self.kernel_number(),
            Stage::Interpolate => 2 * self.kernel_number() + usize::from(self.nearest),
            _ => 0,
        }
    }
}

/// Index of `stage` in [`STAGES`].
pub(super) const fn stage_index(stage: Stage) -> usize {
    stage as usize
}

impl Pipelines {
    /// Compiles all pipelines. The callbacks of the device receive the errors.
    pub(super) fn new(device: &Device) -> Self {
        let (layouts, variants) =
            STAGES.iter().zip(&SHADERS).map(|(stage, shader)| compile(device, *stage, shader)).unzip();
        Self { layouts, variants }
    }

    /// Bind group layout of `stage`.
    pub(super) fn layout(&self, stage: Stage) -> &BindGroupLayout {
        &self.layouts[stage_index(stage)]
    }

    /// Pipeline of `stage` for `variant`.
    pub(super) fn pipeline(&self, stage: Stage, variant: Variant) -> &ComputePipeline {
        &self.variants[stage_index(stage)][variant.index(stage)]
    }
}

fn compile(device: &Device, stage: Stage, shader: &Shader<BufferId>) -> (BindGroupLayout, Vec<ComputePipeline>) {
    let label = format!("molmesh.{}", shader.stage);
    let entries: Vec<_> = shader.bindings.iter().map(Binding::layout).collect();
    let layout =
        device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(&label), entries: &entries });
    let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(&label),
        bind_group_layouts: &[Some(&layout)],
        immediate_size: 0,
    });
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(&label),
        source: wgpu::ShaderSource::Wgsl(shader.source.into()),
    });
    let kernels = [0.0, 1.0, 2.0].map(|kernel| ("KERNEL", kernel));
    let constants: Vec<Vec<(&str, f64)>> = match stage {
        Stage::Field => kernels.iter().map(|kernel| vec![*kernel]).collect(),
        Stage::Interpolate => {
            let with = |kernel: &(&'static str, f64)| [0.0, 1.0].map(|nearest| vec![*kernel, ("NEAREST", nearest)]);
            kernels.iter().flat_map(with).collect()
        }
        _ => vec![vec![]],
    };
    let build = |constants: &Vec<(&str, f64)>| {
        device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(&label),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants,
                // Every shader writes workgroup memory before it reads it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        })
    };
    let pipelines = constants.iter().map(build).collect();
    (layout, pipelines)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_are_indexed_in_order() {
        assert!(STAGES.iter().enumerate().all(|(i, &stage)| stage_index(stage) == i));
    }
}
