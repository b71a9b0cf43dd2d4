//! Simplification of the mesh of a job, and its report.

use molmesh_surface::{Measures, Mesh, MeshOutput, SurfaceError, SurfaceParams, Validation};
use serde::Serialize;

use super::Options;
use super::clock::WorkScope;
use super::collapse::{check_error, simplify};

/// Size of the mesh before its simplification, and distance between the original and the simplified surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, utoipa::ToSchema)]
pub struct SimplificationReport {
    /// Number of triangles before the simplification.
    pub triangles_before: u64,
    /// Largest distance between the surfaces in Å, at samples: vertices of the original mesh, and points of the
    /// simplified one at most one grid spacing apart. No point is farther than one grid spacing from a sample, so the
    /// true maximum is at most one grid spacing larger.
    pub max_deviation: f64,
    /// Mean distance in Å at the samples in at most 200 cubes.
    pub mean_deviation: f64,
    /// Number of pairs of triangles of one part that intersect without a common edge. Simplification creates none
    /// within a piece of the mesh, but triangles of neighbouring pieces can intersect.
    pub intersections: u64,
}

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
        Ok::<_, SurfaceError>(SimplificationReport {
            triangles_before: found.triangles,
            max_deviation: found.deviation.maximum,
            mean_deviation: found.deviation.mean,
            intersections: found.deviation.intersections,
        })
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
