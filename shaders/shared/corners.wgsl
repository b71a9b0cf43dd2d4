// Inside bits at the eight corners of 32 cells. Needs `inside`.

// The halves at corner c of the cells: bit 0 of c is x, 1 y, 2 z.
struct Corners {
    low: vec4<u32>,
    high: vec4<u32>,
}

const FIRST_COLUMN: u32 = 0x01010101u;

fn half_word(brick: u32, at: u32) -> u32 {
    // NONE is a brick out of every atom's reach: nothing of it is inside.
    if (brick == 0xffffffffu) {
        return 0u;
    }
    return inside[brick * 16u + at];
}

// Shifted by one sample along x, y and both.
fn plane_corners(own: u32, next: u32, x_own: u32, x_next: u32) -> vec4<u32> {
    let up = own >> 8u | next << 24u;
    let x_up = x_own >> 8u | x_next << 24u;
    let along = (own >> 1u & ~(FIRST_COLUMN << 7u)) | (x_own & FIRST_COLUMN) << 7u;
    let both = (up >> 1u & ~(FIRST_COLUMN << 7u)) | (x_up & FIRST_COLUMN) << 7u;
    return vec4<u32>(own, along, up, both);
}

// `near`: the brick and its neighbours towards +x, +y, +z, first those of the same layer of bricks.
fn plane_of(near: vec4<u32>, z: u32, half: u32) -> vec4<u32> {
    let at = 2u * z + half;
    let above = select(near.z, near.x, half == 0u);
    let x_above = select(near.w, near.y, half == 0u);
    let next = 2u * z + (1u - half);
    return plane_corners(half_word(near.x, at), half_word(above, next), half_word(near.y, at), half_word(x_above, next));
}

fn corners_of(near: vec4<u32>, near_above: vec4<u32>, z: u32, half: u32) -> Corners {
    let low = plane_of(near, z, half);
    if (z == 7u) {
        return Corners(low, plane_of(near_above, 0u, half));
    }
    return Corners(low, plane_of(near, z + 1u, half));
}

// Cells that the surface passes through.
fn active_cells(c: Corners) -> u32 {
    let some = c.low | c.high;
    let every = c.low & c.high;
    return (some.x | some.y | some.z | some.w) & ~(every.x & every.y & every.z & every.w);
}

// Case of the cell at `bit`.
fn case_at(c: Corners, bit: u32) -> u32 {
    let low = c.low >> vec4<u32>(bit) & vec4<u32>(1u);
    let high = c.high >> vec4<u32>(bit) & vec4<u32>(1u);
    return low.x | low.y << 1u | low.z << 2u | low.w << 3u | high.x << 4u | high.y << 5u | high.z << 6u | high.w << 7u;
}
