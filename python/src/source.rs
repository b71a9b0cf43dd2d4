//! Input of a call: a file, its bytes, a structure, or coordinates and radii.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use molmesh_pipeline::{ProgressSink as _, Tracker};
use molmesh_structure::strict_validator::{self, Level};
use molmesh_structure::{Context, ReadLimits, Selected, Selection, Structure, from_spheres, read_with, select_with};
use molmesh_surface::spheres::MAX_COORDINATE;
use molmesh_surface::{Control, Exceeded, Limit, Spheres, SurfaceError};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::{PyByteArray, PyBytes, PyMemoryView, PyString};

use crate::error::Failure;
use crate::parameters::Pairs;
use crate::structure::PyStructure;

/// File on disk or in memory.
pub(crate) enum Content {
    File(PathBuf),
    Bytes(PyBackedBytes),
}

/// Bytes of a file.
pub(crate) enum LoadedBytes {
    Read(Vec<u8>),
    Shared(PyBackedBytes),
}

impl AsRef<[u8]> for LoadedBytes {
    fn as_ref(&self) -> &[u8] {
        match self {
            Self::Read(bytes) => bytes,
            Self::Shared(bytes) => bytes,
        }
    }
}

/// Input of a call.
pub(crate) enum Source {
    Content(Content),
    Atoms(Arc<Atoms>),
    Spheres(Spheres),
}

/// Structure with its selected atoms.
pub(crate) struct Atoms {
    pub(crate) structure: Arc<Structure>,
    pub(crate) selected: Selected,
    /// Selected atoms, moved by the operators of the assembly.
    pub(crate) spheres: Spheres,
    /// Parameters of the selection.
    pub(crate) parameters: Pairs,
}

impl Source {
    /// Takes the first arguments of a call.
    ///
    /// # Errors
    /// Returns `ValueError` for arrays that are not coordinates and radii, and `TypeError` for other objects.
    pub(crate) fn new(source: &Bound<'_, PyAny>, radii: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let known = if let Ok(structure) = source.cast::<PyStructure>() {
            Some(Self::Atoms(Arc::clone(&structure.get().atoms)))
        } else {
            Content::of(source)?.map(Self::Content)
        };
        match (known, radii) {
            (Some(known), None) => Ok(known),
            (Some(_), Some(_)) => {
                Err(PyValueError::new_err("radii belong to an array of coordinates; a structure has its own"))
            }
            (None, Some(radii)) => spheres(source, radii).map(Self::Spheres),
            (None, None) if source.hasattr("__array__")? || source.hasattr("__len__")? => {
                Err(PyValueError::new_err("the radii are missing: expected coordinates and radii"))
            }
            (None, None) => Err(PyTypeError::new_err(format!(
                "found {}, expected a path, bytes, a Structure, or coordinates and radii",
                source.get_type().name()?
            ))),
        }
    }

    /// Returns the parameters of atoms that are already selected, and the reason why no others can be set.
    pub(crate) fn selection(&self) -> Option<(&[(String, String)], &'static str)> {
        match self {
            Self::Content(_) => None,
            Self::Atoms(atoms) => Some((&atoms.parameters, "pass it to read(), which has selected the atoms")),
            Self::Spheres(_) => Some((&[], "coordinates have no names; select them before the call")),
        }
    }

    /// Returns true if the atoms come from arrays.
    pub(crate) fn is_spheres(&self) -> bool {
        matches!(self, Self::Spheres(_))
    }

    /// Reads the structure. `strict` runs the strict validator first.
    ///
    /// # Errors
    /// Returns the failures of reading.
    pub(crate) fn load(self, strict: bool, control: &Control<'_>, tracker: &Tracker) -> Result<Loaded, Failure> {
        let limits = ReadLimits::default();
        tracker.progress("read", 0.0);
        let structure = match self {
            Self::Atoms(atoms) => return Ok(Loaded::Selected(atoms)),
            Self::Spheres(spheres) => from_spheres(&spheres, &limits, control)?,
            Self::Content(content) => {
                let bytes = content.read(Limit::InflatedBytes, limits.max_inflated_bytes)?;
                read(bytes.as_ref(), strict, &limits, control)?
            }
        };
        tracker.progress("read", 1.0);
        Ok(Loaded::Read(Arc::new(structure)))
    }
}

/// Structure of a source, with its atoms if `read()` has selected them.
pub(crate) enum Loaded {
    Read(Arc<Structure>),
    Selected(Arc<Atoms>),
}

impl Loaded {
    pub(crate) fn structure(&self) -> &Arc<Structure> {
        match self {
            Self::Read(structure) => structure,
            Self::Selected(atoms) => &atoms.structure,
        }
    }

    /// Selects the atoms. `parameters` are those of the selection.
    ///
    /// # Errors
    /// Returns the failures of selecting.
    pub(crate) fn select(
        self,
        selection: &Selection,
        parameters: Pairs,
        control: &Control<'_>,
    ) -> Result<Arc<Atoms>, Failure> {
        let structure = match self {
            Self::Selected(atoms) => return Ok(atoms),
            Self::Read(structure) => structure,
        };
        let limits = ReadLimits::default();
        // The rows are the selected atoms: no other atoms of the context, and no instances.
        let has_units = selection.instances || selection.unit.is_some();
        let selection = Selection {
            context: Context::Selection,
            instances: false,
            unit: None,
            assembly: selection.assembly.clone().filter(|_| !has_units),
            ..selection.clone()
        };
        let selected = select_with(&structure, &selection, &limits, control)?;
        let spheres = selected.spheres(&structure)?;
        selected.check_duplicates(&spheres, &limits, control)?;
        Ok(Arc::new(Atoms { structure, selected, spheres, parameters }))
    }
}

