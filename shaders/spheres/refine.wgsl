// Stage `refine` for surfaces of spheres: moves the vertex of every crossing edge to the surface, by Newton's method
// within a bracket, with bisection if it is slow. One workgroup per brick, including halo bricks: `measure` uses their
// edges.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/corners.wgsl
#include shared/crossing.wgsl
#include shared/edge_list.wgsl
#include shared/sphere_union.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> boundary: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> bricks: array<u32>;
@group(0) @binding(5) var<storage, read> halo: array<u32>;
@group(0) @binding(6) var<storage, read> lists: array<u32>;
@group(0) @binding(7) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(8) var<storage, read> field: array<f32>;
@group(0) @binding(9) var<storage, read> inside: array<u32>;
@group(0) @binding(10) var<storage, read_write> crossings: array<f32>;

// Maximum number of steps. Every fourth one halves the bracket.
const MAX_STEPS: u32 = 64u;

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
    let around = around_slot(slot, origin);
    for (var i = lane; i < atomicLoad(&n_edges); i += LANES) {
        let edge = edges[i];
        let from_inside = first_value(edge) >= params.isovalue;
        var t = crossing_at(first_value(edge), second_value(edge));
        // Parameters of one point on each side of the surface.
        var low = 0.0;
        var high = 1.0;
        for (var step = 0u; step < MAX_STEPS; step++) {
            let p = vec3<f32>(first_point(edge)) + t * along(edge);
            let found = nearest_at(around, p);
            let value = found.distance - params.level;
            if ((value >= 0.0) == from_inside) {
                low = t;
            } else {
                high = t;
            }
            if (abs(value) <= params.tolerance || high - low <= params.tolerance) {
                break;
            }
            let outward = outward_at(around, p, found);
            let next = t + value * length(outward) / dot(outward, along(edge));
            let is_within = low < next && next < high;
            t = select(0.5 * (low + high), next, is_within && step % 4u != 3u);
        }
        crossings[crossing_index(edge)] = clamp(t, EDGE_MARGIN, 1.0 - EDGE_MARGIN);
    }
}
