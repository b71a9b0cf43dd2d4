//! `molmesh areas`: writes a table of the exact areas of one structure.

use molmesh::pipeline::areas::measure_selection;
use molmesh::pipeline::params::areas::AreasRequest;
use molmesh::pipeline::{LeftOut, MeasuredSelection, Options, SelectionMeasures};
use molmesh::structure::{self, Structure};
use molmesh::surface::{CancelToken, Control, Limit};
use serde::Serialize;

use super::args::AreasArgs;
use super::error::CliError;
use super::output::{self, Output};
use super::page::{Page, grouped};
use super::report::{CommandReport, WrittenFile};
use super::style::Style;
use super::summary::{self, decimal, exact_measures};
use super::{interrupt, job, request};

/// Runs the command.
pub(super) fn run(args: &AreasArgs) -> Result<(), CliError> {
    let AreasRequest { options, level, .. } = request::parse_areas(args)?;
    let limits = request::common_limits(&args.limits);
    job::set_threads(args.threads)?;
    let cancel = CancelToken::default();
    interrupt::watch(&cancel)?;
    output::refuse_input(&args.input, &args.output)?;
    let mut output = Output::open(&args.output, &cancel)?;
    let input = job::read(&args.input, Limit::InflatedBytes, limits.read.max_inflated_bytes)?;
    let control = Control { cancel, ..Control::default() };
    let failure = |error| job::failure(error, &args.input, &input, &limits);
    let structure = structure::read_with(&input, &limits.read, &control).map_err(|error| failure(error.into()))?;
    let measured = measure_selection(&structure, &options, &limits.read, &limits.surface, &control).map_err(failure)?;
    measured.areas.write_csv(&structure, level, &control, &mut output).map_err(|source| output.failure(source))?;
    let files = [output.written("output", "csv")];
    Output::finish(vec![output])?;
    let report = AreasReport {
        measures: &measured.measures,
        id: structure.id.as_deref(),
        atoms: measured.areas.len(),
        left_out: &measured.left_out,
        warnings: &structure.warnings,
        surface: options.params.surface.name(),
        probe: options.params.used_probe(),
    };
    let text = || text(&structure, &options, &measured, &files);
    CommandReport { report: &report, files: &files, findings: None }.write(args.report, args.quiet, text)
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
