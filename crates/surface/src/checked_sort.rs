//! Sorting that stops soon after cancellation.

use std::cmp::Ordering;

use super::control::Control;
use super::error::SurfaceError;

/// Number of items that are sorted at once, in at most a few milliseconds.
const BLOCK: usize = 1 << 14;

/// Sorts `items` on all threads; equal ones in no particular order. Reserves memory for half of them if there are many.
///
/// # Errors
/// [`SurfaceError::Cancelled`] and [`SurfaceError::Memory`]. The items are in no particular order then, and some of
/// them may be lost.
pub fn sort<T: Copy + Send + Sync>(
    items: &mut [T],
    compare: impl Fn(&T, &T) -> Ordering + Copy + Sync,
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
    if items.len() <= BLOCK {
        items.sort_unstable_by(compare);
        return Ok(());
    }
    control.check()?;
    let middle = items.len() / 2;
    let (low, high) = items.split_at_mut(middle);
    let (low, high) = rayon::join(|| sort(low, compare, control), || sort(high, compare, control));
    low.and(high)?;
    merge(items, middle, compare, control)
}

/// Merges the sorted items before `middle` with the sorted ones from there on.
fn merge<T: Copy>(
    items: &mut [T],
    middle: usize,
    compare: impl Fn(&T, &T) -> Ordering,
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
    let _memory = control.reserve((size_of::<T>() * middle) as u64)?;
    let low = items[..middle].to_vec();
    let (mut from_low, mut from_high) = (0, middle);
    // Ends when the lower half is used up, as the rest of the upper half is in its place then.
    while from_low < low.len() {
        control.check()?;
        for _ in 0..BLOCK {
            let Some(next) = low.get(from_low) else { break };
            let at = from_low + from_high - middle;
            if let Some(other) = items.get(from_high).filter(|other| compare(other, next).is_lt()) {
                items[at] = *other;
                from_high += 1;
            } else {
                items[at] = *next;
                from_low += 1;
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CancelToken;

    /// Numbers that differ, in no order.
    fn shuffled(n: u64) -> Vec<u64> {
        (0..n).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15)).collect()
    }

    #[test]
    fn items_of_any_number_are_sorted() {
        let block = BLOCK as u64;
        for n in [0, 1, 2, block, block + 1, 2 * block + 3, 5 * block - 7] {
            let (mut sorted, mut expected) = (shuffled(n), shuffled(n));
            sort(&mut sorted, Ord::cmp, &Control::default()).unwrap();
            expected.sort_unstable();
            assert!(sorted == expected, "{n}");
            assert!(n < 3 || shuffled(n) != expected, "{n}: the control");
        }
    }

    #[test]
    fn a_cancelled_sort_ends() {
        let cancel = CancelToken::default();
        let control = Control { cancel: cancel.clone(), ..Control::default() };
        let mut items = shuffled(4 * BLOCK as u64);
        assert_eq!(sort(&mut items, Ord::cmp, &control), Ok(()));
        cancel.cancel();
        assert_eq!(sort(&mut items, Ord::cmp, &control), Err(SurfaceError::Cancelled));
        assert_eq!(merge(&mut items, 2 * BLOCK, Ord::cmp, &control), Err(SurfaceError::Cancelled));
    }
}
