// The 2010 program, step 2 of 6: one thread per cube finds the cube's case, and counts active cubes and triangles.

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> field: array<u32>;
@group(0) @binding(2) var<storage, read> cases: array<u32>;
@group(0) @binding(3) var<storage, read_write> flags: array<u32>;
// Active cubes and triangles.
@group(0) @binding(4) var<storage, read_write> counts: array<vec2<u32>>;
// Set if a density is too close to the largest number of 32 bits.
@group(0) @binding(5) var<storage, read_write> dense: atomic<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(num_workgroups) workgroups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = workgroup_number(workgroup, workgroups) * 256u + lane;
    if (i >= grid.n_points) {
        return;
    }
    let cell = grid_point(i, grid.n);
    var flag = 0u;
    if (all(cell + vec3<u32>(1u) < grid.n)) {
        for (var c = 0u; c < 8u; c++) {
            let corner = cell + vec3<u32>(c & 1u, c >> 1u & 1u, c >> 2u);
            flag |= select(0u, 1u << c, field[point_ix(corner, grid.n)] >= ISO);
        }
    }
    if (field[i] >= 0x80000000u) {
        atomicStore(&dense, 1u);
    }
    let n = cases[flag];
    flags[i] = flag;
    counts[i] = vec2<u32>(select(0u, 1u, n > 0u), n);
}
