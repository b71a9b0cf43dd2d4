//! Result of a selection: the atoms to mesh, and their spheres.

use molmesh_surface::vector::joined_bounds;
use molmesh_surface::{Control, Spheres, SurfaceError};
use rayon::prelude::*;

use super::{ATOMS_PER_TASK, LeftOut, Selection};
use crate::atoms::Structure;
use crate::copies::{PlacedCopy, Unit};
use crate::error::StructureError;
use crate::read::{MAX_COORDINATE, ReadLimits, Reading};
use crate::{duplicates, pieces};

/// Result of a selection.
#[derive(Debug, Clone, PartialEq)]
pub struct Selected {
    /// Indices of the atoms to mesh in the columns of the structure: ascending, or by copy in an assembly.
    pub atoms: Vec<u32>,
    /// With [`Context::Whole`](super::Context::Whole), true for the selected atoms, by index. `None` otherwise: all
    /// atoms to mesh are selected.
    pub marks: Option<Vec<bool>>,
    /// Copies that form the assembly; empty for the asymmetric unit and for units.
    pub copies: Vec<PlacedCopy>,
    /// Units that form the assembly with [`Selection::instances`]; otherwise empty.
    pub units: Vec<Unit>,
    /// Number of atoms to mesh before they were copied.
    pub n_distinct: usize,
    /// The selected model; the first one if all are selected.
    pub model: i32,
    /// Counts of the other atoms of the selected models.
    pub left_out: LeftOut,
}

impl Selected {
    /// Returns true if atom `i`, which is meshed, is selected.
    #[must_use]
    pub fn has(&self, i: u32) -> bool {
        self.marks.as_ref().is_none_or(|marks| marks[i as usize])
    }

    /// Returns the number of copies or instances in the assembly.
    #[must_use]
    pub fn n_copies(&self) -> u64 {
        let instances: usize = self.units.iter().map(|unit| unit.operators.len()).sum();
        (self.copies.len() + instances) as u64
    }

    /// Returns the number of selected atoms, including all copies in an assembly.
    #[must_use]
    pub fn n_selected(&self) -> u64 {
        self.atoms.iter().filter(|&&i| self.has(i)).count() as u64
    }

    /// Returns the atoms to mesh as spheres with van der Waals radii.
    ///
    /// # Errors
    /// Returns [`SurfaceError::BadSphere`] if a coordinate is out of range.
    pub fn spheres(&self, structure: &Structure) -> Result<Spheres, SurfaceError> {
        let (n, atoms) = (self.atoms.len(), self.atoms.chunks(ATOMS_PER_TASK));
        let (mut x, mut y, mut z, mut r) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let centres = x.chunks_mut(ATOMS_PER_TASK).zip(y.chunks_mut(ATOMS_PER_TASK)).zip(z.chunks_mut(ATOMS_PER_TASK));
        let mut parts: Vec<_> = atoms.zip(centres).zip(r.chunks_mut(ATOMS_PER_TASK)).collect();
        pieces::map(&mut parts, |((atoms, ((x, y), z)), r)| {
            for (row, i) in atoms.iter().map(|&i| i as usize).enumerate() {
                (x[row], y[row], z[row]) = (structure.x[i], structure.y[i], structure.z[i]);
                r[row] = structure.vdw_radius(i);
            }
        });
        for PlacedCopy { rows, operator } in &self.copies {
            let rows = || rows.clone();
            let moved = (&mut x[rows()], &mut y[rows()], &mut z[rows()]).into_par_iter().with_min_len(ATOMS_PER_TASK);
            moved.for_each(|(x, y, z)| [*x, *y, *z] = operator.apply([*x, *y, *z]));
        }
        Spheres::new(x, y, z, r)
    }

    /// Rejects units with an instance that may lie beyond the range of coordinates, by the corners of its box.
    ///
    /// # Errors
    /// Returns [`StructureError::BadAssembly`].
    pub fn check_instances(&self, spheres: &Spheres, selection: &Selection) -> Result<(), StructureError> {
        for unit in &self.units {
            let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
            for row in unit.rows.clone() {
                bounds = joined_bounds(bounds, [spheres.centre(row); 2]);
            }
            let corners = (0..8).map(|corner| std::array::from_fn(|k| bounds[corner >> k & 1][k]));
            let corners: Vec<[f64; 3]> = corners.collect();
            let images = unit.operators.iter().flat_map(|operator| corners.iter().map(|at| operator.apply(*at)));
            if images.flatten().any(|v| v.abs() > MAX_COORDINATE) {
                return Err(StructureError::BadAssembly {
                    id: selection.assembly.iter().flat_map(|id| id.chars()).take(40).collect(),
                    found: "an instance beyond the range of coordinates".to_owned(),
                    expected: format!("instances within ±{MAX_COORDINATE} Å"),
                });
            }
        }
        Ok(())
    }

    /// Rejects an assembly in which more atoms than allowed have the same position.
    ///
    /// # Errors
    /// Returns [`StructureError::Limit`] and the errors of memory and cancellation.
    pub fn check_duplicates(
        &self,
        spheres: &Spheres,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<(), StructureError> {
        if self.copies.is_empty() {
            // The reader has checked the atoms of the file.
            return Ok(());
        }
        duplicates::check(spheres.len(), |i| (self.model, spheres.centre(i)), &Reading::new(limits, control))
    }
}
