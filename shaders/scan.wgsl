// Stage `scan`: exclusive scan over bricks, which yields the first vertex and the first triangle of each. One workgroup
// per group of 1024 bricks. `classify` has added up the groups, so workgroups do not depend on each other.
#include shared/params.wgsl
#include shared/counters.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> groups: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> offsets: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read_write> counters: Counters;

const LANES: u32 = 256u;

var<workgroup> sums: array<vec2<u32>, 256>;

fn split(count: u32) -> vec2<u32> {
    return vec2<u32>(count & 0xffffu, count >> 16u);
}

// Replaces `sums` by inclusive sums.
fn scan_sums(lane: u32) {
    for (var step = 1u; step < LANES; step = step << 1u) {
        workgroupBarrier();
        let before = select(vec2<u32>(0u), sums[(lane - step) & 255u], lane >= step);
        workgroupBarrier();
        sums[lane] += before;
    }
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let group = workgroup_number(workgroup, workgroups);
    if (group * 1024u >= params.n_own) {
        return;
    }
    // Sum of the groups before.
    var sum = vec2<u32>(0u);
    for (var i = lane; i < group; i += LANES) {
        sum += groups[i].xy;
    }
    sums[lane] = sum;
    scan_sums(lane);
    let before = sums[LANES - 1u] + vec2<u32>(params.first_vertex, params.first_triangle);
    workgroupBarrier();
    let first = group * 1024u + 4u * lane;
    let c0 = load(first);
    let c1 = load(first + 1u);
    let c2 = load(first + 2u);
    let c3 = load(first + 3u);
    sums[lane] = c0 + c1 + c2 + c3;
    scan_sums(lane);
    let start = before + select(vec2<u32>(0u), sums[(lane - 1u) & 255u], lane > 0u);
    store(first, start);
    store(first + 1u, start + c0);
    store(first + 2u, start + c0 + c1);
    store(first + 3u, start + c0 + c1 + c2);
    if ((group + 1u) * 1024u >= params.n_own && lane == 0u) {
        let end = before + sums[LANES - 1u];
        atomicStore(&counters.vertices, end.x);
        atomicStore(&counters.triangles, end.y);
    }
}

fn load(own: u32) -> vec2<u32> {
    if (own >= params.n_own) {
        return vec2<u32>(0u);
    }
    return split(counts[params.first_brick + own]);
}

fn store(own: u32, value: vec2<u32>) {
    if (own < params.n_own) {
        offsets[params.first_brick + own] = value;
    }
}
