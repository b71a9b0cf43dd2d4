// Stage `emit`: triangle indices and their checksum. One workgroup per brick. A lane lists the triangles of a row of
// eight cells; then each lane writes single indices, so that memory accesses are contiguous.
//
// The index of a vertex is the rank of its edge among the crossing edges of the owner's brick.
#include shared/params.wgsl
#include shared/bits.wgsl
#include shared/record.wgsl
#include shared/counters.wgsl
#include shared/checksum.wgsl
#include shared/triangles.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> inside: array<u32>;
@group(0) @binding(2) var<storage, read> cases: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> records: array<BrickRecord>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read> offsets: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> triangles: array<u32>;
@group(0) @binding(7) var<storage, read_write> counters: Counters;

// Checksum of the brick's triangles.
var<workgroup> checksum: array<atomic<u32>, 2>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    if (number >= params.piece_bricks) {
        return;
    }
    let id = params.piece_brick + number;
    let n = counts[id] >> 16u;
    let first = offsets[id].y - params.piece_triangle;
    load_rows(id, lane);
    if (lane < 2u) {
        atomicStore(&checksum[lane], 0u);
    }
    if (lane < 36u) {
        // A layer of the brick or of a neighbour at the same z; the lowest layer of a neighbour above.
        let which = select(lane - 28u, lane >> 3u, lane < 32u);
        let layer = select(0u, lane & 7u, lane < 32u);
        let brick = records[id].neighbours[which];
        if (brick != NONE) {
            var before = params.base_vertex + offsets[brick].x + (records[brick].layers[layer] & 0xffffu);
            let at = 81u * (which & 1u) + 3u * (layer + (which >> 2u) * 8u) + (which & 2u);
            let x_low = records[brick].crossing[6u * layer];
            let x_high = records[brick].crossing[6u * layer + 1u];
            let y_low = records[brick].crossing[6u * layer + 2u];
            let y_high = records[brick].crossing[6u * layer + 3u];
            let z_low = records[brick].crossing[6u * layer + 4u];
            let z_high = records[brick].crossing[6u * layer + 5u];
            // Of a neighbour along y, only the lowest rows are needed, and the array has space for these only.
            let whole = (which & 2u) == 0u;
            edges[at] = vec2<u32>(x_low, before);
            before += countOneBits(x_low);
            if (whole) { edges[at + 1u] = vec2<u32>(x_high, before); }
            before += countOneBits(x_high);
            edges[at + 27u] = vec2<u32>(y_low, before);
            before += countOneBits(y_low);
            if (whole) { edges[at + 28u] = vec2<u32>(y_high, before); }
            before += countOneBits(y_high);
            edges[at + 54u] = vec2<u32>(z_low, before);
            before += countOneBits(z_low);
            if (whole) { edges[at + 55u] = vec2<u32>(z_high, before); }
        }
    }
    workgroupBarrier();
    if (n == 0u || first + n > params.triangle_capacity) {
        return;
    }
    let row = row_of(lane);
    let start = scan_lanes(lane, row.n) - row.n;
    let t0 = lane / 3u;
    let k0 = lane - 3u * t0;
    let t1 = (lane + 64u) / 3u;
    let k1 = lane + 64u - 3u * t1;
    let t2 = (lane + 128u) / 3u;
    let k2 = lane + 128u - 3u * t2;
    for (var window = 0u; window < n; window += WINDOW) {
        list_row(row, start - window);
        workgroupBarrier();
        let words = 3u * min(WINDOW, n - window);
        let base = 3u * (first + window);
        // 192 indices are 64 triangles, so a lane writes the same corners of every 64th triangle.
        var i = lane;
        for (var at = 0u; i < words; at += LANES) {
            triangles[base + i] = vertex_on(edge_at(at + t0, k0));
            if (i + 64u < words) { triangles[base + i + 64u] = vertex_on(edge_at(at + t1, k1)); }
            if (i + 128u < words) { triangles[base + i + 128u] = vertex_on(edge_at(at + t2, k2)); }
            i += 192u;
        }
        workgroupBarrier();
    }
    // Reads the indices back: the checksum is that of the stored triangles.
    storageBarrier();
    var sum = vec2<u32>(0u);
    for (var i = lane; i < n; i += LANES) {
        let at = 3u * (first + i);
        let t = vec3<u32>(triangles[at], triangles[at + 1u], triangles[at + 2u]);
        sum = add64(sum, add64(edge_share(t.x, t.y), add64(edge_share(t.y, t.z), edge_share(t.z, t.x))));
        if (t.x == t.y || t.y == t.z || t.z == t.x) {
            atomicAdd(&counters.degenerate, 1u);
        }
    }
    let before = atomicAdd(&checksum[0], sum.x);
    atomicAdd(&checksum[1], sum.y + select(0u, 1u, before + sum.x < before));
    workgroupBarrier();
    if (lane == 0u) {
        let low = atomicLoad(&checksum[0]);
        let all_before = atomicAdd(&counters.checksum[0], low);
        let carry = select(0u, 1u, all_before + low < all_before);
        atomicAdd(&counters.checksum[1], atomicLoad(&checksum[1]) + carry);
    }
}
