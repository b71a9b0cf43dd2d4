//! Pockets of the report.

use serde::Serialize;

use super::{LiningResidue, Report};
use crate::structure::{Selected, Structure};
use crate::surface::{Pocket, Pockets};

/// Pocket: a region outside the molecule that the probe can enter and a large probe cannot. It does not depend on the
/// mesh and the type of the surface.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct PocketReport {
    /// Volume in Å³.
    pub volume: f64,
    /// Area of the boundary between the pocket and the molecule in Å².
    pub area: f64,
    /// Largest distance of a point of the pocket from its nearest opening in Å; 0 without openings.
    pub depth: f64,
    /// Centroid in the coordinates of the structure, in Å.
    pub center: [f64; 3],
    /// Number of openings; 0 for a closed region.
    pub openings: u32,
    /// Number of atoms that line the pocket: those at most the radius of the probe away from it.
    pub atoms: u64,
    /// Residues of these atoms, by chain and number.
    pub residues: Vec<LiningResidue>,
}

impl PocketReport {
    /// Returns the report of a pocket, whose lining are rows of `selected`.
    fn new(pocket: &Pocket, structure: &Structure, selected: &Selected) -> Self {
        Self {
            volume: pocket.volume,
            area: pocket.area,
            depth: pocket.depth,
            center: pocket.centre,
            openings: pocket.openings,
            atoms: pocket.lining.len() as u64,
            residues: LiningResidue::all(&pocket.lining, structure, selected),
        }
    }
}

impl Report {
    /// Sets the number of pockets and the reports of the largest ones, if they were searched for.
    pub(super) fn set_pockets(&mut self, found: Option<&Pockets>, structure: &Structure, selected: &Selected) {
        let Some(found) = found else { return };
        let largest = found.list.iter().take(100);
        self.pockets = Some(found.list.len() as u64);
        self.pocket_list = Some(largest.map(|pocket| PocketReport::new(pocket, structure, selected)).collect());
    }
}
