//! Limit on atoms at exactly the same position. Such atoms share all their bricks, so the work of a mesh grows with
//! the square of their number. No experiment or model places more than a few atoms at one point.

use rustc_hash::{FxBuildHasher, FxHashMap};
use std::hash::BuildHasher as _;

use super::error::StructureError;
use super::read::Reading;

/// Model and position of an atom, compared bit by bit.
type AtomPosition = (i32, [u64; 3]);

/// Average number of rows in a bucket.
const ROWS_PER_BUCKET: usize = 64;
/// Bytes of an entry of the exact count.
const BYTES_PER_POSITION: u64 = 64;
/// Rows between two checks of the cancellation flag: about a millisecond.
const ROWS_PER_CHECK: usize = 1 << 17;

/// Rejects rows of which more than the limit have the same model and position. `row` returns both for a row below `n`.
///
/// Counts the rows of each bucket of a hash first, which is fast and needs little memory. Compares only the rows of
/// buckets with more rows than the limit.
///
/// # Errors
/// Returns [`StructureError::TooManyDuplicates`] with the position that exceeds the limit first, in the order of rows,
/// and the errors of cancellation and memory.
pub(super) fn check(
    n: usize,
    row: impl Fn(usize) -> (i32, [f64; 3]),
    reading: &Reading<'_>,
) -> Result<(), StructureError> {
    let limit = reading.limits.max_duplicates;
    if n as u64 <= limit {
        return Ok(());
    }
    // Adding 0 turns -0 into 0.
    let key = |i| -> AtomPosition {
        let (model, position) = row(i);
        (model, position.map(|c| (c + 0.0).to_bits()))
    };
    let n_buckets = (n / ROWS_PER_BUCKET).next_power_of_two();
    let _of_counts = reading.reserve(4 * n_buckets as u64)?;
    let mut counts = vec![0_u32; n_buckets];
    // The high bits of the hash depend on all bits of the input.
    let bucket = |i| (FxBuildHasher.hash_one(key(i)) >> 32) as usize & (n_buckets - 1);
    for i in 0..n {
        if i % ROWS_PER_CHECK == 0 {
            reading.check()?;
        }
        counts[bucket(i)] += 1;
    }
    let is_crowded = |count: u32| u64::from(count) > limit;
    let crowded: u64 = counts.iter().filter(|count| is_crowded(**count)).map(|&count| u64::from(count)).sum();
    if crowded == 0 {
        return Ok(());
    }
    let _of_positions = reading.reserve(BYTES_PER_POSITION * crowded)?;
    let mut positions: FxHashMap<AtomPosition, u64> = FxHashMap::default();
    for i in 0..n {
        if i % ROWS_PER_CHECK == 0 {
            reading.check()?;
        }
        if !is_crowded(counts[bucket(i)]) {
            continue;
        }
        let count = positions.entry(key(i)).or_default();
        *count += 1;
        if *count > limit {
            let (_, [x, y, z]) = row(i);
            return Err(StructureError::TooManyDuplicates { limit, x, y, z });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure::ReadLimits;
    use crate::surface::Control;

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
        assert!(matches!(found, StructureError::TooManyDuplicates { limit: 19, x: 7.25, .. }), "{found}");
        // Models do not count together.
        rows[3].0 = 2;
        let found = count(&rows, 19).unwrap_err();
        assert!(matches!(found, StructureError::TooManyDuplicates { x: 8.25, .. }), "{found}");
    }
}
