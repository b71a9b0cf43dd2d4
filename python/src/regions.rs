//! `molmesh.cavities` and `molmesh.pockets`.

use molmesh_formats::Format;
use molmesh_pipeline::params::areas::check_one_model;
use molmesh_pipeline::{JobLimits, Options, ProgressSink as _};
use molmesh_surface::{Cavity, Control, Pocket, SurfaceError, SurfaceLimits, cavities, pockets};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::columns::ColumnData;
use crate::error::parameter_error;
use crate::parameters::{self, check_names, pairs, selection_of};
use crate::source::{Atoms, Source};
use crate::work;

/// Parameters of `cavities()`.
const CAVITIES: [&str; 8] =
    ["probe", "radius_scale", "radius_offset", "select", "chains", "model", "altloc", "assembly"];
/// Parameters of `pockets()`.
const POCKETS: [&str; 9] =
    ["probe", "pocket_probe", "radius_scale", "radius_offset", "select", "chains", "model", "altloc", "assembly"];

/// Cavity from ``molmesh.cavities()``: a closed region between the atoms that holds a probe.
#[pyclass(frozen, get_all, module = "molmesh", name = "Cavity")]
pub(crate) struct PyCavity {
    /// Centre of the largest sphere that fits between the atoms, tuple of float, Å.
    center: (f64, f64, f64),
    /// Radius of this sphere in Å.
    radius: f64,
    /// Volume of the region that the probe covers in Å³: the solvent-excluded volume.
    volume: f64,
    /// Area of the boundary of this region in Å²: the solvent-excluded surface.
    area: f64,
    /// Volume that the centre of the probe can occupy in Å³.
    accessible_volume: f64,
    /// Area of the solvent-accessible surface in Å².
    accessible_area: f64,
    /// Radius of the largest probe that can enter from outside in Å, rounded down; 0 if none was found.
    opening_radius: f64,
    /// Rows of the atoms that the probe can touch, uint32, ascending.
    atoms: Rows,
}

/// Pocket from ``molmesh.pockets()``: a region outside the molecule that the probe can enter and a large probe cannot.
#[pyclass(frozen, get_all, module = "molmesh", name = "Pocket")]
pub(crate) struct PyPocket {
    /// Centroid, tuple of float, Å.
    center: (f64, f64, f64),
    /// Volume in Å³.
    volume: f64,
    /// Area of the boundary between the pocket and the molecule in Å².
    area: f64,
    /// Largest distance of a point of the pocket from its nearest opening in Å; 0 without openings.
    depth: f64,
    /// Number of openings; 0 for a closed region.
    openings: u32,
    /// Rows of the atoms that line the pocket, uint32, ascending.
    atoms: Rows,
}

/// Rows of a structure, as an array.
#[derive(Clone)]
struct Rows(ColumnData);

impl<'py> IntoPyObject<'py> for Rows {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        self.0.array(py)
    }
}

impl From<Cavity> for PyCavity {
    fn from(cavity: Cavity) -> Self {
        Self {
            center: cavity.centre.into(),
            radius: cavity.radius,
            volume: cavity.volume,
            area: cavity.area,
            accessible_volume: cavity.accessible_volume,
            accessible_area: cavity.accessible_area,
            opening_radius: cavity.opening_radius,
            atoms: Rows(ColumnData::from_numbers(cavity.lining)),
        }
    }
}

impl From<Pocket> for PyPocket {
    fn from(pocket: Pocket) -> Self {
        Self {
            center: pocket.centre.into(),
            volume: pocket.volume,
            area: pocket.area,
            depth: pocket.depth,
            openings: pocket.openings,
            atoms: Rows(ColumnData::from_numbers(pocket.lining)),
        }
    }
}

#[pymethods]
impl PyCavity {
    fn __repr__(&self) -> String {
        format!("<molmesh.Cavity: {:.1} Å³, {:.1} Å²>", self.volume, self.area)
    }
}

#[pymethods]
impl PyPocket {
    fn __repr__(&self) -> String {
        format!("<molmesh.Pocket: {:.1} Å³, {} openings>", self.volume, self.openings)
    }
}

