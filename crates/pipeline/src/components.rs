//! Components and voids of the report.

use molmesh_surface::Component;
use serde::Serialize;

/// Connected component of the mesh.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct ComponentReport {
    /// Number of triangles.
    pub triangles: u64,
    /// Number of vertices.
    pub vertices: u64,
    /// Area in Å².
    pub area: f64,
    /// Volume in Å³, negative for a void; null if the mesh is cut open.
    #[schema(required)]
    pub volume: Option<f64>,
}

impl ComponentReport {
    pub(super) fn new(&Component { triangles, vertices, area, volume, .. }: &Component, is_open: bool) -> Self {
        Self { triangles, vertices, area, volume: (!is_open).then_some(volume) }
    }
}

/// Void: a closed surface that encloses space outside the molecule. Most voids are gaps between atoms; no probe has
/// tested whether a solvent molecule fits.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct VoidReport {
    /// Centroid in the coordinates of the structure, in Å.
    pub center: [f64; 3],
    /// Volume in Å³.
    pub volume: f64,
    /// Area in Å².
    pub area: f64,
}

impl VoidReport {
    /// Converts a component. `centre` is the centre of the mesh in the coordinates of the structure, in Å.
    pub(super) fn new(void: &Component, centre: [f64; 3]) -> Self {
        let centroid = void.centroid();
        Self { center: std::array::from_fn(|k| centre[k] + centroid[k]), volume: -void.volume, area: void.area }
    }
}
