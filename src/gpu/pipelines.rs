//! The stages' pipelines, built once: one for each kernel where the stage depends on it.

use wgpu::{BindGroupLayout, ComputePipeline, Device};

use super::shaders::{SHADERS, Shader};
use crate::surface::{Kernel, Stage};

/// Stages that run on a device.
pub(super) const N_STAGES: usize = 6;
/// Their names, in order.
pub(super) const STAGES: [Stage; N_STAGES] =
    [Stage::Bin, Stage::Field, Stage::Classify, Stage::Scan, Stage::Interpolate, Stage::Emit];

/// One pipeline per stage and variant.
#[derive(Debug)]
pub(super) struct Pipelines {
    layouts: Vec<BindGroupLayout>,
    /// Per stage its variants: by kernel, and for `interpolate` also by whether nearest atoms are asked for.
    variants: Vec<Vec<ComputePipeline>>,
}

/// What of a job decides which variant runs.
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

/// A stage's place among those of a device.
pub(super) fn number(stage: Stage) -> usize {
    STAGES.iter().position(|s| *s == stage).unwrap_or_default()
}

impl Pipelines {
    /// Compiles everything. Errors reach the device's callback.
    pub(super) fn new(device: &Device) -> Self {
        let (layouts, variants) =
            STAGES.iter().zip(&SHADERS).map(|(stage, shader)| compile(device, *stage, shader)).unzip();
        Self { layouts, variants }
    }

    /// What `stage` binds.
    pub(super) fn layout(&self, stage: Stage) -> &BindGroupLayout {
        &self.layouts[number(stage)]
    }

    /// What runs `stage`.
    pub(super) fn pipeline(&self, stage: Stage, variant: Variant) -> &ComputePipeline {
        &self.variants[number(stage)][variant.index(stage)]
    }
}

fn compile(device: &Device, stage: Stage, shader: &Shader) -> (BindGroupLayout, Vec<ComputePipeline>) {
    let label = format!("molmesh.{}", shader.stage);
    let entries: Vec<_> = shader.bindings.iter().map(super::shaders::Binding::layout).collect();
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
                // Every shader writes what it reads.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        })
    };
    let pipelines = constants.iter().map(build).collect();
    (layout, pipelines)
}
