//! `molmesh mesh`: meshes structures, each into one file, with a table of areas and a picture on request.

use std::path::Path;
use std::time::{Duration, Instant};

use molmesh::formats::{Compress, Format, GlbSink, GlbSinkError};
use molmesh::pipeline::params::areas::AreasRequest;
use molmesh::pipeline::{JobError, Options, Product, ProgressSink, Report, areas::measure_selection};
use molmesh::structure::table;
use molmesh::surface::SurfaceError;

use super::args::MeshArgs;
use super::backend::Purpose;
use super::batch::{Batch, BatchOutputs, ItemResult, is_batch};
use super::error::CliError;
use super::job::{self, CommandJob};
use super::output::{self, Output, is_stdio};
use super::report::CommandReport;
use super::request::{self, ParsedMesh};
use super::setup::{JobSetup, JobThreads};

/// Runs the command.
pub(super) fn run(args: &MeshArgs) -> Result<(), CliError> {
    let is_extended = args.areas.is_some() || args.picture;
    if is_batch(&args.inputs, &args.batch, is_extended, &args.output, is_mesh_file) {
        return run_batch(args);
    }
    let ParsedMesh { mesh: request, .. } = request::parse_mesh(args, false)?;
    let format = request.format;
    let input = job::first(&args.inputs);
    let limits = request::limits(&args.job.limits);
    let mut setup = JobSetup::new(Purpose::Mesh, request, limits, is_stdio(input), &args.job)?;
    let mesh = setup.open(input, &args.output, format)?;
    let bytes = setup.read(input)?;
    setup.read_map()?;
    let job = setup.job(input, bytes, None, &JobThreads::all(args.job.run.threads)?, true)?;
    let mut files = MeshFiles { mesh, atoms: None, areas: None, picture: None };
    if let Some(path) = &args.atoms {
        output::refuse_input(input, path)?;
        output::refuse_same(path, &args.output)?;
        files.atoms = Some(Output::open(path, &setup.cancel)?);
    }
    let (finished, product) = files.write(job, &setup, format)?;
    // The process ends soon, which frees the memory at once.
    std::mem::forget(product);
    finished.print(&args.job.run)
}

/// Meshes several structures.
fn run_batch(args: &MeshArgs) -> Result<(), CliError> {
    let ParsedMesh { mesh: request, areas, picture } = request::parse_mesh(args, true)?;
    if args.atoms.is_some() {
        return Err(CliError::usage(
            "`--atoms` names the table of one structure; expected one input and one output file",
        ));
    }
    let format = request.format;
    let mut extensions = vec![format.extension()];
    extensions.extend(areas.is_some().then_some("csv"));
    extensions.extend(picture.is_some().then_some("png"));
    let (table, map) = (args.table.as_deref(), args.job.map.as_deref());
    let outputs = BatchOutputs { output: &args.output, extensions, table, map };
    let batch = Batch::new(&args.inputs, &args.batch, &args.job.run, outputs, is_mesh_file)?;
    let purpose = if picture.is_some() { Purpose::Picture } else { Purpose::Mesh };
    let limits = request::limits(&args.job.limits);
    let mut setup = JobSetup::new(purpose, request, limits, batch.reads_stdin(), &args.job)?;
    (setup.areas, setup.picture) = (areas, picture);
    setup.read_map()?;
    batch.run(&setup.cancel, |item, threads| {
        let open = |extension: &str| setup.open(&item.input, &batch.output(item, extension)?, format);
        let files = MeshFiles {
            mesh: open(format.extension())?,
            atoms: None,
            areas: setup.areas.is_some().then(|| open("csv")).transpose()?,
            picture: setup.picture.is_some().then(|| open("png")).transpose()?,
        };
        let bytes = setup.read(&item.input)?;
        let job = setup.job(&item.input, bytes, None, threads, false)?;
        let (finished, _product) = files.write(job, &setup, format)?;
        Ok(ItemResult { document: finished.document()?, table: None })
    })
}

