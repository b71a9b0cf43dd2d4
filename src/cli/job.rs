//! Job of the commands `mesh`, `render` and `tileset`: reads one structure, and writes its files and one report.

use std::cell::{Cell, OnceCell};
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use molmesh::formats::{Format, GlbSink};
use molmesh::pipeline::params::Request;
use molmesh::pipeline::tileset::{self, StreamSource, StructureStream, TilesetReport, WriteError};
use molmesh::pipeline::{self, JobError, JobLimits, MapFile, Options, Product, Report, SelectedBackend};
use molmesh::structure::stream::{BLOCK_BYTES, ScratchFile};
use molmesh::structure::strict_validator::{self, Diagnostic, Level};
use molmesh::structure::{self, Structure, StructureError, table};
use molmesh::surface::{CancelToken, Control, Exceeded, Limit, SurfaceError};

use super::args::JobArgs;
use super::backend::{self, BackendRequest, Purpose};
use super::error::CliError;
use super::output::{self, Output, is_stdio};
use super::progress::Progress;
use super::report::{CommandReport, finding};
use super::style::Style;
use super::{interrupt, request, summary};

/// Maximum value of `--threads`: more than any machine has cores.
const MAX_THREADS: usize = 1024;

/// Job of a command, with its input and backend.
pub(super) struct CommandJob<'a> {
    path: &'a Path,
    args: &'a JobArgs,
    options: Options,
    limits: JobLimits,
    cancel: CancelToken,
    input: Vec<u8>,
    selected: SelectedBackend,
    pub(super) progress: Progress,
    /// Findings of the strict validator, if it ran.
    pub(super) findings: Option<Vec<Diagnostic>>,
    /// Output of the table of atoms, if it is requested.
    atom_table: Option<Output>,
    /// The structure, kept for the table of atoms.
    structure: OnceCell<Arc<Structure>>,
}

impl<'a> CommandJob<'a> {
    /// Prepares a job and opens its output.
    pub(super) fn prepare(
        request: Request,
        path: &'a Path,
        output: &Path,
        args: &'a JobArgs,
    ) -> Result<(Self, Output), CliError> {
        let format = request.format;
        let purpose = if format.is_picture() { Purpose::Picture } else { Purpose::Mesh };
        let open = |cancel: &CancelToken| {
            output::refuse_input(path, output)?;
            if let Some(map) = args.map.as_deref() {
                output::refuse_input(map, output)?;
            }
            let output = Output::open(output, cancel)?;
            output.refuse_terminal(format)?;
            Ok(output)
        };
        Self::prepare_for(purpose, request, path, None, args, open)
    }

    /// Prepares a job whose output `open` opens. Cheap steps come first: flags, output, input, backend. An input that
    /// is read later, as a stream, has an estimated number of atoms in `streamed_atoms`.
    pub(super) fn prepare_for<T>(
        purpose: Purpose,
        Request { mut options, strict, .. }: Request,
        path: &'a Path,
        streamed_atoms: Option<f64>,
        args: &'a JobArgs,
        open: impl FnOnce(&CancelToken) -> Result<T, CliError>,
    ) -> Result<(Self, T), CliError> {
        let is_streamed = streamed_atoms.is_some();
        let limits = if is_streamed { request::limits_of_stream(&args.limits) } else { request::limits(&args.limits) };
        let mut requested = BackendRequest::for_command(args, purpose);
        set_threads(args.threads)?;
        request::check(args, &requested, &options, path)?;
        let cancel = CancelToken::default();
        interrupt::watch(&cancel)?;
        let output = open(&cancel)?;
        let input =
            if is_streamed { Vec::new() } else { read(path, Limit::InflatedBytes, limits.read.max_inflated_bytes)? };
        if let Some(map) = args.map.as_deref() {
            // The command line makes no content keys.
            let bytes = read(map, Limit::MapBytes, limits.map.max_inflated_bytes)?;
            options.map = Some(MapFile::new(String::new(), bytes));
        }
        let atoms = streamed_atoms.unwrap_or_else(|| pipeline::estimate_atoms(&input));
        requested.work = Some(pipeline::estimate_work(atoms, &options));
        let selected = backend::select(&requested)?;
        let progress = Progress::new(!args.quiet);
        let findings = if strict { Some(check(path, &input, &limits)?) } else { None };
        let (atom_table, structure) = (None, OnceCell::new());
        let job =
            Self { path, args, options, limits, cancel, input, selected, progress, findings, atom_table, structure };
        Ok((job, output))
    }

    /// Adds a table of the atoms in the file `path`, beside the mesh in the file `mesh`.
    pub(super) fn add_atom_table(&mut self, path: &Path, mesh: &Path) -> Result<(), CliError> {
        output::refuse_input(self.path, path)?;
        output::refuse_same(path, mesh)?;
        self.atom_table = Some(Output::open(path, &self.cancel)?);
        Ok(())
    }

