//! Job of the commands `mesh`, `render` and `tileset`: reads one structure, and writes files and one report.

use std::cell::{Cell, OnceCell};
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use molmesh::formats::GlbSink;
use molmesh::pipeline::tileset::{self, StreamSource, StructureStream, TilesetReport, WriteError};
use molmesh::pipeline::{self, JobError, JobLimits, Options, Product, Report, SelectedBackend};
use molmesh::structure::stream::{BLOCK_BYTES, ScratchFile};
use molmesh::structure::strict_validator::{self, Diagnostic, Level};
use molmesh::structure::{self, Structure, StructureError};
use molmesh::surface::{Control, Exceeded, Limit, SurfaceError};

use super::args::RunArgs;
use super::error::CliError;
use super::output::{Output, is_stdio};
use super::progress::Progress;
use super::report::{CommandReport, finding};
use super::setup::JobSetup;
use super::style::Style;
use super::summary;

/// Job of a command, with its input and backend.
pub(super) struct CommandJob<'a> {
    setup: &'a JobSetup<'a>,
    path: &'a Path,
    input: Vec<u8>,
    selected: Arc<SelectedBackend>,
    pub(super) progress: Progress,
    /// Findings of the strict validator, if it ran.
    pub(super) findings: Option<Vec<Diagnostic>>,
    /// True if tables need the structure after the run.
    pub(super) keeps_structure: bool,
    structure: OnceCell<Arc<Structure>>,
}

impl<'a> CommandJob<'a> {
    /// Creates a job and runs the strict validator, if it is requested.
    pub(super) fn new(
        setup: &'a JobSetup<'a>,
        path: &'a Path,
        input: Vec<u8>,
        selected: Arc<SelectedBackend>,
        progress: Progress,
    ) -> Result<Self, CliError> {
        let findings = if setup.strict { Some(check(path, &input, &setup.limits)?) } else { None };
        let structure = OnceCell::new();
        Ok(Self { setup, path, input, selected, progress, findings, keeps_structure: false, structure })
    }

    /// Returns the control of a run: cancellation, no deadline and no memory limit.
    pub(super) fn control(&self) -> Control<'static> {
        Control { cancel: self.setup.cancel.clone(), ..Control::default() }
    }

    /// Computes the mesh. If the job allows it, the mesh is written to `sink` as GLB at the same time.
    pub(super) fn run(&self, options: &Options, sink: Option<&GlbSink<'_>>) -> Result<Product, JobError> {
        let choice = self.selected.choice();
        let limits = &self.setup.limits;
        let read = |control: &Control<'_>| {
            if let Some(structure) = self.structure.get() {
                return Ok(Arc::clone(structure));
            }
            let structure = structure::read_with(&self.input, &limits.read, control).map(Arc::new)?;
            if self.keeps_structure {
                self.structure.get_or_init(|| Arc::clone(&structure));
            }
            Ok(structure)
        };
        pipeline::run_with(read, options, limits, &choice, &self.control(), &self.progress, sink)
    }

    /// Returns the structure that a run kept.
    pub(super) fn structure(&self) -> Result<&Structure, CliError> {
        let absent = || CliError::Internal("the job has no structure".to_owned());
        self.structure.get().map(|structure| &**structure).ok_or_else(absent)
    }

    /// Meshes all tiles of a tileset and passes each file to `write`. `folder` is for messages.
    pub(super) fn write_tileset(
        &self,
        folder: &Path,
        write: impl Fn(&str, &[u8]) -> io::Result<()> + Sync,
    ) -> Result<TilesetReport, CliError> {
        let JobSetup { options, limits, .. } = self.setup;
        let read = |control: &Control<'_>| structure::read_with(&self.input, &limits.read, control).map(Box::new);
        let choice = self.selected.choice();
        let written = tileset::write(read, options, &choice, limits, &self.control(), &self.progress, write);
        written.map_err(|error| self.write_failure(folder, self.path, error))
    }

    /// Meshes all tiles of a tileset of a structure that is read as a stream from the files of `inputs`.
    pub(super) fn write_streamed_tileset(
        &self,
        inputs: &[PathBuf],
        files: Vec<Box<dyn Read + Send>>,
        scratch: [File; 2],
        folder: &Path,
        write: impl Fn(&str, &[u8]) -> io::Result<()> + Sync,
    ) -> Result<TilesetReport, CliError> {
        let choice = self.selected.choice();
        let current = Cell::new(0);
        let scratch = scratch.map(|file| ScratchFile { file, meter: Arc::new(()) });
        let source = StreamSource::Files(files);
        let stream =
            StructureStream { source, scratch, block_bytes: BLOCK_BYTES, began: &|number| current.set(number) };
        let (control, sink, setup) = (self.control(), &self.progress, self.setup);
        let written = tileset::write_stream(stream, &setup.options, &choice, &setup.limits, &control, sink, write);
        written.map_err(|error| self.write_failure(folder, inputs.get(current.get()).map_or(self.path, |p| p), error))
    }

    /// Converts the error of a tileset. `folder` and `input` are for messages.
    fn write_failure(&self, folder: &Path, input: &Path, error: WriteError) -> CliError {
        match error {
            WriteError::Job(error) => match self.failure(error) {
                CliError::Job { strict_finding, source, .. } => {
                    CliError::Job { name: name_of(input), strict_finding, source }
                }
                error => error,
            },
            WriteError::File { path, source } => {
                CliError::Output { name: folder.join(path).display().to_string(), source }
            }
        }
    }

    /// Draws the picture of a product.
    pub(super) fn draw(&self, product: &mut Product, options: &Options) -> Result<(), JobError> {
        let params = options.picture.unwrap_or_default();
        pipeline::draw(product, &params, &self.selected.renderer, &self.control(), &self.progress)
    }

    /// Converts the error of the job.
    pub(super) fn failure(&self, source: JobError) -> CliError {
        let is_about_map = match &source {
            JobError::Surface(SurfaceError::Limit(error)) => matches!(error.limit, Limit::MapBytes | Limit::MapPoints),
            other => matches!(other, JobError::Map(_)),
        };
        let map = self.setup.args.map.as_deref().filter(|_| is_about_map);
        failure(source, map.unwrap_or(self.path), &self.input, &self.setup.limits)
    }

    /// Completes the outputs, each with its member of the report and its format. `writing` is the time already spent on
    /// writing.
    pub(super) fn finish(
        self,
        outputs: Vec<(Output, &'static str, &'static str)>,
        mut report: Report,
        writing: Duration,
    ) -> Result<CommandReport<Report>, CliError> {
        drop(self.progress);
        if self.setup.cancel.is_cancelled() {
            return Err(CliError::Interrupted);
        }
        let start = Instant::now();
        let files = outputs.iter().map(|(output, member, format)| output.written(member, format)).collect();
        Output::finish(outputs.into_iter().map(|(output, ..)| output).collect())?;
        report.add_timing("write", (writing + start.elapsed()).as_secs_f64() * 1e3);
        Ok(CommandReport { report, files, findings: self.findings })
    }
}

