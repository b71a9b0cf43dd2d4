//! GPUs to measure: selection, and direct use of wgpu by the benchmarks.

use std::sync::{Arc, Mutex, PoisonError};

use molmesh::gpu::{Discovery, DiscoveryMode, Engine, discover};
use molmesh::surface::{DeviceChoice, DeviceKind};
use wgpu::{Buffer, BufferUsages, BufferView, CommandEncoder, ComputePass, ComputePipeline, Device, QuerySet, Queue};

use crate::error::{Error, Result};

/// Workgroups along the first dimension of a dispatch. All devices support this number.
const MAX_WORKGROUPS: u32 = 1 << 15;

/// Device selected for measurements.
#[derive(Debug)]
pub(crate) struct Selected {
    /// Name of the adapter.
    pub(crate) name: String,
    /// Driver and graphics API.
    pub(crate) driver: String,
    /// True if a processor emulates the device, whose speed is then not that of a GPU.
    pub(crate) software: bool,
    number: usize,
    discovery: Discovery,
}

impl Selected {
    /// Selects the first device of `choice`.
    ///
    /// # Errors
    /// Returns [`Error::NoDevice`] if there is none.
    pub(crate) fn new(choice: &DeviceChoice) -> Result<Self> {
        let discovery = discover(choice, DiscoveryMode::Thorough);
        let Some(device) = discovery.selected().next() else {
            return Err(Error::NoDevice(discovery.no_device_reason().unwrap_or_default()));
        };
        let facts = &device.facts;
        Ok(Self {
            name: facts.name.clone(),
            driver: format!("{} ({})", facts.driver, facts.api),
            software: facts.kind == DeviceKind::Software,
            number: device.number,
            discovery,
        })
    }

    /// Opens the device and compiles the stages of molmesh.
    ///
    /// # Errors
    /// Returns [`Error::Failed`] if the driver reports an error.
    pub(crate) fn engine(&self) -> Result<Engine> {
        let (device, queue) = self.discovery.open(self.number).map_err(Error::failed)?;
        Engine::new(device, queue).map_err(Error::failed)
    }

    /// Opens the device for the benchmarks' own shaders.
    ///
    /// # Errors
    /// Returns the errors of [`Self::engine`].
    pub(crate) fn gpu(&self) -> Result<Gpu> {
        self.discovery.open(self.number).map(Gpu::new).map_err(Error::failed)
    }
}

/// Open device with its queue. The next [`Self::check`] returns errors that wgpu reports asynchronously.
#[derive(Debug)]
pub(crate) struct Gpu {
    pub(crate) device: Device,
    pub(crate) queue: Queue,
    error: Arc<Mutex<Option<String>>>,
}

