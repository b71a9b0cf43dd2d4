//! `molmesh areas`: writes tables of the exact areas of structures.

use std::io::{self, Write};
use std::path::Path;

use molmesh::pipeline::areas::measure_selection;
use molmesh::pipeline::params::areas::AreasRequest;
use molmesh::pipeline::{JobLimits, LeftOut, MeasuredSelection, Options, SelectionMeasures};
use molmesh::structure::{self, Structure};
use molmesh::surface::{CancelToken, Control, Limit, SurfaceError};
use serde::Serialize;

use super::args::AreasArgs;
use super::batch::{Batch, BatchItem, BatchOutputs, ItemResult, is_batch};
use super::error::CliError;
use super::output::{self, Output};
use super::page::{Page, grouped};
use super::report::{CommandReport, WrittenFile};
use super::setup::JobThreads;
use super::style::Style;
use super::summary::{self, decimal, exact_measures};
use super::{interrupt, job, request};

/// Runs the command.
pub(super) fn run(args: &AreasArgs) -> Result<(), CliError> {
    let request = request::parse_areas(args)?;
    let limits = request::common_limits(&args.limits);
    if is_batch(&args.inputs, &args.batch, args.table.is_some(), &args.output, is_table) {
        return run_batch(args, &request, &limits);
    }
    // Sets the number of the global threads.
    JobThreads::all(args.run.threads)?;
    let cancel = CancelToken::default();
    interrupt::watch(&cancel)?;
    let input = job::first(&args.inputs);
    output::refuse_input(input, &args.output)?;
    let mut output = Output::open(&args.output, &cancel)?;
    let measured = MeasuredFile::read(input, &request, &limits, &cancel)?;
    measured.write_csv(&cancel, &mut output).map_err(|source| output.failure(source))?;
    let files = vec![output.written("output", "csv")];
    Output::finish(vec![output])?;
    let done = CommandReport { report: measured.report(), files, findings: None };
    done.write(&args.run, |done| text(&measured.structure, &request.options, &measured.measured, &done.files))
}

/// Measures several structures.
fn run_batch(args: &AreasArgs, request: &AreasRequest, limits: &JobLimits) -> Result<(), CliError> {
    let (extensions, table) = (vec!["csv"], args.table.as_deref());
    let outputs = BatchOutputs { output: &args.output, extensions, table, map: None };
    let batch = Batch::new(&args.inputs, &args.batch, &args.run, outputs, is_table)?;
    let cancel = CancelToken::default();
    interrupt::watch(&cancel)?;
    let work = |item: &BatchItem| {
        let output = if batch.has_folder() { Some(Output::open(&batch.output(item, "csv")?, &cancel)?) } else { None };
        let measured = MeasuredFile::read(&item.input, request, limits, &cancel)?;
        let (mut files, mut table) = (Vec::new(), None);
        if let Some(mut output) = output {
            measured.write_csv(&cancel, &mut output).map_err(|source| output.failure(source))?;
            files.push(output.written("output", "csv"));
            Output::finish(vec![output])?;
        } else {
            let bytes = table.insert(Vec::new());
            measured.write_csv(&cancel, bytes).map_err(|error| match error.downcast::<SurfaceError>() {
                Ok(source) => job::failure(source.into(), &item.input, &[], limits),
                Err(error) => CliError::Internal(error.to_string()),
            })?;
        }
        let document = CommandReport { report: measured.report(), files, findings: None }.document()?;
        Ok(ItemResult { document, table })
    };
    batch.run(&cancel, |item, _threads| work(item))
}

/// Returns true if a path is that of a table: its name has an extension, and it is no folder.
fn is_table(path: &Path) -> bool {
    path.extension().is_some() && !path.is_dir()
}

/// Structure with the areas of its atoms.
struct MeasuredFile<'a> {
    request: &'a AreasRequest,
    structure: Structure,
    measured: MeasuredSelection,
}

impl<'a> MeasuredFile<'a> {
    /// Reads and measures a structure.
    fn read(
        path: &Path,
        request: &'a AreasRequest,
        limits: &JobLimits,
        cancel: &CancelToken,
    ) -> Result<Self, CliError> {
        let input = job::read(path, Limit::InflatedBytes, limits.read.max_inflated_bytes)?;
        let control = Control { cancel: cancel.clone(), ..Control::default() };
        let failure = |error| job::failure(error, path, &input, limits);
        let structure = structure::read_with(&input, &limits.read, &control).map_err(|error| failure(error.into()))?;
        let measured = measure_selection(&structure, &request.options, &limits.read, &limits.surface, &control);
        Ok(Self { request, measured: measured.map_err(failure)?, structure })
    }

    /// Writes the table.
    fn write_csv(&self, cancel: &CancelToken, out: &mut dyn Write) -> io::Result<()> {
        let control = Control { cancel: cancel.clone(), ..Control::default() };
        self.measured.areas.write_csv(&self.structure, self.request.level, &control, out)
    }

    fn report(&self) -> AreasReport<'_> {
        let params = &self.request.options.params;
        AreasReport {
            measures: &self.measured.measures,
            id: self.structure.id.as_deref(),
            atoms: self.measured.areas.len(),
            left_out: &self.measured.left_out,
            warnings: &self.structure.warnings,
            surface: params.surface.name(),
            probe: params.used_probe(),
        }
    }
}

/// Formats the summary.
fn text(structure: &Structure, options: &Options, measured: &MeasuredSelection, files: &[WrittenFile]) -> String {
    let title = summary::title(structure.title.as_deref());
    let mut page = Page::new(Style::stderr(), structure.id.as_deref().unwrap_or("structure"), &title);
    let atoms = grouped(measured.areas.len() as u64);
    let atoms_in_file = grouped(structure.len() as u64);
    page.row("atoms", &format!("{atoms} of {atoms_in_file} in the file"));
    let assembly = options.selection.assembly.as_ref();
    page.rows("assembly", assembly.map(|id| format!("{id}; the atoms are those of all copies")));
    page.rows("left out", summary::left_out(&measured.left_out));
    page.rows("warning", structure.warnings.iter().cloned());
    let probe = options.params.used_probe().map(|radius| format!(", probe {radius} Å")).unwrap_or_default();
    page.row("surface", &format!("{}{probe}", options.params.surface));
    match &measured.measures {
        SelectionMeasures::Exact(exact) => page.row("exact", &exact_measures(exact)),
        SelectionMeasures::Interface(interface) => {
            for side in &interface.sides {
                let areas = format!("{} Å² alone, {} Å² buried", decimal(side.alone), decimal(side.buried));
                page.row(&side.chains.join("/"), &areas);
            }
            page.row("interface", &format!("{} Å²", decimal(interface.area)));
        }
    }
    page.rows("wrote", files.iter().map(WrittenFile::text));
    page.finish()
}

/// Report of a table of areas.
#[derive(Serialize)]
struct AreasReport<'a> {
    #[serde(flatten)]
    measures: &'a SelectionMeasures,
    id: Option<&'a str>,
    /// Number of atoms in the table, with all copies of an assembly.
    atoms: usize,
    left_out: &'a LeftOut,
    warnings: &'a [String],
    surface: &'static str,
    /// Radius of the probe, Å; null for a surface without one.
    probe: Option<f64>,
}
