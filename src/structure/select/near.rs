//! Atoms near other atoms, on a uniform grid.
//!
//! The result equals that of testing `dx² + dy² + dz² ≤ d²` in double precision for all pairs: the bounds of a cell are
//! tested with the same operations, which are monotone.

use rayon::prelude::*;

use crate::structure::read::check;
use crate::structure::{Structure, StructureError};
use crate::surface::{Control, MemoryMeter as _, Reservation};

type Point = [f64; 3];

/// Number of atoms that a thread tests between two checks of the cancellation flag.
const ATOMS_PER_TASK: usize = 4096;
/// The grid has at most `MIN_CELLS + CELLS_PER_ATOM · n` cells for `n` atoms.
const CELLS_PER_ATOM: f64 = 4.0;
const MIN_CELLS: f64 = 4096.0;
/// Distance above which cells are half as long as the distance, Å.
const LONG_DISTANCE: f64 = 8.0;
/// Number of points up to which testing all points of a cell is faster than testing its bounds.
const FEW_POINTS: usize = 16;
/// Margin of the distance when cells are chosen, Å. It exceeds all rounding of coordinates.
const SLACK: f64 = 1e-6;

/// Marks every atom whose distance to an atom of `of` in the same model is at most `distance`. Atoms of `of` belong to
/// one model.
pub(super) fn mark(
    structure: &Structure,
    of: &[bool],
    distance: f64,
    marks: &mut [bool],
    control: &Control<'_>,
) -> Result<(), StructureError> {
    let Some(first) = of.iter().position(|&mark| mark) else { return Ok(()) };
    let model = structure.model[first];
    let memory = Reservation::new(&control.memory);
    let grid = Grid::new(structure, of, distance, &memory, control)?;
    marks.par_chunks_mut(ATOMS_PER_TASK).enumerate().try_for_each(|(part, marks)| {
        check(control)?;
        for (i, mark) in (ATOMS_PER_TASK * part..).zip(marks) {
            *mark = structure.model[i] == model && grid.is_near(position(structure, i));
        }
        Ok(())
    })
}

fn position(structure: &Structure, i: usize) -> Point {
    [structure.x[i], structure.y[i], structure.z[i]]
}

/// Lowest and highest coordinates.
#[derive(Debug, Clone, Copy)]
struct Bounds {
    low: Point,
    high: Point,
}

impl Bounds {
    const NONE: Self = Self { low: [f64::INFINITY; 3], high: [f64::NEG_INFINITY; 3] };

    fn add(&mut self, point: Point) {
        self.low = std::array::from_fn(|k| self.low[k].min(point[k]));
        self.high = std::array::from_fn(|k| self.high[k].max(point[k]));
    }

    /// Returns the least and greatest squared distance between `point` and points in the box.
    fn distances2(&self, point: Point) -> [f64; 2] {
        let ends: [[f64; 2]; 3] = std::array::from_fn(|k| [point[k] - self.low[k], point[k] - self.high[k]]);
        let least = ends.map(|[from_low, from_high]| (-from_low).max(from_high).max(0.0));
        let greatest = ends.map(|[from_low, from_high]| from_low.abs().max(from_high.abs()));
        [least, greatest].map(square)
    }
}

/// Rounds down; negative numbers become 0.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
fn whole(v: f64) -> usize {
    v as usize
}

fn square([x, y, z]: Point) -> f64 {
    x * x + y * y + z * z
}

/// Points in the cells of a uniform grid.
struct Grid {
    distance: f64,
    distance2: f64,
    low: Point,
    cell: f64,
    n: [usize; 3],
    /// Number of each cell among the occupied ones, from 1; 0 for empty cells.
    slots: Vec<u32>,
    /// Bounds of the points in each occupied cell.
    bounds: Vec<Bounds>,
    /// Index of the first point of each occupied cell; the last element is the number of points.
    first: Vec<u32>,
    points: Vec<Point>,
}

impl Grid {
    /// Sorts the marked atoms, at least one, into cells.
    fn new(
        structure: &Structure,
        marked: &[bool],
        distance: f64,
        memory: &Reservation,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let atoms = || (0..structure.len()).filter(|&i| marked[i]).map(|i| position(structure, i));
        let (mut all, mut n_points) = (Bounds::NONE, 0_usize);
        atoms().for_each(|point| {
            all.add(point);
            n_points += 1;
        });
        let size: Point = std::array::from_fn(|k| all.high[k] - all.low[k]);
        let sides = |cell: f64| size.map(|side| (side / cell).floor() + 1.0);
        let most = MIN_CELLS + CELLS_PER_ATOM * n_points as f64;
        // Large cells have many points. In cells smaller than the distance, testing the bounds settles most of them.
        let mut cell = if distance > LONG_DISTANCE { 0.5 * distance } else { distance };
        while sides(cell).iter().product::<f64>() > most {
            cell *= 1.25;
        }
        let n = sides(cell).map(whole);
        let n_cells = n.iter().product::<usize>();
        // There are at most as many occupied cells as points.
        memory.grow((4 * n_cells + n_points * (size_of::<Bounds>() + size_of::<Point>() + 8)) as u64)?;
        let mut grid = Self {
            distance,
            distance2: distance * distance,
            low: all.low,
            cell,
            n,
            slots: vec![0; n_cells],
            bounds: Vec::new(),
            first: Vec::new(),
            points: vec![[0.0; 3]; n_points],
        };
        check(control)?;
        let (mut counts, mut n_slots): (Vec<u32>, u32) = (Vec::new(), 0);
        for point in atoms() {
            let index = grid.index(grid.cell_of(point));
            if grid.slots[index] == 0 {
                grid.bounds.push(Bounds::NONE);
                counts.push(0);
                n_slots += 1;
                grid.slots[index] = n_slots;
            }
            let slot = grid.slots[index] as usize - 1;
            grid.bounds[slot].add(point);
            counts[slot] += 1;
        }
        check(control)?;
        let mut total = 0;
        for count in &mut counts {
            grid.first.push(total);
            total += std::mem::replace(count, total);
        }
        grid.first.push(total);
        // Each count is now the index of the next free place.
        for point in atoms() {
            let slot = grid.slots[grid.index(grid.cell_of(point))] as usize - 1;
            grid.points[counts[slot] as usize] = point;
            counts[slot] += 1;
        }
        check(control)?;
        Ok(grid)
    }

