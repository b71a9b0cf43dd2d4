//! Pictures of finished meshes.

use std::sync::Arc;

use molmesh_picture::{PictureParams, Rendered, SelectedRenderer, png};
use molmesh_surface::Control;

use super::report::PictureReport;
use super::{JobError, Product, ProgressSink, StageClock, WorkScope};

/// Draws the mesh of `product` and replaces it with the PNG.
///
/// # Errors
/// Returns [`JobError::Picture`] if the picture cannot be drawn, and [`JobError::Surface`] if the job was cancelled or
/// a device failed.
pub fn draw(
    product: &mut Product,
    params: &PictureParams,
    renderer: &SelectedRenderer,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
) -> Result<(), JobError> {
    let clock = StageClock::new(progress);
    let mut mesh = std::mem::take(&mut product.mesh);
    let drawn = clock.time("draw", || {
        // The renderer needs random access to vertices.
        mesh.make_contiguous();
        // The mesh is freed before the PNG is allocated.
        renderer.renderer.render(&Arc::new(mesh), params, &WorkScope::new(&clock, control).control)
    })?;
    let bytes = clock.time("png", || png::encode(&drawn.image, control))?;
    product.report.picture = Some(PictureReport::new(params, renderer, &drawn));
    product.report.add_timings(&clock);
    product.picture = Some(bytes);
    Ok(())
}

impl PictureReport {
    /// Returns the report of a picture.
    fn new(params: &PictureParams, renderer: &SelectedRenderer, drawn: &Rendered) -> Self {
        let made_by = drawn.made_by.clone().unwrap_or_else(|| renderer.renderer.identity());
        Self {
            width: params.width,
            height: params.height,
            view: params.view.name(),
            azimuth: params.azimuth,
            elevation: params.elevation,
            background: params.background.to_string(),
            style: params.style.name(),
            pixel: drawn.pixel,
            reason: made_by.reason(&renderer.reason),
            renderer: made_by.backend,
            arithmetic: made_by.arithmetic,
            device: made_by.device,
            fallback: made_by.fallback_reason,
        }
    }
}
