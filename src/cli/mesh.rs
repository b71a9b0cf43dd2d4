//! `molmesh mesh`: meshes one structure into one file.

use std::path::Path;
use std::str::FromStr;
use std::time::{Duration, Instant};

use molmesh::formats::{Format, GlbSink, GlbSinkError};
use molmesh::pipeline::params::Request;
use molmesh::pipeline::{JobError, Product, ProgressSink};
use molmesh::surface::SurfaceError;

use super::args::MeshArgs;
use super::error::CliError;
use super::job::CommandJob;
use super::output::{Output, is_stdio};
use super::request;

/// Runs the command.
pub(super) fn run(args: &MeshArgs) -> Result<(), CliError> {
    let format = args.format.as_ref().map_or_else(|| format_of(&args.output), |name| named(name))?;
    let Request { mut job, strict, .. } = request::parse_mesh(args)?;
    request::set_format(&mut job, format)?;
    let paths = (args.input.as_path(), args.output.as_path());
    let (mut job, mut output) = CommandJob::prepare(job, strict, paths, format, &args.job)?;
    if let Some(path) = &args.atoms {
        job.add_atom_table(path, &args.output)?;
    }
    let product = if format == Format::Glb && output.has_random_access() {
        run_to_file(&job, &output)?
    } else {
        job.run(None).map_err(|source| job.failure(source))?
    };
    let mut report = product.report.clone();
    let mut writing = Duration::ZERO;
    if let Some(bytes) = product.streamed_bytes {
        output.bytes = bytes;
    } else {
        report.add_timing("encode", encode(&product, format, &mut output, &job.progress)?);
        writing = output.writing;
    }
    // The process ends soon, which frees the memory at once.
    std::mem::forget(product);
    job.finish(output, report, format, writing)
}

/// Parses the name of a mesh format.
fn named(name: &str) -> Result<Format, CliError> {
    match Format::from_str(name) {
        Ok(format) if format.is_picture() => Err(CliError::Usage {
            message: format!("{format} is a picture, not a mesh"),
            hint: Some("molmesh render writes pictures".to_owned()),
        }),
        Ok(format) => Ok(format),
        Err(_unknown) => {
            let expected = Format::MESHES.map(Format::name).join(", ");
            Err(CliError::usage(format!("parameter `format`: `{name}` is not allowed; expected one of {expected}")))
        }
    }
}

/// Returns the format of an output by its file extension; GLB on stdout.
fn format_of(output: &Path) -> Result<Format, CliError> {
    let unknown = |why: &str| CliError::Usage {
        message: format!("cannot determine the format of `{}`: {why}", output.display()),
        hint: Some(format!("name the format with --format: {}", Format::MESHES.map(Format::name).join(", "))),
    };
    match output.extension().map(|extension| extension.to_string_lossy()) {
        Some(extension) if extension.parse::<Format>().is_ok() => named(&extension),
        Some(extension) => Err(unknown(&format!("`{extension}` is not a mesh format"))),
        None if is_stdio(output) => Ok(Format::default()),
        None => Err(unknown("it has no extension")),
    }
}

/// Runs the job. If the job allows it, the GLB is written while the mesh is computed.
fn run_to_file(job: &CommandJob<'_>, output: &Output) -> Result<Product, CliError> {
    let sink = GlbSink::new(output);
    job.run(Some(&sink)).map_err(|error| match error {
        JobError::Surface(SurfaceError::Sink) => sink_failure(output, sink.failure()),
        source => job.failure(source),
    })
}

/// Converts the error of the sink to that of the command.
fn sink_failure(output: &Output, cause: Option<GlbSinkError>) -> CliError {
    match cause {
        Some(GlbSinkError::Format(error)) => error.into(),
        Some(GlbSinkError::Io(source)) => output.failure(source),
        Some(error @ GlbSinkError::HeadTooLong { .. }) => CliError::Internal(error.to_string()),
        None => CliError::Internal("the output failed without a cause".to_owned()),
    }
}

/// Encodes the mesh into the output. Returns the time that this took, without the writes, ms.
fn encode(product: &Product, format: Format, out: &mut Output, sink: &dyn ProgressSink) -> Result<f64, CliError> {
    sink.progress("encode", 0.0);
    let start = Instant::now();
    let written = product.file(format)?.write(out);
    let encoding = start.elapsed().saturating_sub(out.writing);
    written.map_err(|source| out.failure(source))?;
    Ok(encoding.as_secs_f64() * 1e3)
}