    /// Returns the cell of a point, or the nearest one if it is outside.
    fn cell_of(&self, point: Point) -> [usize; 3] {
        std::array::from_fn(|k| whole((point[k] - self.low[k]) / self.cell).min(self.n[k] - 1))
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.n[1] + y) * self.n[0] + x
    }

    /// Returns true if a point of the grid is within the distance.
    fn is_near(&self, point: Point) -> bool {
        let reach = self.distance + SLACK;
        let outside = (0..3).any(|k| {
            let beyond = self.n[k] as f64 * self.cell + reach;
            !(-reach..=beyond).contains(&(point[k] - self.low[k]))
        });
        if outside {
            return false;
        }
        // A point in the same cell is almost always within the distance.
        if self.holds_near(self.cell_of(point), point) {
            return true;
        }
        let from = self.cell_of(point.map(|v| v - reach));
        let to = self.cell_of(point.map(|v| v + reach));
        (from[2]..=to[2])
            .any(|z| (from[1]..=to[1]).any(|y| (from[0]..=to[0]).any(|x| self.holds_near([x, y, z], point))))
    }

    /// Returns true if a point in `cell` is within the distance.
    fn holds_near(&self, cell: [usize; 3], point: Point) -> bool {
        let slot = self.slots[self.index(cell)] as usize;
        if slot == 0 {
            return false;
        }
        let points = &self.points[self.first[slot - 1] as usize..self.first[slot] as usize];
        if points.len() > FEW_POINTS {
            let [least, greatest] = self.bounds[slot - 1].distances2(point);
            if least > self.distance2 || greatest <= self.distance2 {
                return greatest <= self.distance2;
            }
        }
        points.iter().any(|other| square(std::array::from_fn(|k| point[k] - other[k])) <= self.distance2)
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;
    use crate::structure::{ReadLimits, read};

    /// Returns atoms at these positions, given in units of 0.001 Å.
    fn atoms(places: &[[i32; 3]]) -> Structure {
        let rows: String = places
            .iter()
            .map(|place| {
                let [x, y, z] = place.map(|v| f64::from(v) / 1000.0);
                format!("ATOM C {x:.3} {y:.3} {z:.3}\n")
            })
            .collect();
        let items = ["group_PDB", "type_symbol", "Cartn_x", "Cartn_y", "Cartn_z"];
        let tags: String = items.iter().map(|item| format!("_atom_site.{item}\n")).collect();
        read(format!("data_x\nloop_\n{tags}{rows}").as_bytes(), &ReadLimits::default()).unwrap()
    }

    fn near(s: &Structure, of: &[bool], distance: f64) -> Vec<bool> {
        let mut marks = vec![false; s.len()];
        mark(s, of, distance, &mut marks, &Control::default()).unwrap();
        marks
    }

    #[test]
    fn marks_are_those_of_all_pairs_at_every_scale() {
        let mut random = 3_u64;
        let mut next = |side: i32| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) as i32 % side
        };
        // Dense, sparse, flat, on a lattice with exact distances, and far apart.
        let sides = [[9_000; 3], [80_000; 3], [60_000, 60_000, 1], [12; 3], [90_000_000; 3]];
        for (i, [x, y, z]) in sides.into_iter().enumerate() {
            let unit = if i == 3 { 1000 } else { 1 };
            let mut place = || [unit * next(x), unit * next(y), unit * next(z)];
            let places: Vec<[i32; 3]> = (0..700).map(|_| place()).collect();
            let s = atoms(&places);
            for share in [1, 7, 350] {
                let of: Vec<bool> = (0..s.len()).map(|i| i % share == 0).collect();
                for distance in [0.001, 1.0, 2.0, 3.75, 5.0, 20.0, 50.0] {
                    let is_near = |i: usize| {
                        let apart = |j: usize| {
                            let [x, y, z] = [&s.x, &s.y, &s.z].map(|c| c[i] - c[j]);
                            x * x + y * y + z * z
                        };
                        (0..s.len()).any(|j| of[j] && apart(j) <= distance * distance)
                    };
                    let expected: Vec<bool> = (0..s.len()).map(is_near).collect();
                    assert_eq!(near(&s, &of, distance), expected, "case {i}, every {share}th, {distance} Å");
                }
            }
        }
    }

    #[test]
    fn no_marks_give_no_marks() {
        let s = atoms(&[[0; 3], [1; 3]]);
        assert_eq!(near(&s, &[false; 2], 50.0), [false; 2]);
    }

    /// Two dense clusters slightly farther apart than the distance: the worst case for a grid.
    #[test]
    fn distant_crowds_are_compared_by_their_bounds() {
        let places: Vec<[i32; 3]> =
            (0..200_000).map(|i| [i % 100 + if i % 2 == 0 { 0 } else { 50_100 }, i / 100 % 100, i / 10_000]).collect();
        let s = atoms(&places);
        let of: Vec<bool> = (0..s.len()).map(|i| i % 2 == 0).collect();
        let start = std::time::Instant::now();
        assert_eq!(near(&s, &of, 50.0), of);
        // The grid takes milliseconds; comparing all pairs takes minutes.
        assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
    }
}
