// Stage `interpolate`: positions of the vertices on crossing edges, analytic normals, and nearest atoms if requested.
// One workgroup per brick; a lane finds the edge of its vertex by rank among the crossing edges.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/kernel.wgsl
#include shared/record.wgsl
#include shared/quantize.wgsl
#include shared/counters.wgsl
#include shared/vertices.wgsl

// Computes the nearest atom of each vertex if true.
override NEAREST: bool = false;

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> tiles: array<Tile>;
@group(0) @binding(3) var<storage, read> bricks: array<u32>;
@group(0) @binding(4) var<storage, read> lists: array<u32>;
@group(0) @binding(5) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(6) var<storage, read> crossings: array<f32>;
@group(0) @binding(7) var<storage, read> records: array<BrickRecord>;
@group(0) @binding(8) var<storage, read> counts: array<u32>;
@group(0) @binding(9) var<storage, read> offsets: array<vec2<u32>>;
// Words of the requested vertex layout: three per position and normal, or two per position and one per normal.
@group(0) @binding(10) var<storage, read_write> positions: array<u32>;
@group(0) @binding(11) var<storage, read_write> normals: array<u32>;
@group(0) @binding(12) var<storage, read_write> sources: array<u32>;
@group(0) @binding(13) var<storage, read_write> counters: Counters;

// Number of candidates staged at once.
const PIECE: u32 = 128u;

// Centre relative to the first grid point of the brick, and 1/ρ².
var<workgroup> staged: array<vec4<f32>, 128>;

// Contribution of an atom to the gradient at p, which is relative to the first grid point of the brick.
fn gradient_of(p: vec3<f32>, atom: vec4<f32>) -> vec3<f32> {
    let d = p - atom.xyz;
    let u = dot(d, d) * atom.w;
    return select(0.0, slope(u, params.u_min * atom.w) * atom.w, u < params.support) * d;
}

// Radius of a staged atom: ρ, or half of it for kernels whose support is twice the radius.
fn radius_of(atom: vec4<f32>) -> f32 {
    return select(0.5, 1.0, KERNEL == GAUSSIAN) * inverseSqrt(atom.w);
}

// Stages the candidates from `start` on, padded to a multiple of four by distant atoms.
fn stage_piece(lane: u32, head: vec4<u32>, start: u32, origin: vec3<i32>) {
    let n = min(PIECE, head.z - start);
    for (var i = lane; i < ((n + 3u) & ~3u); i += LANES) {
        var near = vec4<f32>(1e9, 1e9, 1e9, 1.0);
        if (i < n) {
            let atom = atoms[lists[head.x + start + i]];
            near = vec4<f32>(vec3<f32>(atom.cell - origin) + atom.frac, atom.inv_length2);
        }
        staged[i] = near;
    }
}

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
    let tile = bricks[id] >> 9u;
    let local = bricks[id] & 511u;
    let origin = tiles[tile].coord * 64 + local_brick(local) * 8;
    let head = heads[id - params.first_brick];
    load_brick(lane, id);
    stage_piece(lane, head, 0u, origin);
    workgroupBarrier();
    // A brick beyond the capacity is not written. The host detects it by the totals.
    if (n == 0u || first + n > params.vertex_capacity) {
        return;
    }
    for (var base = 0u; base < n; base += LANES) {
        let vertex = base + lane;
        let mine = vertex < n;
        var p = vec3<f32>(0.0);
        if (mine) {
            p = vertex_of(edge_of(vertex));
        }
        var gradient = vec3<f32>(0.0);
        var nearest = 3.402823e38;
        var source = 0u;
        for (var start = 0u; start == 0u || start < head.z; start += PIECE) {
            let in_piece = min(PIECE, head.z - start);
            if (head.z > PIECE && start + base > 0u) {
                workgroupBarrier();
                stage_piece(lane, head, start, origin);
                workgroupBarrier();
            }
            // No barriers follow, so lanes without a vertex may skip the rest.
            if (mine) {
                for (var i = 0u; i < in_piece; i += 4u) {
                    gradient += gradient_of(p, staged[i]);
                    gradient += gradient_of(p, staged[i + 1u]);
                    gradient += gradient_of(p, staged[i + 2u]);
                    gradient += gradient_of(p, staged[i + 3u]);
                }
                if (NEAREST) {
                    for (var i = 0u; i < in_piece; i++) {
                        let d = length(p - staged[i].xyz) - radius_of(staged[i]);
                        if (d < nearest) {
                            nearest = d;
                            source = start + i;
                        }
                    }
                }
            }
        }
        if (mine) {
            if (NEAREST) {
                sources[first + vertex] = atoms[lists[head.x + source]].source;
            }
            write_vertex(first + vertex, origin, p, gradient);
        }
    }
    workgroupBarrier();
    add_bounds(lane);
}
