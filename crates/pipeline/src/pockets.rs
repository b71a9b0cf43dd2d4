//! Pockets of the report.

use molmesh_structure::{AtomPart, ReadLimits, Selected, Split, Structure, StructureError};
use molmesh_surface::pockets::{count_rows, find};
use molmesh_surface::{Control, DEFAULT_POCKET_PROBE, Mesh, Pocket, Pockets, Spheres, SurfaceError, SurfaceLimits};
use rayon::prelude::*;
use serde::Serialize;

use super::clock::WorkScope;
use super::{LiningResidue, Options, Report};

/// Pocket: a region outside the molecule that the probe can enter and a large probe cannot. It does not depend on the
/// mesh and the type of the surface.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
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
    /// Returns the report of a pocket. Its lining has rows of `selected`.
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

impl Options {
    /// Returns the radius of the large probe, Å, if the job lists pockets, colours them or makes parts of them.
    pub(super) fn pocket_probe(&self) -> Option<f64> {
        let needed = self.split == Split::Pocket || self.color.is_some_and(|color| color.scheme.needs_pockets());
        self.pockets.or_else(|| needed.then_some(DEFAULT_POCKET_PROBE))
    }
}

/// Finds the pockets of `spheres` if the job needs them.
///
/// # Errors
/// Returns the errors of [`find`].
pub(super) fn search(
    options: &Options,
    spheres: &Spheres,
    limits: &SurfaceLimits,
    WorkScope { clock, control }: &WorkScope<'_>,
) -> Result<Option<Pockets>, SurfaceError> {
    let search = |probe| clock.time("pockets", || find(spheres, &options.params, probe, limits, control));
    options.pocket_probe().map(search).transpose()
}

/// Counts the rows of grid points that [`search`] passes over; 0 if the job needs no pockets.
///
/// # Errors
/// Returns the errors of [`count_rows`].
pub(super) fn rows(
    options: &Options,
    spheres: &Spheres,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<u64, SurfaceError> {
    options.pocket_probe().map_or(Ok(0), |probe| count_rows(spheres, &options.params, probe, limits, control))
}

/// Returns the index of the pocket that each vertex lines; `None` for vertices that line no pocket.
pub(super) fn lined_by<'a>(
    mesh: &'a Mesh,
    pockets: &'a Pockets,
) -> impl IndexedParallelIterator<Item = Option<u32>> + 'a {
    (0..mesh.n_vertices()).into_par_iter().map(|i| {
        let position = mesh.position(i);
        pockets.lined_at(std::array::from_fn(|k| mesh.centre[k] + f64::from(position[k])))
    })
}

/// Returns the parts of the selected atoms. With `found` pockets, there is one part per pocket, largest first, and a
/// last part `other`. The part of a pocket has the atoms that line it; an atom can line several pockets. The last part
/// has the atoms that line none. Without pockets, the rule `split` divides the atoms.
///
/// # Errors
/// Returns [`StructureError::Limit`], and without pockets the errors of [`Selected::parts`].
pub(super) fn parts(
    found: Option<&Pockets>,
    structure: &Structure,
    selected: &Selected,
    split: Split,
    limits: &ReadLimits,
    control: &Control<'_>,
) -> Result<Option<Vec<AtomPart>>, StructureError> {
    let Some(found) = found else { return selected.parts(structure, split, limits, control) };
    if found.list.len() as u64 >= limits.max_parts {
        return Err(split.too_many_parts(limits));
    }
    let mut is_lining = vec![false; selected.atoms.len()];
    found.list.iter().flat_map(|pocket| &pocket.lining).for_each(|row| is_lining[*row as usize] = true);
    let name = |number: usize| format!("pocket {number}");
    let pockets = (1..).zip(&found.list);
    let mut parts: Vec<AtomPart> =
        pockets.map(|(number, pocket)| AtomPart { name: name(number), rows: pocket.lining.clone() }).collect();
    let rows = (0..).zip(is_lining).filter(|(_, is_lining)| !is_lining).map(|(row, _)| row).collect();
    parts.push(AtomPart { name: "other".to_owned(), rows });
    Ok(Some(parts))
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
