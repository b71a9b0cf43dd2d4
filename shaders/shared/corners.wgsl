// Inside bits at the eight corners of 32 cells. Requires `inside`.

// Words of the bits at corner c of the cells: bit 0 of c is x, bit 1 is y, bit 2 is z.
struct Corners {
    low: vec4<u32>,
    high: vec4<u32>,
}

const FIRST_COLUMN: u32 = 0x01010101u;

fn half_word(brick: u32, at: u32) -> u32 {
    // NONE is a brick out of reach of all atoms, so no grid point of it is inside.
    if (brick == 0xffffffffu) {
        return 0u;
    }
    return inside[brick * 16u + at];
}

// Words shifted by one grid point along x, along y and along both.
fn plane_corners(own: u32, next: u32, x_own: u32, x_next: u32) -> vec4<u32> {
    let up = own >> 8u | next << 24u;
    let x_up = x_own >> 8u | x_next << 24u;
    let along = (own >> 1u & ~(FIRST_COLUMN << 7u)) | (x_own & FIRST_COLUMN) << 7u;
    let both = (up >> 1u & ~(FIRST_COLUMN << 7u)) | (x_up & FIRST_COLUMN) << 7u;
    return vec4<u32>(own, along, up, both);
}

// Corners in layer z. `near` holds the brick and its neighbours towards +x, +y and both.
fn plane_of(near: vec4<u32>, z: u32, half: u32) -> vec4<u32> {
    let at = 2u * z + half;
    let above = select(near.z, near.x, half == 0u);
    let x_above = select(near.w, near.y, half == 0u);
    let next = 2u * z + (1u - half);
    let own = half_word(near.x, at);
    let x_own = half_word(near.y, at);
    return plane_corners(own, half_word(above, next), x_own, half_word(x_above, next));
}

fn corners_of(near: vec4<u32>, near_above: vec4<u32>, z: u32, half: u32) -> Corners {
    let low = plane_of(near, z, half);
    if (z == 7u) {
        return Corners(low, plane_of(near_above, 0u, half));
    }
    return Corners(low, plane_of(near, z + 1u, half));
}

// Mask of the cells that the surface crosses.
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
