//! Made-up structures in the place of those that are not at hand: as many atoms, in a box of the same size.
//!
//! The paper's grid is known from the four of its structures whose coordinates we have: cubes of 0.4 Å over the box of the atoms'
//! centres with 5 Å around it, whole cubes only, give its number of cubes exactly. So a number of cubes is the product of three whole
//! numbers; of all such triples the most even one is taken, and it gives the box of the centres. In the box the atoms lie on a
//! shaken cubic lattice as dense as the heavy atoms of proteins, those nearest to the diagonal first: small numbers of atoms in
//! large boxes become rods, as the filaments and chains among the paper's structures are, larger ones become plump.

use molmesh::surface::Spheres;

use super::super::cases::{SIDE, Shake, radius};

/// The paper's cube, Å.
const CUBE: f64 = 0.4;
/// What the paper's box leaves around the centres on each side, Å.
const AROUND: f64 = 5.0;

/// Sides of the box of centres that has so many cubes, Å; none where the number is no product of three sensible sides.
pub(super) fn sides(cubes: u64) -> Option<[f64; 3]> {
    // A box that is all margin has 25 cubes along each axis.
    const LEAST: u64 = 26;
    let mut best: Option<[u64; 3]> = None;
    for x in (LEAST..).take_while(|x| x.pow(3) <= cubes).filter(|x| cubes.is_multiple_of(*x)) {
        let rest = cubes / x;
        for y in (x..).take_while(|y| y.pow(2) <= rest).filter(|y| rest.is_multiple_of(*y)) {
            let z = rest / y;
            if best.is_none_or(|[least, _, most]| z * least < most * x) {
                best = Some([x, y, z]);
            }
        }
    }
    // In the middle of the lengths that give this number of whole cubes.
    best.map(|n| n.map(|n| (n as f64 + 0.5) * CUBE - 2.0 * AROUND))
}

/// Where the box lies, Å: anywhere, but not at one place of the grid along all axes, or layers of cubes would come and go along
/// all of them at once.
const ORIGIN: [f64; 3] = [11.313, 23.976, 37.149];

/// `n` atoms in a box of these sides, one in the first and one in the last corner. The same arguments give the same atoms.
///
/// # Errors
/// In words, where the box has no room for so many.
pub(super) fn spheres(n: usize, sides: [f64; 3]) -> Result<Spheres, String> {
    let rows = sides.map(|side| (0_u32..).map(|i| f64::from(i) * SIDE).take_while(move |x| *x <= side));
    let mut places: Vec<(f64, [f64; 3])> = Vec::new();
    for z in rows[2].clone() {
        for y in rows[1].clone() {
            places.extend(rows[0].clone().map(|x| (from_diagonal([x, y, z], sides), [x, y, z])));
        }
    }
    let inner = n.saturating_sub(2);
    if places.len() < inner {
        return Err(format!("a box of {sides:.1?} Å has no room for {n} atoms"));
    }
    // A stable sort: places at one distance keep their order.
    places.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut shake = Shake::new(n as u64);
    let corners = [[0.0; 3], sides];
    let (mut columns, mut radii) = ([const { Vec::new() }; 3], Vec::new());
    for (i, place) in corners.into_iter().chain(places.into_iter().map(|(_, place)| place)).take(n).enumerate() {
        for k in 0..3 {
            let off = 0.5 * SIDE * shake.next();
            columns[k].push(ORIGIN[k] + if i < 2 { place[k] } else { (place[k] + off).clamp(0.0, sides[k]) });
        }
        radii.push(radius(shake.next() + 0.5));
    }
    let [x, y, z] = columns;
    Spheres::new(x, y, z, radii).map_err(|e| e.to_string())
}

/// Squared distance of a point from the diagonal of a box, Å².
fn from_diagonal(point: [f64; 3], sides: [f64; 3]) -> f64 {
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f64>();
    let along = (dot(point, sides) / dot(sides, sides)).clamp(0.0, 1.0);
    (0..3).map(|k| (point[k] - along * sides[k]).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::super::entries::ENTRIES;
    use super::*;

    /// Cubes of the paper's grid over a box of centres.
    fn cubes(sides: [f64; 3]) -> u64 {
        let whole =
            |side: f64| (1..u32::MAX).take_while(|n| f64::from(*n) * CUBE <= side + 2.0 * AROUND).count() as u64;
        sides.map(whole).iter().product()
    }

    #[test]
    fn the_papers_grid_is_that_of_the_structures_at_hand() {
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
    fn every_entry_has_a_stand_in_with_its_atoms_and_its_box() {
        for entry in &ENTRIES {
            let sides = sides(entry.cubes[0]).unwrap();
            assert_eq!(cubes(sides), entry.cubes[0], "{}", entry.id);
            let made = spheres(entry.atoms, sides).unwrap();
            let corners = [ORIGIN, [0, 1, 2].map(|k| ORIGIN[k] + sides[k])];
            assert_eq!((made.len(), made.bounds().unwrap()), (entry.atoms, corners), "{}", entry.id);
            assert_eq!(made, spheres(entry.atoms, sides).unwrap(), "the same every time");
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
        // None on top of another; within 6 Å of an atom of a protein are some 30 to 45 others, fewer at its surface.
        assert!(mean(0.5) < 0.01 && (20.0..47.0).contains(&mean(6.0)), "{} {}", mean(0.5), mean(6.0));
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        assert!(spheres(1000, [5.0; 3]).unwrap_err().contains("no room for 1000"));
        // A prime.
        assert_eq!(sides(1_000_003), None);
    }
}
