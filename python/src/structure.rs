//! `molmesh.Structure`: columns of the selected atoms of a file.

use std::sync::{Arc, OnceLock};

use molmesh_structure::{SourceFormat, Structure, element};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;

use crate::columns::ColumnData;
use crate::error::Failure;
use crate::mesh::dictionary;
use crate::source::Atoms;

/// Selected atoms of a structure, from ``molmesh.read()``.
///
/// All arrays are read-only and have one row per atom, in the order of the file; those of an assembly are repeated
/// for each copy.
#[pyclass(frozen, module = "molmesh", name = "Structure")]
pub(crate) struct PyStructure {
    pub(crate) atoms: Arc<Atoms>,
    columns: Columns,
    left_out: PyOnceLock<Py<PyAny>>,
}

/// Columns, which are made when they are first used.
#[derive(Default)]
struct Columns {
    coordinates: OnceLock<ColumnData>,
    radii: OnceLock<ColumnData>,
    elements: OnceLock<ColumnData>,
    names: OnceLock<ColumnData>,
    residues: OnceLock<ColumnData>,
    chains: OnceLock<ColumnData>,
    b_factors: OnceLock<ColumnData>,
    charges: OnceLock<ColumnData>,
    indices: OnceLock<ColumnData>,
}

impl PyStructure {
    pub(crate) fn new(atoms: Arc<Atoms>) -> Self {
        Self { atoms, columns: Columns::default(), left_out: PyOnceLock::new() }
    }

    /// Returns the array of a column, which `make` makes when it is first used.
    fn column<'py>(
        &self,
        py: Python<'py>,
        cell: &OnceLock<ColumnData>,
        make: impl FnOnce(&Atoms) -> Result<ColumnData, Failure> + Send,
    ) -> PyResult<Bound<'py, PyAny>> {
        if let Some(column) = cell.get() {
            return column.array(py);
        }
        // Another thread may be faster.
        let column = py.detach(|| make(&self.atoms))?;
        cell.get_or_init(|| column).array(py)
    }
}

impl Atoms {
    /// Returns the values of the selected atoms.
    fn rows<T>(&self, value: impl Fn(&Structure, usize) -> T) -> Vec<T> {
        self.selected.atoms.iter().map(|&i| value(&self.structure, i as usize)).collect()
    }

    /// Returns the texts of the selected atoms.
    fn texts<'a>(&'a self, text: impl Fn(&'a Structure, usize) -> &'a str + Clone) -> Result<ColumnData, Failure> {
        ColumnData::texts(self.selected.atoms.iter().map(move |&i| text(&self.structure, i as usize)))
    }
}

#[pymethods]
impl PyStructure {
    fn __len__(&self) -> usize {
        self.atoms.selected.atoms.len()
    }

    fn __repr__(&self) -> String {
        let Atoms { structure, selected, .. } = &*self.atoms;
        let id = structure.id.as_deref().map(|id| format!(" {id}")).unwrap_or_default();
        format!("<molmesh.Structure{id}: {} atoms, {} in the file>", selected.atoms.len(), structure.n_in_file())
    }

    /// Coordinates, float64 (n, 3), Å.
    #[getter]
    fn coordinates<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.coordinates, |atoms| {
            Ok(ColumnData::from_rows((0..atoms.spheres.len()).map(|i| atoms.spheres.centre(i)).collect()))
        })
    }

    /// Van der Waals radii of the file or of the elements, float32 (n,), Å.
    #[getter]
    fn radii<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.radii, |atoms| Ok(ColumnData::from_numbers(atoms.spheres.radii().to_vec())))
    }

    /// Symbols of the elements, str (n,); ``?`` if unknown.
    #[getter]
    fn elements<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.elements, |atoms| {
            atoms.texts(|structure, i| element::symbol(structure.element[i]))
        })
    }

    /// Names of the atoms, such as ``CA``, str (n,).
    #[getter]
    fn names<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.names, |atoms| atoms.texts(|structure, i| structure.name.get(i)))
    }

    /// Residues of the atoms, (n,) with the fields ``name``, ``number`` and ``insertion_code``.
    ///
    /// Examples
    /// --------
    /// >>> structure = molmesh.read("samples/4pti.pdb")
    /// >>> structure.residues["name"][0], structure.residues["number"][0]
    /// (np.str_('ARG'), np.int32(1))
    #[getter]
    fn residues<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.residues, |Atoms { structure, selected, .. }| {
            let rows = selected.atoms.iter().map(|&i| i as usize);
            ColumnData::residues(
                rows.map(|i| (structure.residue.get(i), structure.residue_number[i], structure.insertion_code[i])),
            )
        })
    }

    /// Names of the chains given by the author, str (n,).
    #[getter]
    fn chains<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.chains, |atoms| atoms.texts(|structure, i| structure.chain.get(i)))
    }

    /// B-factors, float32 (n,), Å²; ``None`` for the formats PQR and XYZ, which have none.
    #[getter]
    fn b_factors<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        if matches!(self.atoms.structure.format, SourceFormat::Pqr | SourceFormat::Xyz) {
            return Ok(None);
        }
        self.column(py, &self.columns.b_factors, |atoms| {
            Ok(ColumnData::from_numbers(atoms.rows(|structure, i| structure.b_factor[i])))
        })
        .map(Some)
    }

    /// Partial charges, float32 (n,), e; ``None`` for all formats but PQR. Formal charges are not read.
    #[getter]
    fn charges<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        if self.atoms.structure.charge.is_empty() {
            return Ok(None);
        }
        self.column(py, &self.columns.charges, |atoms| {
            Ok(ColumnData::from_numbers(atoms.rows(|structure, i| structure.charge[i])))
        })
        .map(Some)
    }

    /// Indices of the atoms in the file, from 0, uint32 (n,). Mesh files contain these indices.
    #[getter]
    fn indices<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.column(py, &self.columns.indices, |atoms| Ok(ColumnData::from_numbers(atoms.selected.atoms.clone())))
    }

    /// Numbers of the atoms that are not selected, by reason.
    #[getter]
    fn left_out(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let make = || dictionary(py, &self.atoms.selected.left_out);
        Ok(self.left_out.get_or_try_init(py, make)?.clone_ref(py))
    }

    /// Messages about unreadable values that were replaced by a default.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.atoms.structure.warnings.clone()
    }

    /// PDB id or name of the data block; ``None`` if the file has none.
    #[getter]
    fn id(&self) -> Option<&str> {
        self.atoms.structure.id.as_deref()
    }

    /// Title; ``None`` if the file has none.
    #[getter]
    fn title(&self) -> Option<&str> {
        self.atoms.structure.title.as_deref()
    }

    /// Format of the file: ``pdb``, ``mmcif``, ``bcif``, ``pqr`` or ``xyz``.
    #[getter]
    fn format(&self) -> &'static str {
        self.atoms.structure.format.name()
    }
}
