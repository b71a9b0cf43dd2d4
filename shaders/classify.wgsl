// Stage `classify`: crossing edges, and the numbers of vertices and triangles of every brick. A workgroup has four
// bricks and sixteen lanes per brick, one for each half layer of 32 grid points.
#include shared/params.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/corners.wgsl
#include shared/record.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> bricks: array<u32>;
@group(0) @binding(3) var<storage, read> inside: array<u32>;
@group(0) @binding(4) var<storage, read> cases: array<u32>;
@group(0) @binding(5) var<storage, read_write> records: array<BrickRecord>;
// Number of vertices, and number of triangles shifted by 16.
@group(0) @binding(6) var<storage, read_write> counts: array<u32>;
// Per group of 1024 bricks: number of vertices, triangles and bricks with triangles; the fourth word is unused.
@group(0) @binding(7) var<storage, read_write> groups: array<atomic<u32>>;

var<workgroup> neighbours: array<u32, 32>;
// Per half layer, its number of crossing edges by axis (ten bits each), and its number of triangles.
var<workgroup> edges: array<u32, 64>;
var<workgroup> triangles: array<u32, 64>;
var<workgroup> totals: array<vec2<u32>, 4>;

fn all_axes(n: u32) -> u32 {
    return (n & 1023u) + (n >> 10u & 1023u) + (n >> 20u);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = 4u * workgroup_number(workgroup, workgroups);
    let owner = lane >> 4u;
    let own = first + owner;
    let id = params.first_brick + own;
    let exists = own < params.n_own;
    let part = lane & 15u;
    if (part < 8u) {
        var brick = NONE;
        if (exists) {
            brick = neighbour(bricks[id] >> 9u, bricks[id] & 511u, part);
        }
        neighbours[8u * owner + part] = brick;
        if (exists) {
            records[id].neighbours[part] = brick;
        }
    }
    workgroupBarrier();
    let z = part >> 1u;
    let half = part & 1u;
    let b = 8u * owner;
    let here = vec4<u32>(neighbours[b], neighbours[b + 1u], neighbours[b + 2u], neighbours[b + 3u]);
    let above = vec4<u32>(neighbours[b + 4u], neighbours[b + 5u], neighbours[b + 6u], neighbours[b + 7u]);
    let c = corners_of(here, above, z, half);
    let crossing = vec3<u32>(c.low.x) ^ vec3<u32>(c.low.y, c.low.z, c.high.x);
    let n = countOneBits(crossing);
    edges[lane] = n.x | n.y << 10u | n.z << 20u;
    var n_triangles = 0u;
    for (var cells = active_cells(c); cells != 0u; cells &= cells - 1u) {
        n_triangles += cases[case_at(c, firstTrailingBit(cells))];
    }
    triangles[lane] = n_triangles;
    workgroupBarrier();
    if (exists) {
        for (var axis = 0u; axis < 3u; axis++) {
            let word = select(select(crossing.z, crossing.y, axis == 1u), crossing.x, axis == 0u);
            records[id].crossing[2u * (3u * z + axis) + half] = word;
        }
        if (half == 0u) {
            var before = 0u;
            for (var i = 0u; i < part; i++) {
                before += all_axes(edges[16u * owner + i]);
            }
            let layer = edges[lane] + edges[lane + 1u];
            records[id].layers[z] = before | (layer & 1023u) << 16u | (layer >> 10u & 1023u) << 24u;
        }
    }
    if (part == 0u) {
        var total = vec2<u32>(0u);
        for (var i = 0u; i < 16u; i++) {
            total += vec2<u32>(all_axes(edges[lane + i]), triangles[lane + i]);
        }
        totals[owner] = total;
        if (exists) {
            counts[id] = total.x | total.y << 16u;
        }
    }
    workgroupBarrier();
    // All bricks of a workgroup belong to one group.
    if (lane == 0u && exists) {
        let total = totals[0] + totals[1] + totals[2] + totals[3];
        let group = 4u * (first >> 10u);
        atomicAdd(&groups[group], total.x);
        atomicAdd(&groups[group + 1u], total.y);
        let some = vec4<u32>(vec4<u32>(totals[0].y, totals[1].y, totals[2].y, totals[3].y) > vec4<u32>(0u));
        atomicAdd(&groups[group + 2u], some.x + some.y + some.z + some.w);
    }
}
