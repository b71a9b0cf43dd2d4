//! `molmesh bench paper`: the tables and figures of Dias, Bora and Gomes (HPDC 2010) on this machine.
//!
//! Four programs: the sequential reference, the native CPU backend, the paper's GPU program on today's device, and our
//! stages on the device. All get the same spheres and parameters; times are from spheres to a mesh in the host's memory.

mod csv;
mod entries;
pub(super) mod fetch;
mod figures;
mod fit;
mod grid;
mod growth;
mod machine;
mod markdown;
mod memory;
mod programs;
mod progress;
pub(super) mod redraw;
mod result;
mod roofline;
mod rows;
mod source;
mod standin;
mod text;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use clap::Args as ClapArgs;
use molmesh::surface::{DeviceChoice, Kernel};

use super::super::error::CliError;
use entries::{ENTRIES, Entry, KERNELS};
use programs::{Chosen, OnCpu, Program, Runner};
use progress::Progress;
use result::{Document, MADE_BY};

/// `molmesh bench paper`.
#[derive(Debug, ClapArgs)]
pub(crate) struct PaperArgs {
    /// Which GPU: auto (hardware alone), software, or a number that `molmesh doctor` gives
    #[arg(long, value_name = "WHICH", default_value = "auto", visible_alias = "devices")]
    pub(crate) device: DeviceChoice,
    /// Folder with structures of the paper, named by their PDB ids (.pdb, .ent, .cif, .bcif, plain or .gz); the
    /// others have made-up stand-ins, marked as such
    #[arg(long, value_name = "DIR")]
    pub(crate) data: Option<PathBuf>,
    /// Programs to run: reference, cpu, paper, gpu
    #[arg(long, value_name = "LIST", value_enum, value_delimiter = ',', default_value = "reference,cpu,paper,gpu")]
    pub(crate) programs: Vec<Program>,
    /// Only these structures
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    pub(crate) only: Vec<String>,
    /// Only these kernels: gaussian, soft-object, inverse-square
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) kernels: Vec<Kernel>,
    /// Measured runs of each program on each structure; of the reference three, or one if it takes long
    #[arg(long, value_name = "N", default_value_t = 7)]
    pub(crate) runs: usize,
    /// Runs that would take longer, by an estimate, are left out and say so; s
    #[arg(long, value_name = "SECONDS", default_value_t = 300.0)]
    pub(crate) reference_limit: f64,
    /// Time and memory against atoms too, up to so many
    #[arg(long, value_name = "ATOMS", num_args = 0..=1, default_missing_value = "3000000")]
    pub(crate) growth: Option<usize>,
    /// Spacing of the grid for --growth, Å
    #[arg(long, value_name = "Å", default_value_t = 1.0)]
    pub(crate) growth_resolution: f64,
    /// Leave the tables out
    #[arg(long, requires = "growth", conflicts_with_all = ["only", "kernels"])]
    pub(crate) growth_only: bool,
    /// Three structures, one kernel, three runs, and no run beyond ten seconds
    #[arg(long)]
    pub(crate) quick: bool,
    /// Threads of the native CPU backend; every core by default
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Write paper.json, paper.csv, growth.csv and paper.md into this folder
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

/// What is measured, settled.
struct Plan {
    programs: Vec<Program>,
    /// The device, or why there is none.
    device: Result<Chosen, String>,
    data: Option<PathBuf>,
    only: Vec<String>,
    kernels: Vec<Kernel>,
    runs: usize,
    limit: f64,
    growth_spacing: f64,
    threads: Option<usize>,
}

impl Plan {
    fn new(args: &PaperArgs) -> Result<Self, CliError> {
        if args.runs == 0 || args.growth.is_some_and(|most| most < 100) {
            return Err(CliError::usage("nothing is measured with 0 runs, or with less than 100 atoms"));
        }
        if args.reference_limit.is_nan() || args.reference_limit < 0.0 {
            return Err(CliError::usage("--reference-limit is a number of seconds"));
        }
        check_ids(&args.only)?;
        if let Some(folder) = &args.data
            && !folder.is_dir()
        {
            let source = fs::read_dir(folder).err().unwrap_or_else(|| std::io::ErrorKind::NotADirectory.into());
            return Err(CliError::Input { name: folder.display().to_string(), source });
        }
        let wanted = args.programs.iter().any(|p| p.on_device());
        let device = if wanted { programs::choose(&args.device) } else { Err("not asked for".to_owned()) };
        let may_lack = !wanted || matches!(args.device, DeviceChoice::Auto | DeviceChoice::Cpu);
        if let (Err(why), false) = (&device, may_lack) {
            return Err(CliError::NoBackend { asked: "gpu", why: why.clone() });
        }
        let (mut only, mut kernels) = (args.only.clone(), args.kernels.clone());
        if args.quick && only.is_empty() {
            only = ["110D", "1BK2", "4PTI"].map(str::to_owned).to_vec();
        }
        if args.quick && kernels.is_empty() {
            kernels = vec![Kernel::Gaussian];
        }
        Ok(Self {
            programs: args.programs.clone(),
            device: device.map_err(|why| if wanted { format!("no device: {why}") } else { why }),
            data: args.data.clone(),
            only,
            kernels,
            runs: if args.quick { args.runs.min(3) } else { args.runs },
            limit: if args.quick { args.reference_limit.min(10.0) } else { args.reference_limit },
            growth_spacing: args.growth_resolution,
            threads: args.threads,
        })
    }

