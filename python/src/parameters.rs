//! Keyword arguments as names and values of a query, and their parser.

use molmesh_formats::Format;
use molmesh_pipeline::color::Scheme;
use molmesh_pipeline::params::{self, ParamError, Request};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyString};

use crate::error::parameter_error;
use crate::source::Source;

/// Names and values of parameters.
pub(crate) type Pairs = Vec<(String, String)>;

/// Parameter that checks a structure.
const CHECK: &str = "check";

/// Parameters of `read`: those that choose the atoms of a structure, and [`CHECK`].
pub(crate) const READ: [&str; 6] = ["select", "chains", "model", "altloc", "assembly", CHECK];

/// Returns names and values of the arguments, without those that are `None`.
pub(crate) fn pairs(arguments: Option<&Bound<'_, PyDict>>) -> PyResult<Pairs> {
    let mut pairs = Vec::new();
    for (name, value) in arguments.into_iter().flatten() {
        if !value.is_none() {
            pairs.push((name.extract()?, text(&value)?));
        }
    }
    Ok(pairs)
}

/// Returns a value as a query spells it: the items of a sequence are separated by commas.
fn text(value: &Bound<'_, PyAny>) -> PyResult<String> {
    let is_text = value.is_instance_of::<PyString>() || value.is_instance_of::<PyBytes>();
    if is_text || value.len().is_err() {
        return scalar(value);
    }
    // Sequences among the items are not expanded: a list may contain itself.
    Ok(value.try_iter()?.map(|item| scalar(&item?)).collect::<PyResult<Vec<_>>>()?.join(","))
}

/// Returns a single value as a query spells it.
fn scalar(value: &Bound<'_, PyAny>) -> PyResult<String> {
    match value.extract::<bool>() {
        Ok(flag) => Ok(flag.to_string()),
        Err(_) => value.str()?.extract(),
    }
}

/// Returns the parameters of the selection of `source`, followed by the `given` ones.
///
/// # Errors
/// Returns `ValueError` for a selection from atoms that are already selected.
pub(crate) fn with_selection(source: &Source, given: Pairs) -> PyResult<Pairs> {
    let Some((selection, why)) = source.selection() else { return Ok(given) };
    match given.iter().find(|(name, _)| READ.contains(&name.as_str())) {
        Some((name, _)) => Err(PyValueError::new_err(format!("parameter `{name}` cannot be set here: {why}"))),
        None => Ok([selection, &given[..]].concat()),
    }
}

/// Parses the parameters of a job on `source` whose result has this format.
///
/// # Errors
/// Returns `ValueError`.
pub(crate) fn parse(source: &Source, given: Pairs, format: Format) -> PyResult<Request> {
    if given.iter().any(|(name, _)| name == "format") {
        let message = "parameter `format` cannot be set here: Mesh.save() takes the format from the name of the file, \
                       and render() returns a PNG";
        return Err(PyValueError::new_err(message));
    }
    let request = params::parse_with(with_selection(source, given)?, |_| Ok::<_, ParamError>(format))
        .map_err(|error| parameter_error(&error))?;
    match request.options.color.map(|color| color.scheme) {
        None | Some(Scheme::Uniform(_) | Scheme::Vertex(_)) => Ok(request),
        Some(_) if !source.is_spheres() => Ok(request),
        Some(scheme) => {
            let message = format!("parameter `color`: `{scheme}` needs a file; coordinates have no such values");
            Err(PyValueError::new_err(message))
        }
    }
}

/// Returns the parameters that choose atoms.
pub(crate) fn selection_of(pairs: &Pairs) -> Pairs {
    pairs.iter().filter(|(name, _)| name != CHECK && READ.contains(&name.as_str())).cloned().collect()
}

/// Checks that all parameters are among `known`.
///
/// # Errors
/// Returns `ValueError` with the nearest known name.
pub(crate) fn check_names(given: &Pairs, known: &'static [&'static str]) -> PyResult<()> {
    params::check_names(given, known).map_err(|error| parameter_error(&error))
}
