//! `molmesh.Mesh`: columns and measures of a mesh.

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use molmesh_formats::{Meta, Storage};
use molmesh_picture::PictureParams;
use molmesh_pipeline::{Product, Report};
use molmesh_surface::vector::{dot, sub};
use molmesh_surface::{Control, Mesh};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{IntoPyDict as _, PyBytes, PyDict};

use crate::columns::ColumnData;
use crate::error::Failure;
use crate::source::Atoms;
use crate::{render, save, work};

/// Triangle mesh of a surface, from ``molmesh.surface()``.
///
/// All arrays are read-only; every use of one returns the same memory. Triangles wind counter-clockwise seen from
/// outside. With ``instances`` or ``unit``, arrays and measures are those of one unit in the coordinates of the file;
/// only saved files have the placements.
#[pyclass(frozen, module = "molmesh", name = "Mesh")]
pub(crate) struct PyMesh {
    content: Arc<MeshContent>,
    vertices: OnceLock<ColumnData>,
    normals: OnceLock<ColumnData>,
    report: PyOnceLock<Py<PyAny>>,
}

/// Mesh with its report.
pub(crate) struct MeshContent {
    pub(crate) mesh: Arc<Mesh>,
    pub(crate) storage: Storage,
    pub(crate) bounds: Option<[[f32; 3]; 2]>,
    /// True to compress the vertices and indices of a GLB.
    pub(crate) is_meshopt: bool,
    pub(crate) report: Report,
    atom: Option<ColumnData>,
}

impl MeshContent {
    /// Returns the metadata for a mesh file.
    pub(crate) fn meta(&self) -> Meta {
        Meta { name: self.report.id.clone(), extras: self.report.extras() }
    }
}

impl PyMesh {
    /// Takes the mesh of a product. `atoms` are those of its source, for a mesh with indices of atoms.
    pub(crate) fn new(
        product: Product,
        is_meshopt: bool,
        atoms: Option<&Atoms>,
        control: &Control<'_>,
    ) -> Result<Self, Failure> {
        let Product { mut mesh, bounds, storage, report, .. } = product;
        mesh.make_contiguous();
        let atom = atoms.map(|atoms| atoms.rows_of(&mesh, control)).transpose()?.map(ColumnData::from_numbers);
        let content = MeshContent { mesh: Arc::new(mesh), storage, bounds, is_meshopt, report, atom };
        let (vertices, normals, report) = (OnceLock::new(), OnceLock::new(), PyOnceLock::new());
        Ok(Self { content: Arc::new(content), vertices, normals, report })
    }

    pub(crate) fn content(&self) -> &Arc<MeshContent> {
        &self.content
    }
}

/// Row of a vertex whose nearest atom is not among the rows.
const NO_ROW: u32 = u32::MAX;

impl Atoms {
    /// Returns the row of the nearest atom for each vertex: among the copies of an atom, that with the nearest centre.
    fn rows_of(&self, mesh: &Mesh, control: &Control<'_>) -> Result<Vec<u32>, Failure> {
        /// Vertices between two checks for cancellation.
        const PER_CHECK: usize = 1 << 16;
        // The rows of atom i are starts[i]..starts[i + 1] of `rows`.
        let mut starts = vec![0_u32; self.structure.len() + 1];
        self.selected.atoms.iter().for_each(|&i| starts[i as usize + 1] += 1);
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut rows = vec![0_u32; self.selected.atoms.len()];
        let mut next = starts.clone();
        for (row, &i) in (0..).zip(&self.selected.atoms) {
            let place = &mut next[i as usize];
            rows[*place as usize] = row;
            *place += 1;
        }
        let ids = mesh.atom_ids.as_deref().unwrap_or_default();
        let mut found = Vec::with_capacity(ids.len());
        for (vertex, &i) in ids.iter().enumerate() {
            if vertex.is_multiple_of(PER_CHECK) {
                control.check()?;
            }
            let i = i as usize;
            let copies = &rows[starts[i] as usize..starts[i + 1] as usize];
            found.push(match copies {
                [] => NO_ROW,
                [row] => *row,
                copies => {
                    let at = absolute(mesh, vertex);
                    let distance = |row: u32| {
                        let offset = sub(self.spheres.centre(row as usize), at);
                        dot(offset, offset)
                    };
                    copies.iter().copied().min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or(NO_ROW)
                }
            });
        }
        Ok(found)
    }
}

