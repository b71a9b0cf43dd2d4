//! Limits of one job.

use crate::picture::PictureLimits;
use crate::structure::ReadLimits;
use crate::structure::map::MapLimits;
use crate::surface::SurfaceLimits;

/// Limits of one job.
#[derive(Debug, Clone, Copy)]
pub struct JobLimits {
    /// Limits of reading.
    pub read: ReadLimits,
    /// Limits of meshing.
    pub surface: SurfaceLimits,
    /// Limits of drawing.
    pub picture: PictureLimits,
    /// Limits of reading a map.
    pub map: MapLimits,
    /// Maximum size of a mesh file that the service sends or stores, bytes. A run does not check it, because a mesh can
    /// be written in several formats. The spacing that an error suggests respects it for binary files of the size of
    /// the mesh in memory, such as GLB.
    pub max_file_bytes: u64,
}

impl Default for JobLimits {
    fn default() -> Self {
        let (read, surface, picture) = <(ReadLimits, SurfaceLimits, PictureLimits)>::default();
        Self { read, surface, picture, map: MapLimits::default(), max_file_bytes: u64::MAX }
    }
}
