//! `molmesh-bench gpu`: benchmarks of stages, small jobs, many callers, and several devices.

mod cases;
mod jobs;
mod measure;
mod pool;
mod several;

use std::path::PathBuf;

use molmesh::formats::Compress;
use molmesh::gpu::{DiscoveryMode, GpuBackend, GpuJob, PoolSettings, Prepared, discover};
use molmesh::surface::devices::DeviceName;
use molmesh::surface::{
    Backend as _, CancelToken, Control, DeviceChoice, Spheres, Step, SurfaceLimits, SurfaceParams, lattice,
};
use serde_json::{Value, json};

use crate::device::Selected;
use crate::error::{Error, Result};
use crate::{print, rates, write_json};
use cases::Case;

/// Limits of the benchmarks.
pub(crate) const LIMITS: SurfaceLimits =
    SurfaceLimits { max_grid_points: 1 << 40, max_mesh_bytes: 64 << 30, max_candidates: 1 << 31 };
/// Number of unmeasured runs.
const WARM_UP: usize = 3;

/// Arguments of `molmesh-bench gpu`.
#[derive(Debug, clap::Args)]
pub(crate) struct GpuArgs {
    /// Device: auto, software, or a number printed by `molmesh doctor`; hardware comes first
    #[arg(long, value_name = "WHICH", default_value = "0")]
    device: DeviceChoice,
    /// Number of measured runs of each case, after three unmeasured ones
    #[arg(long, value_name = "N", default_value_t = 20)]
    runs: usize,
    /// Folder with 2hhb, 1aon and 7cgo, as PDB or mmCIF, plain or compressed
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Measure only cases whose name contains one of these texts; 7cgo-x9-0.5 (gigabytes of mesh) only by its full name
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    only: Vec<String>,
    /// Number of atoms of the generated case, which needs no file, and of the largest jobs of --pool
    #[arg(long, value_name = "N", default_value_t = 60_000)]
    atoms: usize,
    /// Encoding of vertices: none (single precision, 24 bytes each) or quantize (12 bytes)
    #[arg(long, value_name = "HOW", default_value = Compress::None.name(), conflicts_with_all = ["jobs", "pool"],
        value_parser = [Compress::None.name(), Compress::Quantize.name()])]
    compress: String,
    /// Compare each mesh with that of the CPU
    #[arg(long)]
    check: bool,
    /// Also measure jobs that follow each other, begun during the transfer of the job before and not
    #[arg(long, conflicts_with_all = ["jobs", "pool", "spread"])]
    overlap: bool,
    /// Measure this number of jobs of 600 atoms instead, one by one and in batches
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Measure this number of jobs of 600 atoms, and fewer large ones, from many callers on 1, 2, … devices instead
    #[arg(long, value_name = "N", conflicts_with_all = ["jobs", "device"])]
    pool: Option<usize>,
    /// Number of callers per device, for --pool
    #[arg(long, value_name = "N", requires = "pool", default_value_t = 8)]
    callers: usize,
    /// Measure each case divided among 1, 2, 4, … devices instead, with at least this number of bricks per device
    #[arg(long, value_name = "BRICKS", conflicts_with_all = ["jobs", "device", "pool", "check"],
        num_args = 0..=1, default_missing_value = "32768")]
    spread: Option<u64>,
    /// Devices for --pool and --spread: all, software, or numbers
    #[arg(long, value_name = "WHICH", default_value = "all", conflicts_with = "device")]
    devices: DeviceChoice,
    /// Also write the results to this file, as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs the command.
pub(crate) fn run(args: &GpuArgs) -> Result<()> {
    if args.runs == 0 || args.atoms == 0 || args.jobs == Some(0) || args.pool == Some(0) || args.callers == 0 {
        return Err(Error::Usage("--runs, --atoms, --jobs, --pool and --callers must be at least 1".to_owned()));
    }
    let results = if let Some(n) = args.pool {
        pool::run(&args.devices, n, args.callers, args.atoms)?
    } else if let Some(min_bricks) = args.spread {
        several::run(&args.devices, min_bricks, &loaded(args)?, args.runs)?
    } else {
        let selected = Selected::new(&args.device)?;
        print(&format!("{}, {}\n", selected.name, selected.driver))?;
        match args.jobs {
            Some(n) => jobs::run(&mut selected.engine()?, n)?,
            None => stages(args, &selected)?,
        }
    };
    write_json(args.json.as_deref(), &results)
}

