//! Connected regions of grid points, and their measures.

use rayon::prelude::*;

use super::bits::{BitGrid, Element, Run};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::to_u32;
use crate::memory::{MemoryMeter, Reservation};
use crate::union_find::UnionFind;

/// Memory of a run, its regions and numbers while regions are found, bytes.
const RUN_BYTES: u64 = 40;
/// Memory of a point whose depth is measured, in a list that may double, bytes.
const POINT_BYTES: u64 = 24;
/// Runs of a task.
const RUNS: usize = 1 << 10;
/// Points between two checks for cancellation.
const POINTS_PER_CHECK: usize = 1 << 8;
/// Number of a region that is too small.
const DROPPED: u32 = u32::MAX;

/// Area in squares of the spacing for each pair of a point and a neighbour beyond the boundary, by the number of axes
/// along which the neighbour lies: twice the weight of the direction divided by the length of the step (formula of
/// Crofton with 13 directions; Legland, Kiêu and Devaux, Image Analysis and Stereology 26, 2007).
const AREAS: [f64; 3] = [0.183_111_6, 0.104_597_1, 0.081_280_9];

/// Regions of points that are connected by their faces, edges or corners, largest first.
#[derive(Debug)]
pub(super) struct Regions {
    /// Runs with the number of their region, row by row.
    runs: Vec<(Run, u32)>,
    /// Index of the first run of each row, and the number of runs.
    starts: Vec<u32>,
    size: [usize; 3],
    /// Number of regions.
    n: usize,
    _memory: Reservation,
}

/// Measures of a region. Lengths are in spacings.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Region {
    pub(super) points: u64,
    /// Sum of the coordinates of the points.
    pub(super) sums: [u64; 3],
    /// Number of pairs of a point and a neighbour in the molecule, by the number of axes along which it lies.
    pairs: [u64; 3],
    /// Area of the boundary with the molecule.
    pub(super) area: f64,
    /// Squared distance of the deepest point from the openings.
    pub(super) depth2: u64,
    pub(super) openings: u32,
}