/// Finds cavities: closed regions between the atoms in which the centre of a probe can lie.
///
/// They follow from the atoms and the probe in closed form, without a mesh. ``surface(…, cavities="only")`` meshes
/// their walls.
///
/// Parameters
/// ----------
/// source, radii, progress
///     As in ``surface()``.
/// **parameters
///     ``probe`` (default 1.4), ``radius_scale``, ``radius_offset`` and those that select atoms.
///
/// Returns
/// -------
/// list of Cavity
///     All cavities, the one with the largest accessible volume first.
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
/// >>> structure = molmesh.read("samples/4pti.pdb")
/// >>> cavities = molmesh.cavities(structure)
/// >>> len(cavities), round(cavities[0].volume, 1), round(cavities[0].area, 1)
/// (1, 73.5, 94.5)
/// >>> structure.elements[cavities[0].atoms].tolist()[:3]
/// ['O', 'O', 'C']
#[pyfunction]
#[pyo3(name = "cavities", signature = (source, radii=None, *, progress=None, **parameters))]
pub(crate) fn find_cavities(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    radii: Option<&Bound<'_, PyAny>>,
    progress: Option<&Bound<'_, PyAny>>,
    parameters: Option<&Bound<'_, PyDict>>,
) -> PyResult<Vec<PyCavity>> {
    let call = Call::new(source, radii, parameters, &CAVITIES, ("cavities", "keep"))?;
    let found = call.run(py, progress, "cavities", |atoms, options, limits, control| {
        cavities::find(&atoms.spheres, &options.params, limits, control)
    })?;
    Ok(found.into_iter().map(PyCavity::from).collect())
}

/// Finds pockets: regions outside the molecule that a probe can enter and a large probe cannot.
///
/// The definition is that of KVFinder, on a grid of 0.6 Å. ``surface(…, split="pocket")`` meshes the surface in a part
/// for each pocket, in the same order.
///
/// Parameters
/// ----------
/// source, radii, progress
///     As in ``surface()``.
/// **parameters
///     ``probe`` (default 1.4), ``pocket_probe`` (default 4), ``radius_scale``, ``radius_offset`` and those that select
///     atoms.
///
/// Returns
/// -------
/// list of Pocket
///     All pockets of at least 5 Å³, the largest first.
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
/// >>> pockets = molmesh.pockets("samples/4pti.pdb")
/// >>> len(pockets), round(pockets[0].volume, 1), pockets[0].openings
/// (2, 42.1, 0)
#[pyfunction]
#[pyo3(name = "pockets", signature = (source, radii=None, *, progress=None, **parameters))]
pub(crate) fn find_pockets(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    radii: Option<&Bound<'_, PyAny>>,
    progress: Option<&Bound<'_, PyAny>>,
    parameters: Option<&Bound<'_, PyDict>>,
) -> PyResult<Vec<PyPocket>> {
    let call = Call::new(source, radii, parameters, &POCKETS, ("pockets", "true"))?;
    let found = call.run(py, progress, "pockets", |atoms, options, limits, control| {
        let large = options.pockets.unwrap_or(pockets::DEFAULT_POCKET_PROBE);
        Ok(pockets::find(&atoms.spheres, &options.params, large, limits, control)?.list)
    })?;
    Ok(found.into_iter().map(PyPocket::from).collect())
}

/// Call that searches the selected atoms for regions.
struct Call {
    source: Source,
    selection: parameters::Pairs,
    options: Options,
}

impl Call {
    /// Parses the arguments. `known` are the parameters of the function. `search` is the name and the value of the
    /// parameter that requests the regions from a job.
    fn new(
        source: &Bound<'_, PyAny>,
        radii: Option<&Bound<'_, PyAny>>,
        parameters: Option<&Bound<'_, PyDict>>,
        known: &'static [&'static str],
        search: (&str, &str),
    ) -> PyResult<Self> {
        let (source, mut given) = (Source::new(source, radii)?, pairs(parameters)?);
        check_names(&given, known)?;
        check_one_model(&given).map_err(|error| parameter_error(&error))?;
        let selection = selection_of(&given);
        // The probe is a parameter of surfaces of spheres. The regions do not depend on the surface.
        let added = [search, ("surface", "sas")];
        given.extend(added.map(|(name, value)| (name.to_owned(), value.to_owned())));
        let options = parameters::parse(&source, given, Format::default())?.options;
        Ok(Self { source, selection, options })
    }

    /// Reads and selects the atoms, and searches them.
    fn run<T: Send + 'static>(
        self,
        py: Python<'_>,
        progress: Option<&Bound<'_, PyAny>>,
        stage: &'static str,
        search: impl FnOnce(&Atoms, &Options, &SurfaceLimits, &Control<'_>) -> Result<T, SurfaceError> + Send + 'static,
    ) -> PyResult<T> {
        let Self { source, selection, options } = self;
        work::run(py, progress, "read", move |control, tracker| {
            let atoms = source.load(false, control, tracker)?.select(&options.selection, selection, control)?;
            tracker.progress(stage, 0.0);
            Ok(search(&atoms, &options, &JobLimits::default().surface, control)?)
        })
    }
}
