//! Sorting in parallel without a serial part: pieces are sorted where they are made, then each range of keys is collected
//! from all pieces.

use rayon::prelude::*;

use super::column::Column;

/// Keys of a piece, and about as many of a range: they are sorted within the second-level cache.
const PIECE: usize = 1 << 13;
/// One key in so many is looked at to choose the ranges.
const EVERY: usize = 1 << 7;

/// `n` different keys in ascending order; `make(first, piece)` writes those from number `first` on.
pub(super) fn sorted(n: usize, make: impl Fn(usize, &mut [u128]) + Sync) -> Column<u128> {
    let mut keys = Column::zeroed(n);
    keys.par_chunks_mut(PIECE).enumerate().for_each(|(p, piece)| {
        make(p * PIECE, piece);
        piece.sort_unstable();
    });
    if n <= PIECE {
        return keys;
    }
    let mut samples: Vec<u128> = keys.chunks(PIECE).flat_map(|piece| piece.iter().step_by(EVERY)).copied().collect();
    samples.sort_unstable();
    let bounds: Vec<u128> = samples.iter().step_by(PIECE / EVERY).skip(1).copied().collect();
    // Per piece where each range begins in it, and where the last one ends.
    let cuts: Vec<Vec<usize>> = keys
        .par_chunks(PIECE)
        .map(|piece| {
            let inner = bounds.iter().map(|bound| piece.partition_point(|key| key < bound));
            [0].into_iter().chain(inner).chain([piece.len()]).collect()
        })
        .collect();
    let mut out = Column::zeroed(n);
    let mut rest = &mut out[..];
    let mut ranges = Vec::with_capacity(bounds.len() + 1);
    for r in 0..=bounds.len() {
        let (range, tail) = rest.split_at_mut(cuts.iter().map(|cut| cut[r + 1] - cut[r]).sum());
        ranges.push(range);
        rest = tail;
    }
    ranges.into_par_iter().enumerate().for_each(|(r, range)| {
        let mut at = 0;
        for (piece, cut) in keys.chunks(PIECE).zip(&cuts) {
            let own = &piece[cut[r]..cut[r + 1]];
            range[at..at + own.len()].copy_from_slice(own);
            at += own.len();
        }
        #[expect(clippy::stable_sort_primitive, reason = "it consists of sorted runs, which a stable sort merges")]
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
        for n in [0, 1, 2, PIECE - 1, PIECE, PIECE + 1, 3 * PIECE + 77, 20 * PIECE] {
            for order in orders {
                let got = sorted(n, |first, piece| (first..).zip(piece).for_each(|(i, key)| *key = order(i)));
                let mut expected: Vec<u128> = (0..n).map(order).collect();
                let made = expected.clone();
                expected.sort_unstable();
                assert_eq!(expected, got, "{n}");
                assert!(n < 2 || made.is_sorted() || made != got, "the control: what was made is not in order");
            }
        }
    }
}
