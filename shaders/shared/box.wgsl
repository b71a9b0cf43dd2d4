// The dense box of samples of the 2010 program. Needs `workgroup_number`.
struct Box {
    // The first sample.
    origin: vec3<i32>,
    n_atoms: u32,
    // Samples along each axis; the last of each begins no cell.
    n: vec3<u32>,
    n_samples: u32,
    // Fixed-point units of a density of 1.
    scale: f32,
    n_active: u32,
    n_triangles: u32,
    pad: u32,
}

// Fixed-point units of the isovalue: the host chooses the scale so.
const ISO: u32 = 1u << 21u;

fn place_of(i: u32, n: vec3<u32>) -> vec3<u32> {
    return vec3<u32>(i % n.x, i / n.x % n.y, i / (n.x * n.y));
}

fn sample_at(p: vec3<u32>, n: vec3<u32>) -> u32 {
    return (p.z * n.y + p.y) * n.x + p.x;
}

// The lower sample of a cell's edge `e`, and the axis along which the upper one is.
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
