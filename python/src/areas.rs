//! `molmesh.areas`.

use molmesh_pipeline::areas::measure_selected;
use molmesh_pipeline::params::areas::{AreasRequest, BY, parse};
use molmesh_pipeline::{AreaLevel, AreaRow, JobLimits};
use molmesh_structure::{Structure, element};
use molmesh_surface::{AreaParts, Reservation};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::columns::ColumnData;
use crate::error::{Failure, parameter_error};
use crate::parameters::{pairs, selection_of, with_selection};
use crate::source::{Atoms, Source};
use crate::work;

/// Computes exact areas of a surface of spheres, without a mesh.
///
/// Parameters
/// ----------
/// source, radii, progress
///     As in ``surface()``.
/// **parameters
///     ``surface`` (``"vdw"``, ``"sas"`` or ``"ses"``, required), ``by`` (``"atom"``, ``"residue"`` or ``"chain"``;
///     default ``"residue"``, for coordinates always ``"atom"``), ``probe``, ``radius_scale``, ``radius_offset``,
///     ``interface`` (such as ``"A,B"``) and those that select atoms.
///
/// Returns
/// -------
/// dict of str to numpy.ndarray
///     Columns of the table of the service, a row per atom, residue or chain: names, ``atoms``, ``area`` in Å², for
///     ``ses`` its parts ``contact``, ``toroidal`` and ``concave``, and with ``interface`` the areas ``alone`` and
///     ``buried``. The rows of atoms are those of the structure.
///
/// Raises
/// ------
/// molmesh.Error
///     If the file cannot be read, no atom is selected, or a limit is exceeded.
/// ValueError
///     If a parameter or an array is invalid.
/// TypeError
///     If the source has another type.
/// OSError
///     If the file cannot be opened.
///
/// Examples
/// --------
/// >>> areas = molmesh.areas("samples/4pti.pdb", surface="sas", by="chain")
/// >>> areas["chain"][0], areas["atoms"][0], round(areas["area"][0], 1)
/// (np.str_('A'), np.uint64(454), np.float64(3977.7))
#[pyfunction]
#[pyo3(signature = (source, radii=None, *, progress=None, **parameters))]
pub(crate) fn areas<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    radii: Option<&Bound<'py, PyAny>>,
    progress: Option<&Bound<'py, PyAny>>,
    parameters: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (source, mut given) = (Source::new(source, radii)?, pairs(parameters)?);
    let selection = selection_of(&given);
    let is_spheres = source.is_spheres();
    if is_spheres {
        match given.iter().find(|(name, _)| name == BY || name == "interface") {
            None => given.push((BY.to_owned(), AreaLevel::Atom.name().to_owned())),
            Some((name, level)) if name == BY && level == AreaLevel::Atom.name() => {}
            Some((name, _)) => {
                let message = format!("parameter `{name}` needs residues or chains, which coordinates do not have");
                return Err(PyValueError::new_err(message));
            }
        }
    }
    let request = parse(&with_selection(&source, given)?).map_err(|error| parameter_error(&error))?;
    let columns = work::run(py, progress, "read", move |control, tracker| {
        let AreasRequest { options, level, .. } = request;
        let atoms = source.load(false, control, tracker)?.select(&options.selection, selection, control)?;
        let Atoms { structure, selected, spheres, .. } = &*atoms;
        let limits = JobLimits::default().surface;
        let (_, measured) = measure_selected(structure, selected, spheres, &options, &limits, control)?;
        let rows = measured.rows(structure, level, control, &Reservation::new(&control.memory))?;
        let mut columns = if is_spheres { Vec::new() } else { names(structure, level, &rows)? };
        columns.extend(numbers(level, &rows, measured.has_parts()));
        Ok(columns)
    })?;
    let table = PyDict::new(py);
    for (name, column) in columns {
        table.set_item(name, column.array(py)?)?;
    }
    Ok(table)
}

/// Columns with their names.
type Table = Vec<(&'static str, ColumnData)>;

/// Returns the columns that name the rows.
fn names(structure: &Structure, level: AreaLevel, rows: &[AreaRow]) -> Result<Table, Failure> {
    let mut table = Vec::new();
    let atoms = || rows.iter().map(|row| row.first);
    if level == AreaLevel::Atom {
        #[expect(clippy::cast_possible_truncation, reason = "indices of atoms have 32 bits")]
        let indices: Vec<u32> = atoms().map(|i| i as u32).collect();
        table.push(("index", ColumnData::from_numbers(indices)));
        table.push(("name", ColumnData::texts(atoms().map(|i| structure.name.get(i)))?));
        table.push(("element", ColumnData::texts(atoms().map(|i| element::symbol(structure.element[i])))?));
    }
    if level != AreaLevel::Chain {
        let codes: Vec<String> = atoms().map(|i| structure.insertion_code[i]).map(code).collect();
        table.push(("residue_name", ColumnData::texts(atoms().map(|i| structure.residue.get(i)))?));
        table
            .push(("residue_number", ColumnData::from_numbers(atoms().map(|i| structure.residue_number[i]).collect())));
        table.push(("insertion_code", ColumnData::texts(codes.iter().map(String::as_str))?));
    }
    table.push(("chain", ColumnData::texts(atoms().map(|i| structure.chain.get(i)))?));
    table.push(("model", ColumnData::from_numbers(atoms().map(|i| structure.model[i]).collect())));
    Ok(table)
}

/// Returns the text of an insertion code.
fn code(code: u8) -> String {
    if code == 0 { String::new() } else { char::from(code).to_string() }
}

/// Returns the columns of numbers.
fn numbers(level: AreaLevel, rows: &[AreaRow], has_parts: bool) -> Table {
    let column =
        |value: &dyn Fn(&AreaRow) -> f64| ColumnData::from_numbers(rows.iter().map(value).collect::<Vec<f64>>());
    let mut table = Vec::new();
    if level != AreaLevel::Atom {
        table.push(("atoms", ColumnData::from_numbers(rows.iter().map(|row| row.atoms).collect::<Vec<u64>>())));
    }
    let area = |row: &AreaRow| AreaParts::total(&row.parts);
    table.push(("area", column(&area)));
    if has_parts {
        table.push(("contact", column(&|row| row.parts.contact)));
        table.push(("toroidal", column(&|row| row.parts.toroidal)));
        table.push(("concave", column(&|row| row.parts.concave)));
    }
    if rows.iter().any(|row| row.alone.is_some()) {
        let alone = |row: &AreaRow| row.alone.unwrap_or_default();
        table.push(("alone", column(&alone)));
        table.push(("buried", column(&|row| alone(row) - area(row))));
    }
    table
}
