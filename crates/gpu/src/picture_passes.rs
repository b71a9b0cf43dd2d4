//! Passes of a picture on a device: four draw passes, one that resolves the samples, and one that shades the pixels.

use std::sync::Arc;
use std::time::Duration;

use molmesh_picture::camera::Camera;
use molmesh_picture::finish::Finish;
use molmesh_picture::light::Levels;
use molmesh_picture::{MeshColumns, PictureParams};
use molmesh_surface::CancelToken;
use wgpu::{
    BindGroup, BindGroupEntry, BindGroupLayout, BindingResource, Buffer, BufferUsages, CommandEncoder, ComputePipeline,
    Device, Limits, LoadOp, MapMode, Operations, PollError, PollType, Queue, RenderPassColorAttachment,
    RenderPassDepthStencilAttachment, RenderPipeline, ShaderModule, StoreOp, TextureUsages, TextureViewDescriptor,
    VertexAttribute, VertexBufferLayout, VertexFormat, VertexStepMode,
};

use super::buffers::buffer;
use super::device_errors::DeviceErrors;
use super::error::GpuError;
use super::picture_targets::{
    DEPTH, DEPTH_BUFFER, FinishParams, NO_SURFACE_DEPTH, PATTERN, SHADE, ViewUniform, layer, layered, taps_of, texture,
};
use super::shaders::{PICTURE, Shader};

/// Interval of checks for cancellation while the device works.
const CANCEL_INTERVAL: Duration = Duration::from_millis(20);
/// Width and height of a workgroup in pixels, as in the shaders.
const GROUP: u32 = 8;

/// Open device with the compiled passes. The bind group layouts follow from the shaders.
pub(super) struct PicturePasses {
    device: Device,
    queue: Queue,
    errors: Arc<DeviceErrors>,
    draw: RenderPipeline,
    resolve: ComputePipeline,
    finish: ComputePipeline,
    levels: Buffer,
}

impl PicturePasses {
    /// Compiles the passes.
    ///
    /// # Errors
    /// [`GpuError::Failed`] or [`GpuError::Lost`] as reported by the device.
    pub(super) fn new(device: Device, queue: Queue) -> Result<Self, GpuError> {
        let errors = DeviceErrors::listen(&device);
        let [vertex, fragment, resolve, finish] = &PICTURE;
        let table: Vec<u32> = Levels::get().table().iter().copied().map(u32::from).collect();
        let levels = filled(&device, &queue, "levels", bytemuck::cast_slice(&table), BufferUsages::STORAGE);
        let passes = Self {
            draw: draw_pipeline(&device, [vertex, fragment]),
            resolve: compute_pipeline(&device, resolve),
            finish: compute_pipeline(&device, finish),
            device,
            queue,
            errors,
            levels,
        };
        passes.check_errors()?;
        Ok(passes)
    }

    /// Returns the limits of the device.
    pub(super) fn limits(&self) -> Limits {
        self.device.limits()
    }

