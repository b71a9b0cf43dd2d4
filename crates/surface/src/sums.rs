//! Sums over lanes, and the checksum of directed edges, vectorized over batches of triangles.

/// Returns the share of a directed edge in the checksum. The two directions of an edge have opposite shares.
#[inline(always)]
fn edge_share(from: u32, to: u32) -> u64 {
    let (low, high) = if from < to { (from, to) } else { (to, from) };
    // Two rounds of multiply and shift, as in splitmix64: the shares of neighbouring keys must not cancel.
    let mut key = (u64::from(low) << 32 | u64::from(high)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    key = (key ^ key >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93);
    key ^= key >> 32;
    if from < to { key } else { key.wrapping_neg() }
}

/// Sums in double precision with eight accumulators: with a single one, each addition would wait for the previous one.
#[inline(always)]
pub(super) fn sum_lanes<const N: usize>(lanes: &[f32; N]) -> f64 {
    let mut strands = [0.0_f64; 8];
    for row in lanes.as_chunks::<8>().0 {
        for (strand, value) in strands.iter_mut().zip(row) {
            *strand += f64::from(*value);
        }
    }
    strands.iter().sum()
}

/// Triangles whose checksum is computed together.
const SHARES: usize = 16;

/// Returns the checksum of triangles, and true if one of them has a corner twice.
#[inline(always)]
pub(super) fn edge_shares(triangles: &[[u32; 3]]) -> (u64, bool) {
    let (mut sum, mut twice) = ([0_u64; SHARES], [false; SHARES]);
    let (whole, rest) = triangles.as_chunks::<SHARES>();
    for batch in whole {
        let [a, b, c]: [[u32; SHARES]; 3] = std::array::from_fn(|k| std::array::from_fn(|i| batch[i][k]));
        for i in 0..SHARES {
            let shares =
                edge_share(a[i], b[i]).wrapping_add(edge_share(b[i], c[i])).wrapping_add(edge_share(c[i], a[i]));
            sum[i] = sum[i].wrapping_add(shares);
            twice[i] |= a[i] == b[i] || b[i] == c[i] || c[i] == a[i];
        }
    }
    for &[a, b, c] in rest {
        sum[0] = sum[0].wrapping_add(edge_share(a, b)).wrapping_add(edge_share(b, c)).wrapping_add(edge_share(c, a));
        twice[0] |= a == b || b == c || c == a;
    }
    (sum.iter().fold(0, |all, s| all.wrapping_add(*s)), twice.contains(&true))
}
