//! `molmesh bench`: how fast this machine's devices are, against what they could do.

mod cases;
mod floor;
mod jobs;
mod measure;
mod paper;
mod pool;
mod spread;
mod table;

use std::path::PathBuf;

use clap::{Args as ClapArgs, Subcommand};
use molmesh::formats::Compress;
use molmesh::gpu::Paper;
use molmesh::gpu::bench::{self, Opened};
use molmesh::gpu::yardstick::{self, Effort, Rates};
use molmesh::surface::{DeviceChoice, Spheres, Step, SurfaceParams, lattice};
use serde_json::json;

use super::error::CliError;
use cases::Case;
use measure::Row;

// What to measure.
#[derive(Debug, Subcommand)]
pub(crate) enum Bench {
    /// Time the stages on a GPU, beside the floor that the device's own rates give
    Gpu(Box<GpuArgs>),
    /// Run the tables of the 2010 paper: its programs and ours, on the CPU and on a GPU
    Paper(Box<paper::PaperArgs>),
    /// Fetch the paper's structures from the archive
    Fetch(paper::fetch::FetchArgs),
    /// Draw figures, and fill tables into a page, from results that were measured before
    Figures(paper::redraw::FiguresArgs),
}

/// `molmesh bench gpu`.
#[derive(Debug, ClapArgs)]
pub(crate) struct GpuArgs {
    /// Number of the device; hardware comes first
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) device: usize,
    /// Measured runs of each case, after three to warm up
    #[arg(long, value_name = "N", default_value_t = 20)]
    pub(crate) runs: usize,
    /// Folder with 2hhb, 1aon and 7cgo, as PDB or mmCIF, plain or compressed
    #[arg(long, value_name = "DIR")]
    pub(crate) data: Option<PathBuf>,
    /// Only the cases whose name contains this; one of gigabytes, 7cgo-x9-0.5, by its whole name alone
    #[arg(long, value_name = "NAME")]
    pub(crate) only: Option<String>,
    /// Atoms of the made-up case, which needs no file
    #[arg(long, value_name = "N", default_value_t = 60_000)]
    pub(crate) atoms: usize,
    /// How vertices come back: none (single precision, 24 bytes each), or quantize (12 bytes, as glb stores them)
    #[arg(long, value_name = "HOW", default_value = Compress::None.name(), conflicts_with_all = ["jobs", "pool"],
        value_parser = [Compress::None.name(), Compress::Quantize.name()])]
    pub(crate) compress: String,
    /// Compare each mesh with the CPU's
    #[arg(long)]
    pub(crate) check: bool,
    /// Time so many jobs of 600 atoms instead, alone and together
    #[arg(long, value_name = "N")]
    pub(crate) jobs: Option<usize>,
    /// Time so many jobs of 600 atoms, and some large ones, through the pool on 1, 2, … devices instead
    #[arg(long, value_name = "N", conflicts_with_all = ["jobs", "device"])]
    pub(crate) pool: Option<usize>,
    /// Callers of `--pool` for each device: none of them should wait for another to prepare its job
    #[arg(long, value_name = "N", requires = "pool", default_value_t = 8)]
    pub(crate) callers: usize,
    /// Time each case on 1, 2, 4, … devices together instead, every device with at least so many bricks
    #[arg(long, value_name = "BRICKS", conflicts_with_all = ["jobs", "device", "pool", "check"],
        num_args = 0..=1, default_missing_value = "32768")]
    pub(crate) spread: Option<u64>,
    /// Devices of `--pool` and `--spread`: all, software, or numbers
    #[arg(long, value_name = "WHICH", default_value = "all", conflicts_with = "device")]
    pub(crate) devices: DeviceChoice,
    /// Write everything to this file too, as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(bench: &Bench) -> Result<(), CliError> {
    match bench {
        Bench::Gpu(args) => gpu(args),
        Bench::Paper(args) => paper::run(args),
        Bench::Fetch(args) => paper::fetch::run(args),
        Bench::Figures(args) => paper::redraw::run(args),
    }
}

