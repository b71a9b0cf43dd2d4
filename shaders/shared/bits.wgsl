// The 64 (x, y) bits of a layer are two words of 32: bit 8·y + x, the second word from y = 4 on.

// Marks a tile or brick that does not exist.
const NONE: u32 = 0xffffffffu;

// Mask of the bits below `bit`, which is at most 31.
fn below(bit: u32) -> u32 {
    return (1u << bit) - 1u;
}

// Position of the set bit that has `rank` set bits below it. Unrolled by hand, because shader compilers do not unroll
// the loop.
fn select_bit(word: u32, rank: u32) -> u32 {
    var rest = word;
    var left = rank;
    var at = 0u;
    var n = countOneBits(rest & 0xffffu);
    if (left >= n) { left -= n; at = 16u; rest = rest >> 16u; }
    n = countOneBits(rest & 0xffu);
    if (left >= n) { left -= n; at += 8u; rest = rest >> 8u; }
    n = countOneBits(rest & 0xfu);
    if (left >= n) { left -= n; at += 4u; rest = rest >> 4u; }
    n = countOneBits(rest & 0x3u);
    if (left >= n) { left -= n; at += 2u; rest = rest >> 2u; }
    return at + select(0u, 1u, left >= (rest & 1u));
}
