// Stage `interpolate` for surfaces of spheres: positions and normals of the vertices on crossing edges, and nearest
// spheres if requested. One workgroup per brick; a lane finds the edge of its vertex by rank among the crossing edges.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/record.wgsl
#include shared/quantize.wgsl
#include shared/counters.wgsl
#include shared/vertices.wgsl
#include shared/sphere_union.wgsl

// Writes the nearest sphere of each vertex if true.
override NEAREST: bool = false;

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> boundary: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> bricks: array<u32>;
@group(0) @binding(5) var<storage, read> lists: array<u32>;
@group(0) @binding(6) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read> crossings: array<f32>;
@group(0) @binding(8) var<storage, read> records: array<BrickRecord>;
@group(0) @binding(9) var<storage, read> counts: array<u32>;
@group(0) @binding(10) var<storage, read> offsets: array<vec2<u32>>;
@group(0) @binding(11) var<storage, read_write> positions: array<u32>;
@group(0) @binding(12) var<storage, read_write> normals: array<u32>;
@group(0) @binding(13) var<storage, read_write> sources: array<u32>;
@group(0) @binding(14) var<storage, read_write> counters: Counters;

@compute @workgroup_size(128)
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
    let n = counts[id] & 0xffffu;
    let first = offsets[id].x - params.piece_vertex;
    let origin = tiles[bricks[id] >> 9u].coord * 64 + local_brick(bricks[id] & 511u) * 8;
    load_brick(lane, id);
    workgroupBarrier();
    // A brick beyond the capacity is not written. The host detects it by the totals.
    if (n == 0u || first + n > params.vertex_capacity) {
        return;
    }
    let around = around_slot(id - params.first_brick, origin);
    for (var vertex = lane; vertex < n; vertex += LANES) {
        let p = vertex_of(edge_of(vertex));
        let found = nearest_at(around, p);
        if (NEAREST) {
            sources[first + vertex] = atoms[found.sphere].source;
        }
        write_vertex(first + vertex, origin, p, outward_at(around, p, found));
    }
    workgroupBarrier();
    add_bounds(lane);
}
