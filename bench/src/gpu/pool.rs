//! Throughput of jobs from many callers on 1, 2, … devices.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Instant;

use molmesh::gpu::{GpuBackend, PoolSettings};
use molmesh::surface::{Backend, Control, DeviceChoice, SurfaceParams};
use serde::Serialize;
use serde_json::{Value, json};

use super::{LIMITS, on_more_devices};
use crate::error::{Error, Result};
use crate::{print, structures};

/// Atoms per job, and jobs per hundred small ones. All sizes take about the same time.
const SIZES: [(usize, usize); 3] = [(600, 100), (6000, 50), (60_000, 20)];

/// Throughput of jobs of one size.
#[derive(Debug, Serialize)]
struct PoolRate {
    devices: usize,
    atoms: usize,
    jobs: usize,
    callers: usize,
    seconds: f64,
    jobs_per_second: f64,
    /// Processor time of the process per job, ms: callers, device threads, driver. Only on Linux.
    cpu_ms: Option<f64>,
    /// Number of submissions shared by several jobs.
    shared: u64,
}

/// Runs `n` small jobs and fewer large ones, of up to `most` atoms, on 1, 2, … devices of `choice`, with `callers`
/// callers per device.
pub(super) fn run(choice: &DeviceChoice, n: usize, callers: usize, most: usize) -> Result<Value> {
    print("jobs at 0.5 Å, prepared by their callers, to a mesh in memory\n")?;
    print("   devices   atoms    jobs  callers         s    jobs/s  CPU ms/job  shared\n")?;
    let mut rates = Vec::new();
    on_more_devices(choice, &PoolSettings::default(), |backend, devices| {
        for (atoms, share) in SIZES.into_iter().filter(|(atoms, _)| *atoms <= most) {
            let (jobs, callers) = ((n * share).div_ceil(100), callers * devices);
            // The first jobs allocate buffers.
            run_jobs(backend, atoms, 2 * callers, callers)?;
            let shared = || backend.devices().iter().map(|device| device.shared).sum::<u64>();
            let (before, cpu, start) = (shared(), processor_seconds(), Instant::now());
            run_jobs(backend, atoms, jobs, callers)?;
            let seconds = start.elapsed().as_secs_f64();
            let rate = PoolRate {
                devices,
                atoms,
                jobs,
                callers,
                seconds,
                jobs_per_second: jobs as f64 / seconds,
                cpu_ms: processor_seconds().zip(cpu).map(|(now, then)| (now - then) * 1e3 / jobs as f64),
                shared: shared() - before,
            };
            let cpu = rate.cpu_ms.map_or_else(|| "–".to_owned(), |ms| format!("{ms:.3}"));
            print(&format!(
                "{devices:>10}{atoms:>8}{jobs:>8}{callers:>9}{seconds:>10.3}{:>10.0}{cpu:>12}{:>8}\n",
                rate.jobs_per_second, rate.shared
            ))?;
            rates.push(rate);
        }
        Ok(())
    })?;
    Ok(json!({ "pool": rates }))
}

/// Returns the processor time used by this process, s.
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

/// Runs `jobs` jobs from `callers` threads, which also prepare them.
fn run_jobs(backend: &GpuBackend, atoms: usize, jobs: usize, callers: usize) -> Result<()> {
    let next = AtomicUsize::new(0);
    let call = |seed: u64| -> Result<()> {
        let (spheres, params) = (structures::ball(atoms, seed)?, SurfaceParams::default());
        while next.fetch_add(1, Ordering::Relaxed) < jobs {
            backend.run(&spheres, &params, &LIMITS, &Control::default()).map_err(Error::failed)?;
        }
        Ok(())
    };
    thread::scope(|scope| {
        let threads: Vec<_> = (1..=callers as u64).map(|seed| scope.spawn(move || call(seed))).collect();
        let join = |thread: thread::ScopedJoinHandle<'_, Result<()>>| {
            thread.join().unwrap_or_else(|_panic| Err(Error::failed("a caller panicked")))
        };
        threads.into_iter().try_for_each(join)
    })
}
