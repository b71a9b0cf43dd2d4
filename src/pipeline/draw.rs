//! The picture of a finished mesh: drawn, packed, and put in the mesh's place.

use super::report::{PictureReport, Report};
use super::{JobError, Product, ProgressSink, StageClock};
use crate::picture::{Drawer, PictureParams, png};
use crate::surface::{CancelToken, Control, Mesh};

/// Draws the mesh of `product`, which gets the PNG and gives the mesh away: nobody asked for it.
///
/// # Errors
/// [`JobError::Picture`], and [`JobError::Surface`] where somebody stopped it or no device could.
pub fn draw(
    product: &mut Product,
    params: &PictureParams,
    drawer: &Drawer,
    cancel: &CancelToken,
    progress: &dyn ProgressSink,
) -> Result<(), JobError> {
    let clock = StageClock::new(progress);
    let mut mesh = std::mem::take(&mut product.mesh);
    let drawn = clock.time("draw", || {
        // The renderer needs random access to the corners.
        mesh.make_contiguous();
        let control = Control { cancel: cancel.clone(), deadline: None, observer: &clock };
        drawer.renderer.render(&mesh, params, &control)
    })?;
    // Before more memory is asked for.
    drop::<Mesh>(mesh);
    let bytes = clock.time("png", || png::encode(&drawn.image))?;
    product.report.picture = Some(PictureReport::new(params, drawer, &drawn));
    for (stage, ms) in clock.finish() {
        Report::add_timing(&mut product.report, stage, ms);
    }
    product.picture = Some(bytes);
    Ok(())
}
