// Declarations that the shaders of the 2010 program share. Lengths are in grid spacings unless stated otherwise.

// An atom on the grid: its nearest grid point, and its offset from that point.
struct Atom {
    cell: vec3<i32>,
    inv_length2: f32,
    frac: vec3<f32>,
    source: u32,
}

// The dense grid, and the constants of the kernel.
struct Grid {
    // The first grid point.
    origin: vec3<i32>,
    n_atoms: u32,
    // Grid points along each axis; the last of each begins no cell.
    n: vec3<u32>,
    n_points: u32,
    // The grid point that positions are relative to.
    centre: vec3<i32>,
    // Å.
    spacing: f32,
    // Fixed-point units of a density of 1.
    scale: f32,
    n_active: u32,
    // u = d²/ρ² from which on the density is 0.
    support: f32,
    // Gaussian: the exponent of 2 is 3 share - rate u; the cut-off's linear term is 3 tail_share + tail_rate u.
    share: f32,
    rate: f32,
    tail_share: f32,
    tail_rate: f32,
    // Factor of the other kernels.
    amplitude: f32,
    // Inverse square: the lower bound of u, per 1/ρ².
    u_min: f32,
    pad_0: u32,
    pad_1: u32,
    pad_2: u32,
}

// Fixed-point units of the isovalue: the host chooses `scale` accordingly.
const ISO: u32 = 1u << 21u;

// Number of a workgroup in a dispatch of two dimensions: one dimension has too few workgroups for large grids.
fn workgroup_number(workgroup: vec3<u32>, workgroups: vec3<u32>) -> u32 {
    return workgroup.y * workgroups.x + workgroup.x;
}

// Grid point with the index `i` in a grid of `n` points.
fn grid_point(i: u32, n: vec3<u32>) -> vec3<u32> {
    return vec3<u32>(i % n.x, i / n.x % n.y, i / (n.x * n.y));
}

fn point_ix(p: vec3<u32>, n: vec3<u32>) -> u32 {
    return (p.z * n.y + p.y) * n.x + p.x;
}

// The lower grid point of a cell's edge `e`, and the axis along which the upper one lies.
fn edge_start(cell: vec3<u32>, e: u32) -> vec3<u32> {
    let low = e & 1u;
    let high = e >> 1u & 1u;
    switch (e >> 2u) {
        case 0u: { return cell + vec3<u32>(0u, low, high); }
        case 1u: { return cell + vec3<u32>(low, 0u, high); }
        default: { return cell + vec3<u32>(low, high, 0u); }
    }
}

fn edge_axis(e: u32) -> vec3<u32> {
    return select(vec3<u32>(0u), vec3<u32>(1u), vec3<u32>(0u, 1u, 2u) == vec3<u32>(e >> 2u));
}
