//! Limits of one job.

use molmesh_picture::PictureLimits;
use molmesh_structure::ReadLimits;
use molmesh_structure::map::MapLimits;
use molmesh_surface::SurfaceLimits;

/// Limits of one job.
#[derive(Debug, Clone, Copy, Default)]
pub struct JobLimits {
    /// Limits of reading.
    pub read: ReadLimits,
    /// Limits of meshing.
    pub surface: SurfaceLimits,
    /// Limits of drawing.
    pub picture: PictureLimits,
    /// Limits of reading a map.
    pub map: MapLimits,
}
