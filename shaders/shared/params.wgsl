// What a dispatch needs to know. Lengths are in spacings unless said otherwise.
struct Params {
    // The sample that positions are relative to.
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
    // The compact kernels' factor.
    amplitude: f32,
    // Inverse square: least u, per 1/ρ².
    u_min: f32,
    // Gaussian: the slope is `2^(slope_offset - rate u) - slope_tail` up to a factor.
    slope_offset: f32,
    slope_tail: f32,
    // The longest reach of an atom.
    reach: f32,
    // Atoms that reach a brick live at most so many bricks before and behind it.
    back: u32,
    ahead: u32,
    // Tiles and bricks of the job.
    n_tiles: u32,
    n_bricks: u32,
    // The chunk's own bricks, and the borrowed ones that hold its neighbours' samples.
    first_brick: u32,
    n_own: u32,
    n_halo: u32,
    n_halo_slots: u32,
    // Entries that the chunk's candidate lists may take.
    list_capacity: u32,
    // Vertices and triangles before the chunk.
    first_vertex: u32,
    first_triangle: u32,
    // The piece of the output at hand: its bricks, where it begins in the mesh, what its buffers hold.
    piece_brick: u32,
    piece_bricks: u32,
    piece_vertex: u32,
    piece_triangle: u32,
    vertex_capacity: u32,
    triangle_capacity: u32,
    // Always 0, which no compiler knows: see `rounded`.
    zero: u32,
    // Vertices before the first that the device's own numbers count: those of other devices' parts.
    base_vertex: u32,
    // What positions are multiplied by before they are rounded, 1/Å; 0: vertices are single-precision numbers.
    steps_per_angstrom: f32,
}

// Number of a workgroup in a dispatch of two dimensions: one has too few workgroups for large grids.
fn workgroup_number(workgroup: vec3<u32>, workgroups: vec3<u32>) -> u32 {
    return workgroup.y * workgroups.x + workgroup.x;
}
