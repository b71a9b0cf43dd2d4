//! Atoms at exactly the same position: the limit on their number, and a warning. Such atoms share all their bricks, so
//! the work of a mesh grows with the square of their number. No experiment or model places more than a few atoms at one
//! point.

use molmesh_surface::{Exceeded, Limit};
use rustc_hash::{FxBuildHasher, FxHashMap};
use std::hash::BuildHasher as _;

use super::error::StructureError;
use super::read::Reading;

/// Model and position of an atom, compared bit by bit.
type AtomPosition = (i32, [u64; 3]);

/// A bucket has on average this part of the threshold in rows, and at least one row.
const BUCKET_PART: u64 = 16;
/// Bytes of an entry of the exact count.
const BYTES_PER_POSITION: u64 = 64;
/// Rows between two checks of the cancellation flag: about a millisecond.
const ROWS_PER_CHECK: usize = 1 << 17;
/// Number of atoms at one position above which the file is probably damaged.
const SUSPECT: u64 = 10;

/// Rejects rows of which more than the limit have the same model and position. `row` returns both for a row below `n`.
///
/// # Errors
/// Returns [`StructureError::Limit`] with the position that exceeds the limit first, in the order of rows, and the
/// errors of cancellation and memory.
pub(super) fn check(
    n: usize,
    row: impl Fn(usize) -> (i32, [f64; 3]),
    reading: &Reading<'_>,
) -> Result<(), StructureError> {
    most_crowded(n, row, reading.limits.max_duplicates, reading).map(drop)
}

/// Returns a warning about the position with the most atoms, if it has too many for a structure, and rejects rows as
/// [`check`] does.
///
/// # Errors
/// Returns the errors of [`check`].
pub(super) fn warning(
    n: usize,
    row: impl Fn(usize) -> (i32, [f64; 3]),
    reading: &Reading<'_>,
) -> Result<Option<String>, StructureError> {
    let crowded = most_crowded(n, &row, SUSPECT, reading)?;
    Ok(crowded.map(|Crowded { first, atoms }| {
        let (_, [x, y, z]) = row(first);
        format!("{atoms} atoms have the same position ({x}, {y}, {z}), the first is atom {}; all are read", first + 1)
    }))
}

/// Rows at one position.
#[derive(Debug, Clone, Copy)]
struct Crowded {
    first: usize,
    atoms: u64,
}

/// Returns the position with the most rows, if they are more than `threshold`.
///
/// Counts the rows of each bucket of a hash first, which is fast and needs little memory. Compares only the rows of
/// buckets with more rows than `threshold`.
fn most_crowded(
    n: usize,
    row: impl Fn(usize) -> (i32, [f64; 3]),
    threshold: u64,
    reading: &Reading<'_>,
) -> Result<Option<Crowded>, StructureError> {
    let limit = reading.limits.max_duplicates;
    let threshold = threshold.min(limit);
    if n as u64 <= threshold {
        return Ok(None);
    }
    // Adding 0 turns -0 into 0.
    let key = |i| -> AtomPosition {
        let (model, position) = row(i);
        (model, position.map(|c| (c + 0.0).to_bits()))
    };
    let rows_per_bucket = (threshold / BUCKET_PART).max(1);
    let n_buckets = usize::try_from(n as u64 / rows_per_bucket).unwrap_or(n).next_power_of_two();
    let _of_counts = reading.reserve(size_of::<u16>() as u64 * n_buckets as u64)?;
    let mut counts = vec![0_u16; n_buckets];
    // The high bits of the hash depend on all bits of the input.
    let bucket = |i| (FxBuildHasher.hash_one(key(i)) >> 32) as usize & (n_buckets - 1);
    let mut has_crowded = false;
    let is_crowded = |count: u16| u64::from(count) > threshold || count == u16::MAX;
    for i in 0..n {
        reading.check_every(i, ROWS_PER_CHECK)?;
        let count = &mut counts[bucket(i)];
        *count = count.saturating_add(1);
        has_crowded |= is_crowded(*count);
    }
    if !has_crowded {
        return Ok(None);
    }
    let n_crowded = (0..n).filter(|&i| is_crowded(counts[bucket(i)])).count();
    reading.check()?;
    let _of_positions = reading.reserve(BYTES_PER_POSITION * n_crowded as u64)?;
    let mut positions: FxHashMap<AtomPosition, Crowded> = FxHashMap::default();
    for i in 0..n {
        reading.check_every(i, ROWS_PER_CHECK)?;
        if !is_crowded(counts[bucket(i)]) {
            continue;
        }
        let crowded = positions.entry(key(i)).or_insert(Crowded { first: i, atoms: 0 });
        crowded.atoms += 1;
        if crowded.atoms > limit {
            let (_, position) = row(i);
            let subject = format!("the position {}, {}, {}", position[0], position[1], position[2]).into();
            let error = Exceeded::new(Limit::Duplicates, limit);
            return Err(Exceeded { subject, position: Some(position), ..error }.error());
        }
    }
    let most = positions.into_values().max_by_key(|crowded| (crowded.atoms, std::cmp::Reverse(crowded.first)));
    Ok(most.filter(|crowded| crowded.atoms > threshold))
}

#[cfg(test)]
mod tests {
    use molmesh_surface::Control;

    use super::*;
    use crate::ReadLimits;

    fn count(rows: &[(i32, [f64; 3])], max_duplicates: u64) -> Result<(), StructureError> {
        let (limits, control) = (ReadLimits { max_duplicates, ..ReadLimits::default() }, Control::default());
        check(rows.len(), |i| rows[i], &Reading::new(&limits, &control))
    }

    #[test]
    fn the_limit_is_exact_and_the_first_position_is_named() {
        let apart = |i: u32| (1, [f64::from(i), 0.5, -0.25]);
        let mut rows: Vec<_> = (0..100_000).map(apart).collect();
        assert_eq!(count(&rows, 1), Ok(()));
        for i in 0..20 {
            rows[5000 * i + 3] = (1, [7.25, if i % 2 == 0 { 0.0 } else { -0.0 }, 1.0]);
            rows[5000 * i + 4] = (1, [8.25, 0.0, 1.0]);
        }
        assert_eq!(count(&rows, 20), Ok(()));
        let found = count(&rows, 19).unwrap_err();
        let at = |error: &StructureError| match error {
            StructureError::Limit(error) => error.position.map(|[x, ..]| (error.max, x)),
            _ => None,
        };
        assert_eq!(at(&found), Some((19, 7.25)), "{found}");
        // Models do not count together.
        rows[3].0 = 2;
        let found = count(&rows, 19).unwrap_err();
        assert_eq!(at(&found), Some((19, 8.25)), "{found}");
    }
}
