//! `molmesh-bench paper`: measures the tables of Dias, Bora and Gomes (HPDC 2010) on this machine.
//!
//! Compares four programs: the sequential reference, the CPU backend, the paper's GPU program, and the GPU stages of
//! molmesh. All have the same spheres and parameters. Times are from spheres to a mesh in host memory.

pub(crate) mod entries;
pub(crate) mod fetch;
mod figures;
mod fit;
mod growth;
mod markdown;
mod programs;
pub(crate) mod redraw;
pub(crate) mod result;
mod roofline;
mod rows;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use molmesh::surface::{CpuBackend, DeviceChoice, Kernel};

use crate::device::Selected;
use crate::error::{Error, Result};
use crate::{machine, note, print};
use entries::{ENTRIES, Entry, KERNELS};
use programs::{Program, Runner};
use result::{Device, Document};

/// Arguments of `molmesh-bench paper`.
#[derive(Debug, clap::Args)]
pub(crate) struct PaperArgs {
    /// GPU: auto (hardware only), cpu (none), software, or a number printed by `molmesh doctor`
    #[arg(long, value_name = "WHICH", default_value = "auto")]
    device: DeviceChoice,
    /// Folder with structures of the paper, named by PDB id (.pdb, .ent, .cif, .bcif, plain or compressed); generated
    /// substitutes, marked in the tables, replace missing ones
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Programs to run
    #[arg(long, value_name = "LIST", value_enum, value_delimiter = ',', default_value = "reference,cpu,paper,gpu")]
    programs: Vec<Program>,
    /// Measure only these structures
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    only: Vec<String>,
    /// Measure only these kernels: gaussian, soft-object, inverse-square
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_parser = kernel)]
    kernels: Vec<Kernel>,
    /// Number of measured runs of each program on each structure; at most three of the reference, or one if it is slow
    #[arg(long, value_name = "N", default_value_t = 7)]
    runs: usize,
    /// Skip runs with a longer estimated time, s
    #[arg(long, value_name = "SECONDS", default_value_t = 300.0)]
    reference_limit: f64,
    /// Also measure time and memory against the number of atoms, up to this number
    #[arg(long, value_name = "ATOMS", num_args = 0..=1, default_missing_value = "3000000")]
    growth: Option<usize>,
    /// Grid spacing of --growth, Å
    #[arg(long, value_name = "Å", default_value_t = 1.0)]
    growth_resolution: f64,
    /// Skip the tables
    #[arg(long, requires = "growth", conflicts_with_all = ["only", "kernels"])]
    growth_only: bool,
    /// Measure three structures with one kernel, at most three runs each, and skip runs of more than ten seconds
    #[arg(long)]
    quick: bool,
    /// Number of threads of the CPU backend; all cores by default
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Write paper.json and paper.md to this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

fn kernel(name: &str) -> std::result::Result<Kernel, String> {
    Kernel::named(name).ok_or_else(|| format!("expected one of {}", Kernel::NAMES.join(", ")))
}

/// Selected measurements.
struct Plan {
    programs: Vec<Program>,
    /// Device, or the reason why there is none.
    device: std::result::Result<Selected, String>,
    data: Option<PathBuf>,
    entries: Vec<&'static Entry>,
    kernels: Vec<Kernel>,
    runs: usize,
    /// Maximum estimated time of a run, s.
    limit: f64,
    growth_spacing: f64,
    threads: Option<usize>,
}

/// Program that is ready to run, or the reason why it does not run.
type Opened = std::result::Result<Box<dyn Runner>, String>;

impl Plan {
    fn new(args: &PaperArgs) -> Result<Self> {
        if args.runs == 0 || args.growth.is_some_and(|max_atoms| max_atoms < 100) {
            return Err(Error::Usage("--runs must be at least 1, and --growth at least 100 atoms".to_owned()));
        }
        if args.reference_limit.is_nan() || args.reference_limit < 0.0 {
            return Err(Error::Usage("--reference-limit must be a number of seconds".to_owned()));
        }
        if let Some(folder) = &args.data {
            fs::read_dir(folder).map_err(Error::file(folder))?;
        }
        let device = if args.programs.iter().any(|program| program.on_device()) {
            match Selected::new(&args.device) {
                Err(error) if !matches!(args.device, DeviceChoice::Auto | DeviceChoice::Cpu) => return Err(error),
                selected => selected.map_err(|error| error.to_string()),
            }
        } else {
            Err(NOT_SELECTED.to_owned())
        };
        let quick =
            |quick: &[&str]| if args.quick { quick.iter().map(|id| (*id).to_owned()).collect() } else { vec![] };
        let only = if args.only.is_empty() { quick(&["110D", "1BK2", "4PTI"]) } else { args.only.clone() };
        let all = if args.quick { &KERNELS[..1] } else { &KERNELS };
        let kernels = KERNELS.into_iter().filter(|kernel| args.kernels.contains(kernel));
        Ok(Self {
            programs: args.programs.clone(),
            device,
            data: args.data.clone(),
            entries: selected_entries(&only)?,
            kernels: if args.kernels.is_empty() { all.to_vec() } else { kernels.collect() },
            runs: if args.quick { args.runs.min(3) } else { args.runs },
            limit: if args.quick { args.reference_limit.min(10.0) } else { args.reference_limit },
            growth_spacing: args.growth_resolution,
            threads: args.threads,
        })
    }

