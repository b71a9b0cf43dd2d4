// The 2010 program, step 1 of 6: one thread per atom adds the atom's density to the grid points around it. WGSL has no
// atomic addition of floats, so densities are fixed-point numbers: devices add them natively, and the sum does not
// depend on the order.

override KERNEL: u32 = 0u;

const GAUSSIAN: u32 = 0u;
const SOFT_OBJECT: u32 = 1u;

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read_write> field: array<atomic<u32>>;

// Maximum density of one atom, in isovalues: 64 atoms at one position still fit in 32 bits. Only grid points deep
// inside the molecule reach it.
const MAX_DENSITY: f32 = 32.0;

fn value(u: f32, u_min: f32) -> f32 {
    if (KERNEL == GAUSSIAN) {
        let tail = 3.0 * grid.tail_share + grid.tail_rate * u;
        return exp2(3.0 * grid.share - grid.rate * u) + tail;
    }
    let t = 1.0 - u;
    let t2 = t * t * grid.amplitude;
    if (KERNEL == SOFT_OBJECT) {
        return t2 * (1.0 - 4.0 / 9.0 * u);
    }
    return t2 / max(u, u_min);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(num_workgroups) workgroups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = workgroup_number(workgroup, workgroups) * 64u + lane;
    if (i >= grid.n_atoms) {
        return;
    }
    let atom = atoms[i];
    let u_min = grid.u_min * atom.inv_length2;
    let reach = sqrt(grid.support / atom.inv_length2);
    // Steps from the grid point nearest to the centre.
    let first = vec3<i32>(ceil(atom.frac - reach));
    let last = vec3<i32>(floor(atom.frac + reach));
    let centre = atom.cell - grid.origin;
    for (var z = first.z; z <= last.z; z++) {
        let dz = f32(z) - atom.frac.z;
        for (var y = first.y; y <= last.y; y++) {
            let dy = f32(y) - atom.frac.y;
            let row = point_ix(vec3<u32>(centre + vec3<i32>(0, y, z)), grid.n);
            for (var x = first.x; x <= last.x; x++) {
                let dx = f32(x) - atom.frac.x;
                let u = (dx * dx + dy * dy + dz * dz) * atom.inv_length2;
                if (u < grid.support) {
                    let density = clamp(value(u, u_min) * grid.scale, 0.0, MAX_DENSITY * f32(ISO));
                    atomicAdd(&field[row + u32(x)], u32(density + 0.5));
                }
            }
        }
    }
}
