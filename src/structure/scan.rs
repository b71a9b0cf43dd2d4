//! Finds the boundaries of white-space separated tokens, 64 bytes at a time.
//!
//! Eight bytes are compared at once in a machine word, their verdicts gathered into a bit mask, and the places where
//! the mask changes are the starts and ends of tokens. Quotes, comments and text fields are the caller's business:
//! [`Edges`] only knows white space (any byte up to a blank).

/// Starts and ends of tokens, alternating, as offsets from the beginning of the window that was scanned.
#[derive(Debug, Default)]
pub(super) struct Edges {
    offsets: Vec<u32>,
    len: usize,
}

/// Edges that 64 bytes can hold.
const PER_BLOCK: usize = 64;

impl Edges {
    /// Scans `window`, which begins outside of any token. A token that the window cuts off is left out, unless
    /// `last` says that the text ends with the window.
    ///
    /// # Panics
    /// Never: windows are far below 4 GiB, as the caller chooses them.
    pub(super) fn scan(&mut self, window: &[u8], last: bool) {
        self.len = 0;
        let room = window.len() + 2 * PER_BLOCK;
        if self.offsets.len() < room {
            self.offsets.resize(room, 0);
        }
        let mut open = 0_u64;
        let (blocks, rest) = window.as_chunks::<PER_BLOCK>();
        for (i, block) in blocks.iter().enumerate() {
            open = self.block(block, i * PER_BLOCK, open);
        }
        if !rest.is_empty() {
            let mut block = [b' '; PER_BLOCK];
            block[..rest.len()].copy_from_slice(rest);
            open = self.block(&block, blocks.len() * PER_BLOCK, open);
        }
        if open == 1 {
            self.push_last(window.len());
        }
        // A token that touches the end of the window may go on behind it.
        let touches = self.len.is_multiple_of(2) && self.len > 0 && self.offsets[self.len - 1] as usize == window.len();
        if touches && !last {
            self.len -= 2;
        }
    }

    fn push_last(&mut self, end: usize) {
        self.offsets[self.len] = end as u32;
        self.len += 1;
    }

    /// The edges that were found: `[start, end, start, end, …]`.
    pub(super) fn offsets(&self) -> &[u32] {
        &self.offsets[..self.len]
    }

    /// Scans one block; `open` is 1 where a token goes on from the block before.
    #[inline]
    fn block(&mut self, block: &[u8; PER_BLOCK], base: usize, open: u64) -> u64 {
        let solid = solid_mask(block);
        let mut edges = solid ^ ((solid << 1) | open);
        let count = edges.count_ones() as usize;
        let base = base as u32;
        let mut at = self.len;
        self.len += count;
        // Eight at a time without asking whether there are eight: what is too much is written over later.
        loop {
            if let Some(out) = self.offsets.get_mut(at..).and_then(|o| o.first_chunk_mut::<8>()) {
                for slot in out {
                    *slot = base + edges.trailing_zeros();
                    edges &= edges.wrapping_sub(1);
                }
            }
            at += 8;
            if at >= self.len {
                return solid >> 63;
            }
        }
    }
}

/// Bit `i` is set where byte `i` is above a blank.
#[inline]
fn solid_mask(block: &[u8; PER_BLOCK]) -> u64 {
    const LOW_BITS: u64 = 0x7F7F_7F7F_7F7F_7F7F;
    const ABOVE_BLANK: u64 = 0x5F5F_5F5F_5F5F_5F5F;
    let mut mask = 0;
    let (words, _) = block.as_chunks::<8>();
    for (i, word) in words.iter().enumerate() {
        let bytes = u64::from_le_bytes(*word);
        // The high bit of each byte: its low seven bits exceed 0x20, or it is above ASCII.
        let verdicts = (((bytes & LOW_BITS) + ABOVE_BLANK) | bytes) & !LOW_BITS;
        // The product gathers the eight bits in its highest byte, in order.
        let gathered = (verdicts >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        mask |= gathered << (8 * i);
    }
    mask
}

#[cfg(test)]
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

    proptest::proptest! {
        #[test]
        fn edges_are_where_tokens_begin_and_end(
            bytes in proptest::collection::vec(proptest::sample::select(&b" \n\tA\x20\x21\x7f\x80\xff\x00\x1fz"[..]), 0..300),
            last: bool,
        ) {
            let mut edges = Edges::default();
            // Scanned twice: nothing of an earlier window may show.
            edges.scan(&[b'x'; 200], true);
            edges.scan(&bytes, last);
            proptest::prop_assert_eq!(edges.offsets(), naive(&bytes, last));
        }
    }
}
