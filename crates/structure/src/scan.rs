//! Boundaries of tokens separated by white space, found in blocks of 64 bytes.
//!
//! Vector comparisons yield one bit per byte. Changes between adjacent bits are the starts and ends of tokens. Only
//! white space (any byte up to the space character) separates tokens here; the caller handles quotes, comments and text
//! fields.

/// Starts and ends of tokens, alternating, as offsets from the beginning of the window that was scanned.
#[derive(Debug, Default)]
pub(super) struct Edges {
    offsets: Vec<u32>,
    len: usize,
}

/// Bytes per block, which is also the largest number of edges in a block.
const BLOCK: usize = 64;
const STEP: u32 = 64;

impl Edges {
    /// Scans `window`, which must begin outside a token and be smaller than 4 GiB. Leaves out a token that the end of
    /// the window may have cut, unless `last` is true (the text ends with the window).
    pub(super) fn scan(&mut self, window: &[u8], last: bool) {
        let needed = window.len() + 2 * BLOCK;
        if self.offsets.len() < needed {
            self.offsets.resize(needed, 0);
        }
        self.len = edges(window, &mut self.offsets);
        let cut = self.len > 0 && self.offsets[self.len - 1] as usize == window.len();
        if cut && !last {
            self.len -= 2;
        }
    }

    /// Returns the edges: `[start, end, start, end, …]`.
    pub(super) fn offsets(&self) -> &[u32] {
        &self.offsets[..self.len]
    }
}

/// Returns the number of leading bytes of `text` that are non-blank (`solid`) or blank.
pub(super) fn run_length(text: &[u8], solid: bool) -> usize {
    let (blocks, rest) = text.as_chunks::<BLOCK>();
    for (i, block) in blocks.iter().enumerate() {
        let mask = solid_mask(block);
        let run = if solid { mask.trailing_ones() } else { mask.trailing_zeros() };
        if run < STEP {
            return i * BLOCK + run as usize;
        }
    }
    blocks.len() * BLOCK + rest.iter().position(|&b| (b > b' ') != solid).unwrap_or(rest.len())
}

/// Writes the edges of `window` to `out`, which must be slightly longer, and returns their number, which is even.
#[multiversion::multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+bmi1+bmi2+popcnt+lzcnt",
    "x86_64+avx2+bmi1+bmi2+popcnt+lzcnt"
))]
fn edges(window: &[u8], out: &mut [u32]) -> usize {
    let mut len = 0;
    let mut open = 0;
    let (blocks, rest) = window.as_chunks::<BLOCK>();
    let mut base = 0;
    for block in blocks {
        (len, open) = block_edges(block, base, open, out, len);
        base += STEP;
    }
    if !rest.is_empty() {
        let mut block = [b' '; BLOCK];
        block[..rest.len()].copy_from_slice(rest);
        (len, open) = block_edges(&block, base, open, out, len);
    }
    if open == 1 {
        out[len] = u32::try_from(window.len()).unwrap_or(u32::MAX);
        len += 1;
    }
    len
}

/// Appends the edges of one block to the first `len` of `out`. `open` is 1 if a token continues from the previous
/// block.
#[expect(clippy::inline_always, reason = "must be compiled for each instruction set of the caller")]
#[inline(always)]
fn block_edges(block: &[u8; BLOCK], base: u32, open: u64, out: &mut [u32], len: usize) -> (usize, u64) {
    let solid = solid_mask(block);
    let mut edges = solid ^ ((solid << 1) | open);
    let total = len + edges.count_ones() as usize;
    let mut at = len;
    // Writes sixteen at a time without checking the count; surplus entries are overwritten later. Blocks of atom rows
    // have 17 to 32 edges, so the number of iterations is predictable.
    while at < total {
        if let Some(out) = out.get_mut(at..).and_then(|o| o.first_chunk_mut::<16>()) {
            for slot in out {
                *slot = base + edges.trailing_zeros();
                edges &= edges.wrapping_sub(1);
            }
        }
        at += 16;
    }
    (total, solid >> 63)
}

/// Returns a mask whose bit `i` is set if byte `i` is non-blank.
#[inline]
fn solid_mask(block: &[u8; BLOCK]) -> u64 {
    const LOW_BITS: u64 = 0x7F7F_7F7F_7F7F_7F7F;
    const ABOVE_BLANK: u64 = 0x5F5F_5F5F_5F5F_5F5F;
    let mut mask = 0;
    let (words, _) = block.as_chunks::<8>();
    for (i, word) in words.iter().enumerate() {
        let bytes = u64::from_le_bytes(*word);
        // Sets the high bit of each byte whose low seven bits exceed 0x20, or which is not ASCII.
        let verdicts = (((bytes & LOW_BITS) + ABOVE_BLANK) | bytes) & !LOW_BITS;
        // The multiplication gathers the eight bits, in order, in the highest byte.
        let gathered = (verdicts >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        mask |= gathered << (8 * i);
    }
    mask
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn naive(window: &[u8], last: bool) -> Vec<u32> {
        let mut out = Vec::new();
        let mut inside = false;
        for (i, &b) in window.iter().enumerate() {
            if (b > b' ') != inside {
                inside = !inside;
                out.push(i as u32);
            }
        }
        if inside {
            out.push(window.len() as u32);
            if !last {
                out.truncate(out.len() - 2);
            }
        }
        out
    }

    #[test]
    fn every_byte_is_classified() {
        for byte in 0..=u8::MAX {
            for at in 0..BLOCK {
                let mut block = [b' '; BLOCK];
                block[at] = byte;
                let expected = u64::from(byte > b' ') << at;
                assert_eq!(solid_mask(&block), expected, "{byte} at {at}");
            }
        }
    }

    #[test]
    fn runs_end_where_they_end() {
        for n in 0..200 {
            for tail in ["", " x", "x y"] {
                let solid = format!("{}{}", "é".repeat(n), tail.trim_start_matches('x'));
                assert_eq!(run_length(solid.as_bytes(), true), 2 * n, "{tail}");
                assert_eq!(
                    run_length(format!("{}{}", "\t".repeat(n), tail.trim_start()).as_bytes(), false),
                    n,
                    "{tail}"
                );
            }
        }
    }

    proptest::proptest! {
        #[test]
        fn edges_are_where_tokens_begin_and_end(
            bytes in proptest::collection::vec(proptest::sample::select(&b" \n\tA\x20\x21\x7f\x80\xff\x00\x1fz"[..]), 0..300),
            last: bool,
        ) {
            let mut edges = Edges::default();
            // Scans twice: the second result must not depend on the first.
            edges.scan(&[b'x'; 200], true);
            edges.scan(&bytes, last);
            proptest::prop_assert_eq!(edges.offsets(), naive(&bytes, last));
        }
    }
}
