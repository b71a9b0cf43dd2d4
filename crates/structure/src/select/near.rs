//! Atoms near other atoms, on a uniform grid.
//!
//! The result equals that of testing `dx² + dy² + dz² ≤ d²` in double precision for all pairs. The bounds of a cell are
//! tested with the same operations; rounding keeps their order.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use indexmap::IndexMap;
use molmesh_surface::groups::{GroupCounts, Groups};
use molmesh_surface::vector::{dot, joined_bounds, squared_distance, sub};
use molmesh_surface::{Control, Exceeded, Limit, MemoryMeter as _, Reservation};
use rayon::prelude::*;

use crate::altloc::ATOMS_PER_CHECK;
use crate::read::{ReadLimits, check, check_every};
use crate::{Structure, StructureError};

type Point = [f64; 3];

/// Number of atoms that a task tests.
const ATOMS_PER_TASK: usize = 4096;
/// Number of tested distances between two checks of limit and cancellation: they take less than 0.1 ms.
const TESTS_PER_CHECK: usize = 1 << 15;
/// The grid has at most `MIN_CELLS + CELLS_PER_ATOM · n` cells for `n` atoms.
const CELLS_PER_ATOM: f64 = 4.0;
const MIN_CELLS: f64 = 4096.0;
/// Distance above which cells are half as long as the distance, Å.
const LONG_DISTANCE: f64 = 8.0;
/// Number of points of a cell up to which testing all of them is faster than testing its bounds.
const MAX_TESTED_POINTS: usize = 16;
/// Margin of the distance when cells are chosen, Å. It exceeds all rounding of coordinates.
const SLACK: f64 = 1e-6;
/// Margin of the squared distance, Å². Squared distances between coordinates with three decimals are multiples of 1e-6
/// Å², so this decides ties exactly in spite of rounding.
const TIE: f64 = 5e-7;

/// Marks every atom whose distance to an atom of `of` in the same model is at most `distance`. The time is linear if
/// the atoms of each model are consecutive, as all common programs write them.
pub(super) fn mark(
    structure: &Structure,
    of: &[bool],
    distance: f64,
    marks: &mut [bool],
    tests: &TestCount,
    control: &Control<'_>,
) -> Result<(), StructureError> {
    let mut models: IndexMap<i32, Range<usize>> = IndexMap::new();
    let mut first = 0;
    for run in structure.model.chunk_by(|a, b| a == b) {
        let rows = first..first + run.len();
        models.entry(run[0]).or_insert_with(|| rows.clone()).end = rows.end;
        first = rows.end;
    }
    for (model, rows) in models {
        check(control)?;
        let is_of = |i: usize| of[i] && structure.model[i] == model;
        if !rows.clone().any(is_of) {
            continue;
        }
        let memory = Reservation::new(&control.memory);
        let grid = PointGrid::new(structure, rows.clone(), is_of, distance, &memory, control)?;
        marks[rows.clone()].par_chunks_mut(ATOMS_PER_TASK).enumerate().try_for_each(|(part, marks)| {
            let mut tests = Tests { count: tests, control, uncounted: 0 };
            for (i, mark) in (rows.start + ATOMS_PER_TASK * part..).zip(marks) {
                if structure.model[i] == model {
                    *mark = grid.is_near(position(structure, i), &mut tests)?;
                }
            }
            tests.count()
        })?;
    }
    Ok(())
}

/// Number of tested distances, which determines the time of a selection.
pub(super) struct TestCount {
    so_far: AtomicU64,
    limit: u64,
}

impl TestCount {
    /// Starts at 0.
    pub(super) fn new(limits: &ReadLimits) -> Self {
        Self { so_far: AtomicU64::new(0), limit: limits.max_distances }
    }
}

/// Tests of distances by one thread.
struct Tests<'a> {
    count: &'a TestCount,
    control: &'a Control<'a>,
    /// Number of tests that `count` does not include yet.
    uncounted: usize,
}

impl Tests<'_> {
    /// Adds `n` tests. Checks limit and cancellation from time to time.
    #[inline]
    fn add(&mut self, n: usize) -> Result<(), StructureError> {
        self.uncounted += n;
        if self.uncounted < TESTS_PER_CHECK { Ok(()) } else { self.count() }
    }

    /// Counts the tests so far, so that their total does not depend on threads.
    fn count(&mut self) -> Result<(), StructureError> {
        check(self.control)?;
        let (TestCount { so_far, limit }, new) = (self.count, std::mem::take(&mut self.uncounted) as u64);
        let tests = so_far.fetch_add(new, Ordering::Relaxed) + new;
        if tests <= *limit { Ok(()) } else { Err(Exceeded::new(Limit::Distances, *limit).error()) }
    }
}

fn position(structure: &Structure, i: usize) -> Point {
    [structure.x[i], structure.y[i], structure.z[i]]
}

/// Lowest and highest coordinates.
#[derive(Debug, Clone, Copy)]
struct PointBox {
    low: Point,
    high: Point,
}

impl PointBox {
    const NONE: Self = Self { low: [f64::INFINITY; 3], high: [f64::NEG_INFINITY; 3] };

