// Tile: 8 × 8 × 8 bricks, and one bit for each, set if the brick exists. Requires `tiles` and shared/bits.
struct Tile {
    coord: vec3<i32>,
    // Number of bricks in all earlier tiles.
    base: u32,
    // Word z, bit 8·y + x.
    bricks: array<vec2<u32>, 8>,
    // Number of bricks of the tile before each word.
    before: array<u32, 8>,
    // Adjacent tiles, or NONE: entry 9·(z + 1) + 3·(y + 1) + (x + 1), the last is unused.
    around: array<u32, 28>,
}

// Number of bricks of the job before position `local` (9 bits: z, y, x) of a tile.
fn bricks_before(tile: u32, local: u32) -> u32 {
    let z = local >> 6u;
    let word = tiles[tile].bricks[z];
    let bit = local & 63u;
    let low = select(word.x, word.x & below(bit & 31u), bit < 32u);
    let high = select(word.y & below(bit & 31u), 0u, bit < 32u);
    return tiles[tile].base + tiles[tile].before[z] + countOneBits(low) + countOneBits(high);
}

// Returns true if the brick at `local` exists.
fn brick_exists(tile: u32, local: u32) -> bool {
    let word = tiles[tile].bricks[local >> 6u];
    let bit = local & 63u;
    return (select(word.y, word.x, bit < 32u) >> (bit & 31u) & 1u) == 1u;
}

// Neighbour `n` (bit 0: x, bit 1: y, bit 2: z) of the brick at `local`, or NONE.
fn neighbour(tile: u32, local: u32, n: u32) -> u32 {
    let x = (local & 7u) + (n & 1u);
    let y = (local >> 3u & 7u) + (n >> 1u & 1u);
    let z = (local >> 6u) + (n >> 2u);
    let at = tiles[tile].around[13u + 9u * (z >> 3u) + 3u * (y >> 3u) + (x >> 3u)];
    let there = (z & 7u) << 6u | (y & 7u) << 3u | (x & 7u);
    if (at == NONE || !brick_exists(at, there)) {
        return NONE;
    }
    return bricks_before(at, there);
}

// Coordinates of a brick within its tile.
fn local_brick(local: u32) -> vec3<i32> {
    return vec3<i32>(vec3<u32>(local, local >> 3u, local >> 6u) & vec3<u32>(7u));
}
