//! `molmesh mesh`: meshes one structure into one file.

use std::time::{Duration, Instant};

use molmesh::formats::{Format, GlbSink, GlbSinkError};
use molmesh::pipeline::{JobError, Product, ProgressSink};
use molmesh::surface::SurfaceError;

use super::args::MeshArgs;
use super::error::CliError;
use super::job::CommandJob;
use super::output::Output;
use super::request;

/// Runs the command.
pub(super) fn run(args: &MeshArgs) -> Result<(), CliError> {
    let request = request::parse_mesh(args)?;
    let format = request.format;
    let (mut job, mut output) = CommandJob::prepare(request, &args.input, &args.output, &args.job)?;
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
