//! Measured rates of a device: memory, arithmetic, and transfers to the host.

use std::time::Instant;

use serde::Serialize;
use wgpu::{Buffer, BufferUsages};

use crate::device::{Gpu, Timer};
use crate::error::Result;

/// Rates of a device.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct Rates {
    /// Bytes read plus bytes written per second by a shader that copies one buffer to another.
    pub(crate) memory: f64,
    /// Fused multiply-adds of single precision per second.
    pub(crate) fma: f64,
    /// Bytes per second from the device to memory that the host reads in place.
    pub(crate) to_host: f64,
    /// Time of a submission that copies 256 bytes, from submission to readback, s.
    pub(crate) round_trip: f64,
}

/// Multiply-adds per thread of `fma.wgsl`.
const FMAS: f64 = 8.0 * 1024.0;
/// Number of repetitions. The fastest one counts, since the rates are upper bounds.
const REPEATS: usize = 8;

/// Measures a device. Returns `None` if it does not support timestamps.
///
/// # Errors
/// Returns the errors of the device.
pub(crate) fn measure(gpu: &Gpu, software: bool) -> Result<Option<Rates>> {
    let Some(timer) = Timer::new(gpu) else { return Ok(None) };
    // Larger than caches, and enough workgroups for a few milliseconds.
    let (bytes, workgroups) = if software { (16 << 20, 64) } else { (1 << 30, 1 << 16) };
    let bytes = gpu.max_binding().min(bytes) & !255;
    let storage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
    let [source, target] = ["source", "target"].map(|label| gpu.buffer(label, bytes, storage));
    gpu.queue.write_buffer(&source, 0, bytemuck::cast_slice(&[0.999_f32, 0.5, 0.25, 0.125, 1e-3, 2e-3, 3e-3, 4e-3]));
    let best = |label: &str, shader: &str, workgroups: u32| -> Result<f64> {
        let pipeline = gpu.pipeline(label, shader, &[]);
        let mut best = f64::MAX;
        for _ in 0..REPEATS {
            let mut encoder = gpu.encoder();
            let timestamp_writes = Some(timer.writes(Some(0), Some(0)));
            let descriptor = wgpu::ComputePassDescriptor { label: Some(label), timestamp_writes };
            let mut pass = encoder.begin_compute_pass(&descriptor);
            gpu.dispatch(&mut pass, &pipeline, &[(&source, bytes), (&target, bytes)], workgroups);
            drop(pass);
            gpu.queue.submit([encoder.finish()]);
            best = best.min(timer.seconds::<1>(gpu)?[0]);
        }
        Ok(best.max(1e-9))
    };
    let copied = best("copy", include_str!("../shaders/copy.wgsl"), u32::try_from(bytes / 4096).unwrap_or(u32::MAX))?;
    let computed = best("fma", include_str!("../shaders/fma.wgsl"), workgroups)?;
    Ok(Some(Rates {
        memory: 2.0 * bytes as f64 / copied,
        fma: f64::from(workgroups) * 256.0 * FMAS / computed,
        to_host: bytes as f64 / transfer(gpu, &source, bytes)?,
        round_trip: transfer(gpu, &source, 256)?,
    }))
}

/// Returns the minimum time to transfer `bytes` bytes to the host, s.
fn transfer(gpu: &Gpu, source: &Buffer, bytes: u64) -> Result<f64> {
    let readback = gpu.readback(bytes);
    let mut best = f64::MAX;
    for _ in 0..REPEATS {
        let start = Instant::now();
        let mut encoder = gpu.encoder();
        encoder.copy_buffer_to_buffer(source, 0, &readback, 0, bytes);
        drop(gpu.submit(encoder, &readback, bytes)?);
        best = best.min(start.elapsed().as_secs_f64());
        readback.unmap();
    }
    Ok(best)
}