fn gpu(args: &GpuArgs) -> Result<(), CliError> {
    if args.runs == 0 || args.atoms == 0 || args.jobs == Some(0) || args.pool == Some(0) || args.callers == 0 {
        return Err(CliError::usage("nothing is measured with 0 runs, atoms, jobs or callers"));
    }
    if let Some(n) = args.pool {
        let rates = pool::run(&args.devices, n, args.callers)?;
        super::say(&pool::table(&rates))?;
        return save(args, &json!({ "pool": rates }));
    }
    if let Some(least) = args.spread {
        let rows = spread::run(&args.devices, least, &loaded(args)?, args.runs)?;
        super::say(&spread::table(&rows))?;
        return save(args, &json!({ "spread": rows, "runs": args.runs }));
    }
    let opened = open(args.device)?;
    super::say(&format!("device {}: {}, {}\n", args.device, opened.name, opened.driver))?;
    let result = match args.jobs {
        Some(n) => {
            let rates = jobs::run(opened, n)?;
            super::say(&jobs::table(&rates))?;
            json!({ "jobs": rates })
        }
        None => cases(args, opened)?,
    };
    save(args, &result)
}

/// Writes the result where it was asked for.
fn save(args: &GpuArgs, result: &serde_json::Value) -> Result<(), CliError> {
    let Some(path) = &args.json else { return Ok(()) };
    let text = format!("{result:#}\n");
    std::fs::write(path, text).map_err(|source| CliError::Output { name: path.display().to_string(), source })
}

/// The cases that are asked for.
fn chosen(args: &GpuArgs) -> Vec<Case> {
    cases::chosen(args.atoms, args.only.as_deref().unwrap_or_default())
}

/// A case's spheres and its surface, with the vertices that are asked for.
fn load(args: &GpuArgs, case: &Case) -> Result<(Spheres, SurfaceParams), String> {
    let (spheres, params) = case.load(args.data.as_deref())?;
    let rounded = args.compress == Compress::Quantize.name();
    let quantize = rounded.then(|| Step::covering(lattice::extent(&spheres, &params)));
    Ok((spheres, SurfaceParams { quantize, ..params }))
}

/// Those of them whose files are there; it is said which are not.
fn loaded(args: &GpuArgs) -> Result<Vec<(Case, Spheres, SurfaceParams)>, CliError> {
    let mut loaded = Vec::new();
    for case in chosen(args) {
        match load(args, &case) {
            Ok((spheres, params)) => loaded.push((case, spheres, params)),
            Err(why) => super::say(&format!("{}: not measured: {why}\n", case.name))?,
        }
    }
    Ok(loaded)
}

/// Measures every case. Each has an engine of its own, so that none finds what another left.
fn cases(args: &GpuArgs, opened: Opened) -> Result<serde_json::Value, CliError> {
    let effort = if opened.software { Effort::SOFTWARE } else { Effort::HARDWARE };
    let rates = yardstick::rates(&opened.engine, effort).map_err(|e| CliError::Service(e.to_string()))?;
    super::say(&table::rates(rates.as_ref()))?;
    let (name, driver) = (opened.name.clone(), opened.driver.clone());
    drop(opened);
    let mut rows = Vec::new();
    for case in chosen(args) {
        let row = one(args, &case, rates.as_ref());
        super::say(&table::row(case.name, &row))?;
        rows.push(match row {
            Ok(row) => json!({ "case": case.name, "measured": row }),
            Err(why) => json!({ "case": case.name, "not_measured": why }),
        });
    }
    Ok(
        json!({ "device": name, "driver": driver, "rates": rates.map(table::rates_json), "runs": args.runs, "cases": rows }),
    )
}

/// One case, or why it was not measured.
fn one(args: &GpuArgs, case: &Case, rates: Option<&Rates>) -> Result<Row, String> {
    let (spheres, params) = load(args, case)?;
    let mut opened = bench::open(args.device).map_err(|e| e.to_string())?;
    let mut row = measure::measure(&mut opened.engine, &spheres, &params, args.runs, rates, args.check)?;
    if case.with_paper {
        let paper = Paper::new(opened.engine).map_err(|e| e.to_string());
        row.paper =
            Some(paper.and_then(|mut paper| measure::paper(&mut paper, &spheres, &params, args.runs, row.stages_ms)));
    }
    Ok(row)
}

fn open(number: usize) -> Result<Opened, CliError> {
    bench::open(number).map_err(|e| CliError::NoBackend { asked: "gpu", why: e.to_string() })
}
