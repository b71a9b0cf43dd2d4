//! Report of the shapes of triangles.

use molmesh_surface::{Mesh, Stage, TriangleQuality, TriangleShapes};
use serde::Serialize;

use super::{Options, StageClock};

/// Shapes of the triangles.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct TriangleReport {
    /// Smallest angle of all triangles in degrees.
    pub smallest_angle: f64,
    /// Angle in degrees below which the smallest angle of 0.1 % of the triangles lies, rounded down to tenths.
    pub angle_0_1_percent: f64,
    /// Angle in degrees below which the smallest angle of 1 % of the triangles lies, rounded down to tenths.
    pub angle_1_percent: f64,
    /// Median of the smallest angles in degrees, rounded down to tenths.
    pub angle_median: f64,
    /// Numbers of triangles by their smallest angle, in twelve classes of 5° from 0° to 60°.
    pub angle_histogram: Vec<u64>,
    /// Numbers of triangles by their aspect ratio (circumradius over twice the inradius, 1 if equilateral): up to 1.25,
    /// 1.5, 2, 3, 5, 10, 100, and above.
    pub aspect_histogram: Vec<u64>,
}

impl TriangleReport {
    /// Returns the report of a mesh if the job improves triangles.
    pub(super) fn for_job(options: &Options, mesh: &Mesh, clock: &StageClock<'_>) -> Option<Self> {
        let is_improved = options.quality == TriangleQuality::High;
        is_improved.then(|| clock.time(Stage::Measure.name(), || Self::new(mesh)))
    }

    fn new(mesh: &Mesh) -> Self {
        let shapes = TriangleShapes::of(mesh);
        let rounded = |angle: f64| (angle * 1e3).round() / 1e3;
        Self {
            smallest_angle: rounded(shapes.smallest_angle),
            angle_0_1_percent: shapes.angle_at(0.001),
            angle_1_percent: shapes.angle_at(0.01),
            angle_median: shapes.angle_at(0.5),
            angle_histogram: shapes.angles().to_vec(),
            aspect_histogram: shapes.aspects.to_vec(),
        }
    }
}
