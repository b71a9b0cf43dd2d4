//! Spheres of the levels of a tileset, in memory or in a file.

use std::sync::Arc;

use molmesh_structure::Selected;
use molmesh_surface::{Control, Spheres};

use super::TilesetColors;
use super::level::TilesetLevel;
use super::stored::SphereIndex;
use crate::JobError;
use crate::color::{ColorReport, Coloring, MeshColors};

/// Spheres of a level.
pub(super) enum LevelSource {
    Memory(TilesetLevel),
    File(Arc<SphereIndex>),
}

/// Values of a structure that is not in memory.
pub(super) struct Streamed {
    pub(super) n_atoms: u64,
    pub(super) atoms_in_file: u64,
    pub(super) radii: &'static str,
    pub(super) colors: Option<(Coloring, ColorReport)>,
}

/// Spheres near a tile.
pub(super) struct NearSpheres {
    pub(super) spheres: Spheres,
    /// Atom of the structure for each sphere.
    pub(super) atoms: Vec<u32>,
    /// Colours of the spheres.
    pub(super) colors: Option<MeshColors>,
}

impl LevelSource {
    /// Returns the largest radius, Å.
    pub(super) fn largest(&self) -> f32 {
        match self {
            Self::Memory(level) => level.spheres.radius_range().1,
            Self::File(index) => index.radii[1],
        }
    }

    /// Returns the spheres whose centres are at most `margin` away from a box along each axis, in the order of the
    /// level. Lengths are in Å. `selected` are the atoms of the tileset.
    pub(super) fn near(
        &self,
        selected: &Selected,
        bounds: [[f64; 3]; 2],
        margin: f64,
        colors: Option<&TilesetColors>,
        control: &Control<'_>,
    ) -> Result<NearSpheres, JobError> {
        match self {
            Self::Memory(level) => {
                let near = level.near(bounds, margin);
                let rows = near.iter().map(|sphere| level.row(*sphere));
                let of_rows = |colors: &TilesetColors| rows.clone().map(|row| colors.0.of_sphere(row)).collect();
                let colors = colors.and_then(|colors| colors.0.of_tile(of_rows(colors)));
                let atoms = rows.clone().map(|row| selected.atoms[row as usize]).collect();
                Ok(NearSpheres { spheres: level.spheres.subset(&near), atoms, colors })
            }
            Self::File(index) => {
                let (near, _memory) = index.near(bounds, margin, control)?;
                let column = |k: usize| near.iter().map(|sphere| sphere.centre[k]).collect();
                let radii = near.iter().map(|sphere| sphere.radius).collect();
                let spheres = Spheres::new(column(0), column(1), column(2), radii)?;
                let of_near = |colors: &TilesetColors| colors.0.of_tile(near.iter().map(|near| near.color).collect());
                let atoms = near.iter().map(|sphere| sphere.atom).collect();
                Ok(NearSpheres { spheres, atoms, colors: colors.and_then(of_near) })
            }
        }
    }
}
