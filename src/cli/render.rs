//! `molmesh render`: renders one structure as one picture.

use std::io::Write as _;
use std::path::Path;
use std::time::Instant;

use molmesh::formats::Format;
use molmesh::picture::PictureParams;
use molmesh::pipeline::params::Request;
use molmesh::pipeline::{self, Choice};
use molmesh::surface::CancelToken;

use super::args::RenderArgs;
use super::backend::{self, BackendRequest, Use};
use super::error::CliError;
use super::output::{Output, is_stdio};
use super::progress::Progress;
use super::summary::Written;
use super::{interrupt, mesh, request};

/// Runs the command, with the steps in the order of `mesh`.
pub(super) fn run(args: &RenderArgs) -> Result<(), CliError> {
    let Request { job, strict, .. } = request::of_render(args)?;
    require_png(&args.output)?;
    let (output_path, input_path, args) = (&args.output, &args.input, &args.job);
    let limits = request::limits(&args.limits);
    backend::check(&BackendRequest::once(args))?;
    let cancel = CancelToken::default();
    interrupt::watch(&cancel)?;
    let mut output = Output::open(output_path, &cancel)?;
    let input = mesh::read(input_path, limits.read.max_inflated_bytes)?;
    let requested = BackendRequest { work: Some(pipeline::work(&input, &job)), ..BackendRequest::once(args) };
    let picked = backend::pick(&requested, &Use::Picture)?;

    let progress = Progress::new(!args.quiet);
    let findings = if strict { Some(mesh::check(input_path, &input, &limits)?) } else { None };
    let choice = Choice { backend: picked.backend.as_ref(), reason: &picked.reason };
    let failed = |source| mesh::failure(input_path, &input, &limits, source);
    let mut product = pipeline::run(&input, &job, &limits, &choice, &cancel, &progress, None).map_err(failed)?;
    let plain = PictureParams::default();
    pipeline::draw(&mut product, job.picture.as_ref().unwrap_or(&plain), &picked.renderer, &cancel, &progress)
        .map_err(failed)?;
    let start = Instant::now();
    product.file(Format::Png)?.write(&mut output).map_err(|source| output.failure(source))?;
    drop(progress);
    if cancel.is_cancelled() {
        return Err(CliError::Interrupted);
    }
    output.flush().map_err(|source| output.failure(source))?;
    let (to_stdout, bytes) = (output.is_stdout(), output.bytes);
    output.finish()?;
    let mut report = product.report;
    report.add_timing("write", start.elapsed().as_secs_f64() * 1e3);
    let name = if to_stdout { "stdout".to_owned() } else { output_path.display().to_string() };
    let written = Written { name: &name, format: Format::Png.extension(), bytes };
    mesh::write_report(args, &report, findings.as_deref(), &written, to_stdout)
}

/// Rejects an output file without the extension `png`.
fn require_png(output: &Path) -> Result<(), CliError> {
    let png = output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
    if png || is_stdio(output) {
        return Ok(());
    }
    let message = format!("`{}` does not end in .png", output.display());
    Err(CliError::Usage { message, hint: Some("molmesh mesh writes meshes".to_owned()) })
}
