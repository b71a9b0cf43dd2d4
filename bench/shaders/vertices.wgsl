// The 2010 program, step 5 of 6: one thread per active cube writes its triangles, each with three vertices of its own.

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> field: array<u32>;
// Number of triangles of each case; from word 304 on, the edges of its triangles, four bits per corner.
@group(0) @binding(2) var<storage, read> cases: array<u32>;
@group(0) @binding(3) var<storage, read> flags: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> active_cubes: array<u32>;
@group(0) @binding(6) var<storage, read_write> positions: array<f32>;

const EDGE_MARGIN: f32 = 1.0 / 1024.0;

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
            // Differences of whole numbers are exact.
            let inner = i32(field[point_ix(start, grid.n)]);
            let outer = i32(field[point_ix(start + axis, grid.n)]);
            let s = clamp(f32(inner - i32(ISO)) / f32(inner - outer), EDGE_MARGIN, 1.0 - EDGE_MARGIN);
            let p = vec3<f32>(vec3<i32>(start) + grid.origin - grid.centre) + vec3<f32>(axis) * s;
            let at = 3u * (3u * (counts[i].y + t) + v);
            positions[at] = p.x * grid.spacing;
            positions[at + 1u] = p.y * grid.spacing;
            positions[at + 2u] = p.z * grid.spacing;
        }
    }
}
