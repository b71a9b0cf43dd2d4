//! Python package `molmesh`: a layer over the crates of the workspace. It parses arguments, runs jobs of `pipeline`
//! without the global interpreter lock, and passes columns to numpy without a copy.
//!
//! `source` reads the input of a call, `work` runs it on a thread, `columns` makes arrays of its results.

#![expect(
    clippy::doc_markdown,
    clippy::doc_link_with_quotes,
    reason = "comments of Python's functions are their docstrings, which numpydoc reads"
)]

mod areas;
mod columns;
mod error;
mod mesh;
mod parameters;
mod read;
mod regions;
mod render;
mod save;
mod source;
mod structure;
mod surface;
mod work;

use molmesh_pipeline::params::{Parameter, TABLE};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Extension module of the package `molmesh`.
#[pymodule]
fn _molmesh(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("Error", error::class(py)?)?;
    let parameters = PyDict::new(py);
    // Functions reject `format`.
    for Parameter { name, domain, default, doc } in TABLE.iter().filter(|parameter| parameter.name != "format") {
        let default = if *name == surface::ATOM_IDS { "true" } else { default };
        parameters.set_item(name, format!("{doc} Default: {default}. Values: {}.", domain.expected()))?;
    }
    module.add("PARAMETERS", parameters)?;
    module.add_class::<structure::PyStructure>()?;
    module.add_class::<mesh::PyMesh>()?;
    module.add_class::<regions::PyCavity>()?;
    module.add_class::<regions::PyPocket>()?;
    for function in [
        wrap_pyfunction!(read::read, module)?,
        wrap_pyfunction!(surface::surface, module)?,
        wrap_pyfunction!(areas::areas, module)?,
        wrap_pyfunction!(regions::find_cavities, module)?,
        wrap_pyfunction!(regions::find_pockets, module)?,
        wrap_pyfunction!(render::render, module)?,
    ] {
        function.setattr("__module__", "molmesh")?;
        module.add_function(function)?;
    }
    Ok(())
}