impl Gpu {
    /// Wraps an open device.
    pub(crate) fn new((device, queue): (Device, Queue)) -> Self {
        let error = Arc::new(Mutex::new(None));
        let first = Arc::clone(&error);
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(e.to_string());
        }));
        Self { device, queue, error }
    }

    /// Returns the size of the largest storage buffer binding, bytes.
    pub(crate) fn max_binding(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// Checks for asynchronous errors.
    ///
    /// # Errors
    /// Returns the first error since the last call as [`Error::Failed`].
    pub(crate) fn check(&self) -> Result<()> {
        self.error.lock().unwrap_or_else(PoisonError::into_inner).take().map_or(Ok(()), |e| Err(Error::Failed(e)))
    }

    /// Creates a buffer.
    pub(crate) fn buffer(&self, label: &str, size: u64, usage: BufferUsages) -> Buffer {
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        self.device.create_buffer(&descriptor)
    }

    /// Creates a readback buffer.
    pub(crate) fn readback(&self, bytes: u64) -> Buffer {
        self.buffer("readback", bytes, BufferUsages::COPY_DST | BufferUsages::MAP_READ)
    }

    /// Compiles a shader whose entry point is `main`.
    pub(crate) fn pipeline(&self, label: &str, source: &str, constants: &[(&str, f64)]) -> ComputePipeline {
        let source = wgpu::ShaderSource::Wgsl(source.into());
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source });
        self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants,
                // All shaders write workgroup memory before they read it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        })
    }

    /// Dispatches `workgroups` workgroups with the first bytes of `buffers` bound, in order.
    pub(crate) fn dispatch(
        &self,
        pass: &mut ComputePass<'_>,
        pipeline: &ComputePipeline,
        buffers: &[(&Buffer, u64)],
        workgroups: u32,
    ) {
        let resource = |buffer, bytes| wgpu::BufferBinding { buffer, offset: 0, size: wgpu::BufferSize::new(bytes) };
        let binding = |(binding, &(buffer, bytes))| wgpu::BindGroupEntry {
            binding,
            resource: wgpu::BindingResource::Buffer(resource(buffer, bytes)),
        };
        let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &pipeline.get_bind_group_layout(0),
            entries: &(0..).zip(buffers).map(binding).collect::<Vec<_>>(),
        });
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(workgroups.min(MAX_WORKGROUPS), workgroups.div_ceil(MAX_WORKGROUPS), 1);
    }

    /// Creates an encoder of commands.
    pub(crate) fn encoder(&self) -> CommandEncoder {
        self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
    }

    /// Submits commands, waits for them, and maps the first bytes of `readback`. Drop the view before unmapping the
    /// buffer.
    ///
    /// # Errors
    /// Returns the errors of wgpu as [`Error::Failed`].
    pub(crate) fn submit(&self, encoder: CommandEncoder, readback: &Buffer, bytes: u64) -> Result<BufferView> {
        let index = self.queue.submit([encoder.finish()]);
        // `get_mapped_range` reports failures to map.
        readback.slice(..bytes).map_async(wgpu::MapMode::Read, |_| {});
        let waited = self.device.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: None });
        self.check()?;
        waited.map_err(Error::failed)?;
        readback.slice(..bytes).get_mapped_range().map_err(Error::failed)
    }
}

/// Timer of the steps of a computation, by timestamp queries.
#[derive(Debug)]
pub(crate) struct Timer {
    queries: QuerySet,
    resolved: Buffer,
    readback: Buffer,
    /// Seconds per tick.
    period: f64,
}

impl Timer {
    /// Creates a timer of at most 16 steps. Returns `None` if the device does not support timestamps.
    pub(crate) fn new(gpu: &Gpu) -> Option<Self> {
        gpu.device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Self {
            queries: gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: 32,
            }),
            resolved: gpu.buffer("timestamps", 256, BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            readback: gpu.readback(256),
            period: f64::from(gpu.queue.get_timestamp_period()) * 1e-9,
        })
    }

    /// Returns the timestamp writes of a pass that begins the step `begins`, ends the step `ends`, or both.
    pub(crate) fn writes(&self, begins: Option<u32>, ends: Option<u32>) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: begins.map(|step| 2 * step),
            end_of_pass_write_index: ends.map(|step| 2 * step + 1),
        }
    }

    /// Returns the durations of the first `N` steps, s. All of them must have been submitted.
    ///
    /// # Errors
    /// Returns the errors of wgpu as [`Error::Failed`].
    pub(crate) fn seconds<const N: usize>(&self, gpu: &Gpu) -> Result<[f64; N]> {
        let (bytes, mut encoder) = (16 * N as u64, gpu.encoder());
        encoder.resolve_query_set(&self.queries, 0..u32::try_from(2 * N).unwrap_or(u32::MAX), &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.readback, 0, bytes);
        let view = gpu.submit(encoder, &self.readback, bytes)?;
        let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&view);
        drop(view);
        self.readback.unmap();
        Ok(std::array::from_fn(|i| ticks[2 * i + 1].saturating_sub(ticks[2 * i]) as f64 * self.period))
    }
}