/// Reads a structure.
fn read(bytes: &[u8], strict: bool, limits: &ReadLimits, control: &Control<'_>) -> Result<Structure, Failure> {
    if strict {
        let findings = strict_validator::check(bytes, limits, control)?;
        let errors: Vec<_> = findings.iter().filter(|finding| finding.level == Level::Error).collect();
        if let Some(first) = errors.first() {
            return Err(Failure::Check { errors: errors.len(), first: first.message.clone(), line: first.line });
        }
    }
    Ok(read_with(bytes, limits, control)?)
}

impl Content {
    /// Takes a path or an object of bytes; `None` for other objects.
    pub(crate) fn of(object: &Bound<'_, PyAny>) -> PyResult<Option<Self>> {
        if object.is_instance_of::<PyString>() || object.hasattr("__fspath__")? {
            return Ok(Some(Self::File(object.extract()?)));
        }
        if object.is_instance_of::<PyBytes>() || object.is_instance_of::<PyByteArray>() {
            return Ok(Some(Self::Bytes(object.extract()?)));
        }
        if object.is_instance_of::<PyMemoryView>() {
            return Ok(Some(Self::Bytes(object.call_method0("tobytes")?.extract()?)));
        }
        Ok(None)
    }

    /// Returns the bytes of the file, at most `max`; `limit` is the limit that a larger one exceeds.
    pub(crate) fn read(self, limit: Limit, max: u64) -> Result<LoadedBytes, Failure> {
        let loaded = match self {
            Self::Bytes(bytes) => LoadedBytes::Shared(bytes),
            Self::File(path) => {
                LoadedBytes::Read(read_file(&path, max).map_err(|source| Failure::File { path, source })?)
            }
        };
        if loaded.as_ref().len() as u64 > max {
            return Err(SurfaceError::from(Box::new(Exceeded::new(limit, max))).into());
        }
        Ok(loaded)
    }
}

/// Reads a file, at most one byte more than `max`.
fn read_file(path: &Path, max: u64) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let size = file.metadata()?.len().min(max);
    // One spare byte lets the reader detect the end of the file without growing the buffer.
    let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or(0) + 1);
    file.take(max.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Converts coordinates (n, 3) and radii (n), or one radius for all, Å.
fn spheres(coordinates: &Bound<'_, PyAny>, radii: &Bound<'_, PyAny>) -> PyResult<Spheres> {
    let (coordinates, shape) = array("coordinates", coordinates)?;
    let (radii, shape_of_radii) = array("radii", radii)?;
    let bad = |message: String| Err(PyValueError::new_err(message));
    let &[n, 3] = &shape[..] else { return bad(format!("coordinates have shape {shape:?}, expected (n, 3)")) };
    if n == 0 {
        return bad("there are no coordinates, expected at least one sphere".to_owned());
    }
    if !shape_of_radii.is_empty() && shape_of_radii != [n] {
        return bad(format!("radii have shape {shape_of_radii:?}, expected ({n},) for {n} coordinates"));
    }
    // A broadcast array takes no memory until it is copied.
    ReadLimits::default().check_atoms(n).map_err(Failure::from)?;
    let (positions, radii) = (bytes(&coordinates)?, bytes(&radii)?);
    if let Some(radius) = numbers(&radii).find(|radius| radius.is_finite() && *radius > MAX_COORDINATE) {
        return bad(format!("the radius {radius} Å is too large, expected at most {MAX_COORDINATE} Å"));
    }
    let spheres = coordinates.py().detach(|| {
        let column = |k: usize| numbers(&positions).skip(k).step_by(3).collect();
        #[expect(clippy::cast_possible_truncation, reason = "radii of spheres are f32")]
        let radii = numbers(&radii).cycle().take(n).map(|radius| radius as f32).collect();
        Spheres::new(column(0), column(1), column(2), radii)
    });
    spheres.map_err(|error| PyValueError::new_err(error.to_string()))
}

/// Returns the array that numpy makes of an object, with its shape. `name` is that of the argument.
fn array<'py>(name: &str, object: &Bound<'py, PyAny>) -> PyResult<(Bound<'py, PyAny>, Vec<usize>)> {
    let numpy = object.py().import("numpy")?;
    if numpy.getattr("ma")?.call_method1("is_masked", (object,))?.is_truthy()? {
        return Err(PyValueError::new_err(format!("{name} have masked values; pass the others only")));
    }
    let array = numpy.call_method1("asarray", (object,))?;
    let dtype = array.getattr("dtype")?;
    // Numpy would drop imaginary parts and units.
    if matches!(dtype.getattr("kind")?.extract()?, 'c' | 'm' | 'M') {
        return Err(PyTypeError::new_err(format!("{name} have the type {dtype}, expected real numbers")));
    }
    let shape = array.getattr("shape")?.extract()?;
    Ok((array, shape))
}

/// Copies the values of an array, for [`numbers`].
fn bytes(array: &Bound<'_, PyAny>) -> PyResult<PyBackedBytes> {
    let array = array.py().import("numpy")?.call_method1("asarray", (array, "<f8"))?;
    Ok(array.call_method0("tobytes")?.extract()?)
}

/// Returns the numbers in the bytes of an array.
fn numbers(bytes: &[u8]) -> impl Iterator<Item = f64> + Clone {
    bytes.as_chunks::<8>().0.iter().map(|word| f64::from_le_bytes(*word))
}
