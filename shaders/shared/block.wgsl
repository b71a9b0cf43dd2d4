// Crossing edges of the block of a brick, by words of `edges`. Requires shared/triangles.

// A word of `edges`: the neighbour that owns it, and its position in the block.
struct Word {
    owner: u32,
    axis: u32,
    z: u32,
    // y divided by 4.
    quarter: u32,
}

// Word `3·lane + quarter`.
fn word_of(lane: u32, quarter: u32) -> Word {
    let z = lane % 9u;
    let owner = lane / 27u | select(0u, 2u, quarter == 2u) | select(0u, 4u, z == 8u);
    return Word(owner, lane / 9u % 3u, z, quarter);
}

// Crossing edges of row `at` of the block that belong to a word.
fn crossing_row(at: u32, word: Word) -> u32 {
    var next = rows[at] >> 1u;
    if (word.axis > 0u) {
        next = rows[at + select(9u, 1u, word.axis == 1u)];
    }
    let row = (rows[at] ^ next) & 511u;
    return select(row & 255u, row >> 8u, (word.owner & 1u) == 1u);
}

// Crossing edges of a word within the block. They follow from the inside bits: the records of later bricks may not
// exist yet.
fn crossing_edges(word: Word) -> u32 {
    if ((word.owner >> word.axis & 1u) == 1u) {
        return 0u;
    }
    let at = 9u * word.z + 4u * word.quarter;
    let crossing = crossing_row(at, word);
    if (word.quarter == 2u) {
        return crossing;
    }
    return crossing | crossing_row(at + 1u, word) << 8u | crossing_row(at + 2u, word) << 16u
        | crossing_row(at + 3u, word) << 24u;
}

// Edges of a word that lie in the brick's first layer along x, y and z, each without those along that axis.
fn in_first_layers(word: Word, on: u32) -> vec3<u32> {
    let y = select(0u, 0xffu, word.quarter == 0u);
    let z = select(0u, 0xffffffffu, word.z == 0u);
    let axis = vec3<u32>(0u, 1u, 2u) == vec3<u32>(word.axis);
    return select(vec3<u32>(on) & vec3<u32>(0x01010101u, y, z), vec3<u32>(0u), axis);
}

// Edges of a word whose vertices other bricks use too.
fn shared_edges(word: Word, crossing: u32) -> u32 {
    let first = in_first_layers(word, crossing);
    return select(first.x | first.y | first.z, crossing, word.owner > 0u);
}

// Neighbours that use vertices of a word: bit n for neighbour n above; bit 8 + n for the neighbour below that has this
// brick as neighbour n.
fn users(word: Word, on: u32) -> u32 {
    if (word.owner > 0u) {
        return select(0u, 1u << word.owner, on != 0u);
    }
    let f = in_first_layers(word, on);
    let one = select(vec3<u32>(0u), vec3<u32>(1u << 9u, 1u << 10u, 1u << 12u), f != vec3<u32>(0u));
    let both = vec3<u32>(f.x & f.y, f.x & f.z, f.y & f.z);
    let two = select(vec3<u32>(0u), vec3<u32>(1u << 11u, 1u << 13u, 1u << 14u), both != vec3<u32>(0u));
    return one.x | one.y | one.z | two.x | two.y | two.z;
}

// Own vertex, shifted by 16, and neighbours that use it as in `users`, of an edge with its first point and its axis.
fn counts_of(point: vec3<u32>, axis: vec3<bool>) -> u32 {
    let owner = point.x >> 3u | point.y >> 3u << 1u | point.z >> 3u << 2u;
    if (owner > 0u) {
        return 1u << owner;
    }
    let f = select(vec3<u32>(0u), vec3<u32>(1u), (point == vec3<u32>(0u)) & !axis);
    return 1u << 16u | f.x << 9u | f.y << 10u | f.z << 12u
        | (f.x & f.y) << 11u | (f.x & f.z) << 13u | (f.y & f.z) << 14u;
}
