// Parameters of a dispatch. Lengths are in spacings unless said otherwise.
struct Params {
    // Grid point that positions are relative to.
    centre: vec3<i32>,
    // Spacing, Å.
    spacing: f32,
    isovalue: f32,
    // u from which on the density is 0.
    support: f32,
    // Gaussian: the exponent of 2 is `share - rate u` per axis; the three shares carry the amplitude.
    share: f32,
    rate: f32,
    // Gaussian: the cut-off's linear term is `tail_share + tail_rate u` per axis, `tail_end` at the support.
    tail_share: f32,
    tail_rate: f32,
    tail_end: f32,
    // Factor of the compact kernels.
    amplitude: f32,
    // Inverse square: minimum u, per 1/ρ².
    u_min: f32,
    // Gaussian: the slope is `2^(slope_offset - rate u) - slope_tail` up to a factor.
    slope_offset: f32,
    slope_tail: f32,
    // Maximum reach of an atom.
    reach: f32,
    // Number of bricks before and behind a brick, per axis, whose atoms may reach it.
    back: u32,
    ahead: u32,
    // Number of tiles of the job.
    n_tiles: u32,
    // Capacity of the blocks of sheets and the table of their offsets, in words.
    sheet_capacity: u32,
    // Own bricks of the chunk, halo bricks, and entries of the table of halo slots.
    first_brick: u32,
    n_own: u32,
    n_halo: u32,
    n_halo_slots: u32,
    // Capacity of the candidate lists, in entries.
    list_capacity: u32,
    // Number of vertices and triangles before the chunk.
    first_vertex: u32,
    first_triangle: u32,
    // Output piece: its bricks, the number of vertices and triangles before it, and the capacity of its buffers.
    piece_brick: u32,
    piece_bricks: u32,
    piece_vertex: u32,
    piece_triangle: u32,
    vertex_capacity: u32,
    triangle_capacity: u32,
    // Always 0, but unknown to the compiler; see `rounded` in `bin.wgsl`.
    zero: u32,
    // Number of vertices in earlier partitions, which other devices compute.
    base_vertex: u32,
    // Factor of positions before rounding to integers, 1/Å; 0 for vertices in single precision.
    steps_per_angstrom: f32,
    // -dF/du is the slope times this.
    slope_scale: f32,
    // Number of bricks of the job.
    n_bricks: u32,
    // Surfaces of spheres: depth of the surface below the boundary, and maximum distance of vertices from it.
    level: f32,
    tolerance: f32,
    // Number of kinds of candidates: 2 with the arcs of a boundary, else 1 (atoms).
    n_kinds: u32,
    // `reach`, `back` and `ahead` of the arcs.
    arc_reach: f32,
    arc_back: u32,
    arc_ahead: u32,
}

// Index of a workgroup. Dispatches have two dimensions, because one has too few workgroups for large grids.
fn workgroup_number(workgroup: vec3<u32>, workgroups: vec3<u32>) -> u32 {
    return workgroup.y * workgroups.x + workgroup.x;
}
