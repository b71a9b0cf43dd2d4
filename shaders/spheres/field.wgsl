// Stage `field` for surfaces of spheres: distance to the boundary at the 8 × 8 × 8 grid points of every brick, and the
// bits of the grid points inside the surface. One workgroup per brick, one lane per column of grid points along z.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/sphere_union.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> boundary: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> bricks: array<u32>;
@group(0) @binding(5) var<storage, read> lists: array<u32>;
@group(0) @binding(6) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read_write> field: array<f32>;
@group(0) @binding(8) var<storage, read_write> inside: array<u32>;

var<workgroup> bits: array<atomic<u32>, 16>;

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
    let id = heads[slot].w;
    let origin = tiles[bricks[id] >> 9u].coord * 64 + local_brick(bricks[id] & 511u) * 8;
    let around = around_slot(slot, origin);
    if (lane < 16u) {
        atomicStore(&bits[lane], 0u);
    }
    workgroupBarrier();
    // A sphere or an arc is loaded once for all points of the column.
    let xy = vec2<f32>(f32(lane & 7u), f32(lane >> 3u));
    var distance = array<f32, 8>();
    var sphere = array<u32, 8>();
    for (var z = 0u; z < 8u; z++) {
        distance[z] = -3.0e38;
    }
    for (var i = 0u; i < around.spheres.y; i++) {
        let index = lists[around.spheres.x + i];
        let ball = sphere_at(index, origin);
        let d = xy - ball.xy;
        for (var z = 0u; z < 8u; z++) {
            let dz = f32(z) - ball.z;
            let depth = ball.w - sqrt((d.x * d.x + d.y * d.y) + dz * dz);
            let is_deeper = depth > distance[z];
            distance[z] = select(distance[z], depth, is_deeper);
            sphere[z] = select(sphere[z], index, is_deeper);
        }
    }
    var buried = 0u;
    for (var z = 0u; z < 8u; z++) {
        if (needs_arcs(around, vec3<f32>(xy, f32(z)), Nearest(distance[z], sphere[z], NONE))) {
            buried |= 1u << z;
        }
    }
    if (buried != 0u) {
        let most = params.level + 1.0;
        var least = array<f32, 8>();
        for (var z = 0u; z < 8u; z++) {
            least[z] = most * most;
        }
        for (var i = 0u; i < around.arcs.z; i++) {
            let arc = arc_at(lists[around.arcs.x + i], origin);
            for (var z = 0u; z < 8u; z++) {
                if ((buried >> z & 1u) == 1u) {
                    least[z] = min(least[z], distance2_to(arc, vec3<f32>(xy, f32(z))));
                }
            }
        }
        for (var z = 0u; z < 8u; z++) {
            distance[z] = select(distance[z], sqrt(least[z]), (buried >> z & 1u) == 1u);
        }
    }
    for (var z = 0u; z < 8u; z++) {
        // The surface has the value 1. Outside all spheres, the distance itself is not needed.
        let exact = clamp(params.isovalue + (distance[z] - params.level), 0.0, 2.0 * params.isovalue);
        let value = select(0.0, exact, distance[z] > 0.0);
        field[slot * 512u + 64u * z + lane] = value;
        if (value >= params.isovalue) {
            atomicOr(&bits[2u * z + (lane >> 5u)], 1u << (lane & 31u));
        }
    }
    workgroupBarrier();
    if (lane < 16u) {
        inside[id * 16u + lane] = atomicLoad(&bits[lane]);
    }
}
