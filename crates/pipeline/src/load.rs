//! First steps of a job: reads a structure and selects its spheres.

use std::ops::Deref;

use molmesh_structure::{ReadLimits, Selected, Structure, StructureError};
use molmesh_surface::{Control, Spheres, SurfaceError};

use super::{JobError, Options, WorkScope};

/// Memory of selecting, bytes per atom of the structure.
const INDEX_BYTES: u64 = 8;
/// Memory of a sphere, bytes.
pub(super) const SPHERE_BYTES: u64 = 28;

/// Structure and its selected spheres.
pub(super) struct LoadedStructure<S> {
    pub(super) structure: S,
    pub(super) selected: Selected,
    pub(super) spheres: Spheres,
}

/// Reads a structure and selects its spheres.
pub(super) fn load<S: Deref<Target = Structure>>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    options: &Options,
    limits: &ReadLimits,
    WorkScope { clock, control }: &WorkScope<'_>,
) -> Result<LoadedStructure<S>, JobError> {
    control.memory.also_held(options.map.as_ref().map_or(0, |map| map.as_ref().len() as u64));
    let structure = clock.time("read", || read(control))?;
    control.check()?;
    // Selecting holds an index for each atom, and a sphere for each selected one.
    control.memory.grow(INDEX_BYTES * structure.len() as u64).map_err(SurfaceError::from)?;
    let (selected, spheres) = clock.time("select", || -> Result<_, JobError> {
        let selected = molmesh_structure::select_with(&structure, &options.selection, limits, control)?;
        control.check()?;
        control.memory.grow(SPHERE_BYTES * selected.atoms.len() as u64).map_err(SurfaceError::from)?;
        let spheres = selected.spheres(&structure)?;
        selected.check_instances(&spheres, &options.selection)?;
        selected.check_duplicates(&spheres, limits, control)?;
        Ok((selected, spheres))
    })?;
    Ok(LoadedStructure { structure, selected, spheres })
}
