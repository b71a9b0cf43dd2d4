//! Generated substitutes for unavailable structures, with the same number of atoms in a box of the same size.
//!
//! The grid of the paper consists of whole cubes of 0.4 Å over the bounding box of the atom centres plus a margin of 5
//! Å. This gives the exact number of cubes for the four structures with known coordinates. A number of cubes is
//! therefore a product of three integers. The most even factorization determines the box of the centres.
//!
//! The atoms are on a perturbed cubic lattice as dense as the heavy atoms of proteins, those nearest to the diagonal
//! first. Few atoms in a large box form a rod, like the filaments and chains among the paper's structures.

use molmesh::surface::Spheres;

use crate::error::{Error, Result};
use crate::structures::{self, ATOM_DISTANCE, Random};

/// Side of the paper's cubes, Å.
const CUBE: f64 = 0.4;
/// Margin of the paper's box around the centres, Å.
const MARGIN: f64 = 5.0;
/// Lowest corner of the box, Å. The offset from the grid differs by axis, so that layers of cubes do not appear along
/// all axes at once.
const ORIGIN: [f64; 3] = [11.313, 23.976, 37.149];

/// Generates `n` atoms whose grid has `cubes` cubes. The same arguments give the same atoms.
///
/// # Errors
/// Returns [`Error::Failed`] if `cubes` has no suitable factors, or the box is too small for the atoms.
pub(crate) fn generate(n: usize, cubes: u64) -> Result<Spheres> {
    let sides = sides(cubes).ok_or_else(|| Error::Failed(format!("{cubes} is not the product of three sides")))?;
    spheres(n, sides)
}

/// Returns the sides of the box of the centres for a number of cubes, Å.
fn sides(cubes: u64) -> Option<[f64; 3]> {
    // The margin alone has 25 cubes along each axis.
    const MIN: u64 = 26;
    let mut best: Option<[u64; 3]> = None;
    for x in (MIN..).take_while(|x| x.pow(3) <= cubes).filter(|x| cubes.is_multiple_of(*x)) {
        let rest = cubes / x;
        for y in (x..).take_while(|y| y.pow(2) <= rest).filter(|y| rest.is_multiple_of(*y)) {
            let z = rest / y;
            if best.is_none_or(|[min, _, max]| z * min < max * x) {
                best = Some([x, y, z]);
            }
        }
    }
    // Middle of the range of lengths with this number of whole cubes.
    best.map(|n| n.map(|n| (n as f64 + 0.5) * CUBE - 2.0 * MARGIN))
}

/// Generates `n` atoms in a box. The first two are in opposite corners.
fn spheres(n: usize, sides: [f64; 3]) -> Result<Spheres> {
    let rows = sides.map(|side| (0_u32..).map(|i| f64::from(i) * ATOM_DISTANCE).take_while(move |x| *x <= side));
    let mut points: Vec<(f64, [f64; 3])> = Vec::new();
    for z in rows[2].clone() {
        for y in rows[1].clone() {
            points.extend(rows[0].clone().map(|x| (from_diagonal([x, y, z], sides), [x, y, z])));
        }
    }
    if points.len() + 2 < n {
        return Err(Error::Failed(format!("a box of {sides:.1?} Å is too small for {n} atoms")));
    }
    // The sort is stable: points at the same distance keep their order.
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut random = Random::new(n as u64);
    let corners = [[0.0; 3], sides].into_iter();
    let points = corners.chain(points.into_iter().map(|(_, point)| point)).take(n).enumerate();
    structures::spheres(points.map(|(i, point)| {
        let centre = std::array::from_fn(|k| {
            let offset = 0.5 * ATOM_DISTANCE * random.next();
            ORIGIN[k] + if i < 2 { point[k] } else { (point[k] + offset).clamp(0.0, sides[k]) }
        });
        (centre, random.radius())
    }))
}

/// Returns the squared distance of a point from the diagonal of a box, Å².
fn from_diagonal(point: [f64; 3], sides: [f64; 3]) -> f64 {
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f64>();
    let along = (dot(point, sides) / dot(sides, sides)).clamp(0.0, 1.0);
    (0..3).map(|k| (point[k] - along * sides[k]).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paper::entries::ENTRIES;

    /// Returns the number of cubes of the paper's grid over a box of centres.
    fn cubes(sides: [f64; 3]) -> u64 {
        let whole =
            |side: f64| (1..u32::MAX).take_while(|n| f64::from(*n) * CUBE <= side + 2.0 * MARGIN).count() as u64;
        sides.map(whole).iter().product()
    }

    #[test]
    fn known_structures_have_the_papers_number_of_cubes() {
        // Sides of the boxes of the centres in the files of these entries.
        for (id, sides) in [
            ("110D", [16.379, 15.183, 24.499]),
            ("4PTI", [33.008, 27.174, 32.616]),
            ("1BK2", [24.404, 23.934, 26.014]),
            ("1QL2", [44.685, 53.315, 76.154]),
        ] {
            let entry = ENTRIES.iter().find(|e| e.id == id).unwrap();
            assert_eq!(cubes(sides), entry.cubes[0], "{id}");
            assert_ne!(cubes(sides.map(|s| s + 0.4)), entry.cubes[0], "{id}");
        }
    }

    #[test]
    fn substitutes_have_the_atoms_and_box_of_their_entries() {
        for entry in &ENTRIES {
            let sides = sides(entry.cubes[0]).unwrap();
            assert_eq!(cubes(sides), entry.cubes[0], "{}", entry.id);
            let made = spheres(entry.atoms, sides).unwrap();
            let corners = [ORIGIN, [0, 1, 2].map(|k| ORIGIN[k] + sides[k])];
            assert_eq!((made.len(), made.bounds().unwrap()), (entry.atoms, corners), "{}", entry.id);
            assert_eq!(made, spheres(entry.atoms, sides).unwrap(), "generation is deterministic");
            assert_ne!(made, spheres(entry.atoms + 1, sides).unwrap());
        }
    }

    #[test]
    fn atoms_are_packed_as_in_proteins() {
        let made = spheres(1521, sides(2_578_680).unwrap()).unwrap();
        let near = |i: usize, r: f64| {
            let at = made.centre(i);
            let d2 = |j: usize| (0..3).map(|k| (made.centre(j)[k] - at[k]).powi(2)).sum::<f64>();
            (0..made.len()).filter(|j| *j != i && d2(*j) < r * r).count()
        };
        let mean = |r: f64| (0..made.len()).map(|i| near(i, r)).sum::<usize>() as f64 / made.len() as f64;
        // Atoms do not overlap. In proteins, 30 to 45 atoms are within 6 Å of an atom, fewer at the surface.
        assert!(mean(0.5) < 0.01 && (20.0..47.0).contains(&mean(6.0)), "{} {}", mean(0.5), mean(6.0));
    }

    #[test]
    fn impossible_substitutes_are_rejected() {
        assert!(spheres(1000, [5.0; 3]).unwrap_err().to_string().contains("too small for 1000"));
        // A prime.
        assert!(generate(10, 1_000_003).unwrap_err().to_string().contains("1000003"));
    }
}
