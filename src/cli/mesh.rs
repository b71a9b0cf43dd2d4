//! `molmesh mesh`: meshes one structure into one file.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;
use std::str::FromStr;
use std::time::{Duration, Instant};

use molmesh::formats::{Encoder, Format, GlbSink, GlbSinkError};
use molmesh::pipeline::params::Request;
use molmesh::pipeline::{self, Choice, Job, JobError, JobLimits, Product, ProgressSink, Report};
use molmesh::structure::StructureError;
use molmesh::structure::strict_validator::{self, Diagnostic, Level};
use molmesh::surface::{CancelToken, SurfaceError};
use serde_json::{Value, json};

use super::args::{JobArgs, MeshArgs, ReportStyle};
use super::backend::{self, BackendRequest, SelectedBackend};
use super::error::CliError;
use super::output::{Output, is_stdio};
use super::progress::Progress;
use super::style::Style;
use super::summary::{self, Written};
use super::{interrupt, request};

/// Runs the command. Cheap steps come first: flags, output, input, backend, mesh.
pub(super) fn run(args: &MeshArgs) -> Result<(), CliError> {
    let Request { mut job, format: requested, strict, .. } = request::of_mesh(args)?;
    let format = requested.map_or_else(|| format(&args.output), Ok)?;
    if format.is_picture() {
        return Err(CliError::Usage {
            message: format!("{format} is a picture, not a mesh"),
            hint: Some("molmesh render writes pictures".to_owned()),
        });
    }
    request::settle(&mut job, format)?;
    let (output_path, input_path, args) = (&args.output, &args.input, &args.job);
    let limits = request::limits(&args.limits);
    backend::check(&BackendRequest::once(args))?;
    let cancel = CancelToken::default();
    interrupt::watch(&cancel)?;
    let mut output = Output::open(output_path, &cancel)?;
    let input = read(input_path, limits.read.max_inflated_bytes)?;
    let requested = BackendRequest { work: Some(pipeline::work(&input, &job)), ..BackendRequest::once(args) };
    let picked = backend::pick(&requested, &backend::Use::Once)?;

    let progress = Progress::new(!args.quiet);
    let findings = if strict { Some(check(input_path, &input, &limits)?) } else { None };
    let work = Work { path: input_path, job: &job, limits: &limits, picked: &picked, input: &input, cancel: &cancel };
    let product = if format == Format::Glb && output.has_random_access() {
        work.run_to_file(&output, &progress)?
    } else {
        work.run(&progress, None).map_err(|source| work.failure(source))?
    };
    let mut report = product.report.clone();
    let mut writing = Duration::ZERO;
    if let Some(bytes) = product.streamed_bytes {
        output.bytes = bytes;
    } else {
        report.add_timing("encode", encode(&product, format, &mut output, &progress)?);
        writing = output.writing;
    }
    // The process ends soon, which frees the memory at once.
    std::mem::forget(product);
    drop(progress);
    if cancel.is_cancelled() {
        return Err(CliError::Interrupted);
    }
    let (to_stdout, bytes) = (output.is_stdout(), output.bytes);
    let start = Instant::now();
    output.finish()?;
    report.add_timing("write", (writing + start.elapsed()).as_secs_f64() * 1e3);

    let name = if to_stdout { "stdout".to_owned() } else { output_path.display().to_string() };
    let written = Written { name: &name, format: format.extension(), bytes };
    write_report(args, &report, findings.as_deref(), &written, to_stdout)
}

/// Format of an output by its file extension; GLB on stdout.
fn format(output: &Path) -> Result<Format, CliError> {
    let hint = || Some("name the format with --format".to_owned());
    let name = output.display();
    match output.extension() {
        Some(extension) => Format::from_str(&extension.to_string_lossy())
            .map_err(|e| CliError::Usage { message: format!("cannot tell the format of `{name}`: {e}"), hint: hint() }),
        None if is_stdio(output) => Ok(Format::default()),
        None => Err(CliError::Usage {
            message: format!("cannot tell the format of `{name}`: it has no extension"),
            hint: hint(),
        }),
    }
}

/// Reads the input. `limit` is that of the decompressed bytes, which are not fewer.
pub(super) fn read(path: &Path, limit: u64) -> Result<Vec<u8>, CliError> {
    let stdin = is_stdio(path);
    let name = || name_of(path);
    let read = || -> io::Result<Vec<u8>> {
        if stdin {
            return take(io::stdin().lock(), 0, limit);
        }
        let file = File::open(path)?;
        let size = file.metadata()?.len();
        // The spare byte lets the reader detect the end of the file without growing the buffer.
        take(file, if size > limit { 0 } else { size + 1 }, limit)
    };
    let bytes = read().map_err(|source| CliError::Input { name: name(), source })?;
    if bytes.len() as u64 > limit {
        return Err(CliError::InputTooLarge { name: name(), limit });
    }
    Ok(bytes)
}

fn take(source: impl Read, capacity: u64, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(usize::try_from(capacity).unwrap_or(0));
    source.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Returns the name of the input in messages.
fn name_of(input: &Path) -> String {
    if is_stdio(input) { "stdin".to_owned() } else { input.display().to_string() }
}

/// One job with its input.
struct Work<'a> {
    path: &'a Path,
    job: &'a Job,
    limits: &'a JobLimits,
    picked: &'a SelectedBackend,
    input: &'a [u8],
    cancel: &'a CancelToken,
}