/// Returns the position of a vertex in the coordinates of the structure, Å.
fn absolute(mesh: &Mesh, vertex: usize) -> [f64; 3] {
    let position = mesh.position(vertex);
    std::array::from_fn(|k| mesh.centre[k] + f64::from(position[k]))
}

/// Converts a report to a dictionary.
pub(crate) fn dictionary(py: Python<'_>, report: &impl serde::Serialize) -> PyResult<Py<PyAny>> {
    let text = serde_json::to_string(report).map_err(|error| Failure::Argument(error.to_string()))?;
    Ok(py.import("json")?.call_method1("loads", (text,))?.unbind())
}

#[pymethods]
impl PyMesh {
    fn __repr__(&self) -> String {
        let Report { vertices, triangles, area, closed, .. } = &self.content.report;
        let closed = if *closed { "closed" } else { "open" };
        format!("<molmesh.Mesh: {vertices} vertices, {triangles} faces, {area:.1} Å², {closed}>")
    }

    /// Vertices in the coordinates of the structure, float32 (m, 3), Å. They are made when they are first used.
    ///
    /// float32 rounds them far from the origin, by up to 0.002 Å at 50,000 Å.
    #[getter]
    fn vertices<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        #[expect(clippy::cast_possible_truncation, reason = "vertices are f32")]
        let row = |vertex| absolute(&self.content.mesh, vertex).map(|v| v as f32);
        let make = || ColumnData::from_rows((0..self.content.mesh.n_vertices()).map(row).collect());
        py.detach(|| self.vertices.get_or_init(make)).array(py)
    }

    /// Triangles as indices of vertices, uint32 (k, 3).
    #[getter]
    fn faces<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        ColumnData::from_mesh::<u32>(&self.content.mesh, 3, |mesh| bytemuck::cast_slice(&mesh.triangles)).array(py)
    }

    /// Unit normals of the vertices, pointing outwards, float32 (m, 3).
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let make = || match &self.content.mesh.quantized {
            None => ColumnData::from_mesh::<f32>(&self.content.mesh, 3, |mesh| bytemuck::cast_slice(&mesh.normals)),
            Some(quantized) => {
                let row = |[x, y, z, _]: &[i8; 4]| [*x, *y, *z].map(|v| f32::from(v) / 127.0);
                ColumnData::from_rows(quantized.normals.iter().map(row).collect())
            }
        };
        py.detach(|| self.normals.get_or_init(make)).array(py)
    }

    /// Row of the nearest atom of each vertex, uint32 (m,); ``None`` with ``atom_ids=False``.
    ///
    /// Rows are those of the given structure or coordinates, or of ``read()`` with the same selection of the same
    /// file. With ``instances=True`` or ``unit``, they are those without ``assembly``. With ``context="whole"``, a
    /// vertex at the border of the patch may be nearest to an atom that is not selected; its row is 4294967295:
    /// select the others with ``mesh.atom < len(structure)``.
    #[getter]
    fn atom<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.content.atom.as_ref().map(|column| column.array(py)).transpose()
    }

    /// Colours of the vertices, sRGB with alpha, uint8 (m, 4); ``None`` without ``color``.
    #[getter]
    fn colors<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let mesh = &self.content.mesh;
        let column = || {
            ColumnData::from_mesh::<u8>(mesh, 4, |mesh| mesh.colors.as_deref().map_or(&[], |rows| rows.as_flattened()))
        };
        mesh.colors.is_some().then(|| column().array(py)).transpose()
    }

    /// Area in Å², including the walls of voids.
    #[getter]
    fn area(&self) -> f64 {
        self.content.report.area
    }

    /// Enclosed volume in Å³; ``None`` if the mesh is cut open.
    #[getter]
    fn volume(&self) -> Option<f64> {
        self.content.report.volume
    }

    /// Number of connected components.
    #[getter]
    fn components(&self) -> u64 {
        self.content.report.components
    }

    /// ``True`` if the mesh has no boundary, as a check of the mesh found.
    #[getter]
    fn closed(&self) -> bool {
        self.content.report.closed
    }

    /// Report of the service: counts, measures, components, cavities, pockets, times.
    #[getter]
    fn report(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        Ok(self.report.get_or_try_init(py, || dictionary(py, &self.content.report))?.clone_ref(py))
    }

    /// Writes the mesh to a file, which gets its name when it is complete.
    ///
    /// Parameters
    /// ----------
    /// path : str or os.PathLike
    ///     File. Its extension selects the format: ``glb``, ``gltf``, ``ply``, ``stl``, ``obj``, ``vtp``, ``vert``,
    ///     ``face`` or ``png``. stl, vert and face hold no colours.
    /// format : str, optional
    ///     Format, for files with another extension and for ``ply-text``.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     If the format is unknown or cannot hold the mesh.
    /// molmesh.Error
    ///     If the mesh is too large for the format.
    /// OSError
    ///     If the file cannot be written.
    ///
    /// Examples
    /// --------
    /// >>> mesh = molmesh.surface("samples/1crn.cif", resolution=1)
    /// >>> mesh.save("1crn.ply")
    #[pyo3(signature = (path, *, format=None))]
    fn save(&self, py: Python<'_>, path: PathBuf, format: Option<&str>) -> PyResult<()> {
        let format = save::format_of(&path, format)?;
        let content = Arc::clone(&self.content);
        work::run(py, None, "encode", move |control, _| save::save(&content, format, &path, control))
    }

    /// Returns the mesh as a ``trimesh.Trimesh`` with its normals and colours.
    ///
    /// The package ``trimesh`` must be installed. Vertices are float64. ``vertex_attributes["atom"]`` is ``Mesh.atom``
    /// unless that is ``None``.
    ///
    /// Returns
    /// -------
    /// trimesh.Trimesh
    ///     The mesh.
    ///
    /// Raises
    /// ------
    /// ImportError
    ///     If trimesh is not installed.
    ///
    /// Examples
    /// --------
    /// >>> molmesh.surface("samples/1crn.cif", resolution=1).to_trimesh().is_watertight
    /// True
    fn to_trimesh<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let arguments = PyDict::new(py);
        let mesh = &self.content.mesh;
        let make = || ColumnData::from_rows((0..mesh.n_vertices()).map(|vertex| absolute(mesh, vertex)).collect());
        arguments.set_item("vertices", py.detach(make).array(py)?)?;
        arguments.set_item("faces", self.faces(py)?)?;
        arguments.set_item("vertex_normals", self.normals(py)?)?;
        arguments.set_item("vertex_colors", self.colors(py)?)?;
        if let Some(atom) = self.atom(py)? {
            arguments.set_item("vertex_attributes", [("atom", atom)].into_py_dict(py)?)?;
        }
        arguments.set_item("process", false)?;
        py.import("trimesh")?.getattr("Trimesh")?.call((), Some(&arguments))
    }

    /// Picture for notebooks.
    fn _repr_png_<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let content = &self.content;
        if content.mesh.quantized.is_some() || content.mesh.placements.is_some() {
            return Ok(None);
        }
        let mesh = Arc::clone(&content.mesh);
        let picture =
            work::run(py, None, "draw", move |control, _| render::picture(&mesh, &PictureParams::default(), control))?;
        Ok(Some(PyBytes::new(py, &picture)))
    }
}
