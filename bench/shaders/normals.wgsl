// The 2010 program, step 6 of 6: normals from central differences of the density at both ends of each vertex's edge.

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> field: array<u32>;
@group(0) @binding(2) var<storage, read> cases: array<u32>;
@group(0) @binding(3) var<storage, read> flags: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> active_cubes: array<u32>;
@group(0) @binding(6) var<storage, read> positions: array<f32>;
@group(0) @binding(7) var<storage, read_write> normals: array<f32>;

// Twice the gradient at a grid point. No atom reaches the outermost grid points, so no edge with a vertex ends there.
fn difference(p: vec3<u32>) -> vec3<f32> {
    let x = vec3<u32>(1u, 0u, 0u);
    let y = vec3<u32>(0u, 1u, 0u);
    let z = vec3<u32>(0u, 0u, 1u);
    let more = vec3<u32>(field[point_ix(p + x, grid.n)], field[point_ix(p + y, grid.n)], field[point_ix(p + z, grid.n)]);
    let less = vec3<u32>(field[point_ix(p - x, grid.n)], field[point_ix(p - y, grid.n)], field[point_ix(p - z, grid.n)]);
    return vec3<f32>(bitcast<vec3<i32>>(more) - bitcast<vec3<i32>>(less));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(num_workgroups) workgroups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let number = workgroup_number(workgroup, workgroups) * 64u + lane;
    if (number >= grid.n_active) {
        return;
    }
    let i = active_cubes[number];
    let cell = grid_point(i, grid.n);
    let flag = flags[i];
    for (var t = 0u; t < cases[flag]; t++) {
        for (var v = 0u; v < 3u; v++) {
            let corner = 3u * t + v;
            let e = cases[304u + 2u * flag + (corner >> 3u)] >> (4u * (corner & 7u)) & 15u;
            let start = edge_start(cell, e);
            let axis = edge_axis(e);
            let at = 3u * (3u * (counts[i].y + t) + v);
            let p = vec3<f32>(positions[at], positions[at + 1u], positions[at + 2u]) / grid.spacing;
            let along = dot(p - vec3<f32>(vec3<i32>(start) + grid.origin - grid.centre), vec3<f32>(axis));
            let gradient = mix(difference(start), difference(start + axis), along);
            let length2 = dot(gradient, gradient);
            // Zero where the gradient vanishes.
            let normal = -gradient * select(0.0, inverseSqrt(length2), length2 > 0.0);
            normals[at] = normal.x;
            normals[at + 1u] = normal.y;
            normals[at + 2u] = normal.z;
        }
    }
}