    /// Draws a mesh. Returns the pixels in rows from the top; none after a cancellation. The caller has checked the
    /// [`Requirements`](super::picture_targets::Requirements).
    ///
    /// # Errors
    /// [`GpuError::Failed`] or [`GpuError::Lost`] as reported by the device.
    pub(super) fn draw_mesh(
        &self,
        columns: MeshColumns<'_>,
        params: &PictureParams,
        camera: &Camera,
        cancel: &CancelToken,
    ) -> Result<Vec<[u8; 4]>, GpuError> {
        let (device, queue) = (&self.device, &self.queue);
        let MeshColumns { positions, normals, triangles, colors } = columns;
        let n_pixels = u64::from(params.width) * u64::from(params.height);
        let column = |label: &str, bytes: &[u8], usage| filled(device, queue, label, bytes, usage);
        let position_buffer = column("positions", bytemuck::cast_slice(positions), BufferUsages::VERTEX);
        let normal_buffer = column("normals", bytemuck::cast_slice(normals), BufferUsages::VERTEX);
        let color_buffer = colors.map(|colors| column("colors", bytemuck::cast_slice(colors), BufferUsages::VERTEX));
        let index_buffer = column("triangles", bytemuck::cast_slice(triangles), BufferUsages::INDEX);
        let n_indices = u32::try_from(3 * triangles.len()).map_err(|_too_many| {
            GpuError::Failed(format!("{} triangles are too many for one draw", triangles.len()))
        })?;
        let shades = layered(device, "molmesh.picture.shades", SHADE, params);
        let depths = layered(device, "molmesh.picture.depths", DEPTH, params);
        let tints = layered(device, "molmesh.picture.tints", SHADE, params);
        let attachment = TextureUsages::RENDER_ATTACHMENT;
        let nearest = texture(device, "molmesh.picture.nearest", DEPTH_BUFFER, params, 1, attachment);
        let nearest = nearest.create_view(&TextureViewDescriptor::default());
        self.check_errors()?;

        let mut encoder =
            device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("molmesh.picture") });
        for (sample, offset) in (0_u32..).zip(PATTERN) {
            let view = ViewUniform::new(camera, offset);
            let view = column("view", bytemuck::bytes_of(&view), BufferUsages::UNIFORM);
            let group = bind(device, &self.draw.get_bind_group_layout(0), &[view.as_entire_binding()]);
            let views = [layer(&shades, sample), layer(&depths, sample), layer(&tints, sample)];
            let mut pass = begin_draw(&mut encoder, &views, &nearest);
            pass.set_pipeline(&self.draw);
            pass.set_bind_group(0, &group, &[]);
            pass.set_vertex_buffer(0, position_buffer.slice(..));
            pass.set_vertex_buffer(1, normal_buffer.slice(..));
            // Without colours, the shader ignores the values, so any column of sufficient length will do.
            pass.set_vertex_buffer(2, color_buffer.as_ref().unwrap_or(&position_buffer).slice(..));
            pass.set_index_buffer(index_buffer.slice(..), wgpu::IndexFormat::Uint32);
            pass.draw_indexed(0..n_indices, 0, 0..1);
        }
        let finish = Finish::new(params, camera);
        let finish_params = FinishParams::new(&finish, params, colors.is_some());
        let finish_params = column("params", bytemuck::bytes_of(&finish_params), BufferUsages::UNIFORM);
        let taps = column("taps", bytemuck::cast_slice(&taps_of(&finish)), BufferUsages::STORAGE);
        let rows = |label| buffer(device, label, 16 * n_pixels, BufferUsages::STORAGE);
        let (seen, resolved_normals) = (rows("molmesh.picture.seen"), rows("molmesh.picture.normals"));
        let both = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
        let pixels = buffer(device, "molmesh.picture.pixels", 4 * n_pixels, both);
        let mappable = BufferUsages::COPY_DST | BufferUsages::MAP_READ;
        let readback = buffer(device, "molmesh.picture.readback", 4 * n_pixels, mappable);
        let groups = [params.width.div_ceil(GROUP), params.height.div_ceil(GROUP)];
        let [all_shades, all_depths, all_tints] =
            [&shades, &depths, &tints].map(|texture| texture.create_view(&TextureViewDescriptor::default()));
        let resources = [
            finish_params.as_entire_binding(),
            BindingResource::TextureView(&all_shades),
            BindingResource::TextureView(&all_depths),
            seen.as_entire_binding(),
            resolved_normals.as_entire_binding(),
            BindingResource::TextureView(&all_tints),
        ];
        compute(device, &mut encoder, &self.resolve, &resources, groups);
        let resources =
            [&finish_params, &seen, &resolved_normals, &taps, &self.levels, &pixels].map(Buffer::as_entire_binding);
        compute(device, &mut encoder, &self.finish, &resources, groups);
        encoder.copy_buffer_to_buffer(&pixels, 0, &readback, 0, 4 * n_pixels);
        queue.submit([encoder.finish()]);
        self.read(&readback, cancel)
    }

    /// Waits for all submissions and returns the contents of a buffer. After a cancellation, the device finishes its
    /// submission, and the result is empty.
    fn read(&self, readback: &Buffer, cancel: &CancelToken) -> Result<Vec<[u8; 4]>, GpuError> {
        readback.map_async(MapMode::Read, .., |_mapped| {});
        let waited = loop {
            match self.device.poll(PollType::Wait { submission_index: None, timeout: Some(CANCEL_INTERVAL) }) {
                Err(PollError::Timeout) if cancel.is_cancelled() => return Ok(Vec::new()),
                Err(PollError::Timeout) => {}
                waited => break waited,
            }
        };
        self.check_errors()?;
        waited.map_err(|error| GpuError::Failed(error.to_string()))?;
        let view = readback.get_mapped_range(..).map_err(|error| GpuError::Failed(error.to_string()))?;
        let pixels = bytemuck::cast_slice::<u8, [u8; 4]>(&view).to_vec();
        drop(view);
        readback.unmap();
        Ok(pixels)
    }

    /// Fails if the graphics API has reported an error since the last check.
    fn check_errors(&self) -> Result<(), GpuError> {
        self.errors.check(|| GpuError::Failed("it has too little memory for the picture".to_owned()))
    }
}

