//! Measurement of the backends for `--backend auto`.

use std::num::NonZero;
use std::time::{Duration, Instant};

use molmesh::pipeline::cost::{Cost, time_mesh};
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::{DeviceChoice, SurfaceError};

use super::checks::{Check, CheckResult};
use crate::cli::args::BackendName;
use crate::cli::backend::{self, BackendRequest, Purpose};
use crate::cli::calibration::{Calibration, MeasuredGpu};
use crate::cli::estimate::GpuCost;

/// Time for the measurement of each backend.
const MEASURING: Duration = Duration::from_secs(2);
/// Atoms of the first mesh on a GPU.
const FIRST_ATOMS: usize = 8_000;

/// Measures the backends and stores the result.
pub(super) fn run(devices: &DeviceChoice) -> Check {
    let warning = |detail: String| Check::new("calibration", CheckResult::Warning, detail);
    let (gpu, no_gpu) = match gpu(devices) {
        Ok(gpu) => (Some(gpu), String::new()),
        Err(why) => (None, format!(", no GPU: {why}")),
    };
    let cpu = match cpu() {
        Ok(cpu) => cpu,
        Err(why) => return warning(format!("the CPU cannot be measured: {why}")),
    };
    let calibration = Calibration { version: env!("CARGO_PKG_VERSION").to_owned(), cpu, gpu };
    let of_gpu = calibration.gpu.as_ref().map_or(no_gpu, |gpu| {
        let (start, unit) = (gpu.cost.start * 1e3, (gpu.cost.first_use + gpu.cost.warm.per_unit) * 1e6);
        format!(", {}: start {start:.0} ms, {unit:.2} µs per atom", gpu.device)
    });
    let found = format!("CPU: {:.2} µs per atom and thread{of_gpu}", calibration.cpu.per_unit * 1e6);
    match calibration.save() {
        Ok(path) => Check::new("calibration", CheckResult::Ok, format!("{found}; stored in {}", path.display())),
        Err(error) => warning(format!("{found}; cannot be stored: {error}")),
    }
}

/// Measures the CPU. Returns its cost on one thread.
fn cpu() -> Result<Cost, String> {
    let cpu = CpuBackend::new(None)?;
    let cost = Cost::measure(&cpu, MEASURING).map_err(|error| error.to_string())?;
    let threads = std::thread::available_parallelism().map_or(1, NonZero::get);
    Ok(Cost { per_unit: cost.per_unit * threads as f64, ..cost })
}

/// Starts a GPU and measures it.
fn gpu(devices: &DeviceChoice) -> Result<MeasuredGpu, String> {
    let begun = Instant::now();
    let request =
        BackendRequest { backend: BackendName::Gpu, devices, threads: None, work: None, purpose: Purpose::Mesh };
    let selected = backend::select(&request).map_err(|error| error.to_string())?;
    let failed = |error: SurfaceError| error.to_string();
    selected.backend.warm_up().map_err(failed)?;
    let start = begun.elapsed().as_secs_f64();
    let (work, first) = time_mesh(selected.backend.as_ref(), FIRST_ATOMS).map_err(failed)?;
    let warm = Cost::measure(selected.backend.as_ref(), MEASURING).map_err(failed)?;
    let first_use = ((first - warm.seconds(work)) / work).max(0.0);
    let device = selected.devices.into_iter().find(|device| device.selected).ok_or("no device is used")?;
    let cost = GpuCost { start, first_use, warm };
    Ok(MeasuredGpu { device: device.facts.name, driver: device.facts.driver, cost })
}
