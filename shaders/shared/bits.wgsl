// 64 (x, y) bits of a layer are two halves of 32: bit 8·y + x, the upper half from y = 4 on.

// The bits below `bit`, which is at most 31.
fn below(bit: u32) -> u32 {
    return (1u << bit) - 1u;
}

// Position of the set bit that has `rank` set bits below it.
fn select_bit(word: u32, rank: u32) -> u32 {
    var rest = word;
    var left = rank;
    var at = 0u;
    for (var step = 16u; step > 0u; step = step >> 1u) {
        let n = countOneBits(rest & below(step));
        if (left >= n) {
            left -= n;
            at += step;
            rest = rest >> step;
        }
    }
    return at;
}
