//! `molmesh render`: renders one structure as one picture.

use std::path::Path;
use std::time::Instant;

use molmesh::formats::Format;

use super::args::RenderArgs;
use super::error::CliError;
use super::job::CommandJob;
use super::output::is_stdio;
use super::request;

/// Runs the command.
pub(super) fn run(args: &RenderArgs) -> Result<(), CliError> {
    let request = request::parse_render(args)?;
    require_png(&args.output)?;
    let (job, mut output) = CommandJob::prepare(request, &args.input, &args.output, &args.job)?;
    let mut product = job.run(None).map_err(|source| job.failure(source))?;
    job.draw(&mut product).map_err(|source| job.failure(source))?;
    let start = Instant::now();
    product.file(Format::Png)?.write(&mut output).map_err(|source| output.failure(source))?;
    job.finish(output, product.report, Format::Png, start.elapsed())
}

/// Rejects an output file without the extension `png`.
fn require_png(output: &Path) -> Result<(), CliError> {
    let png = output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
    if png || is_stdio(output) {
        return Ok(());
    }
    let message = format!("`{}` does not end in .png", output.display());
    Err(CliError::usage_with_hint(message, "molmesh mesh writes meshes"))
}
