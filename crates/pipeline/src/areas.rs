//! Exact areas of a surface of spheres: in total, by chain, residue and atom, and buried between two sets of chains.

mod table;

use std::fmt;
use std::str::FromStr;

use molmesh_structure::{ReadLimits, Selected, Structure, select};
use molmesh_surface::params::bad;
use molmesh_surface::{
    AreaParts, Control, ExactMeasures, Reservation, Spheres, SurfaceError, SurfaceKind, SurfaceLimits,
};
use serde::Serialize;

pub use self::table::{AreaLevel, AreaRow};
use super::load::{LoadedStructure, SPHERE_BYTES, load};
use super::{JobError, LeftOut, Options, StageClock, WorkScope};

/// Description of the values of `interface`.
pub const EXPECTED: &str = "the chains of both sides, separated by a comma, such as A,B; several chains of a side are joined by a slash: H/L,A";

/// Largest number of chains in a report.
const MAX_CHAINS: usize = 1000;
/// Number of atoms between two checks for cancellation.
const ATOMS_PER_CHECK: usize = 1 << 16;

/// Two sets of chains without a common chain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interface {
    /// Author names of the chains of each side; `_` is the blank chain.
    pub sides: [Vec<String>; 2],
}

impl FromStr for Interface {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let side = |text: &str| -> Vec<String> { text.split('/').map(|name| name.trim().to_owned()).collect() };
        let sides: Vec<Vec<String>> = text.split(',').map(side).collect();
        let sides: [Vec<String>; 2] = sides.try_into().map_err(|_other| ())?;
        let names = || sides.iter().flatten();
        let is_valid = names().all(|name| !name.is_empty() && !name.chars().any(char::is_control));
        let distinct = names().collect::<std::collections::HashSet<_>>().len() == names().count();
        if is_valid && distinct { Ok(Self { sides }) } else { Err(()) }
    }
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [first, second] = &self.sides;
        write!(f, "{},{}", first.join("/"), second.join("/"))
    }
}

/// Exact measures of a surface of spheres, which do not depend on the grid spacing. The area includes the walls of
/// voids; the volume excludes voids.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct ExactReport {
    /// Area in Å².
    pub area: f64,
    /// Enclosed volume in Å³.
    pub volume: f64,
    /// Parts of this area; `surface=ses` only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parts: Option<AreaPartsReport>,
    /// Number of chains.
    pub chain_count: u64,
    /// Areas of the chains, in the order of their first atoms, at most 1,000. `…/areas?by=chain` and
    /// `molmesh areas --by chain` list all.
    pub chains: Vec<ChainArea>,
    /// Surface area buried between two sets of chains; absent without `interface`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub interface: Option<InterfaceReport>,
}

/// Area of the surface on the atoms of a chain.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct ChainArea {
    /// Name given by the author; empty if the file leaves it blank.
    pub chain: String,
    /// Number of atoms, in all copies.
    pub atoms: u64,
    /// Area in Å².
    pub area: f64,
    /// Parts of this area; `surface=ses` only. Toroidal and concave parts are divided between the atoms that the probe
    /// touches.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parts: Option<AreaPartsReport>,
}

/// Parts of an area of a solvent-excluded surface.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct AreaPartsReport {
    /// Area of the contact parts in Å², where the probe touches one atom.
    pub contact: f64,
    /// Area of the toroidal parts in Å², where the probe touches two atoms.
    pub toroidal: f64,
    /// Area of the concave parts in Å², where the probe touches three or more atoms.
    pub concave: f64,
}

impl AreaPartsReport {
    fn new(parts: AreaParts) -> Self {
        Self { contact: round(parts.contact), toroidal: round(parts.toroidal), concave: round(parts.concave) }
    }
}

/// Surface area buried between two sets of chains.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct InterfaceReport {
    /// Half of the buried area of both sides in Å².
    pub area: f64,
    /// First and second side.
    pub sides: [InterfaceSide; 2],
}

