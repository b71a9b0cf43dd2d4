//! `molmesh render`: renders structures, each as one picture.

use std::path::Path;
use std::time::Instant;

use molmesh::formats::Format;
use molmesh::pipeline::Report;

use super::args::RenderArgs;
use super::backend::Purpose;
use super::batch::{Batch, BatchOutputs, ItemResult, is_batch};
use super::error::CliError;
use super::job::{self, CommandJob};
use super::output::{Output, is_stdio};
use super::report::CommandReport;
use super::request;
use super::setup::{JobSetup, JobThreads};

/// Runs the command.
pub(super) fn run(args: &RenderArgs) -> Result<(), CliError> {
    let is_batch = is_batch(&args.inputs, &args.batch, false, &args.output, is_png);
    let request = request::parse_render(args)?;
    let limits = request::limits(&args.job.limits);
    if is_batch {
        let (extensions, map) = (vec!["png"], args.job.map.as_deref());
        let outputs = BatchOutputs { output: &args.output, extensions, table: None, map };
        let batch = Batch::new(&args.inputs, &args.batch, &args.job.run, outputs, is_png)?;
        let mut setup = JobSetup::new(Purpose::Picture, request, limits, batch.reads_stdin(), &args.job)?;
        setup.read_map()?;
        return batch.run(&setup.cancel, |item, threads| {
            let output = setup.open(&item.input, &batch.output(item, "png")?, Format::Png)?;
            let bytes = setup.read(&item.input)?;
            let job = setup.job(&item.input, bytes, None, threads, false)?;
            Ok(ItemResult { document: write(job, &setup, output)?.document()?, table: None })
        });
    }
    require_png(&args.output)?;
    let input = job::first(&args.inputs);
    let mut setup = JobSetup::new(Purpose::Picture, request, limits, is_stdio(input), &args.job)?;
    let output = setup.open(input, &args.output, Format::Png)?;
    let bytes = setup.read(input)?;
    setup.read_map()?;
    let job = setup.job(input, bytes, None, &JobThreads::all(args.job.run.threads)?, true)?;
    write(job, &setup, output)?.print(&args.job.run)
}

/// Runs a job and writes its picture.
fn write(job: CommandJob<'_>, setup: &JobSetup<'_>, mut output: Output) -> Result<CommandReport<Report>, CliError> {
    let mut product = job.run(&setup.options, None).map_err(|source| job.failure(source))?;
    job.draw(&mut product, &setup.options).map_err(|source| job.failure(source))?;
    let start = Instant::now();
    product.file(Format::Png)?.write(&mut output).map_err(|source| output.failure(source))?;
    job.finish(vec![(output, "output", Format::Png.name())], product.report, start.elapsed())
}

fn is_png(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"))
}

/// Rejects an output file without the extension `png`.
fn require_png(output: &Path) -> Result<(), CliError> {
    if is_png(output) || is_stdio(output) {
        return Ok(());
    }
    let message = format!("`{}` does not end in .png", output.display());
    Err(CliError::usage_with_hint(message, "molmesh mesh writes meshes"))
}