    fn entries(&self) -> Vec<&'static Entry> {
        let wanted = |id: &str| self.only.is_empty() || self.only.iter().any(|only| only.eq_ignore_ascii_case(id));
        ENTRIES.iter().filter(|entry| wanted(entry.id)).collect()
    }

    fn kernels(&self) -> Vec<Kernel> {
        KERNELS.into_iter().filter(|kernel| self.kernels.is_empty() || self.kernels.contains(kernel)).collect()
    }

    /// A program, ready to run; the inner error is why it does not run here.
    fn open(&self, program: Program) -> Result<Result<Box<dyn Runner>, String>, String> {
        if !self.programs.contains(&program) {
            return Ok(Err("not asked for".to_owned()));
        }
        match (program.on_device(), &self.device) {
            (false, _) => rows::on_cpu(program, self.threads).map(Ok),
            (true, Ok(chosen)) => chosen.open(program).map(Ok),
            (true, Err(why)) => Ok(Err(why.clone())),
        }
    }

    /// Refuses a run that would take longer than the limit.
    fn within_limit(&self, seconds: f64) -> Result<(), String> {
        if seconds <= self.limit { Ok(()) } else { Err(format!("about {}", text::seconds(seconds))) }
    }
}

/// Refuses ids that the tables do not have.
fn check_ids(ids: &[String]) -> Result<(), CliError> {
    match ids.iter().find(|id| !ENTRIES.iter().any(|entry| entry.id.eq_ignore_ascii_case(id))) {
        None => Ok(()),
        Some(id) => {
            let known: Vec<&str> = ENTRIES.iter().map(|entry| entry.id).collect();
            let hint = Some(format!("one of {}", known.join(", ")));
            Err(CliError::Usage { message: format!("`{id}` is not in the paper's tables"), hint })
        }
    }
}

/// Runs the command.
pub(super) fn run(args: &PaperArgs) -> Result<(), CliError> {
    let plan = Plan::new(args)?;
    if let Some(folder) = &args.out {
        fs::create_dir_all(folder).map_err(|source| CliError::Output { name: folder.display().to_string(), source })?;
    }
    let (_, threads) = OnCpu::native(args.threads).map_err(CliError::usage)?;
    let mut document = Document {
        made_by: MADE_BY.to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        date: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        machine: machine::look(threads),
        device: plan.device.as_ref().ok().map(|chosen| chosen.device.clone()),
        rows: Vec::new(),
        growth: None,
        roofline: Vec::new(),
    };
    super::super::say(&text::head(&document, plan.device.as_ref().err()))?;
    let progress = Progress::new();
    // What was measured is on disk after every row: these commands take long, and people stop them.
    if !args.growth_only {
        super::super::say(&text::columns())?;
        rows::measure(&plan, &progress, &mut |row| {
            progress.aside(|| super::super::say(&text::row(&row)))?;
            document.rows.push(row);
            save(args.out.as_deref(), &document)
        })?;
    }
    if plan.programs.contains(&Program::Gpu)
        && let Ok(chosen) = &plan.device
    {
        progress.at(0, 1, "roofline");
        document.roofline = roofline::measure(chosen, &plan)?;
        progress.aside(|| super::super::say(&text::roofline(&document.roofline)))?;
        save(args.out.as_deref(), &document)?;
    }
    if let Some(most) = args.growth {
        growth::measure(&plan, most, &progress, &mut |growth| {
            document.growth = Some(growth.clone());
            save(args.out.as_deref(), &document)
        })?;
        progress.aside(|| super::super::say(&text::growth(document.growth.as_ref())))?;
    }
    save(args.out.as_deref(), &document)
}

/// Writes the files.
fn save(folder: Option<&Path>, document: &Document) -> Result<(), CliError> {
    let Some(folder) = folder else { return Ok(()) };
    let json = serde_json::to_string_pretty(document).map_err(|e| CliError::Internal(e.to_string()))?;
    let mut files = vec![("paper.json", json + "\n"), ("paper.md", markdown::page(document))];
    if !document.rows.is_empty() {
        files.push(("paper.csv", csv::rows(&document.rows)));
    }
    files.extend(document.growth.as_ref().map(|growth| ("growth.csv", csv::growth(growth))));
    files.into_iter().try_for_each(|(name, text)| put(&folder.join(name), text.as_bytes()))
}

/// Writes a file that is whole or absent.
fn put(path: &Path, bytes: &[u8]) -> Result<(), CliError> {
    let mut staged = path.as_os_str().to_owned();
    staged.push(".part");
    let written = fs::write(&staged, bytes).and_then(|()| fs::rename(&staged, path));
    written.map_err(|source| CliError::Output { name: path.display().to_string(), source })
}