/// Side of an interface.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct InterfaceSide {
    /// Names of its chains.
    pub chains: Vec<String>,
    /// Area without the other side in Å².
    pub alone: f64,
    /// Area that the other side covers in Å².
    pub buried: f64,
}

/// Areas of the surface on each atom, Å².
#[derive(Debug, Clone, PartialEq)]
pub struct AtomAreas {
    /// Indices of the atoms in the columns of the structure, in the order of the selection.
    atoms: Vec<u32>,
    /// Area of each atom. With an interface, the atoms are those of both sides.
    areas: Vec<AreaParts>,
    /// Area of each atom without the other side; with an interface only.
    alone: Option<Vec<f64>>,
    /// True for a solvent-excluded surface, whose areas have parts.
    has_parts: bool,
}

/// Rounds to 0.0001, because the last digits depend on mathematical libraries.
fn round(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

/// Exact areas of a selection, without a mesh.
#[derive(Debug, Clone)]
pub struct MeasuredSelection {
    /// Atoms that were not measured.
    pub left_out: LeftOut,
    /// Measures of the selection, or with an interface, those of its sides.
    pub measures: SelectionMeasures,
    /// Areas of the atoms; with an interface, of those of both sides.
    pub areas: AtomAreas,
}

/// Measures of a selection.
#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SelectionMeasures {
    /// All atoms together.
    Exact(ExactReport),
    /// Surface area buried between two sets of chains.
    Interface(InterfaceReport),
}