impl Regions {
    /// Finds the regions of a set that have at least `min_points` points.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn new(set: &BitGrid, min_points: f64, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let n_rows = set.n_rows();
        let memory = control.reserve(RUN_BYTES * set.n_runs() as u64 + 4 * n_rows as u64)?;
        let runs: Vec<(Run, u32)> = set.runs().into_iter().map(|run| (run, DROPPED)).collect();
        let starts = starts(&runs, n_rows);
        let mut found = Self { runs, starts, size: set.size, n: 0, _memory: memory };
        let ny = set.size[1];
        let mut joined = UnionFind::new(found.runs.len());
        for (i, (run, _)) in found.runs.iter().enumerate() {
            control.check_every(i, RUNS)?;
            let row = run.row as usize;
            let (y, z) = (row % ny, row / ny);
            let before = (z > 0).then(|| (y.saturating_sub(1)..(y + 2).min(ny)).map(|y| (z - 1) * ny + y));
            let own = (y > 0).then(|| row - 1);
            for other in before.into_iter().flatten().chain(own) {
                let ends = [(run.first as usize).saturating_sub(1), run.last as usize + 1];
                for j in found.overlapping(other, ends) {
                    joined.union(to_u32(i), to_u32(j));
                }
            }
        }
        let mut numbers = Vec::new();
        let mut points = vec![0_u64; joined.number_sets(&mut numbers) as usize];
        for ((run, _), number) in found.runs.iter().zip(&numbers) {
            points[*number as usize] += u64::from(run.last - run.first + 1);
        }
        let mut order: Vec<usize> = (0..points.len()).filter(|i| points[*i] as f64 >= min_points).collect();
        // The sort is stable: regions of equal size stay in the order of their first rows.
        order.sort_by_key(|i| std::cmp::Reverse(points[*i]));
        let mut ranks = vec![DROPPED; points.len()];
        for (rank, number) in (0..).zip(&order) {
            ranks[*number] = rank;
        }
        for ((_, region), number) in found.runs.iter_mut().zip(&numbers) {
            *region = ranks[*number as usize];
        }
        found.runs.retain(|(_, region)| *region != DROPPED);
        found.starts = self::starts(&found.runs, n_rows);
        found.n = order.len();
        Ok(found)
    }

    /// Returns the indices of the runs of a row that contain a point from the first to the last.
    fn overlapping(&self, row: usize, [first, last]: [usize; 2]) -> std::ops::Range<usize> {
        let (start, end) = (self.starts[row] as usize, self.starts[row + 1] as usize);
        let runs = &self.runs[start..end];
        let from = runs.partition_point(|(run, _)| (run.last as usize) < first);
        let n = runs[from..].iter().take_while(|(run, _)| run.first as usize <= last).count();
        start + from..start + from + n
    }

    /// Returns the regions that contain a point of a row from the first to the last.
    pub(super) fn touched(&self, row: usize, ends: [usize; 2]) -> impl Iterator<Item = u32> {
        self.runs[self.overlapping(row, ends)].iter().map(|(_, region)| *region)
    }

    /// Returns the region of the nearest of all points that are at most `most` from `point`.
    pub(super) fn nearest(&self, point: [f64; 3], most: f64) -> Option<u32> {
        let [nx, ny, nz] = self.size;
        let mut found: Option<(f64, u32)> = None;
        for z in super::range(point[2], most, nz) {
            for y in super::range(point[1], most, ny) {
                let of_row = (y as f64 - point[1]).powi(2) + (z as f64 - point[2]).powi(2);
                let across = super::range(point[0], (most * most - of_row).max(0.0).sqrt(), nx);
                if across.is_empty() || of_row > most * most {
                    continue;
                }
                for (run, region) in &self.runs[self.overlapping(z * ny + y, [across.start, across.end - 1])] {
                    let x = point[0].round().clamp(f64::from(run.first), f64::from(run.last));
                    let distance2 = of_row + (x - point[0]).powi(2);
                    if distance2 <= most * most && found.is_none_or(|best| (distance2, *region) < best) {
                        found = Some((distance2, *region));
                    }
                }
            }
        }
        found.map(|(_, region)| region)
    }

    /// Measures the regions, which are parts of `set`. `outside` contains the points outside the molecule.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn measure(
        &self,
        outside: &BitGrid,
        set: BitGrid,
        control: &Control<'_>,
    ) -> Result<Vec<Region>, SurfaceError> {
        let mut regions = vec![Region::default(); self.n];
        let add = |runs: &[(Run, u32)]| {
            control.check()?;
            Ok(runs.iter().map(|(run, region)| (*region, self.of_run(run, outside))).collect::<Vec<_>>())
        };
        // A block at a time, so that the results of all runs need no memory.
        for block in self.runs.chunks(64 * RUNS) {
            let added = block.par_chunks(RUNS).map(add).collect::<Result<Vec<_>, SurfaceError>>()?;
            for (region, run) in added.into_iter().flatten() {
                let region = &mut regions[region as usize];
                region.points += run.points;
                region.sums.iter_mut().zip(run.sums).for_each(|(sum, of_run)| *sum += of_run);
                region.pairs.iter_mut().zip(run.pairs).for_each(|(sum, of_run)| *sum += of_run);
            }
        }
        for region in &mut regions {
            region.area = AREAS.iter().zip(region.pairs).map(|(area, n)| area * n as f64).sum();
        }
        self.measure_openings(&mut regions, outside, set, control)?;
        Ok(regions)
    }

    /// Returns the sums over the points of a run.
    fn of_run(&self, run: &Run, outside: &BitGrid) -> Region {
        let [first, last] = [run.first, run.last].map(|x| x as usize);
        let (n, row) = (u64::from(run.last - run.first + 1), run.row as usize);
        let [y, z] = [row % self.size[1], row / self.size[1]];
        let across = (first as u64 + last as u64) * n / 2;
        let mut sums = Region { points: n, sums: [across, n * y as u64, n * z as u64], ..Region::default() };
        for x in first..=last {
            // Pockets do not reach the sides of the grid.
            for step in 0..27_isize {
                let [dx, dy, dz] = [step % 3 - 1, step / 3 % 3 - 1, step / 9 - 1];
                let n_axes = [dx, dy, dz].iter().filter(|d| **d != 0).count();
                let moved = |c: usize, by: isize| c.saturating_add_signed(by);
                if n_axes > 0 && !outside.contains([moved(x, dx), moved(y, dy), moved(z, dz)]) {
                    sums.pairs[n_axes - 1] += 1;
                }
            }
        }
        sums
    }

    /// Counts the openings of the regions and measures the depths.
    fn measure_openings(
        &self,
        regions: &mut [Region],
        outside: &BitGrid,
        set: BitGrid,
        control: &Control<'_>,
    ) -> Result<(), SurfaceError> {
        // Points of the set with a face on a point that is neither in the set nor in the molecule.
        let mut others = BitGrid::new(self.size, control)?;
        others.combine(outside, |_, outside| outside);
        others.combine(&set, |outside, set| outside & !set);
        let mut openings = others.dilated(&Element::ball(1.0), control)?;
        drop(others);
        openings.combine(&set, |near, set| near & set);
        drop(set);
        let openings = Self::new(&openings, 1.0, control)?;
        let mut of_opening = vec![DROPPED; openings.n];
        for (run, opening) in &openings.runs {
            let row = run.row as usize;
            let region = self.touched(row, [run.first as usize; 2]).next().unwrap_or(DROPPED);
            of_opening[*opening as usize] = region;
        }
        for region in &of_opening {
            if let Some(region) = regions.get_mut(*region as usize) {
                region.openings += 1;
            }
        }
        let memory = control.reserve(0)?;
        let points_of = |found: &Self, wanted: &dyn Fn(u32) -> u32| -> Result<Vec<Vec<[i32; 3]>>, SurfaceError> {
            let mut points = vec![Vec::new(); self.n];
            for (run, number) in &found.runs {
                let Some(points) = points.get_mut(wanted(*number) as usize) else { continue };
                memory.grow(POINT_BYTES * u64::from(run.last - run.first + 1))?;
                let (y, z) = (run.row as usize % self.size[1], run.row as usize / self.size[1]);
                let [y, z] = [y, z].map(|c| to_u32(c).cast_signed());
                points.extend((run.first..=run.last).map(|x| [x.cast_signed(), y, z]));
            }
            Ok(points)
        };
        let entrances = points_of(&openings, &|opening| of_opening[opening as usize])?;
        let points = points_of(self, &|region| region)?;
        let depths: Vec<u64> = points
            .par_iter()
            .zip(&entrances)
            .map(|(points, entrances)| depth2(points, entrances, control))
            .collect::<Result<_, SurfaceError>>()?;
        regions.iter_mut().zip(depths).for_each(|(region, depth2)| region.depth2 = depth2);
        Ok(())
    }
}