impl Work<'_> {
    fn choice(&self) -> Choice<'_> {
        Choice { backend: self.picked.backend.as_ref(), reason: &self.picked.reason }
    }

    fn failure(&self, source: JobError) -> CliError {
        failure(self.path, self.input, self.limits, source)
    }

    fn run(&self, progress: &Progress, sink: Option<&GlbSink<'_>>) -> Result<Product, JobError> {
        pipeline::run(self.input, self.job, self.limits, &self.choice(), self.cancel, progress, sink)
    }

    /// Runs the job and writes a GLB while it is meshed, if the job allows that.
    fn run_to_file(&self, output: &Output, progress: &Progress) -> Result<Product, CliError> {
        let sink = GlbSink::new(output);
        let product = self.run(progress, Some(&sink));
        let cause = sink.failure();
        drop(sink);
        match product {
            Err(JobError::Surface(SurfaceError::Sink)) => Err(sink_failure(output, cause)),
            product => product.map_err(|source| self.failure(source)),
        }
    }
}

/// Converts the error of a job.
pub(super) fn failure(path: &Path, input: &[u8], limits: &JobLimits, source: JobError) -> CliError {
    match source {
        JobError::Surface(SurfaceError::Cancelled) => CliError::Interrupted,
        source => {
            let (name, strict_finding) = (name_of(path), worst_finding(&source, input, limits));
            CliError::Job { name, strict_finding, source }
        }
    }
}

/// Error of the command for that of its sink.
fn sink_failure(output: &Output, cause: Option<GlbSinkError>) -> CliError {
    match cause {
        Some(GlbSinkError::Format(error)) => error.into(),
        Some(GlbSinkError::Io(source)) => output.failure(source),
        Some(error @ GlbSinkError::HeadTooLong { .. }) => CliError::Internal(error.to_string()),
        None => CliError::Internal("the output failed without a cause".to_owned()),
    }
}

/// Returns the findings of the strict validator, or an error if there are errors among them.
pub(super) fn check(path: &Path, input: &[u8], limits: &JobLimits) -> Result<Vec<Diagnostic>, CliError> {
    let name = || name_of(path);
    let findings = strict_validator::check(input, &limits.read).map_err(|source| CliError::Job {
        name: name(),
        source: source.into(),
        strict_finding: None,
    })?;
    let errors = findings.iter().filter(|f| f.level == Level::Error);
    match errors.clone().next() {
        Some(first) => Err(CliError::Strict { name: name(), errors: errors.count(), first: finding(first) }),
        None => Ok(findings),
    }
}

/// Returns the worst finding of the strict validator in a file with a syntax error.
fn worst_finding(error: &JobError, input: &[u8], limits: &JobLimits) -> Option<String> {
    let JobError::Structure(StructureError::Syntax { .. }) = error else { return None };
    let findings = strict_validator::check(input, &limits.read).ok()?;
    let worst = findings.iter().max_by_key(|f| f.level)?;
    Some(format!("the strict validator reports: {}", finding(worst)))
}

/// Formats a finding on one line.
fn finding(finding: &Diagnostic) -> String {
    let place = finding.line.map(|n| format!("line {n}: ")).unwrap_or_default();
    format!("{place}{}", finding.message.split_whitespace().collect::<Vec<_>>().join(" "))
}

/// Encodes the mesh into the output. Returns the time that took, without the writes, in ms.
fn encode(product: &Product, format: Format, out: &mut Output, sink: &dyn ProgressSink) -> Result<f64, CliError> {
    sink.progress("encode", 0.0);
    let start = Instant::now();
    let written = Encoder::new(format, product.storage, &product.mesh, &product.meta())?.write(out);
    let encoding = start.elapsed().saturating_sub(out.writing);
    written.map_err(|source| out.failure(source))?;
    Ok(encoding.as_secs_f64() * 1e3)
}

/// Writes the report: text to stderr, JSON to stdout, or to stderr if the file is on stdout.
pub(super) fn write_report(
    args: &JobArgs,
    report: &Report,
    findings: Option<&[Diagnostic]>,
    written: &Written<'_>,
    file_on_stdout: bool,
) -> Result<(), CliError> {
    match args.report {
        ReportStyle::Text if args.quiet => Ok(()),
        ReportStyle::Text => {
            let lines: Option<Vec<String>> =
                findings.map(|all| all.iter().map(|f| format!("{}: {}", f.level.name(), finding(f))).collect());
            let text = summary::text(report, written, lines.as_deref(), Style::stderr());
            // A closed stderr does not make a finished mesh a failure.
            drop(io::stderr().write_all(text.as_bytes()));
            Ok(())
        }
        ReportStyle::Json => {
            let text = json_report(report, findings, written)?;
            let printed =
                if file_on_stdout { io::stderr().write_all(text.as_bytes()) } else { return super::print(&text) };
            printed.map_err(|source| CliError::Output { name: "stderr".to_owned(), source })
        }
    }
}

fn json_report(report: &Report, findings: Option<&[Diagnostic]>, written: &Written<'_>) -> Result<String, CliError> {
    let failed = |e: serde_json::Error| CliError::Internal(format!("the report cannot be serialised: {e}"));
    let mut value = serde_json::to_value(report).map_err(failed)?;
    if let Value::Object(map) = &mut value {
        let output = json!({ "file": written.name, "format": written.format, "bytes": written.bytes });
        map.insert("output".to_owned(), output);
        let finding = |f: &Diagnostic| json!({ "level": f.level.name(), "message": f.message, "line": f.line });
        if let Some(findings) = findings {
            map.insert("findings".to_owned(), findings.iter().map(finding).collect());
        }
    }
    let mut text = serde_json::to_string_pretty(&value).map_err(failed)?;
    text.push('\n');
    Ok(text)
}
