//! Sets of grid points, one bit each, and their dilation.

use rayon::prelude::*;

use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::to_u32;
use crate::memory::Reservation;

/// Bits of a word.
const BITS: usize = u64::BITS as usize;
/// Layers of a task. More layers repeat less work at their borders, fewer stay in the cache.
const LAYERS: usize = 8;

/// Set of points in a box of a grid. Rows are along x, layers are perpendicular to z.
#[derive(Debug)]
pub(super) struct BitGrid {
    /// Number of points along each axis.
    pub(super) size: [usize; 3],
    row_words: usize,
    words: Vec<u64>,
    _memory: Reservation,
}

/// Neighbourhood of a point, symmetric about it: a row along x for each offset along y and z.
#[derive(Debug)]
pub(super) struct Element {
    /// Largest offset.
    reach: usize,
    /// Rows by offset along z plus `reach`: offset along y, and number of points on each side of the centre.
    rows: Vec<Vec<(isize, usize)>>,
}

impl Element {
    /// Returns the points within a distance, in spacings.
    pub(super) fn ball(radius: f64) -> Self {
        Self::new(whole(radius), |y, z| {
            let left = radius * radius - (y * y + z * z) as f64;
            (left >= 0.0).then(|| whole(left.sqrt()))
        })
    }

    /// Returns the points within a distance along each axis, in spacings.
    pub(super) fn cube(half: f64) -> Self {
        // Quotients of lengths may be slightly less than a whole number.
        let reach = whole(half + 1e-9);
        Self::new(reach, |_, _| Some(reach))
    }

    /// Returns the rows with a half-width for offsets along y and z.
    fn new(reach: usize, half: impl Fn(isize, isize) -> Option<usize>) -> Self {
        let offsets = || -reach.cast_signed()..=reach.cast_signed();
        let of_layer = |z| offsets().filter_map(|y| Some((y, half(y, z)?))).collect();
        Self { reach, rows: offsets().map(of_layer).collect() }
    }
}

/// Rounds a length down to whole spacings.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "casts saturate, small positive lengths")]
fn whole(length: f64) -> usize {
    length as usize
}

impl BitGrid {
    /// Returns an empty set.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`].
    pub(super) fn new(size: [usize; 3], control: &Control<'_>) -> Result<Self, SurfaceError> {
        let row_words = size[0].div_ceil(BITS);
        let n = row_words * size[1] * size[2];
        let memory = control.reserve((n * size_of::<u64>()) as u64)?;
        Ok(Self { size, row_words, words: vec![0; n], _memory: memory })
    }

    /// Returns the number of rows.
    pub(super) fn n_rows(&self) -> usize {
        self.size[1] * self.size[2]
    }

    /// Returns a row by its number, y + z times the number of rows of a layer.
    fn row(&self, row: usize) -> &[u64] {
        &self.words[row * self.row_words..][..self.row_words]
    }

    /// Returns true if a point is in the set.
    pub(super) fn contains(&self, [x, y, z]: [usize; 3]) -> bool {
        self.row(z * self.size[1] + y)[x / BITS] >> (x % BITS) & 1 == 1
    }

    /// Combines each word with that of another set of the same size.
    pub(super) fn combine(&mut self, other: &Self, of_words: impl Fn(u64, u64) -> u64 + Sync) {
        self.words.par_iter_mut().zip(&other.words).for_each(|(word, other)| *word = of_words(*word, *other));
    }

    /// Replaces the set by its complement.
    pub(super) fn invert(&mut self) {
        let last = self.last_mask();
        self.words.par_chunks_mut(self.row_words.max(1)).for_each(|row| {
            for word in &mut *row {
                *word = !*word;
            }
            if let Some(word) = row.last_mut() {
                *word &= last;
            }
        });
    }

    /// Bits of the last word of a row that are points.
    fn last_mask(&self) -> u64 {
        u64::MAX >> ((BITS - self.size[0] % BITS) % BITS)
    }

