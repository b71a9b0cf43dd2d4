//! `molmesh tileset`: meshes one structure into the files of a tileset.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::Instant;

use molmesh::formats::tileset::MAX_LEVELS;
use molmesh::pipeline::BYTES_PER_ATOM;
use molmesh::pipeline::tileset::{LevelReport, TilesetReport, unit_folder};
use molmesh::structure::strict_validator::Diagnostic;

use super::args::TilesetArgs;
use super::backend::Purpose;
use super::error::CliError;
use super::job::{self, name_of};
use super::output::is_stdio;
use super::page::Page;
use super::report::CommandReport;
use super::setup::{JobSetup, JobThreads};
use super::style::{Style, printable};
use super::{interrupt, request, summary};

/// Runs the command.
pub(super) fn run(args: &TilesetArgs) -> Result<(), CliError> {
    let request = request::parse_tileset(args)?;
    let start = Instant::now();
    let input = job::first(&args.inputs);
    let scratch = args.scratch.as_deref().map(|scratch| StreamFiles::open(&args.inputs, scratch)).transpose()?;
    let streamed_atoms = scratch.as_ref().map(|files| files.atoms);
    let limits = if streamed_atoms.is_some() { request::limits_of_stream } else { request::limits };
    let limits = limits(&args.job.limits);
    let mut setup = JobSetup::new(Purpose::Mesh, request, limits, is_stdio(input), &args.job)?;
    let mut folder = Folder::create(&args.output)?;
    let bytes = if streamed_atoms.is_some() { Vec::new() } else { setup.read(input)? };
    setup.read_map()?;
    let threads = JobThreads::all(args.job.run.threads)?;
    let job = setup.job(input, bytes, streamed_atoms, &threads, true)?;
    let write = |path: &str, bytes: &[u8]| folder.write(path, bytes);
    let report = match scratch {
        Some(StreamFiles { inputs, scratch, .. }) => {
            job.write_streamed_tileset(&args.inputs, inputs, scratch, &folder.path, write)?
        }
        None => job.write_tileset(&folder.path, write)?,
    };
    folder.complete = true;
    let findings = job.findings.clone();
    // Ends the progress bar.
    drop(job);
    let (done, seconds) = (CommandReport { report, files: Vec::new(), findings }, start.elapsed().as_secs_f64());
    done.write(&args.job.run, |done| {
        text(&done.report, done.findings.as_deref(), &folder.path, seconds, Style::stderr())
    })
}

/// Files that are read as a stream.
struct StreamFiles {
    inputs: Vec<Box<dyn Read + Send>>,
    /// Estimated number of atoms.
    atoms: f64,
    /// Files without a name, so that the system removes them in any case.
    scratch: [File; 2],
}

impl StreamFiles {
    /// Opens the inputs.
    fn open(paths: &[PathBuf], folder: &Path) -> Result<Self, CliError> {
        if paths.iter().filter(|path| is_stdio(path)).count() > 1 {
            return Err(CliError::usage("only one of several files can be read from stdin"));
        }
        let (mut inputs, mut bytes) = (Vec::<Box<dyn Read + Send>>::new(), 0);
        for path in paths {
            if is_stdio(path) {
                inputs.push(Box::new(io::stdin()));
                continue;
            }
            let failed = |source| CliError::Input { name: name_of(path), source };
            let file = File::open(path).map_err(failed)?;
            bytes += file.metadata().map_err(failed)?.len();
            inputs.push(Box::new(file));
        }
        let failed = |source| CliError::Output { name: folder.display().to_string(), source };
        let file = || tempfile::tempfile_in(folder).map_err(failed);
        Ok(Self { inputs, atoms: bytes as f64 / BYTES_PER_ATOM, scratch: [file()?, file()?] })
    }
}

/// Folder of a tileset. Dropping it before it is complete removes its files.
struct Folder {
    path: PathBuf,
    /// Folders that the command created, innermost first: this one and those that contain it.
    created: Vec<PathBuf>,
    complete: bool,
}

impl Folder {
    /// Creates a folder, or uses an empty one.
    fn create(path: &Path) -> Result<Self, CliError> {
        if is_stdio(path) {
            return Err(CliError::usage("a tileset has several files and cannot be written to stdout"));
        }
        let failed = |source| CliError::Output { name: path.display().to_string(), source };
        let is_missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
        let created: Vec<PathBuf> = path.ancestors().take_while(is_missing).map(Path::to_owned).collect();
        // An interrupt may come while the command waits for its input.
        for folder in &created {
            interrupt::stage(folder);
        }
        fs::create_dir_all(path).map_err(failed)?;
        if fs::read_dir(path).map_err(failed)?.next().is_some() {
            let message = format!("`{}` is not empty", path.display());
            return Err(CliError::usage_with_hint(message, "name another folder with -o"));
        }
        Ok(Self { path: path.to_owned(), created, complete: false })
    }

    /// Writes a file, whose path is relative to the folder.
    fn write(&self, path: &str, bytes: &[u8]) -> io::Result<()> {
        let path = self.path.join(path);
        path.parent().map_or(Ok(()), fs::create_dir_all)?;
        fs::write(path, bytes)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        for folder in &self.created {
            interrupt::keep(folder);
        }
        if self.complete {
            return;
        }
        // The command already fails with another error, so errors are ignored. Files of others remain.
        let mut names: Vec<String> = (0..MAX_LEVELS).map(|level| level.to_string()).collect();
        names.push("subtrees".to_owned());
        names.extend((1..).map(unit_folder).take_while(|name| self.path.join(name).exists()));
        for name in names {
            drop(fs::remove_dir_all(self.path.join(name)));
        }
        drop(fs::remove_file(self.path.join("tileset.json")));
        for folder in &self.created {
            drop(fs::remove_dir(folder));
        }
    }
}

/// Adds a row for each level.
fn add_levels(page: &mut Page, levels: &[LevelReport]) {
    for (number, LevelReport { spacing, tiles, triangles, bytes, .. }) in levels.iter().enumerate() {
        let megabytes = *bytes as f64 / 1e6;
        page.row(
            &format!("level {number}"),
            &format!("{spacing} Å: {tiles} tiles, {triangles} triangles, {megabytes:.1} MB"),
        );
    }
}

/// Formats the report as text.
fn text(report: &TilesetReport, findings: Option<&[Diagnostic]>, folder: &Path, seconds: f64, style: Style) -> String {
    let mut page = Page::new(style, report.id.as_deref().unwrap_or("structure"), &format!("{} atoms", report.atoms));
    page.rows("left out", summary::left_out(&report.left_out));
    add_levels(&mut page, &report.levels);
    for (number, unit) in report.units.iter().enumerate() {
        let counts = format!("{}: {} atoms, {} instances", unit.name, unit.atoms, unit.instances);
        page.row(&format!("unit {}", number + 1), &counts);
        add_levels(&mut page, &unit.levels);
    }
    if let Some(findings) = findings {
        summary::add_findings(&mut page, findings);
    }
    let megabytes = report.bytes as f64 / 1e6;
    page.row("time", &format!("{seconds:.1} s"));
    let folder = folder.display().to_string();
    page.row("wrote", &format!("{} ({} files, {megabytes:.1} MB)", printable(&folder), report.files));
    page.finish()
}
