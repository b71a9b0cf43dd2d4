//! `molmesh.read`.

use molmesh_formats::Format;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::parameters::{self, READ, pairs, selection_of};
use crate::source::{Content, Source};
use crate::structure::PyStructure;
use crate::work;

/// Reads a structure and selects its atoms.
///
/// Parameters
/// ----------
/// source : str, os.PathLike or bytes
///     PDB, mmCIF, BinaryCIF, PQR or XYZ file, or its content, plain or compressed with gzip or zstd. The format is
///     detected from the content.
/// progress : callable, optional
///     Function of the stage (str) and of the fraction that is done (float).
/// **parameters
///     ``select`` (default ``"polymer"``), ``chains``, ``model``, ``altloc``, ``assembly`` and ``check``, as described
///     in ``molmesh.PARAMETERS``. The atoms of an assembly are those of all its copies.
///
/// Returns
/// -------
/// Structure
///     The selected atoms.
///
/// Raises
/// ------
/// molmesh.Error
///     If the file cannot be read or no atom is selected.
/// ValueError
///     If a parameter is invalid.
/// TypeError
///     If the source is neither a path nor bytes.
/// OSError
///     If the file cannot be opened.
///
/// Examples
/// --------
/// >>> structure = molmesh.read("samples/4pti.pdb")
/// >>> len(structure), structure.coordinates.shape
/// (454, (454, 3))
/// >>> structure.left_out["total"]
/// 60
/// >>> len(molmesh.read("samples/4pti.pdb", select="name CA"))
/// 58
#[pyfunction]
#[pyo3(signature = (source, *, progress=None, **parameters))]
pub(crate) fn read(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    progress: Option<&Bound<'_, PyAny>>,
    parameters: Option<&Bound<'_, PyDict>>,
) -> PyResult<PyStructure> {
    let Some(content) = Content::of(source)? else {
        return Err(PyTypeError::new_err(format!("found {}, expected a path or bytes", source.get_type().name()?)));
    };
    let (source, given) = (Source::Content(content), pairs(parameters)?);
    parameters::check_names(&given, &READ)?;
    let selection = selection_of(&given);
    let request = parameters::parse(&source, given, Format::default())?;
    let atoms = work::run(py, progress, "read", move |control, tracker| {
        source.load(request.strict, control, tracker)?.select(&request.options.selection, selection, control)
    })?;
    Ok(PyStructure::new(atoms))
}
