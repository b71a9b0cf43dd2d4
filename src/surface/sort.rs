//! Sorting in parallel without a serial part: pieces are sorted where they are made, then each range of keys is collected
//! from all pieces.

use bytemuck::Pod;
use rayon::prelude::*;

use super::column::Column;

/// Most keys of a piece, and about as many of a range: they are sorted within the second-level cache.
const LARGEST: usize = 1 << 13;
/// Fewest: below, what is done for each pair of a piece and a range would count.
const SMALLEST: usize = 1 << 10;
/// One key in so many is looked at to choose the ranges.
const EVERY: usize = 1 << 7;

/// A key: whole, and in order.
pub(super) trait Key: Pod + Ord + Send + Sync {}

impl<K: Pod + Ord + Send + Sync> Key for K {}

/// Keys of a piece: several pieces a thread, so that none waits long for the slowest.
fn piece_of(n: usize) -> usize {
    (n / (4 * rayon::current_num_threads())).clamp(SMALLEST, LARGEST).next_multiple_of(EVERY)
}

/// `n` different keys in ascending order; `make(first, piece)` writes those from number `first` on. `few`: on this thread.
pub(super) fn sorted<K: Key>(few: bool, n: usize, make: impl Fn(usize, &mut [K]) + Sync) -> Column<K> {
    let size = if few { n.next_multiple_of(EVERY) } else { piece_of(n) };
    sorted_by_pieces(n, size, make)
}

/// [`sorted`], with `size` keys a piece, a multiple of [`EVERY`]; the result does not depend on it.
fn sorted_by_pieces<K: Key>(n: usize, size: usize, make: impl Fn(usize, &mut [K]) + Sync) -> Column<K> {
    let mut keys = Column::scratch(n);
    let piece = |p: usize, piece: &mut [K]| {
        make(p * size, piece);
        piece.sort_unstable();
    };
    if n <= size {
        piece(0, &mut keys);
        return keys;
    }
    keys.par_chunks_mut(size).enumerate().for_each(|(p, keys)| piece(p, keys));
    let mut samples: Vec<K> =
        keys.par_chunks(size).flat_map_iter(|piece| piece.iter().step_by(EVERY)).copied().collect();
    samples.par_sort_unstable();
    let bounds: Vec<K> = samples.iter().step_by(size / EVERY).skip(1).copied().collect();
    // Per piece where each range begins in it, and where the last one ends.
    let cuts: Vec<Vec<usize>> = keys
        .par_chunks(size)
        .map(|piece| {
            let inner = bounds.iter().map(|bound| piece.partition_point(|key| key < bound));
            [0].into_iter().chain(inner).chain([piece.len()]).collect()
        })
        .collect();
    let mut out = Column::scratch(n);
    let mut rest = &mut out[..];
    let mut ranges = Vec::with_capacity(bounds.len() + 1);
    for r in 0..=bounds.len() {
        let (range, tail) = rest.split_at_mut(cuts.iter().map(|cut| cut[r + 1] - cut[r]).sum());
        ranges.push(range);
        rest = tail;
    }
    ranges.into_par_iter().enumerate().for_each(|(r, range)| {
        let mut at = 0;
        for (piece, cut) in keys.chunks(size).zip(&cuts) {
            let own = &piece[cut[r]..cut[r + 1]];
            range[at..at + own.len()].copy_from_slice(own);
            at += own.len();
        }
        // It consists of sorted runs, which a stable sort merges.
        range.sort();
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_come_out_in_order_whatever_their_order_and_number() {
        let scatter = |i: usize| (i as u128 * 0x9e37_79b9_7f4a_7c15) & 0xffff_ffff_ffff;
        let orders: [&(dyn Fn(usize) -> u128 + Sync); 4] =
            [&|i| i as u128, &|i| u128::MAX - i as u128, &scatter, &|i| (i as u128 % 3) << 64 | i as u128];
        for n in [0, 1, 2, LARGEST - 1, LARGEST, LARGEST + 1, 3 * LARGEST + 77, 20 * LARGEST] {
            for order in orders {
                let mut expected: Vec<u128> = (0..n).map(order).collect();
                let made = expected.clone();
                expected.sort_unstable();
                for size in [SMALLEST, 3 * EVERY, LARGEST, piece_of(n)] {
                    let make = |first, piece: &mut [u128]| (first..).zip(piece).for_each(|(i, key)| *key = order(i));
                    let got = sorted_by_pieces(n, size, make);
                    assert_eq!(expected, got, "{n} in pieces of {size}");
                    assert!(n < 2 || made.is_sorted() || made != got, "the control: what was made is not in order");
                }
            }
        }
    }

    #[test]
    fn pieces_hold_whole_samples() {
        for n in [0, 1, 5_000, 60_000, 1_000_000, 10_000_000] {
            let size = piece_of(n);
            assert!((SMALLEST..=LARGEST).contains(&size) && size.is_multiple_of(EVERY), "{size}");
        }
    }
}
