//! Instances of the units of an assembly: each unit is meshed once, and the file repeats its mesh.

use std::num::NonZeroU32;

use molmesh_structure::{Selected, Selection, Unit};
use molmesh_surface::lattice::to_f32;
use molmesh_surface::{Control, Mesh, PartRange, Placements, SurfaceError};
use serde::Serialize;

/// Memory of a placement, bytes.
const PLACEMENT_BYTES: u64 = 28;

/// Biological assembly.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct AssemblyReport {
    /// Id in the file.
    pub id: String,
    /// Number of copies of chains, or of instances; 1 for one unit.
    pub copies: u64,
    /// Number of the unit that is meshed (`unit`); absent for all units.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unit: Option<u32>,
}

impl AssemblyReport {
    /// Returns the report of the assembly of `selection`; `None` for the asymmetric unit.
    pub(super) fn new(selection: &Selection, selected: &Selected) -> Option<Self> {
        let unit = selection.unit.map(NonZeroU32::get);
        let copies = if unit.is_some() { 1 } else { selected.n_copies() };
        Some(Self { id: selection.assembly.clone()?, copies, unit })
    }
}

/// Instances of the units of an assembly.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct InstancesReport {
    /// Number of instances of all units.
    pub count: u64,
    /// Always false: each instance has a closed surface of its own, and the surfaces of neighbouring instances are not
    /// joined.
    pub joined: bool,
    /// Sum of the atoms of all instances.
    pub atoms_sum: u64,
    /// Sum of the areas of all instances in Å². It includes the walls between instances.
    pub area_sum: f64,
    /// Sum of the volumes of all instances in Å³. Where instances overlap, it counts the volume of each.
    pub volume_sum: f64,
}

impl InstancesReport {
    /// Returns the sums over all instances of `units`, which are the parts of `mesh`; `None` without units.
    pub(super) fn new(units: &[Unit], mesh: &Mesh) -> Option<Self> {
        mesh.placements.as_ref()?;
        let sum = |of_part: &dyn Fn(&PartRange) -> f64| {
            mesh.parts.iter().map(|part| of_part(part) * part.placements.len() as f64).sum()
        };
        Some(Self {
            count: units.iter().map(|unit| unit.operators.len() as u64).sum(),
            joined: false,
            atoms_sum: units.iter().map(|unit| (unit.rows.len() * unit.operators.len()) as u64).sum(),
            area_sum: sum(&|part| part.area),
            volume_sum: sum(&|part| part.volume.unwrap_or_default()),
        })
    }
}

/// Records the placements of `units`, which are the parts of `mesh`.
///
/// # Errors
/// Returns the errors of memory.
pub(super) fn place(mesh: &mut Mesh, units: &[Unit], control: &Control<'_>) -> Result<(), SurfaceError> {
    if units.is_empty() {
        return Ok(());
    }
    let n: usize = units.iter().map(|unit| unit.operators.len()).sum();
    control.memory.grow(PLACEMENT_BYTES * n as u64)?;
    let (mut translations, mut rotations) = (Vec::with_capacity(n), Vec::with_capacity(n));
    let centre = mesh.centre;
    for (part, unit) in mesh.parts.iter_mut().zip(units) {
        let first = translations.len();
        for operator in &unit.operators {
            let moved = operator.apply(centre);
            translations.push(std::array::from_fn(|k| to_f32(moved[k] - centre[k])));
        }
        rotations.extend(unit.rotations.iter().map(|rotation| rotation.map(to_f32)));
        part.placements = first..translations.len();
    }
    mesh.placements = Some(Placements { translations: translations.into(), rotations: rotations.into() });
    Ok(())
}
