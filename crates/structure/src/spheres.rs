//! Structure of spheres that no file contains: coordinates and radii of a caller.

use molmesh_surface::{Control, Spheres};

use super::atoms::Structure;
use super::error::StructureError;
use super::fields::Rows;
use super::read::{ReadLimits, Reading};
use super::source::{SourceFields, SourceFormat};

/// Returns the structure of one model whose atoms are `spheres`, in their order, without names and elements. As in an
/// XYZ file, all belong to one residue of a polymer, which the default selection takes.
///
/// # Errors
/// Returns the errors of limits, memory and cancellation.
pub fn from_spheres(
    spheres: &Spheres,
    limits: &ReadLimits,
    control: &Control<'_>,
) -> Result<Structure, StructureError> {
    limits.check_atoms(spheres.len())?;
    let reading = Reading::new(limits, control);
    let mut rows = Rows::new(&reading, spheres.len());
    let name = rows.tables.name.number("");
    for i in 0..spheres.len() {
        rows.count_line()?;
        let atom = rows.atom(spheres.centre(i), 0, name, 1);
        rows.push(&atom)?;
    }
    reading.keep(size_of_val(spheres.radii()) as u64)?;
    rows.finish(SourceFields { radii: spheres.radii().to_vec(), ..SourceFields::new(SourceFormat::Xyz) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Selection, select};

    #[test]
    fn the_default_selection_takes_all_spheres_in_their_order() {
        let column = |n: f64| (0..3).map(|i| f64::from(i) * n).collect::<Vec<f64>>();
        let spheres = Spheres::new(column(1.0), column(2.0), column(-3.0), vec![1.0, 2.5, 1.0]).unwrap();
        let structure = from_spheres(&spheres, &ReadLimits::default(), &Control::default()).unwrap();
        let selected = select(&structure, &Selection::default()).unwrap();
        assert_eq!((selected.atoms.as_slice(), selected.left_out.total), (&[0, 1, 2][..], 0));
        assert_eq!(selected.spheres(&structure).unwrap(), spheres);
        assert_eq!(structure.warnings, Vec::<String>::new());
        let few = ReadLimits { max_atoms: 2, ..ReadLimits::default() };
        assert!(matches!(from_spheres(&spheres, &few, &Control::default()), Err(StructureError::Limit(_))));
    }
}
