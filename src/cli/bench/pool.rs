//! Many jobs from many callers through the device pool, on one device, two, and so on to all.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Instant;

use molmesh::gpu::{GpuBackend, Look, PoolSettings, Program, discover};
use molmesh::surface::devices::DeviceName;
use molmesh::surface::{Backend, Control, DeviceChoice, SurfaceError, SurfaceLimits, SurfaceParams};
use serde::Serialize;

use super::super::error::CliError;
use super::cases::ball;

/// Atoms of a small job, of a usual one and of a large one, and how many of them are made for each hundred small ones: they
/// take about as long.
const SIZES: [(usize, usize); 3] = [(600, 100), (6000, 50), (60_000, 20)];
/// Jobs of one size on so many devices.
#[derive(Debug, Clone, Serialize)]
pub(super) struct PoolRate {
    devices: usize,
    atoms: usize,
    jobs: usize,
    callers: usize,
    seconds: f64,
    jobs_per_second: f64,
    /// Processor time of the whole process for each job, ms: callers, device threads, driver. None where nobody tells.
    cpu_ms: Option<f64>,
    /// Submissions that several jobs shared.
    shared: u64,
}

/// Runs `n` small jobs and a share of larger ones on 1, 2, … devices of those that `choice` takes, from so many callers for
/// each device.
pub(super) fn run(choice: &DeviceChoice, n: usize, callers: usize) -> Result<Vec<PoolRate>, CliError> {
    let failed = |e: &dyn std::fmt::Display| CliError::Service(e.to_string());
    let found = discover(choice, Look::Thorough);
    if let Some(why) = found.why_none() {
        return Err(CliError::NoBackend { asked: "gpu", why });
    }
    let taken: Vec<usize> = found.devices.iter().filter(|d| d.taken).map(|d| d.number).collect();
    let mut rates = Vec::new();
    for devices in (1..=taken.len()).filter(|n| n.is_power_of_two() || *n == taken.len()) {
        let some = DeviceChoice::These(taken[..devices].iter().map(|&n| DeviceName::Number(n)).collect());
        let backend =
            GpuBackend::start(&discover(&some, Look::Thorough), Program::Stages, &PoolSettings::default(), None)
                .map_err(|e| failed(&e))?;
        backend.warm().map_err(|e| failed(&e))?;
        for (atoms, share) in SIZES {
            let jobs = (n * share).div_ceil(100);
            // Once without the clock: buffers are made.
            let callers = callers * devices;
            flood(&backend, atoms, 2 * callers, callers).map_err(|e| failed(&e))?;
            let shared = |backend: &GpuBackend| backend.devices().iter().map(|d| d.shared).sum::<u64>();
            let (before, cpu, start) = (shared(&backend), processor_seconds(), Instant::now());
            flood(&backend, atoms, jobs, callers).map_err(|e| failed(&e))?;
            let seconds = start.elapsed().as_secs_f64();
            let jobs_per_second = jobs as f64 / seconds;
            let cpu_ms = processor_seconds().zip(cpu).map(|(now, then)| (now - then) * 1e3 / jobs as f64);
            let shared = shared(&backend) - before;
            rates.push(PoolRate { devices, atoms, jobs, callers, seconds, jobs_per_second, cpu_ms, shared });
        }
    }
    Ok(rates)
}

/// Processor time of this process so far, s.
fn processor_seconds() -> Option<f64> {
    #[cfg(target_os = "linux")]
    let seconds = {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        Some(time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9)
    };
    #[cfg(not(target_os = "linux"))]
    let seconds = None;
    seconds
}

/// Runs `jobs` jobs from so many callers, each of which prepares its own.
fn flood(backend: &GpuBackend, atoms: usize, jobs: usize, callers: usize) -> Result<(), SurfaceError> {
    let next = AtomicUsize::new(0);
    let call = |seed: u64| {
        let (spheres, params, limits) = (ball(atoms, seed), SurfaceParams::default(), SurfaceLimits::default());
        while next.fetch_add(1, Ordering::Relaxed) < jobs {
            backend.run(&spheres, &params, &limits, &Control::default())?;
        }
        Ok(())
    };
    thread::scope(|scope| {
        let threads: Vec<_> = (1..=callers as u64).map(|seed| scope.spawn(move || call(seed))).collect();
        threads.into_iter().try_for_each(|thread| thread.join().unwrap_or(Err(SurfaceError::Cancelled)))
    })
}

/// The same as text.
pub(super) fn table(rates: &[PoolRate]) -> String {
    let mut text = "jobs at 0.5 Å through the pool, prepared by their callers, to a mesh in memory\n".to_owned();
    // A string takes everything.
    _ = writeln!(
        text,
        "  {:>8}{:>8}{:>8}{:>9}{:>10}{:>10}{:>12}{:>8}",
        "devices", "atoms", "jobs", "callers", "s", "jobs/s", "CPU ms/job", "shared"
    );
    for r in rates {
        let cpu = r.cpu_ms.map_or_else(|| "–".to_owned(), |ms| format!("{ms:.3}"));
        _ = writeln!(
            text,
            "  {:>8}{:>8}{:>8}{:>9}{:>10.3}{:>10.0}{cpu:>12}{:>8}",
            r.devices, r.atoms, r.jobs, r.callers, r.seconds, r.jobs_per_second, r.shared
        );
    }
    text
}