    fn add(&mut self, point: Point) {
        [self.low, self.high] = joined_bounds([self.low, self.high], [point; 2]);
    }

    /// Returns the minimum and maximum squared distance between `point` and points in the box.
    fn distances2(&self, point: Point) -> [f64; 2] {
        let ends: [[f64; 2]; 3] = std::array::from_fn(|k| [point[k] - self.low[k], point[k] - self.high[k]]);
        let least = ends.map(|[from_low, from_high]| (-from_low).max(from_high).max(0.0));
        let greatest = ends.map(|[from_low, from_high]| from_low.abs().max(from_high.abs()));
        [least, greatest].map(|gap| dot(gap, gap))
    }
}

/// Rounds down; negative numbers become 0.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
fn whole(v: f64) -> usize {
    v as usize
}

/// Points in the cells of a uniform grid.
struct PointGrid {
    /// Distance beyond which a cell holds no near point, Å.
    reach: f64,
    /// Maximum squared distance of a near point, Å².
    distance2: f64,
    low: Point,
    cell: f64,
    n: [usize; 3],
    /// Number of each cell among the occupied ones, from 1; 0 for empty cells.
    slots: Vec<u32>,
    /// Bounds of the points in each occupied cell.
    bounds: Vec<PointBox>,
    /// Points of each occupied cell.
    points: Groups<Point>,
}

