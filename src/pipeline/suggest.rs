//! Suggestions of a grid spacing that fits, for errors about the size of a grid.

use super::Choice;
use super::estimate::{MeshPlan, ends_work, n_vertices};
use crate::surface::lattice::slightly_coarser;
use crate::surface::params::MAX_RESOLUTION;
use crate::surface::{Control, SurfaceError, SurfaceKind, SurfaceParams};

/// Maximum number of grids that [`with_finest_fit`] plans.
const MAX_PLANS: u32 = 8;
/// Factor by which the spacing grows if it does not fit all parts.
const COARSER: f64 = 1.5;
/// Spacing of the mesh that gives the area for a suggestion, as a multiple of the suggested spacing.
const SKETCH_FACTOR: f64 = 4.0;
/// Margin of the estimated size of a mesh that must fit.
const SIZE_MARGIN: f64 = 1.3;

/// Replaces the suggested spacing of an error about the grid or about candidate pairs with the finest hundredth of an Å
/// whose planned grid fits all limits. A mesh of that spacing fits as well.
pub(super) fn with_finest_fit(
    mut error: SurfaceError,
    plan: &MeshPlan<'_>,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> SurfaceError {
    let bound = match &error {
        SurfaceError::GridTooLarge { suggested_resolution, .. } => Some(*suggested_resolution),
        SurfaceError::TooManyCandidates { suggested_resolution, .. } => *suggested_resolution,
        _ => return error,
    };
    let found = bound.map(|bound| finest_fit(bound, plan, choice, control)).transpose();
    let fits = match found {
        Ok(fits) => fits.flatten(),
        Err(ends) => return ends,
    };
    match &mut error {
        // A backend may need more than the plan. Its own suggestion is then the coarser one.
        SurfaceError::GridTooLarge { suggested_resolution, resolution, .. } => {
            *suggested_resolution = match fits {
                Some(fits) if fits <= *resolution => *suggested_resolution,
                fits => fits.unwrap_or(f64::INFINITY),
            };
        }
        SurfaceError::TooManyCandidates { suggested_resolution, .. } => *suggested_resolution = fits,
        _ => {}
    }
    error
}

/// Returns the finest spacing that fits, beginning at `bound`, if one is found.
fn finest_fit(
    bound: f64,
    plan: &MeshPlan<'_>,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<Option<f64>, SurfaceError> {
    // The spheres of one part at a time.
    let part_bytes = plan.parts.map_or(0, |_| super::SPHERE_BYTES * plan.spheres.len() as u64);
    let _spheres = control.reserve(part_bytes)?;
    let limit = plan.limits.max_grid_points;
    let (mut fits, mut next) = (None, bound.min(MAX_RESOLUTION));
    for _ in 0..MAX_PLANS {
        let coarser = match plan.grid_points(next, control) {
            Ok(needed) if needed <= limit => {
                fits = Some(next);
                // The arcs of a solvent-excluded surface are not counted here.
                if plan.params.surface == SurfaceKind::Ses {
                    break;
                }
                // The bricks of a finer grid cover less volume, so the grid at this spacing fits as well.
                let finer = (next * (needed as f64 / limit as f64).cbrt() * 100.0).ceil() / 100.0;
                if finer >= next {
                    break;
                }
                next = finer;
                continue;
            }
            Err(error) if ends_work(&error) => return Err(error),
            _too_large if fits.is_some() => break,
            // This bound comes from the grid, that one from the pairs: both limits apply.
            Err(error) => error.suggested_resolution().filter(|coarser| *coarser > next),
            Ok(_) => None,
        };
        // The bounds come from one part and may be too fine for all parts.
        let coarser = coarser.or_else(|| plan.parts.map(|_| COARSER * next));
        match coarser.map(|coarser| coarser.min(MAX_RESOLUTION)) {
            Some(coarser) if coarser > next => next = coarser,
            _ => break,
        }
    }
    fits.map(|fits| with_fitting_mesh(fits, plan, choice, control)).transpose()
}

/// Returns `spacing`, or a coarser one at which the mesh fits its limit as well.
fn with_fitting_mesh(
    spacing: f64,
    plan: &MeshPlan<'_>,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<f64, SurfaceError> {
    let (params, limit) = (plan.params, plan.limits.max_mesh_bytes);
    let exceeds = |area: f64| {
        let vertices = n_vertices(area, spacing);
        let bytes = params.mesh_bytes(vertices, vertices.saturating_mul(2));
        (bytes > limit || control.memory.check(bytes).is_err()).then_some(bytes)
    };
    if exceeds(plan.spheres.area(params)).is_none() {
        return Ok(spacing);
    }
    let coarse = MeshPlan { params: &SurfaceParams { resolution: spacing, ..params.clone() }, ..*plan };
    let area = match coarse.areas(SKETCH_FACTOR * spacing, choice, control) {
        Err(error) if ends_work(&error) => return Err(error),
        areas => areas.map_or(0.0, |[whole, _]| whole),
    };
    let Some(bytes) = exceeds(SIZE_MARGIN * area) else { return Ok(spacing) };
    let limit = limit.min(control.memory.available());
    Ok(slightly_coarser(spacing * (bytes as f64 / limit as f64).sqrt()).min(MAX_RESOLUTION))
}