    /// Calls `add` for each layer with its number and a function that adds points of a row, from the first to the last.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub(super) fn fill_layers(
        &mut self,
        control: &Control<'_>,
        add: impl Fn(usize, &mut dyn FnMut(usize, [usize; 2])) + Sync,
    ) -> Result<(), SurfaceError> {
        let row_words = self.row_words;
        self.words.par_chunks_mut((row_words * self.size[1]).max(1)).enumerate().try_for_each(|(z, layer)| {
            control.check()?;
            add(z, &mut |y, range| fill(&mut layer[y * row_words..][..row_words], range));
            Ok(())
        })
    }

    /// Returns the points that have a point of this set in their neighbourhood.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn dilated(&self, element: &Element, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let mut found = Self::new(self.size, control)?;
        let ([_, ny, nz], row_words, reach) = (self.size, self.row_words, element.reach);
        let layer = row_words * ny;
        found.words.par_chunks_mut(LAYERS * layer.max(1)).enumerate().try_for_each(|(i, slab)| {
            let (start, n) = (i * LAYERS, slab.len() / layer.max(1));
            let mut widened = vec![0; (reach + 1) * row_words];
            for z in start.saturating_sub(reach)..(start + n + reach).min(nz) {
                control.check()?;
                for y in 0..ny {
                    let row = self.row(z * ny + y);
                    if row.iter().all(|word| *word == 0) {
                        continue;
                    }
                    self.widen(row, &mut widened);
                    for to_z in z.saturating_sub(reach).max(start)..(z + reach + 1).min(start + n) {
                        for (offset, half) in &element.rows[to_z + reach - z] {
                            let Some(to_y) = y.checked_add_signed(*offset).filter(|y| *y < ny) else { continue };
                            let to = &mut slab[(to_z - start) * layer + to_y * row_words..][..row_words];
                            let from = &widened[half * row_words..][..row_words];
                            to.iter_mut().zip(from).for_each(|(to, from)| *to |= from);
                        }
                    }
                }
            }
            Ok::<(), SurfaceError>(())
        })?;
        Ok(found)
    }

    /// Writes a row to `widened`, followed by the same row with each point extended by 1, 2, … points on both sides.
    fn widen(&self, row: &[u64], widened: &mut [u64]) {
        let n = self.row_words;
        widened[..n].copy_from_slice(row);
        for start in (n..widened.len()).step_by(n) {
            let (before, after) = widened.split_at_mut(start);
            let from = &before[start - n..];
            for (i, to) in after[..n].iter_mut().enumerate() {
                let below = i.checked_sub(1).map_or(0, |i| from[i] >> (BITS - 1));
                let above = from.get(i + 1).map_or(0, |next| next << (BITS - 1));
                *to = from[i] | from[i] << 1 | from[i] >> 1 | below | above;
            }
            after[n - 1] &= self.last_mask();
        }
    }

    /// Returns the number of runs.
    pub(super) fn n_runs(&self) -> usize {
        let starts = |row: &[u64]| {
            let carry = |i: usize| if i == 0 { 0 } else { row[i - 1] >> (BITS - 1) };
            (0..row.len()).map(|i| (row[i] & !(row[i] << 1 | carry(i))).count_ones() as usize).sum::<usize>()
        };
        (0..self.n_rows()).into_par_iter().map(|row| starts(self.row(row))).sum()
    }

    /// Returns the runs, row by row.
    pub(super) fn runs(&self) -> Vec<Run> {
        let of_row = |row: usize| {
            let words = self.row(row);
            let mut from = 0;
            std::iter::from_fn(move || {
                let first = next(words, from, 0)?;
                from = next(words, first, u64::MAX).unwrap_or(BITS * words.len());
                Some(Run { row: to_u32(row), first: to_u32(first), last: to_u32(from - 1) })
            })
        };
        (0..self.n_rows()).into_par_iter().flat_map_iter(of_row).collect()
    }
}

/// Points of a row that follow each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Run {
    /// Number of the row.
    pub(super) row: u32,
    pub(super) first: u32,
    pub(super) last: u32,
}