impl CommandReport<Report> {
    /// Writes the report of a command with a single job.
    pub(super) fn print(&self, run: &RunArgs) -> Result<(), CliError> {
        let text = |done: &Self| summary::text(&done.report, &done.files, done.findings.as_deref(), Style::stderr());
        self.write(run, text)
    }
}

/// Returns the first input, or stdin without one.
pub(super) fn first(inputs: &[PathBuf]) -> &Path {
    inputs.first().map_or(Path::new("-"), PathBuf::as_path)
}

/// Reads a file of at most `max` bytes; `limit` is the limit that a larger one exceeds. That of decompressed bytes also
/// suits a compressed file.
pub(super) fn read(path: &Path, limit: Limit, max: u64) -> Result<Vec<u8>, CliError> {
    let stdin = is_stdio(path);
    let name = || name_of(path);
    let read = || -> io::Result<Vec<u8>> {
        if stdin {
            return take(io::stdin().lock(), 0, max);
        }
        let file = File::open(path)?;
        let size = file.metadata()?.len();
        // One spare byte lets the reader detect the end of the file without growing the buffer.
        take(file, if size > max { 0 } else { size + 1 }, max)
    };
    let bytes = read().map_err(|source| CliError::Input { name: name(), source })?;
    if bytes.len() as u64 > max {
        let source = SurfaceError::Limit(Exceeded::new(limit, max).into()).into();
        return Err(CliError::Job { name: name(), source, strict_finding: None });
    }
    Ok(bytes)
}

fn take(source: impl Read, capacity: u64, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(usize::try_from(capacity).unwrap_or(0));
    source.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Returns the name of the input in messages.
pub(super) fn name_of(input: &Path) -> String {
    if is_stdio(input) { "stdin".to_owned() } else { input.display().to_string() }
}

/// Returns the findings of the strict validator, or an error if there are errors among them.
fn check(path: &Path, input: &[u8], limits: &JobLimits) -> Result<Vec<Diagnostic>, CliError> {
    let name = || name_of(path);
    let findings = strict_validator::check(input, &limits.read, &Control::default())
        .map_err(|source| CliError::Job { name: name(), source: source.into(), strict_finding: None })?;
    let errors = findings.iter().filter(|f| f.level == Level::Error);
    match errors.clone().next() {
        Some(first) => Err(CliError::Strict { name: name(), errors: errors.count(), first: finding(first) }),
        None => Ok(findings),
    }
}

/// Converts the error of a job on the `input` that the file `path` contains.
pub(super) fn failure(source: JobError, path: &Path, input: &[u8], limits: &JobLimits) -> CliError {
    if let JobError::Surface(SurfaceError::Cancelled) = source {
        return CliError::Interrupted;
    }
    let strict_finding = worst_finding(&source, input, limits).map(String::into_boxed_str);
    CliError::Job { name: name_of(path), strict_finding, source }
}

/// Returns the worst finding of the strict validator if the file has a syntax error.
fn worst_finding(error: &JobError, input: &[u8], limits: &JobLimits) -> Option<String> {
    let JobError::Structure(StructureError::Syntax { .. }) = error else { return None };
    let findings = strict_validator::check(input, &limits.read, &Control::default()).ok()?;
    let worst = findings.iter().filter(|f| f.level > Level::Note).max_by_key(|f| f.level)?;
    Some(format!("the strict validator reports: {}", finding(worst)))
}
