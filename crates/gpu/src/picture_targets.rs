//! Textures, buffers and uniforms of a picture on a device, and the limits that they require.

use bytemuck::{Pod, Zeroable};
use molmesh_picture::PictureParams;
use molmesh_picture::camera::Camera;
use molmesh_picture::finish::{self, Finish};
use molmesh_picture::light::{AMBIENT, DIFFUSE, LIGHT};
use molmesh_surface::Mesh;
use wgpu::{
    Device, Extent3d, Limits, Texture, TextureDescriptor, TextureDimension, TextureFormat, TextureUsages, TextureView,
    TextureViewDescriptor, TextureViewDimension,
};

/// Positions of the samples within a pixel, as in the CPU renderer.
pub(super) const PATTERN: [[f32; 2]; 4] = [[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]];
/// Format of the normal and the light of a sample, and of its colour.
pub(super) const SHADE: TextureFormat = TextureFormat::Rgba16Float;
/// Format of the depth of a sample, Å.
pub(super) const DEPTH: TextureFormat = TextureFormat::R32Float;
/// Format of the depth buffer.
pub(super) const DEPTH_BUFFER: TextureFormat = TextureFormat::Depth32Float;
/// Depth of samples without a surface.
pub(super) const NO_SURFACE_DEPTH: f64 = 3.0e38;

/// Uniform of the draw passes, as `shaders/picture/vertex.wgsl` reads it.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct ViewUniform {
    pub(super) right: [f32; 4],
    pub(super) up: [f32; 4],
    pub(super) toward: [f32; 4],
    pub(super) light: [f32; 4],
    pub(super) size: [f32; 2],
    pub(super) offset: [f32; 2],
    pub(super) scale: f32,
    pub(super) reach: f32,
    pub(super) diffuse: f32,
    pub(super) pad: f32,
}

impl ViewUniform {
    pub(super) fn new(camera: &Camera, offset: [f32; 2]) -> Self {
        let row = |k: usize| {
            let [x, y, z] = camera.axes[k];
            [x, y, z, camera.shift[k]]
        };
        let [x, y, z] = LIGHT;
        Self {
            right: row(0),
            up: row(1),
            toward: row(2),
            light: [x, y, z, AMBIENT],
            size: camera.middle.map(|half| 2.0 * half),
            offset,
            scale: camera.scale,
            reach: camera.reach,
            diffuse: DIFFUSE,
            pad: 0.0,
        }
    }
}

/// Uniform of the resolve and shading passes, as `shaders/shared/picture.wgsl` reads it.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct FinishParams {
    pub(super) color: [f32; 4],
    pub(super) background: [f32; 4],
    pub(super) size: [u32; 2],
    pub(super) n_taps: u32,
    pub(super) line_width: i32,
    pub(super) falloff: f32,
    pub(super) bias: f32,
    pub(super) strength: f32,
    pub(super) min_light: f32,
    pub(super) step_min: f32,
    pub(super) step_max: f32,
    pub(super) line_strength: f32,
    pub(super) pad: f32,
}

impl FinishParams {
    /// `is_colored`: the mesh has colours of its own.
    pub(super) fn new(finish: &Finish, params: &PictureParams, is_colored: bool) -> Self {
        let [r, g, b] = finish.color;
        let [step_min, step_max] = finish.steps;
        Self {
            color: [r, g, b, if is_colored { 1.0 } else { 0.0 }],
            background: finish.background,
            size: [params.width, params.height],
            n_taps: u32::try_from(finish.taps.len()).unwrap_or(0),
            line_width: finish.line_width,
            falloff: finish.falloff,
            bias: finish::OCCLUSION_BIAS,
            strength: finish::OCCLUSION_STRENGTH,
            min_light: finish::MIN_LIGHT,
            step_min,
            step_max,
            line_strength: finish::LINE_STRENGTH,
            pad: 0.0,
        }
    }
}

/// Neighbour of a pixel, as `shaders/picture/finish.wgsl` reads it.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct TapUniform {
    pub(super) pixels: [i32; 2],
    pub(super) length: [f32; 2],
}

/// Neighbours of `finish`; one unused entry if there are none, because buffers must not be empty.
pub(super) fn taps_of(finish: &Finish) -> Vec<TapUniform> {
    let mut all: Vec<TapUniform> =
        finish.taps.iter().map(|tap| TapUniform { pixels: [tap.dx, tap.dy], length: [tap.right, tap.up] }).collect();
    if all.is_empty() {
        all.push(TapUniform::zeroed());
    }
    all
}

/// Requirements of a picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Requirements {
    /// Larger side in pixels.
    side: u32,
    /// Bytes of the largest storage buffer.
    binding: u64,
    /// Bytes of the largest buffer.
    buffer: u64,
}

impl Requirements {
    /// Requirements of a picture of `mesh`.
    pub(super) fn new(mesh: &Mesh, params: &PictureParams) -> Self {
        let binding = u64::from(params.width) * u64::from(params.height) * 16;
        let columns = 12 * mesh.n_vertices().max(mesh.n_triangles()) as u64;
        Self { side: params.width.max(params.height), binding, buffer: columns.max(binding) }
    }

    /// Fails with a message if a device with these limits cannot draw the picture.
    pub(super) fn check(&self, limits: &Limits) -> Result<(), String> {
        let too_large = |what: &str, needed: u64, limit: u64| {
            if needed > limit {
                Err(format!("{what} of {needed} is needed, the device's limit is {limit}"))
            } else {
                Ok(())
            }
        };
        too_large("a texture side", self.side.into(), limits.max_texture_dimension_2d.into())?;
        too_large("a storage buffer in bytes", self.binding, limits.max_storage_buffer_binding_size)?;
        too_large("a buffer in bytes", self.buffer, limits.max_buffer_size)
    }
}

/// Creates a texture with one layer per sample.
pub(super) fn layered(device: &Device, label: &str, format: TextureFormat, params: &PictureParams) -> Texture {
    let usage = TextureUsages::RENDER_ATTACHMENT | TextureUsages::TEXTURE_BINDING;
    texture(device, label, format, params, PATTERN.len(), usage)
}

/// Creates a view of the layer of one sample, as a render target.
pub(super) fn layer(texture: &Texture, sample: u32) -> TextureView {
    texture.create_view(&TextureViewDescriptor {
        dimension: Some(TextureViewDimension::D2),
        base_array_layer: sample,
        array_layer_count: Some(1),
        ..TextureViewDescriptor::default()
    })
}

/// Creates a texture of the size of the picture.
pub(super) fn texture(
    device: &Device,
    label: &str,
    format: TextureFormat,
    params: &PictureParams,
    layers: usize,
    usage: TextureUsages,
) -> Texture {
    let depth_or_array_layers = u32::try_from(layers).unwrap_or(1);
    device.create_texture(&TextureDescriptor {
        label: Some(label),
        size: Extent3d { width: params.width, height: params.height, depth_or_array_layers },
        mip_level_count: 1,
        sample_count: 1,
        dimension: TextureDimension::D2,
        format,
        usage,
        view_formats: &[],
    })
}