/// Sets the bits of a row from the first to the last.
fn fill(row: &mut [u64], [first, last]: [usize; 2]) {
    let (low, high) = (u64::MAX << (first % BITS), u64::MAX >> (BITS - 1 - last % BITS));
    let (from, to) = (first / BITS, last / BITS);
    if from == to {
        row[from] |= low & high;
        return;
    }
    row[from] |= low;
    row[from + 1..to].fill(u64::MAX);
    row[to] |= high;
}

/// Returns the first bit from `from` on that is set after each word is combined with `flip` by exclusive or.
fn next(row: &[u64], from: usize, flip: u64) -> Option<usize> {
    let mut mask = u64::MAX << (from % BITS);
    for (i, word) in row.iter().enumerate().skip(from / BITS) {
        let bits = (word ^ flip) & mask;
        if bits != 0 {
            return Some(i * BITS + bits.trailing_zeros() as usize);
        }
        mask = u64::MAX;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Random points in a box whose rows end within a word, or with one.
    fn random(size: [usize; 3], one_in: u64) -> BitGrid {
        let mut grid = BitGrid::new(size, &Control::default()).unwrap();
        let mut state = 7_u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            state >> 33
        };
        for row in 0..grid.n_rows() {
            for x in 0..size[0] {
                if random() % one_in == 0 {
                    fill(&mut grid.words[row * grid.row_words..][..grid.row_words], [x, x]);
                }
            }
        }
        grid
    }

    fn points(grid: &BitGrid) -> Vec<[usize; 3]> {
        let [nx, ny, nz] = grid.size;
        let all = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])));
        all.filter(|point| grid.contains(*point)).collect()
    }

    #[test]
    fn dilations_are_those_of_brute_force() {
        for size in [[70, 9, 19], [64, 11, 8], [5, 6, 30], [130, 4, 9]] {
            let grid = random(size, 400);
            let set = points(&grid);
            assert!(!set.is_empty());
            for (element, near) in [
                (Element::ball(1.0), 1.0),
                (Element::ball(2.4), 2.4),
                (Element::ball(6.7), 6.7),
                (Element::cube(4.0), f64::NAN),
            ] {
                let is_near = |a: &[usize; 3], b: &[usize; 3]| {
                    let d = [0, 1, 2].map(|k| a[k].abs_diff(b[k]));
                    if near.is_nan() {
                        d.into_iter().all(|d| d <= 4)
                    } else {
                        d.into_iter().map(|d| (d * d) as f64).sum::<f64>() <= near * near
                    }
                };
                let found = grid.dilated(&element, &Control::default()).unwrap();
                let mut all = BitGrid::new(size, &Control::default()).unwrap();
                all.invert();
                let expected: Vec<_> = points(&all).into_iter().filter(|a| set.iter().any(|b| is_near(a, b))).collect();
                assert_eq!(points(&found), expected, "{size:?} {near}");
                assert_ne!(points(&found), set);
            }
        }
    }

    #[test]
    fn runs_are_the_points_in_order() {
        for size in [[70, 9, 3], [64, 5, 2], [192, 2, 2]] {
            for one_in in [1, 2, 9] {
                let mut grid = random(size, one_in);
                for _ in 0..2 {
                    let runs = grid.runs();
                    assert_eq!(runs.len(), grid.n_runs());
                    let of_run = |run: &Run| {
                        let (y, z) = (run.row as usize % size[1], run.row as usize / size[1]);
                        (run.first..=run.last).map(move |x| [x as usize, y, z])
                    };
                    assert_eq!(runs.iter().flat_map(of_run).collect::<Vec<_>>(), points(&grid));
                    // Runs of a row do not touch.
                    assert!(runs.windows(2).all(|pair| pair[0].row < pair[1].row || pair[0].last + 1 < pair[1].first));
                    grid.invert();
                }
            }
        }
    }

    #[test]
    fn a_cancelled_dilation_ends() {
        let control = Control::default();
        let grid = random([20, 20, 20], 5);
        control.cancel.cancel();
        assert_eq!(grid.dilated(&Element::ball(2.0), &control).map(drop), Err(SurfaceError::Cancelled));
    }
}