/// Measures the atoms that a job selects, without a mesh.
///
/// # Errors
/// Returns the errors of [`super::run`] before meshing.
pub fn measure_selection(
    structure: &Structure,
    options: &Options,
    read: &ReadLimits,
    surface: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<MeasuredSelection, JobError> {
    let LoadedStructure { selected, spheres, .. } =
        load(|_| Ok(structure), options, read, &WorkScope::new(&StageClock::new(&()), control))?;
    let (measures, areas) = measure_selected(structure, &selected, &spheres, options, surface, control)?;
    Ok(MeasuredSelection { left_out: selected.left_out, measures, areas })
}

/// Measures `spheres`, those of the `selected` atoms, without a mesh.
///
/// # Errors
/// Returns the errors of [`super::run`] before meshing.
pub fn measure_selected(
    structure: &Structure,
    selected: &Selected,
    spheres: &Spheres,
    options: &Options,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<(SelectionMeasures, AtomAreas), JobError> {
    let (measures, areas) = if let Some(interface) = &options.interface {
        let (report, areas) = interface.measure(structure, selected, spheres, options, limits, control)?;
        (SelectionMeasures::Interface(report), areas)
    } else {
        let (report, areas) = whole(structure, selected, spheres, options, limits, control)?;
        (SelectionMeasures::Exact(report), areas)
    };
    Ok((measures, areas))
}

/// Measures `spheres`, those of the `selected` atoms.
pub(super) fn measure(
    structure: &Structure,
    selected: &Selected,
    spheres: &Spheres,
    options: &Options,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<ExactReport, JobError> {
    let (mut report, _) = whole(structure, selected, spheres, options, limits, control)?;
    if let Some(interface) = &options.interface {
        report.interface = Some(interface.measure(structure, selected, spheres, options, limits, control)?.0);
    }
    Ok(report)
}

/// Measures all spheres, without an interface.
fn whole(
    structure: &Structure,
    selected: &Selected,
    spheres: &Spheres,
    options: &Options,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<(ExactReport, AtomAreas), SurfaceError> {
    let whole = ExactMeasures::of(spheres, &options.params, limits, control)?;
    let has_parts = options.params.surface == SurfaceKind::Ses;
    control.memory.grow(size_of_val(&*selected.atoms) as u64)?;
    let parts = whole.parts();
    let mut report = ExactReport {
        area: round(parts.total()),
        volume: round(whole.volume),
        parts: has_parts.then(|| AreaPartsReport::new(parts)),
        chain_count: 0,
        chains: Vec::new(),
        interface: None,
    };
    let areas = AtomAreas { atoms: selected.atoms.clone(), areas: whole.of_spheres, alone: None, has_parts };
    let chain = |AreaRow { first, atoms, parts, .. }| ChainArea {
        chain: structure.chain.get(first).to_owned(),
        atoms,
        area: round(parts.total()),
        parts: has_parts.then(|| AreaPartsReport::new(parts)),
    };
    let memory = Reservation::new(&control.memory);
    let rows = areas.rows(structure, AreaLevel::Chain, control, &memory)?;
    report.chain_count = rows.len() as u64;
    report.chains = rows.into_iter().take(MAX_CHAINS).map(chain).collect();
    Ok((report, areas))
}

impl Interface {
    /// Returns the rows of the selected atoms of each side.
    fn rows(
        &self,
        structure: &Structure,
        selected: &Selected,
        control: &Control<'_>,
    ) -> Result<[Vec<u32>; 2], JobError> {
        let side = |k: usize| select::chains(structure, self.sides[k].iter().map(String::as_str), "interface chain");
        let sides = [side(0)?, side(1)?];
        let mut is_meshed = vec![false; sides[0].len()];
        let mut rows = [Vec::new(), Vec::new()];
        for (row, &atom) in (0_u32..).zip(&selected.atoms) {
            control.check_every(row as usize, ATOMS_PER_CHECK)?;
            let chain = structure.chain.id(atom as usize) as usize;
            is_meshed[chain] = true;
            for (rows, side) in rows.iter_mut().zip(&sides) {
                if side[chain] {
                    rows.push(row);
                }
            }
        }
        let mut absent = structure.chain.texts().enumerate().filter(|(chain, _)| !is_meshed[*chain]);
        match absent.find(|(chain, _)| sides.iter().any(|side| side[*chain])) {
            None => Ok(rows),
            Some((_, name)) => Err(bad("interface", format!("`{name}`"), "names of chains that are meshed").into()),
        }
    }

    /// Measures the selected atoms of each side, alone and together.
    fn measure(
        &self,
        structure: &Structure,
        selected: &Selected,
        spheres: &Spheres,
        options: &Options,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<(InterfaceReport, AtomAreas), JobError> {
        let all = selected.atoms.len() as u64;
        // Rows, spheres and areas of each side and of both.
        let _memory = control.reserve(2 * (SPHERE_BYTES + 32) * all).map_err(SurfaceError::from)?;
        let [first, second] = self.rows(structure, selected, control)?;
        let of = |rows: &[u32]| -> Result<Vec<AreaParts>, SurfaceError> {
            Ok(ExactMeasures::of(&spheres.subset(rows), &options.params, limits, control)?.of_spheres)
        };
        let totals = |areas: &[AreaParts]| areas.iter().map(AreaParts::total).collect();
        let mut alone: Vec<f64> = totals(&of(&first)?);
        alone.extend::<Vec<f64>>(totals(&of(&second)?));
        let rows = [&first[..], &second].concat();
        let areas = of(&rows)?;
        let side = |k: usize, rows: std::ops::Range<usize>| {
            let alone: f64 = alone[rows.clone()].iter().sum();
            let together: f64 = areas[rows].iter().map(AreaParts::total).sum();
            InterfaceSide { chains: self.sides[k].clone(), alone: round(alone), buried: round(alone - together) }
        };
        let sides = [side(0, 0..first.len()), side(1, first.len()..rows.len())];
        let area = round(0.5 * (sides[0].buried + sides[1].buried));
        let atoms = rows.iter().map(|&row| selected.atoms[row as usize]).collect();
        let has_parts = options.params.surface == SurfaceKind::Ses;
        Ok((InterfaceReport { area, sides }, AtomAreas { atoms, areas, alone: Some(alone), has_parts }))
    }
}
