//! Compute pipelines of the stages, compiled once. Stages that depend on the kernel have one pipeline per kernel, and
//! those that depend on the type of the surface have a second shader, for surfaces of spheres.

use molmesh_surface::{Kernel, Stage};
use wgpu::{BindGroupLayout, ComputePipeline, Device};

use super::buffers::BufferId;
use super::shaders::{Binding, SHADERS, SPHERE_SHADERS, Shader};

/// Number of stages that run on a device.
pub(super) const N_STAGES: usize = 8;
/// Stages that run on a device, in order.
pub(super) const STAGES: [Stage; N_STAGES] = {
    let [stages @ .., _write, _improve] = Stage::ALL;
    stages
};
/// Stages that have a second shader for surfaces of spheres, in order.
const SPHERE_STAGES: [Stage; 3] = [Stage::Field, Stage::Refine, Stage::Interpolate];

/// Bytes of the timestamps of a submission: begin and end of every stage.
pub(super) const TIMESTAMP_BYTES: u64 = 16 * N_STAGES as u64;

/// One pipeline per shader and variant.
#[derive(Debug)]
pub(super) struct Pipelines {
    /// Layouts by [`ShaderIndex`].
    layouts: Vec<BindGroupLayout>,
    /// Variants per shader: one per kernel if it depends on the kernel, each with a second one that computes the
    /// nearest atoms in `interpolate`.
    variants: Vec<Vec<ComputePipeline>>,
}

/// Index of a shader among those of all stages, followed by those of surfaces of spheres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ShaderIndex(usize);

impl ShaderIndex {
    /// Returns the index of the shader of `stage` for a type of surface.
    pub(super) fn new(stage: Stage, variant: Variant) -> Self {
        let second = SPHERE_STAGES.iter().position(|other| *other == stage).filter(|_| variant.kernel.is_none());
        Self(second.map_or(stage_index(stage), |index| N_STAGES + index))
    }

    /// Returns all shaders with their indices.
    pub(super) fn all() -> impl Iterator<Item = (Self, &'static Shader<BufferId>)> {
        (0..).map(Self).zip(SHADERS.iter().chain(&SPHERE_SHADERS))
    }

    /// Returns the index as a number.
    pub(super) const fn get(self) -> usize {
        self.0
    }
}

/// Properties of a job that select the variants of its pipelines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Variant {
    /// Kernel of an isosurface; `None` for a surface of spheres.
    pub(super) kernel: Option<Kernel>,
    pub(super) nearest: bool,
}

impl Variant {
    const fn kernel_number(self) -> usize {
        match self.kernel {
            None | Some(Kernel::Gaussian) => 0,
            Some(Kernel::SoftObject) => 1,
            Some(Kernel::InverseSquare) => 2,
        }
    }

    fn index(self, stage: Stage) -> usize {
        match stage {
            Stage::Field | Stage::Refine => self.kernel_number(),
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
        let stages = STAGES.iter().map(|stage| (*stage, true)).chain(SPHERE_STAGES.map(|stage| (stage, false)));
        let (layouts, variants) = ShaderIndex::all()
            .zip(stages)
            .map(|((_, shader), (stage, has_kernel))| compile(device, shader, &constants(stage, has_kernel)))
            .unzip();
        Self { layouts, variants }
    }

    /// Bind group layout of a shader.
    pub(super) fn layout(&self, shader: ShaderIndex) -> &BindGroupLayout {
        &self.layouts[shader.get()]
    }

    /// Pipeline of `stage` for `variant`.
    pub(super) fn pipeline(&self, stage: Stage, variant: Variant) -> &ComputePipeline {
        &self.variants[ShaderIndex::new(stage, variant).get()][variant.index(stage)]
    }
}

/// Constants of the variants of a shader.
fn constants(stage: Stage, has_kernel: bool) -> Vec<Vec<(&'static str, f64)>> {
    let kernels = [0.0, 1.0, 2.0].map(|kernel| vec![("KERNEL", kernel)]);
    let nearest = |other: &Vec<_>| [0.0, 1.0].map(|nearest| [&other[..], &[("NEAREST", nearest)]].concat());
    match (stage, has_kernel) {
        (Stage::Field | Stage::Refine, true) => kernels.to_vec(),
        (Stage::Interpolate, true) => kernels.iter().flat_map(nearest).collect(),
        (Stage::Interpolate, false) => nearest(&Vec::new()).to_vec(),
        _ => vec![Vec::new()],
    }
}

fn compile(
    device: &Device,
    shader: &Shader<BufferId>,
    constants: &[Vec<(&str, f64)>],
) -> (BindGroupLayout, Vec<ComputePipeline>) {
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