    /// Returns the control of a run: cancellation, no deadline and no memory limit.
    fn control(&self) -> Control<'static> {
        Control { cancel: self.cancel.clone(), ..Control::default() }
    }

    /// Computes the mesh. If the job allows it, the mesh is written to `sink` as GLB at the same time.
    pub(super) fn run(&self, sink: Option<&GlbSink<'_>>) -> Result<Product, JobError> {
        let choice = self.selected.choice();
        let read = |control: &Control<'_>| {
            let structure = structure::read_with(&self.input, &self.limits.read, control).map(Arc::new)?;
            if self.atom_table.is_some() {
                self.structure.get_or_init(|| Arc::clone(&structure));
            }
            Ok(structure)
        };
        pipeline::run_with(read, &self.options, &self.limits, &choice, &self.control(), &self.progress, sink)
    }

    /// Meshes all tiles of a tileset and passes each file to `write`. `folder` is for messages.
    pub(super) fn write_tileset(
        &self,
        folder: &Path,
        write: impl Fn(&str, &[u8]) -> io::Result<()> + Sync,
    ) -> Result<TilesetReport, CliError> {
        let read = |control: &Control<'_>| structure::read_with(&self.input, &self.limits.read, control).map(Box::new);
        let choice = self.selected.choice();
        let written =
            tileset::write(read, &self.options, &choice, &self.limits, &self.control(), &self.progress, write);
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
        let (control, sink) = (self.control(), &self.progress);
        let written = tileset::write_stream(stream, &self.options, &choice, &self.limits, &control, sink, write);
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
    pub(super) fn draw(&self, product: &mut Product) -> Result<(), JobError> {
        let params = self.options.picture.unwrap_or_default();
        pipeline::draw(product, &params, &self.selected.renderer, &self.control(), &self.progress)
    }

    /// Converts the error of the job.
    pub(super) fn failure(&self, source: JobError) -> CliError {
        let is_about_map = match &source {
            JobError::Surface(SurfaceError::Limit(error)) => matches!(error.limit, Limit::MapBytes | Limit::MapPoints),
            other => matches!(other, JobError::Map(_)),
        };
        let map = self.args.map.as_deref().filter(|_| is_about_map);
        failure(source, map.unwrap_or(self.path), &self.input, &self.limits)
    }

    /// Completes the output and writes the report. `writing` is the time already spent on writing.
    pub(super) fn finish(
        mut self,
        output: Output,
        mut report: Report,
        format: Format,
        writing: Duration,
    ) -> Result<(), CliError> {
        drop(self.progress);
        if self.cancel.is_cancelled() {
            return Err(CliError::Interrupted);
        }
        let start = Instant::now();
        let mut outputs = vec![output];
        if let Some(mut output) = self.atom_table.take() {
            let absent = || CliError::Internal("the job has no structure".to_owned());
            let structure = self.structure.get().ok_or_else(absent)?;
            table::write_csv(structure, &mut output).map_err(|source| output.failure(source))?;
            outputs.push(output);
        }
        let written = outputs.iter().zip([("output", format.name()), ("atom_table", "csv")]);
        let files: Vec<_> = written.map(|(output, (member, format))| output.written(member, format)).collect();
        Output::finish(outputs)?;
        report.add_timing("write", (writing + start.elapsed()).as_secs_f64() * 1e3);
        let (args, findings) = (self.args, self.findings.as_deref());
        let text = || summary::text(&report, &files, findings, Style::stderr());
        CommandReport { report: &report, files: &files, findings }.write(args.report, args.quiet, text)
    }
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

/// Checks the value of `--threads` and sets the number of the global threads, on which reading, exact areas and colours
/// run.
pub(super) fn set_threads(n: Option<usize>) -> Result<(), CliError> {
    let Some(n) = n else { return Ok(()) };
    if !(1..=MAX_THREADS).contains(&n) {
        let message = format!("parameter `threads`: {n} is not allowed; expected a number from 1 to {MAX_THREADS}");
        return Err(CliError::usage(message));
    }
    let built = rayon::ThreadPoolBuilder::new().num_threads(n).build_global();
    built.map_err(|error| CliError::Internal(error.to_string()))
}

/// Returns the worst finding of the strict validator if the file has a syntax error.
fn worst_finding(error: &JobError, input: &[u8], limits: &JobLimits) -> Option<String> {
    let JobError::Structure(StructureError::Syntax { .. }) = error else { return None };
    let findings = strict_validator::check(input, &limits.read, &Control::default()).ok()?;
    let worst = findings.iter().filter(|f| f.level > Level::Note).max_by_key(|f| f.level)?;
    Some(format!("the strict validator reports: {}", finding(worst)))
}