/// Returns true if a path has the extension of a mesh.
fn is_mesh_file(path: &Path) -> bool {
    let format = path.extension().and_then(|extension| extension.to_string_lossy().parse::<Format>().ok());
    format.is_some_and(|format| !format.is_picture())
}

/// Open files of one structure.
struct MeshFiles {
    mesh: Output,
    /// Table of atoms.
    atoms: Option<Output>,
    /// Table of areas.
    areas: Option<Output>,
    picture: Option<Output>,
}

impl MeshFiles {
    /// Runs a job and writes its files. Also returns the product, which may take long to free.
    fn write(
        self,
        mut job: CommandJob<'_>,
        setup: &JobSetup<'_>,
        format: Format,
    ) -> Result<(CommandReport<Report>, Product), CliError> {
        let Self { mesh: mut output, mut atoms, mut areas, mut picture } = self;
        job.keeps_structure = atoms.is_some() || areas.is_some() || picture.is_some();
        // A picture needs the vertices in memory, at full precision.
        let draws_mesh = picture.is_some() && setup.options.compress == Compress::None;
        let mut product = if format == Format::Glb && output.has_random_access() && !draws_mesh {
            run_to_file(&job, &setup.options, &output)?
        } else {
            job.run(&setup.options, None).map_err(|source| job.failure(source))?
        };
        let mut report = product.report.clone();
        let mut writing = Duration::ZERO;
        if let Some(bytes) = product.streamed_bytes {
            output.bytes = bytes;
        } else {
            report.add_timing("encode", encode(&product, format, &mut output, &job.progress)?);
            writing = output.writing;
        }
        let start = Instant::now();
        if let Some(output) = &mut atoms {
            table::write_csv(job.structure()?, output).map_err(|source| output.failure(source))?;
        }
        writing += start.elapsed();
        if let Some((output, request)) = areas.as_mut().zip(setup.areas.as_ref()) {
            write_areas(&job, setup, request, output)?;
        }
        if let Some((output, options)) = picture.as_mut().zip(setup.picture.as_ref()) {
            if !draws_mesh {
                drop(product);
                product = job.run(options, None).map_err(|source| job.failure(source))?;
            }
            job.draw(&mut product, options).map_err(|source| job.failure(source))?;
            product.file(Format::Png)?.write(output).map_err(|source| output.failure(source))?;
            add_picture(&mut report, &mut product.report);
        }
        let others = [(atoms, "atom_table", "csv"), (areas, "area_table", "csv"), (picture, "picture_file", "png")];
        let others = others.into_iter().filter_map(|(output, member, format)| Some((output?, member, format)));
        let outputs = [(output, "output", format.name())].into_iter().chain(others).collect();
        Ok((job.finish(outputs, report, writing)?, product))
    }
}

/// Writes the table of areas.
fn write_areas(
    job: &CommandJob<'_>,
    setup: &JobSetup<'_>,
    AreasRequest { options, level, .. }: &AreasRequest,
    output: &mut Output,
) -> Result<(), CliError> {
    let (structure, control, limits) = (job.structure()?, job.control(), &setup.limits);
    let measured = measure_selection(structure, options, &limits.read, &limits.surface, &control);
    let areas = measured.map_err(|source| job.failure(source))?.areas;
    areas.write_csv(structure, *level, &control, output).map_err(|source| output.failure(source))
}

/// Moves the picture and its times from the report `drawn`.
fn add_picture(report: &mut Report, drawn: &mut Report) {
    report.picture = drawn.picture.take();
    for stage in ["draw", "png"] {
        if let Some(time) = drawn.timings_ms.get(stage).and_then(serde_json::Value::as_f64) {
            report.add_timing(stage, time);
        }
    }
}

/// Runs the job. If the job allows it, the GLB is written while the mesh is computed.
fn run_to_file(job: &CommandJob<'_>, options: &Options, output: &Output) -> Result<Product, CliError> {
    let sink = GlbSink::new(output);
    job.run(options, Some(&sink)).map_err(|error| match error {
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
