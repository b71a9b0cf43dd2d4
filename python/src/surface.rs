//! `molmesh.surface`.

use std::sync::Arc;

use molmesh_formats::{Compress, Format};
use molmesh_pipeline::params::Request;
use molmesh_pipeline::{Choice, JobLimits, MapFile, Options, Product, Tracker, run_with};
use molmesh_surface::{Control, CpuBackend, Limit};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::Failure;
use crate::mesh::PyMesh;
use crate::parameters::{self, Pairs, pairs};
use crate::source::{Content, Loaded, Source};
use crate::work;

/// Parameter that is true by default.
pub(crate) const ATOM_IDS: &str = "atom_ids";
/// Reason for the choice of the backend, for reports.
pub(crate) const REASON: &str = "library";

/// Computes the surface of a structure, or of spheres, as a triangle mesh.
///
/// Parameters
/// ----------
/// source : str, os.PathLike, bytes, Structure or array_like
///     Structure file or its content, a structure from ``read()``, or coordinates (n, 3) in Å.
/// radii : array_like, optional
///     Radii (n,) in Å, or one for all; with coordinates only.
/// map : str, os.PathLike or bytes, optional
///     CCP4, MRC or OpenDX map; with ``color="map"`` only.
/// progress : callable, optional
///     Function of the stage (str) and of the fraction that is done (float).
/// **parameters
///     Parameters of the service, described in ``molmesh.PARAMETERS``, such as ``surface``, ``resolution``, ``probe``
///     and ``select``. Lists may be sequences. Parameters of a picture belong to ``render()``; those that select atoms
///     belong to ``read()`` if the source is a structure, and values of ``color`` that need a file cannot be used with
///     coordinates. Unlike in the service, ``atom_ids`` is true by default.
///
/// Returns
/// -------
/// Mesh
///     The mesh with its report.
///
/// Raises
/// ------
/// molmesh.Error
///     If the file cannot be read, no atom is selected, a limit is exceeded, or there is no surface.
/// ValueError
///     If a parameter or an array is invalid.
/// TypeError
///     If the source or the map has another type.
/// OSError
///     If a file cannot be opened.
///
/// Examples
/// --------
/// >>> mesh = molmesh.surface("samples/4pti.pdb", surface="ses", resolution=1)
/// >>> mesh.closed
/// True
/// >>> sphere = molmesh.surface([[0, 0, 0]], [2.0], surface="vdw", resolution=0.2)
/// >>> round(sphere.area), round(sphere.volume)
/// (50, 33)
#[pyfunction]
#[pyo3(signature = (source, radii=None, *, map=None, progress=None, **parameters))]
pub(crate) fn surface(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    radii: Option<&Bound<'_, PyAny>>,
    map: Option<&Bound<'_, PyAny>>,
    progress: Option<&Bound<'_, PyAny>>,
    parameters: Option<&Bound<'_, PyDict>>,
) -> PyResult<PyMesh> {
    let mut given = pairs(parameters)?;
    if !given.iter().any(|(name, _)| name == ATOM_IDS) {
        given.push((ATOM_IDS.to_owned(), "true".to_owned()));
    }
    let job = Job::new(Source::new(source, radii)?, given, map, Format::Glb)?;
    work::run(py, progress, "read", move |control, tracker| {
        // A compressed mesh has no columns. It is compressed when it is saved.
        let compress = job.request.options.compress;
        let quantized = if compress == Compress::Meshopt { Compress::Quantize } else { compress };
        let (loaded, product, options) = job.run(|options| options.compress = quantized, control, tracker)?;
        let has_atoms = product.mesh.atom_ids.is_some();
        let atoms = has_atoms.then(|| loaded.select(&options.selection, Pairs::new(), control)).transpose()?;
        PyMesh::new(product, compress == Compress::Meshopt, atoms.as_deref(), control)
    })
}

/// Job on a source.
pub(crate) struct Job {
    source: Source,
    pub(crate) request: Request,
    map: Option<Content>,
}

impl Job {
    /// Parses the parameters of a job whose result has this format.
    pub(crate) fn new(source: Source, given: Pairs, map: Option<&Bound<'_, PyAny>>, format: Format) -> PyResult<Self> {
        let content = |map| Content::of(map)?.ok_or_else(|| PyTypeError::new_err("map must be a path or bytes"));
        let map = map.map(content).transpose()?;
        let request = parameters::parse(&source, given, format)?;
        Ok(Self { source, request, map })
    }

    /// Reads the source and computes the mesh, after `adjust` has changed the options. Returns the options as well.
    pub(crate) fn run(
        self,
        adjust: impl FnOnce(&mut Options),
        control: &Control<'_>,
        tracker: &Tracker,
    ) -> Result<(Loaded, Product, Options), Failure> {
        let Self { source, request: Request { mut options, strict, .. }, map } = self;
        let limits = JobLimits::default();
        adjust(&mut options);
        if let Some(map) = map {
            // Without stored results, the map needs no digest.
            options.map = Some(MapFile::new(String::new(), map.read(Limit::MapBytes, limits.map.max_inflated_bytes)?));
        }
        options.check(&limits)?;
        let is_spheres = source.is_spheres();
        let loaded = source.load(strict, control, tracker)?;
        let choice = Choice { backend: &CpuBackend::default(), reason: REASON };
        let read = |_: &Control<'_>| Ok(Arc::clone(loaded.structure()));
        let mut product = run_with(read, &options, &limits, &choice, control, tracker, None)?;
        if is_spheres {
            (product.report.source_format, product.report.radii) = ("arrays", "radii of the caller");
        }
        Ok((loaded, product, options))
    }
}