/// Loads the selected cases. Prints the ones that cannot be measured.
fn loaded(args: &GpuArgs) -> Result<Vec<(Case, Spheres, SurfaceParams)>> {
    let mut loaded = Vec::new();
    for case in cases::selected(args.atoms, &args.only) {
        match case.load(args.data.as_deref()) {
            Ok((spheres, params)) => {
                let quantized = args.compress == Compress::Quantize.name();
                let quantize = quantized.then(|| Step::covering(lattice::extent(&spheres, &params)));
                loaded.push((case, spheres, SurfaceParams { quantize, ..params }));
            }
            Err(why) => print(&format!("{}: not measured: {why}\n", case.name))?,
        }
    }
    Ok(loaded)
}

/// Measures the stages of all cases, each on a new engine with empty buffers.
fn stages(args: &GpuArgs, selected: &Selected) -> Result<Value> {
    let rates = rates::measure(&selected.gpu()?, selected.software)?;
    print(&match &rates {
        Some(r) => format!(
            "measured: memory {:.3} TB/s (read + written), {:.2} T multiply-adds/s, to the host {:.1} GB/s, round trip {:.0} µs\n\n",
            r.memory * 1e-12,
            r.fma * 1e-12,
            r.to_host * 1e-9,
            r.round_trip * 1e6,
        ),
        None => "this device does not support timestamps: stages are not timed\n\n".to_owned(),
    })?;
    let mut rows = Vec::new();
    let results = |rows: &[Value]| {
        let Selected { name, driver, .. } = selected;
        json!({ "device": name, "driver": driver, "rates": rates, "runs": args.runs, "cases": rows })
    };
    for (case, spheres, params) in loaded(args)? {
        let row = measure::measure(&mut selected.engine()?, &spheres, &params, args, rates.as_ref());
        rows.push(match row {
            Ok(row) => {
                print(&measure::table(case.name, &row))?;
                json!({ "case": case.name, "measured": row })
            }
            Err(why) => {
                print(&format!("{}: not measured: {why}\n", case.name))?;
                json!({ "case": case.name, "not_measured": why.to_string() })
            }
        });
        // After each case, so that a run that is stopped leaves results.
        write_json(args.json.as_deref(), &results(&rows))?;
    }
    Ok(results(&rows))
}

/// Prepares a job.
fn prepare(spheres: &Spheres, params: &SurfaceParams) -> Result<GpuJob> {
    let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(Error::failed)?;
    Ok(GpuJob { prepared: prepared.into(), cancel: CancelToken::default(), deadline: None })
}

/// Starts backends on 1, 2, 4, … and all devices of `choice`. Calls `measure` with each backend and its number of
/// devices.
fn on_more_devices(
    choice: &DeviceChoice,
    settings: &PoolSettings,
    mut measure: impl FnMut(&GpuBackend, usize) -> Result<()>,
) -> Result<()> {
    let found = discover(choice, DiscoveryMode::Thorough);
    if let Some(why) = found.no_device_reason() {
        return Err(Error::NoDevice(why));
    }
    let numbers: Vec<DeviceName> = found.selected().map(|device| DeviceName::Number(device.number)).collect();
    for n in (1..=numbers.len()).filter(|n| n.is_power_of_two() || *n == numbers.len()) {
        let some = discover(&DeviceChoice::Listed(numbers[..n].to_vec()), DiscoveryMode::Thorough);
        let backend = GpuBackend::start(&some, settings).map_err(Error::failed)?;
        backend.warm_up().map_err(Error::failed)?;
        measure(&backend, n)?;
    }
    Ok(())
}
