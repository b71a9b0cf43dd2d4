//! What a device can do at most, measured: memory, arithmetic and the way to the host. Floors are computed from these.

use std::time::Instant;

use wgpu::{Buffer, BufferUsages};

use super::engine::Engine;
use super::error::GpuError;
use super::output_layout::values;
use super::readback::ReadbackPool;
use super::recording::ticks_to_ns;
use super::shaders::YARDSTICKS;

/// Rates of a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Bytes read plus bytes written per second by a shader that copies one buffer to another.
    pub memory: f64,
    /// Fused multiply-adds of single precision per second.
    pub fma: f64,
    /// Bytes per second from the device to memory that the host reads in place.
    pub to_host: f64,
    /// Seconds of a submission with next to nothing in it, from submitting to reading.
    pub round_trip: f64,
}

/// How much work the measurements do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Bytes copied; more than caches hold.
    pub bytes: u64,
    /// Workgroups of 256 threads that multiply and add.
    pub workgroups: u32,
}

impl Effort {
    /// For a GPU: 1 GiB there and 1 GiB back, and a few milliseconds of arithmetic.
    pub const HARDWARE: Self = Self { bytes: 1 << 30, workgroups: 1 << 16 };
    /// For a processor that plays one.
    pub const SOFTWARE: Self = Self { bytes: 16 << 20, workgroups: 64 };
}

/// Multiply-adds of a thread of `fma`.
const FMAS: f64 = 8.0 * 1024.0;
/// Repetitions; the best counts, as a floor should.
const REPEATS: usize = 8;

/// Measures `engine`'s device. `None` where it has no timestamps.
///
/// # Errors
/// [`GpuError`] as the device reports it.
pub fn rates(engine: &Engine, effort: Effort) -> Result<Option<Rates>, GpuError> {
    if !engine.has_timestamps() {
        return Ok(None);
    }
    let bytes = effort.bytes.min(engine.budget.piece_bytes) & !255;
    let buffer = |label, bytes, usage| {
        engine.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes,
            usage,
            mapped_at_creation: false,
        })
    };
    let source =
        buffer("molmesh.bench.source", bytes, BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST);
    let goal = buffer("molmesh.bench.goal", bytes, BufferUsages::STORAGE);
    engine.queue.write_buffer(&source, 0, bytemuck::cast_slice(&[0.999_f32, 0.5, 0.25, 0.125, 1e-3, 2e-3, 3e-3, 4e-3]));
    let groups = u32::try_from(bytes / 16 / 256).unwrap_or(u32::MAX);
    let copy = engine.best_time(0, &source, &goal, groups)?;
    let fma = engine.best_time(1, &source, &goal, effort.workgroups)?;
    // Not the engine's: what is measured with must not lie about when jobs are.
    let landings = ReadbackPool::new(engine.budget.idle_bytes);
    let (mut to_host, mut round_trip) = (f64::MAX, f64::MAX);
    for _ in 0..REPEATS {
        to_host = to_host.min(engine.fetch(&landings, &source, bytes)?);
        round_trip = round_trip.min(engine.fetch(&landings, &source, 256)?);
    }
    Ok(Some(Rates {
        memory: 2.0 * bytes as f64 / copy,
        fma: f64::from(effort.workgroups) * 256.0 * FMAS / fma,
        to_host: bytes as f64 / to_host,
        round_trip,
    }))
}

impl Engine {
    /// The least device time of yardstick `which`, s.
    fn best_time(&self, which: usize, source: &Buffer, goal: &Buffer, workgroups: u32) -> Result<f64, GpuError> {
        let shader = &YARDSTICKS[which];
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(shader.stage),
            source: wgpu::ShaderSource::Wgsl(shader.source.into()),
        });
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(shader.stage),
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        });
        let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(shader.stage),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: source.as_entire_binding() },
                wgpu::BindGroupEntry { binding: 1, resource: goal.as_entire_binding() },
            ],
        });
        let queries = self.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some(shader.stage),
            ty: wgpu::QueryType::Timestamp,
            count: 2,
        });
        let resolved = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(shader.stage),
            size: 256,
            usage: BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let period = f64::from(self.queue.get_timestamp_period());
        let mut best = f64::MAX;
        for _ in 0..REPEATS {
            let mut recording = self.recording();
            let timestamp_writes = Some(wgpu::ComputePassTimestampWrites {
                query_set: &queries,
                beginning_of_pass_write_index: Some(0),
                end_of_pass_write_index: Some(1),
            });
            let descriptor = wgpu::ComputePassDescriptor { label: Some(shader.stage), timestamp_writes };
            let mut pass = recording.encoder.begin_compute_pass(&descriptor);
            pass.set_pipeline(&pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.dispatch_workgroups(workgroups.min(1 << 15), workgroups.div_ceil(1 << 15), 1);
            drop(pass);
            recording.encoder.resolve_query_set(&queries, 0..2, &resolved, 0);
            let landing = self.readback.acquire(&self.device, 16);
            recording.encoder.copy_buffer_to_buffer(&resolved, 0, landing.buffer().map_err(GpuError::Failed)?, 0, 16);
            let landed = self.submit_and_wait(recording, (landing, 16))?;
            let ticks: &[u64] = values((*landed).as_ref(), 0, 2).map_err(GpuError::Failed)?;
            let [begin, end] = ticks else { return Err(GpuError::Failed("no timestamps came back".to_owned())) };
            best = best.min(ticks_to_ns(end.saturating_sub(*begin), period) as f64 * 1e-9);
        }
        Ok(best.max(1e-9))
    }

    /// Seconds to bring `bytes` bytes to the host.
    fn fetch(&self, landings: &ReadbackPool, from: &Buffer, bytes: u64) -> Result<f64, GpuError> {
        let landing = landings.acquire(&self.device, bytes);
        let start = Instant::now();
        let mut recording = self.recording();
        recording.encoder.copy_buffer_to_buffer(from, 0, landing.buffer().map_err(GpuError::Failed)?, 0, bytes);
        let landed = self.submit_and_wait(recording, (landing, bytes))?;
        let seconds = start.elapsed().as_secs_f64();
        drop(landed);
        Ok(seconds)
    }
}
