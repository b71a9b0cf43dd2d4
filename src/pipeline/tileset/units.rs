//! Units of an assembly with `instances=true`: each has its own tileset, which the tileset of the assembly repeats.

use std::num::NonZeroU32;
use std::ops::Deref;

use super::layout::Layout;
use crate::formats::tileset::{RepeatedTileset, TilesetBounds};
use crate::pipeline::{Job, JobError, SPHERE_BYTES, Spacing, StageClock, load};
use crate::structure::{Operator, ReadLimits, Selection, Structure, StructureError, Unit};
use crate::surface::{Control, SurfaceError, SurfaceParams};

/// Maximum grid spacing of the mesh of the whole assembly, Å. A coarser grid could miss the surface.
const MAX_ASSEMBLY_SPACING: f64 = 4.0;

/// Unit of an assembly, and the bounds of its tileset.
#[derive(Debug, Clone)]
pub struct UnitTileset {
    /// Author names of its chains.
    pub name: String,
    /// Number of atoms.
    pub atoms: u64,
    /// Operators that place its instances.
    pub operators: Vec<Operator>,
    /// Bounds of its tileset, in the coordinates of the structure.
    pub bounds: TilesetBounds,
}

impl UnitTileset {
    /// Returns the tileset at `uri` with all placements.
    #[must_use]
    pub fn repeated(&self, uri: String) -> RepeatedTileset {
        RepeatedTileset {
            uri,
            bounds: self.bounds,
            placements: self.operators.iter().map(|operator| operator.0).collect(),
        }
    }
}

/// Returns the structure that `read` returns and the units of its assembly with the bounds of their tilesets. `job` has
/// `instances`.
///
/// # Errors
/// Returns a [`JobError`] if reading or selecting fails, or the job is cancelled.
pub fn units<S: Deref<Target = Structure>>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    job: &Job,
    limits: &ReadLimits,
    control: &Control<'_>,
    clock: &StageClock<'_>,
) -> Result<(S, Vec<UnitTileset>), JobError> {
    let (structure, selected, spheres) = load(read, job, limits, clock, control)?;
    let placed = |Unit { name, rows, operators, .. }: Unit| -> Result<UnitTileset, JobError> {
        control.check()?;
        let _spheres = control.reserve((SPHERE_BYTES + 4) * rows.len() as u64).map_err(SurfaceError::from)?;
        // The reader limits the number of atoms, so rows have 32 bits.
        let rows: Vec<u32> = rows.map(|row| u32::try_from(row).unwrap_or(u32::MAX)).collect();
        let own = spheres.subset(&rows);
        let bounds = Layout::of(&own, &job.params_for(own.len()))?.bounds();
        Ok(UnitTileset { name, atoms: rows.len() as u64, operators, bounds })
    };
    let units = selected.units.into_iter().map(placed).collect::<Result<Vec<UnitTileset>, JobError>>()?;
    Ok((structure, units))
}

/// Returns the job of the mesh of the whole assembly that is shown from afar: a coarse mesh with `instances`.
#[must_use]
pub fn job_of_assembly(job: &Job, units: &[UnitTileset]) -> Job {
    let coarsest = units.iter().fold(0.0_f64, |most, unit| most.max(unit.bounds.error));
    let resolution = coarsest.min(MAX_ASSEMBLY_SPACING);
    let params = SurfaceParams { resolution, ..job.params.clone() };
    Job { params, spacing: Spacing::Given, ..job.clone() }
}

/// Returns the job of the tileset of a unit. `index` counts from 0.
#[must_use]
pub fn job_of_unit(job: &Job, index: usize) -> Job {
    let unit = u32::try_from(index + 1).ok().and_then(NonZeroU32::new);
    Job { selection: Selection { instances: false, unit, ..job.selection.clone() }, ..job.clone() }
}