/// Records a compute pass.
fn compute(
    device: &Device,
    encoder: &mut CommandEncoder,
    pipeline: &ComputePipeline,
    resources: &[BindingResource<'_>],
    groups: [u32; 2],
) {
    let group = bind(device, &pipeline.get_bind_group_layout(0), resources);
    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes: None });
    pass.set_pipeline(pipeline);
    pass.set_bind_group(0, &group, &[]);
    pass.dispatch_workgroups(groups[0], groups[1], 1);
}

/// Begins a pass that draws one sample of every pixel onto cleared targets.
fn begin_draw<'a>(
    encoder: &'a mut CommandEncoder,
    views: &[wgpu::TextureView; 3],
    nearest: &wgpu::TextureView,
) -> wgpu::RenderPass<'a> {
    let cleared =
        |r: f64| Operations { load: LoadOp::Clear(wgpu::Color { r, g: 0.0, b: 0.0, a: 0.0 }), store: StoreOp::Store };
    let color =
        |view, r| Some(RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops: cleared(r) });
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("molmesh.picture"),
        color_attachments: &[color(&views[0], 0.0), color(&views[1], NO_SURFACE_DEPTH), color(&views[2], 0.0)],
        depth_stencil_attachment: Some(RenderPassDepthStencilAttachment {
            view: nearest,
            depth_ops: Some(Operations { load: LoadOp::Clear(1.0), store: StoreOp::Discard }),
            stencil_ops: None,
        }),
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    })
}

/// Compiles the pipeline of the draw passes.
fn draw_pipeline(device: &Device, [vertex, fragment]: [&Shader; 2]) -> RenderPipeline {
    let formats = [(0, VertexFormat::Float32x3), (1, VertexFormat::Float32x3), (2, VertexFormat::Unorm8x4)];
    let attributes = formats.map(|(shader_location, format)| [VertexAttribute { format, offset: 0, shader_location }]);
    let columns = attributes.each_ref().map(|attributes| {
        let array_stride = attributes[0].format.size();
        Some(VertexBufferLayout { array_stride, step_mode: VertexStepMode::Vertex, attributes })
    });
    let [vertex, fragment] = [vertex, fragment].map(|shader| module(device, shader));
    let target = |format| Some(wgpu::ColorTargetState { format, blend: None, write_mask: wgpu::ColorWrites::ALL });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("molmesh.picture"),
        layout: None,
        vertex: wgpu::VertexState {
            module: &vertex,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &columns,
        },
        primitive: wgpu::PrimitiveState {
            front_face: wgpu::FrontFace::Ccw,
            cull_mode: Some(wgpu::Face::Back),
            ..wgpu::PrimitiveState::default()
        },
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH_BUFFER,
            depth_write_enabled: Some(true),
            depth_compare: Some(wgpu::CompareFunction::Less),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &fragment,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[target(SHADE), target(DEPTH), target(SHADE)],
        }),
        multiview_mask: None,
        cache: None,
    })
}

fn module(device: &Device, shader: &Shader) -> ShaderModule {
    let source = wgpu::ShaderSource::Wgsl(shader.source.into());
    device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(shader.stage), source })
}

fn compute_pipeline(device: &Device, shader: &Shader) -> ComputePipeline {
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(shader.stage),
        layout: None,
        module: &module(device, shader),
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    })
}

fn bind(device: &Device, layout: &BindGroupLayout, resources: &[BindingResource<'_>]) -> BindGroup {
    let entries: Vec<_> = (0..)
        .zip(resources)
        .map(|(binding, resource)| BindGroupEntry { binding, resource: resource.clone() })
        .collect();
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
}

/// Creates a buffer that holds `bytes`, a multiple of four.
fn filled(device: &Device, queue: &Queue, label: &str, bytes: &[u8], usage: BufferUsages) -> Buffer {
    let buffer = buffer(device, label, bytes.len() as u64, usage | BufferUsages::COPY_DST);
    queue.write_buffer(&buffer, 0, bytes);
    buffer
}
