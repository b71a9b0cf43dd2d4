//! `molmesh.render`.

use std::sync::Arc;

use molmesh_formats::Format;
use molmesh_picture::{CpuRenderer, PictureParams, Renderer as _, SelectedRenderer, png};
use molmesh_pipeline::draw;
use molmesh_pipeline::params::{PICTURES, ParamError, parse_with};
use molmesh_surface::{Control, Mesh};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::error::{Failure, parameter_error};
use crate::mesh::PyMesh;
use crate::parameters::{check_names, pairs};
use crate::source::Source;
use crate::surface::{Job, REASON};
use crate::work;

/// Renders a surface as a PNG.
///
/// Parameters
/// ----------
/// source : Mesh, str, os.PathLike, bytes, Structure or array_like
///     Mesh, or source of one as in ``surface()``.
/// radii, map, progress
///     As in ``surface()``.
/// **parameters
///     Parameters of a picture: ``width``, ``height``, ``view``, ``azimuth``, ``elevation``, ``background``,
///     ``style``; and unless the source is a mesh, those of ``surface()``.
///
/// Returns
/// -------
/// bytes
///     PNG file.
///
/// Raises
/// ------
/// molmesh.Error
///     As ``surface()``.
/// ValueError
///     If a parameter or an array is invalid, or a mesh has ``compress`` or ``instances``.
/// OSError
///     If the file cannot be opened.
///
/// Examples
/// --------
/// >>> png = molmesh.render("samples/1crn.cif", color="chain", width=320, height=240)
/// >>> png[:4]
/// b'\x89PNG'
#[pyfunction]
#[pyo3(signature = (source, radii=None, *, map=None, progress=None, **parameters))]
pub(crate) fn render<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    radii: Option<&Bound<'py, PyAny>>,
    map: Option<&Bound<'py, PyAny>>,
    progress: Option<&Bound<'py, PyAny>>,
    parameters: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let given = pairs(parameters)?;
    let png = if let Ok(mesh) = source.cast::<PyMesh>() {
        check_names(&given, &PICTURES)?;
        if radii.is_some() || map.is_some() {
            return Err(PyValueError::new_err("radii and map belong to the surface; this mesh exists already"));
        }
        let request = parse_with(given, |_| Ok::<_, ParamError>(Format::Png));
        let params = request.map_err(|error| parameter_error(&error))?.options.picture.unwrap_or_default();
        let mesh = Arc::clone(&mesh.get().content().mesh);
        work::run(py, progress, "draw", move |control, _| picture(&mesh, &params, control))?
    } else {
        let job = Job::new(Source::new(source, radii)?, given, map, Format::Png)?;
        work::run(py, progress, "read", move |control, tracker| {
            let (_, mut product, options) = job.run(|_| {}, control, tracker)?;
            let params = options.picture.unwrap_or_default();
            draw(&mut product, &params, &SelectedRenderer::cpu(REASON), control, tracker)?;
            Ok(product.picture.unwrap_or_default())
        })?
    };
    Ok(PyBytes::new(py, &png))
}

/// Draws a mesh.
///
/// # Errors
/// Returns the failures of drawing, and [`Failure::Argument`] for a mesh that cannot be drawn.
pub(crate) fn picture(mesh: &Arc<Mesh>, params: &PictureParams, control: &Control<'_>) -> Result<Vec<u8>, Failure> {
    if mesh.quantized.is_some() || mesh.placements.is_some() {
        let message = "a mesh with compress or instances cannot be drawn; compute it without them";
        return Err(Failure::Argument(message.to_owned()));
    }
    let drawn = CpuRenderer.render(mesh, params, control)?;
    Ok(png::encode(&drawn.image, control)?)
}