/// Returns the index of the first run of each row, followed by the number of runs.
fn starts(runs: &[(Run, u32)], n_rows: usize) -> Vec<u32> {
    let mut starts = Vec::with_capacity(n_rows + 1);
    let mut at = 0;
    for row in 0..n_rows {
        starts.push(to_u32(at));
        while runs.get(at).is_some_and(|(run, _)| run.row as usize == row) {
            at += 1;
        }
    }
    starts.push(to_u32(at));
    starts
}

/// Returns the square of the largest distance of one of `points` from the nearest of `entrances`; 0 without entrances.
///
/// A point is done as soon as an entrance is not farther than the result so far, and the search begins at the entrance
/// of the point before (Taha and Hanbury, IEEE Transactions on Pattern Analysis and Machine Intelligence 37, 2015).
fn depth2(points: &[[i32; 3]], entrances: &[[i32; 3]], control: &Control<'_>) -> Result<u64, SurfaceError> {
    let (mut most, mut start) = (0, 0_usize);
    if entrances.is_empty() {
        return Ok(0);
    }
    for (i, point) in points.iter().enumerate() {
        control.check_every(i, POINTS_PER_CHECK)?;
        let mut nearest = (u64::MAX, start);
        for step in 0..2 * entrances.len() {
            // Both directions in turn: start, start + 1, start − 1, …
            let by = (step / 2 + step % 2).cast_signed() * if step % 2 == 0 { -1 } else { 1 };
            let Some(at) = start.checked_add_signed(by).filter(|at| *at < entrances.len()) else { continue };
            let entrance = entrances[at];
            let square = |k: usize| u64::from(point[k].abs_diff(entrance[k])).pow(2);
            nearest = nearest.min((square(0) + square(1) + square(2), at));
            if nearest.0 <= most {
                break;
            }
        }
        (most, start) = (most.max(nearest.0), nearest.1);
    }
    Ok(most)
}