impl PointGrid {
    /// Sorts the atoms among `rows` for which `is_of` is true into cells. There is at least one.
    fn new(
        structure: &Structure,
        rows: Range<usize>,
        is_of: impl Fn(usize) -> bool,
        distance: f64,
        memory: &Reservation,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let atoms = || rows.clone().filter(|&i| is_of(i)).map(|i| position(structure, i));
        let (mut all, mut n_points) = (PointBox::NONE, 0_usize);
        for point in atoms() {
            check_every(control, n_points, ATOMS_PER_CHECK)?;
            all.add(point);
            n_points += 1;
        }
        let size = sub(all.high, all.low);
        let sides = |cell: f64| size.map(|side| (side / cell).floor() + 1.0);
        let most = MIN_CELLS + CELLS_PER_ATOM * n_points as f64;
        // Large cells have many points. If cells are smaller than the distance, testing the bounds is enough for most
        // cells.
        let mut cell = if distance > LONG_DISTANCE { 0.5 * distance } else { distance };
        while sides(cell).iter().product::<f64>() > most {
            cell *= 1.25;
        }
        let n = sides(cell).map(whole);
        let n_cells = n.iter().product::<usize>();
        // There are at most as many occupied cells as points.
        memory.grow((4 * n_cells + n_points * (size_of::<PointBox>() + size_of::<Point>() + 8)) as u64)?;
        let mut grid = Self {
            reach: (distance * distance + TIE).sqrt() + SLACK,
            distance2: distance * distance + TIE,
            low: all.low,
            cell,
            n,
            slots: vec![0; n_cells],
            bounds: Vec::new(),
            points: Groups::default(),
        };
        let (mut counts, mut n_slots) = (GroupCounts::new(0), 0);
        for (n, point) in atoms().enumerate() {
            check_every(control, n, ATOMS_PER_CHECK)?;
            let index = grid.index(grid.cell_of(point));
            if grid.slots[index] == 0 {
                grid.bounds.push(PointBox::NONE);
                counts.push_group();
                n_slots += 1;
                grid.slots[index] = n_slots;
            }
            let slot = grid.slots[index] as usize - 1;
            grid.bounds[slot].add(point);
            counts.add(slot);
        }
        grid.points = counts.groups();
        for (n, point) in atoms().enumerate() {
            check_every(control, n, ATOMS_PER_CHECK)?;
            let slot = grid.slots[grid.index(grid.cell_of(point))] as usize - 1;
            grid.points.push(slot, point);
        }
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
    fn is_near(&self, point: Point, tests: &mut Tests<'_>) -> Result<bool, StructureError> {
        let reach = self.reach;
        let outside = (0..3).any(|k| {
            let beyond = self.n[k] as f64 * self.cell + reach;
            !(-reach..=beyond).contains(&(point[k] - self.low[k]))
        });
        if outside {
            return Ok(false);
        }
        // A point in the same cell is almost always within the distance.
        if self.holds_near(self.cell_of(point), point, tests)? {
            return Ok(true);
        }
        let from = self.cell_of(point.map(|v| v - reach));
        let to = self.cell_of(point.map(|v| v + reach));
        for z in from[2]..=to[2] {
            for y in from[1]..=to[1] {
                for x in from[0]..=to[0] {
                    if self.holds_near([x, y, z], point, tests)? {
                        return Ok(true);
                    }
                }
            }
        }
        Ok(false)
    }

    /// Returns true if a point in `cell` is within the distance.
    fn holds_near(&self, cell: [usize; 3], point: Point, tests: &mut Tests<'_>) -> Result<bool, StructureError> {
        let slot = self.slots[self.index(cell)] as usize;
        tests.add(1)?;
        if slot == 0 {
            return Ok(false);
        }
        let points = self.points.get(slot - 1);
        if points.len() > MAX_TESTED_POINTS {
            let [least, greatest] = self.bounds[slot - 1].distances2(point);
            if least > self.distance2 || greatest <= self.distance2 {
                return Ok(greatest <= self.distance2);
            }
        }
        let is_near = |other: &Point| squared_distance(point, *other) <= self.distance2;
        for points in points.chunks(TESTS_PER_CHECK) {
            let found = points.iter().position(is_near);
            tests.add(found.unwrap_or(points.len()))?;
            if found.is_some() {
                return Ok(true);
            }
        }
        Ok(false)
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use molmesh_surface::CancelToken;

    use super::*;
    use crate::read;

    /// Returns atoms at these positions, given in units of 0.001 Å.
    fn atoms(positions: &[[i32; 3]]) -> Structure {
        let rows: String = positions
            .iter()
            .map(|position| {
                let [x, y, z] = position.map(|v| f64::from(v) / 1000.0);
                format!("ATOM C {x:.3} {y:.3} {z:.3}\n")
            })
            .collect();
        let items = ["group_PDB", "type_symbol", "Cartn_x", "Cartn_y", "Cartn_z"];
        let tags: String = items.iter().map(|item| format!("_atom_site.{item}\n")).collect();
        read(format!("data_x\nloop_\n{tags}{rows}").as_bytes(), &ReadLimits::default()).unwrap()
    }

    fn near(s: &Structure, of: &[bool], distance: f64) -> Vec<bool> {
        let mut marks = vec![false; s.len()];
        let tests = TestCount::new(&ReadLimits::default());
        mark(s, of, distance, &mut marks, &tests, &Control::default()).unwrap();
        marks
    }

    #[test]
    fn ties_are_near() {
        for first in (0..4000).step_by(101) {
            let s = atoms(&[[first, 0, 0], [first + 1900, 0, 0], [first + 3801, 0, 0]]);
            assert_eq!(near(&s, &[true, false, false], 1.9), [true, true, false], "{first}");
            assert_eq!(near(&s, &[false, true, false], 1.9), [true, true, false], "{first}");
        }
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
            let mut point = || [unit * next(x), unit * next(y), unit * next(z)];
            let positions: Vec<[i32; 3]> = (0..700).map(|_| point()).collect();
            let s = atoms(&positions);
            for share in [1, 7, 350] {
                let of: Vec<bool> = (0..s.len()).map(|i| i % share == 0).collect();
                for thousandths in [1, 1_000, 1_900, 2_000, 3_750, 5_000, 20_000, 50_000] {
                    let distance = f64::from(thousandths) / 1000.0;
                    let is_near = |i: usize| {
                        // Exact, in units of 0.001 Å.
                        let apart = |j: usize| -> i64 {
                            let (a, b) = (positions[i], positions[j]);
                            (0..3).map(|k| i64::from(a[k] - b[k]).pow(2)).sum()
                        };
                        (0..s.len()).any(|j| of[j] && apart(j) <= i64::from(thousandths).pow(2))
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

    /// Two dense clusters around the distance: every cell has near and distant points.
    #[test]
    fn the_tests_of_clusters_are_limited_and_stop_at_cancellation() {
        let side = 100_000;
        let point = |i: i32| [(i % 2) * 50_000 + i / 2 % 100, i / 200 % 100, i / 20_000];
        let s = atoms(&(0..side).map(point).collect::<Vec<_>>());
        let of: Vec<bool> = (0..s.len()).map(|i| i % 2 == 0).collect();
        let run = |max_distances: u64, control: &Control<'_>| {
            let tests = TestCount::new(&ReadLimits { max_distances, ..ReadLimits::default() });
            let marked = mark(&s, &of, 49.95, &mut vec![false; s.len()], &tests, control);
            (marked, tests.so_far.into_inner())
        };
        let (limited, tests) = run(1_000_000, &Control::default());
        assert_eq!(limited, Err(Exceeded::new(Limit::Distances, 1_000_000).error()));
        // Each thread stops at its next check.
        let threads = rayon::current_num_threads() as u64;
        assert!(tests <= 1_000_000 + threads * (2 * TESTS_PER_CHECK as u64 + 1), "{tests}");
        let cancel = CancelToken::default();
        cancel.cancel();
        let (cancelled, tests) = run(u64::MAX, &Control { cancel, ..Control::default() });
        assert_eq!((cancelled, tests), (Err(StructureError::Cancelled), 0));
    }

    /// Two dense clusters slightly farther apart than the distance: the worst case for a grid.
    #[test]
    fn distant_clusters_are_compared_by_their_bounds() {
        let positions: Vec<[i32; 3]> =
            (0..200_000).map(|i| [i % 100 + if i % 2 == 0 { 0 } else { 50_100 }, i / 100 % 100, i / 10_000]).collect();
        let s = atoms(&positions);
        let of: Vec<bool> = (0..s.len()).map(|i| i % 2 == 0).collect();
        let start = std::time::Instant::now();
        assert_eq!(near(&s, &of, 50.0), of);
        // The grid takes milliseconds; comparing all pairs takes minutes.
        assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
    }
}
