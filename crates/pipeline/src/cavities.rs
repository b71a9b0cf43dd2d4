//! Cavities of the report, and their removal from a mesh.

use molmesh_structure::{Selected, Structure};
use molmesh_surface::cavities::{InnerComponents, find};
use molmesh_surface::{
    Cavity, Column, Control, MeshOutput, Spheres, SurfaceError, SurfaceLimits, SurfaceParams, named,
};
use rustc_hash::FxHashSet;
use serde::Serialize;

use super::Report;

/// Value of the parameter `cavities`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Cavities {
    /// Finds cavities and leaves the mesh as it is.
    Keep,
    /// Removes the inner components of the mesh that are cavities.
    Drop,
    /// Removes everything else.
    Only,
}

named!(Cavities, Keep => "keep", Drop => "drop", Only => "only");

/// Residue that lines a cavity or a pocket.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, utoipa::ToSchema)]
pub struct LiningResidue {
    /// Author name of the chain.
    pub chain: String,
    /// Author number.
    pub number: i32,
    /// Insertion code; absent if there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub insertion: Option<char>,
    /// Residue name.
    pub name: String,
}

impl LiningResidue {
    /// Returns the residues of atoms, given by rows of `selected`, by chain and number.
    pub(super) fn all(lining: &[u32], structure: &Structure, selected: &Selected) -> Vec<Self> {
        let atoms = lining.iter().map(|&row| selected.atoms[row as usize] as usize);
        let residue = |i: usize| Self {
            chain: structure.chain.get(i).to_owned(),
            number: structure.residue_number[i],
            insertion: Some(char::from(structure.insertion_code[i])).filter(|code| *code != '\0'),
            name: structure.residue.get(i).to_owned(),
        };
        let mut residues: Vec<Self> = atoms.map(residue).collect::<FxHashSet<_>>().into_iter().collect();
        residues.sort_unstable();
        residues
    }
}

/// Cavity: a closed region that holds a probe. It does not depend on the grid spacing and the type of the surface.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct CavityReport {
    /// Centre of the largest sphere that fits between the atoms, in the coordinates of the structure, in Å.
    pub center: [f64; 3],
    /// Radius of this sphere in Å, with an error of at most 0.001 Å.
    pub radius: f64,
    /// Volume of the region that the probe covers in Å³: the solvent-excluded volume of the cavity.
    pub volume: f64,
    /// Area of the boundary of this region in Å²: the solvent-excluded surface of the cavity.
    pub area: f64,
    /// Volume that the centre of the probe can occupy in Å³.
    pub accessible_volume: f64,
    /// Area of the solvent-accessible surface of the cavity in Å².
    pub accessible_area: f64,
    /// Radius of the largest probe that can enter the cavity from outside in Å, rounded down to a multiple of 1/16 of
    /// the radius of the probe. 0 if not even a probe of 1/16 of that radius can enter.
    pub opening_radius: f64,
    /// Number of atoms that the probe can touch.
    pub atoms: u64,
    /// Residues of these atoms, by chain and number.
    pub residues: Vec<LiningResidue>,
    /// True if an inner component of the mesh encloses the cavity, so that `drop` removed it or `only` kept it; false
    /// if the grid is too coarse for the wall. Absent with `keep`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub enclosed: Option<bool>,
}

/// Cavities of the selected atoms, largest first.
pub(super) struct FoundCavities {
    cavities: Vec<Cavity>,
    /// True for each cavity that an inner component of the mesh encloses; `None` if the mesh was not searched.
    enclosed: Option<Vec<bool>>,
}

impl CavityReport {
    /// Returns the report of a cavity, whose lining are rows of `selected`.
    fn new(cavity: &Cavity, enclosed: Option<bool>, structure: &Structure, selected: &Selected) -> Self {
        Self {
            center: cavity.centre,
            radius: cavity.radius,
            volume: cavity.volume,
            area: cavity.area,
            accessible_volume: cavity.accessible_volume,
            accessible_area: cavity.accessible_area,
            opening_radius: cavity.opening_radius,
            atoms: cavity.lining.len() as u64,
            residues: LiningResidue::all(&cavity.lining, structure, selected),
            enclosed,
        }
    }
}

impl Report {
    /// Sets the number of cavities and the reports of the largest ones, if they were searched for.
    pub(super) fn set_cavities(&mut self, found: Option<&FoundCavities>, structure: &Structure, selected: &Selected) {
        let Some(found) = found else { return };
        let enclosed = |i: usize| found.enclosed.as_ref().map(|enclosed| enclosed[i]);
        let largest = found.cavities.iter().take(100).enumerate();
        let reports = largest.map(|(i, cavity)| CavityReport::new(cavity, enclosed(i), structure, selected));
        self.cavities = Some(found.cavities.len() as u64);
        self.cavity_list = Some(reports.collect());
    }
}

/// Finds the cavities of `spheres`, and removes components of their mesh.
///
/// # Errors
/// Returns the errors of the search, and [`SurfaceError::NoCavity`] if no wall is left for `only`.
pub(super) fn search(
    mode: Cavities,
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    output: &mut MeshOutput,
    control: &Control<'_>,
) -> Result<FoundCavities, SurfaceError> {
    let cavities = find(spheres, params, limits, control)?;
    let enclosed = match mode {
        Cavities::Keep => None,
        Cavities::Drop | Cavities::Only => Some(remove(mode, &cavities, params.probe, output, control)?),
    };
    Ok(FoundCavities { cavities, enclosed })
}

/// Removes components of a mesh in memory. An inner component is the wall of a cavity if it encloses the centre of the
/// largest sphere in the cavity. Returns true for each cavity that has a wall.
fn remove(
    mode: Cavities,
    cavities: &[Cavity],
    probe: f64,
    output: &mut MeshOutput,
    control: &Control<'_>,
) -> Result<Vec<bool>, SurfaceError> {
    let mesh = &mut output.mesh;
    mesh.make_contiguous();
    let inner = InnerComponents::new(mesh, control)?;
    let mut walls = FxHashSet::default();
    let mut enclosed = Vec::new();
    for cavity in cavities {
        control.check()?;
        let wall = inner.around(mesh, cavity.centre);
        enclosed.push(wall.is_some());
        walls.extend(wall);
    }
    if walls.is_empty() {
        return match mode {
            Cavities::Only => Err(SurfaceError::NoCavity { probe, cavities: cavities.len() as u64 }),
            Cavities::Keep | Cavities::Drop => Ok(enclosed),
        };
    }
    let keeps = |vertex: u32| walls.contains(&inner.of_vertex[vertex as usize]) == (mode == Cavities::Only);
    let triangles: Column<[u32; 3]> = mesh.triangles.iter().filter(|triangle| keeps(triangle[0])).copied().collect();
    mesh.triangles = triangles;
    mesh.drop_unused_vertices(control)?;
    (output.measures, output.bounds) = (None, None);
    Ok(enclosed)
}
