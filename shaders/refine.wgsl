// Stage `refine`: moves the vertex of every crossing edge to the isosurface, by one step of Newton's method from the
// linearly interpolated crossing. One workgroup per brick, including halo bricks: `measure` uses their edges.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/kernel.wgsl
#include shared/corners.wgsl
#include shared/crossing.wgsl
#include shared/edge_list.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> tiles: array<Tile>;
@group(0) @binding(3) var<storage, read> bricks: array<u32>;
@group(0) @binding(4) var<storage, read> halo: array<u32>;
@group(0) @binding(5) var<storage, read> lists: array<u32>;
@group(0) @binding(6) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read> field: array<f32>;
@group(0) @binding(8) var<storage, read> inside: array<u32>;
@group(0) @binding(9) var<storage, read_write> crossings: array<f32>;

// Maximum step, as a share of the rest of the edge. Same value as `MAX_SHARE` in `surface/cpu/interpolate.rs`.
const MAX_SHARE: f32 = 0.75;

// Parameter of the isosurface on an edge, by one step on the logarithm of the density from t, where the density is
// `value` and has the derivative `derivative` along the edge. The root lies between t and the end of the edge on the
// other side of the surface.
fn newton(t: f32, from_inside: bool, value: f32, derivative: f32) -> f32 {
    let rest = select(0.0, 1.0, (value >= params.isovalue) == from_inside) - t;
    // 2 (r - 1)/(r + 1) approximates ln r for the ratio r. The step is `step / whole` of the rest. It is compared
    // before the division, because the derivative may be 0.
    let step = -2.0 * (value - params.isovalue) * value;
    let whole = (value + params.isovalue) * derivative * rest;
    let is_within = step * sign(whole) >= 0.0 && abs(step) < MAX_SHARE * abs(whole);
    let share = select(MAX_SHARE, step / select(1.0, whole, is_within), is_within);
    return clamp(t + share * rest, EDGE_MARGIN, 1.0 - EDGE_MARGIN);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let slot = workgroup_number(workgroup, workgroups);
    if (slot >= params.n_own + params.n_halo) {
        return;
    }
    let id = brick_in(slot);
    list_edges(lane, id, slot);
    let origin = tiles[bricks[id] >> 9u].coord * 64 + local_brick(bricks[id] & 511u) * 8;
    let head = heads[slot];
    for (var i = lane; i < atomicLoad(&n_edges); i += LANES) {
        let edge = edges[i];
        let from_inside = first_value(edge) >= params.isovalue;
        let t = crossing_at(first_value(edge), second_value(edge));
        let p = vec3<f32>(first_point(edge)) + t * along(edge);
        var value = 0.0;
        var gradient = vec3<f32>(0.0);
        for (var k = 0u; k < head.z; k++) {
            let atom = atoms[lists[head.x + k]];
            let d = p - (vec3<f32>(atom.cell - origin) + atom.frac);
            let u = dot(d, d) * atom.inv_length2;
            let u_min = params.u_min * atom.inv_length2;
            value += density_at(u, u_min);
            gradient += select(0.0, slope(u, u_min) * atom.inv_length2, u < params.support) * d;
        }
        let slope_along = -2.0 * params.slope_scale * dot(gradient, along(edge));
        crossings[crossing_index(edge)] = newton(t, from_inside, value, slope_along);
    }
}