    /// Prepares a program.
    fn open(&self, program: Program) -> Result<Opened> {
        if !self.programs.contains(&program) {
            return Ok(Err(NOT_SELECTED.to_owned()));
        }
        match (program.on_device(), &self.device) {
            (true, Err(why)) => Ok(Err(why.clone())),
            (true, Ok(selected)) => program.on(selected).map(Ok),
            (false, _) => program.on_cpu(self.threads).map(Ok),
        }
    }

    /// Returns an error if a run would take longer than the limit.
    fn within_limit(&self, seconds: f64) -> Result<()> {
        let within = seconds <= self.limit;
        if within { Ok(()) } else { Err(Error::Failed(format!("about {}", markdown::seconds(seconds)))) }
    }
}

/// Reason for programs that `--programs` excludes. Stored results contain this text.
const NOT_SELECTED: &str = "not asked for";

/// Returns the entries with these ids, or all if there are no ids.
fn selected_entries(ids: &[String]) -> Result<Vec<&'static Entry>> {
    if ids.is_empty() {
        return Ok(ENTRIES.iter().collect());
    }
    let is = |entry: &Entry, id: &String| entry.id.eq_ignore_ascii_case(id);
    if let Some(unknown) = ids.iter().find(|id| !ENTRIES.iter().any(|entry| is(entry, id))) {
        let known: Vec<&str> = ENTRIES.iter().map(|entry| entry.id).collect();
        return Err(Error::Usage(format!("`{unknown}` is not in the paper's tables; expected {}", known.join(", "))));
    }
    Ok(ENTRIES.iter().filter(|entry| ids.iter().any(|id| is(entry, id))).collect())
}

/// Runs the command.
pub(crate) fn run(args: &PaperArgs) -> Result<()> {
    let plan = Plan::new(args)?;
    if let Some(folder) = &args.out {
        fs::create_dir_all(folder).map_err(Error::file(folder))?;
    }
    let threads = CpuBackend::new(args.threads).map_err(Error::Usage)?.threads();
    let device = |Selected { name, driver, software, .. }: &Selected| Device {
        name: name.clone(),
        driver: driver.clone(),
        software: *software,
    };
    let mut document = Document {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        date: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        machine: machine::describe(threads),
        device: plan.device.as_ref().ok().map(device),
        rows: Vec::new(),
        growth: None,
        roofline: Vec::new(),
    };
    // Results are saved after each measurement, as the command takes long and may be interrupted.
    if !args.growth_only {
        rows::measure(&plan, &mut |row| {
            document.rows.push(row);
            save(args.out.as_deref(), &document)
        })?;
    }
    if plan.programs.contains(&Program::Gpu)
        && let Ok(selected) = &plan.device
    {
        note("stages against the device");
        document.roofline = roofline::measure(selected, &plan)?;
        save(args.out.as_deref(), &document)?;
    }
    if let Some(max_atoms) = args.growth {
        growth::measure(&plan, max_atoms, &mut |growth| {
            document.growth = Some(growth.clone());
            save(args.out.as_deref(), &document)
        })?;
    }
    save(args.out.as_deref(), &document)?;
    print(&markdown::page(&document))
}

/// Writes the files.
fn save(folder: Option<&Path>, document: &Document) -> Result<()> {
    let Some(folder) = folder else { return Ok(()) };
    let json = serde_json::to_string_pretty(document).map_err(Error::failed)?;
    replace(&folder.join("paper.json"), (json + "\n").as_bytes())?;
    replace(&folder.join("paper.md"), markdown::page(document).as_bytes())
}

/// Writes a file atomically.
fn replace(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut staged = path.as_os_str().to_owned();
    staged.push(".part");
    fs::write(&staged, bytes).and_then(|()| fs::rename(&staged, path)).map_err(Error::file(path))
}
