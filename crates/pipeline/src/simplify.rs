//! Simplification of the mesh of a job.

use molmesh_surface::{Measures, Mesh, MeshOutput, SurfaceError, SurfaceParams, Validation};

use super::Options;
use super::clock::WorkScope;
use super::collapse::{SimplificationReport, check_error, simplify};

/// Returns the parameters of the mesh before a simplification, which must not take rounded vertices that coincide for
/// one vertex.
///
/// # Errors
/// [`SurfaceError::BadParameter`] if the error of the simplification is too large for the grid.
pub(super) fn params_of_input(options: &Options, params: &SurfaceParams) -> Result<SurfaceParams, SurfaceError> {
    options.simplify.map_or(Ok(()), |wanted| check_error(wanted.error, params.resolution))?;
    Ok(SurfaceParams { quantize: params.quantize.filter(|_| options.simplify.is_none()), ..params.clone() })
}

/// Simplifies the mesh of `output` if the job requires it, and then quantizes it if `params` require it. Does nothing
/// if the mesh was streamed into a sink.
///
/// # Errors
/// Returns the errors of [`simplify`], [`SurfaceError::Memory`] and [`SurfaceError::Cancelled`].
pub(super) fn apply(
    options: &Options,
    params: &SurfaceParams,
    output: &mut MeshOutput,
    WorkScope { clock, control }: &WorkScope<'_>,
) -> Result<Option<SimplificationReport>, SurfaceError> {
    if output.streamed.is_some() {
        return Ok(None);
    }
    let simplified = |wanted| {
        let found = clock.time("simplify", || simplify(&mut output.mesh, wanted, params.resolution, control))?;
        (output.measures, output.bounds) = (None, None);
        Ok::<_, SurfaceError>(found)
    };
    let report = options.simplify.map(simplified).transpose()?;
    let whole = std::mem::replace(output, MeshOutput::new(Mesh::default(), output.grid));
    *output = whole.deliver(params, control, None)?;
    if output.measures.is_none() && output.mesh.cut {
        // The checksum would not tell the boundary of a cut mesh from a defect.
        output.mesh.make_geometry_contiguous();
        output.measures = Some(Measures::of(&output.mesh, Validation::Exact, control)?);
    }
    Ok(report)
}
