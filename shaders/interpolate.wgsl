// Stage `interpolate`: vertex positions on crossing edges, analytic normals, and nearest atoms on request. One workgroup
// a brick; a lane finds its vertex by rank among the crossing edges.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/kernel.wgsl
#include shared/record.wgsl

// Whether to find the nearest atom of each vertex.
override NEAREST: bool = false;

struct Tally {
    list_end: u32,
    vertices: u32,
    triangles: u32,
    flat: atomic<u32>,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> tiles: array<Tile>;
@group(0) @binding(3) var<storage, read> bricks: array<u32>;
@group(0) @binding(4) var<storage, read> halo: array<u32>;
@group(0) @binding(5) var<storage, read> lists: array<u32>;
@group(0) @binding(6) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read> field: array<f32>;
@group(0) @binding(8) var<storage, read> records: array<Record>;
@group(0) @binding(9) var<storage, read> counts: array<u32>;
@group(0) @binding(10) var<storage, read> offsets: array<vec2<u32>>;
@group(0) @binding(11) var<storage, read_write> positions: array<f32>;
@group(0) @binding(12) var<storage, read_write> normals: array<f32>;
@group(0) @binding(13) var<storage, read_write> sources: array<u32>;
@group(0) @binding(14) var<storage, read_write> tally: Tally;

const LANES: u32 = 64u;
// Candidates staged at once.
const PIECE: u32 = 128u;
// As `EDGE_MARGIN` of every backend.
const EDGE_MARGIN: f32 = 1.0 / 1024.0;

var<workgroup> crossing: array<u32, 48>;
var<workgroup> layers: array<u32, 8>;
// The brick's slot and those of its neighbours towards +x, +y, +z.
var<workgroup> slots: array<u32, 4>;
// Centre from the brick's first sample, and 1/ρ².
var<workgroup> staged: array<vec4<f32>, 128>;
var<workgroup> staged_source: array<u32, 128>;
var<workgroup> written: array<f32, 192>;

// A crossing edge: its owner's bit, layer and axis.
struct Edge {
    bit: u32,
    z: u32,
    axis: u32,
}

fn edge_of(vertex: u32) -> Edge {
    var z = 0u;
    for (var step = 4u; step > 0u; step = step >> 1u) {
        if ((layers[z + step] & 0xffffu) <= vertex) {
            z += step;
        }
    }
    let layer = layers[z];
    var axis = 0u;
    axis += select(0u, 1u, before_word(layer, 1u) <= vertex);
    axis += select(0u, 1u, before_word(layer, 2u) <= vertex);
    let rank = vertex - before_word(layer, axis);
    let word = 2u * (3u * z + axis);
    let n_low = countOneBits(crossing[word]);
    if (rank < n_low) {
        return Edge(select_bit(crossing[word], rank), z, axis);
    }
    return Edge(32u + select_bit(crossing[word + 1u], rank - n_low), z, axis);
}

// Density at the far end of an edge.
fn density_beyond(edge: Edge) -> f32 {
    let at = vec3<u32>(edge.bit & 7u, edge.bit >> 3u, edge.z);
    let along = vec3<u32>(vec3<u32>(0u, 1u, 2u) == vec3<u32>(edge.axis));
    let next = at + along;
    let beyond = (next.x | next.y | next.z) > 7u;
    let slot = slots[select(0u, edge.axis + 1u, beyond)];
    if (slot == NONE) {
        // A brick out of every atom's reach.
        return 0.0;
    }
    let sample = next & vec3<u32>(7u);
    return field[slot * 512u + sample.z * 64u + sample.y * 8u + sample.x];
}

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
    let n = counts[id] & 0xffffu;
    let first = offsets[id].x - params.piece_vertex;
    // Where the estimate was too small nothing is written; the host sees the totals.
    if (n == 0u || first + n > params.vertex_capacity) {
        return;
    }
    let tile = bricks[id] >> 9u;
    let local = bricks[id] & 511u;
    let origin = tiles[tile].coord * 64 + local_brick(local) * 8;
    let head = heads[id - params.first_brick];
    if (lane < 48u) {
        crossing[lane] = records[id].crossing[lane];
    } else if (lane < 56u) {
        layers[lane - 48u] = records[id].layers[lane - 48u];
    } else if (lane < 59u) {
        slots[lane - 55u] = slot_of(neighbour(tile, local, 1u << (lane - 56u)));
    } else if (lane == 59u) {
        slots[0] = id - params.first_brick;
    }
    workgroupBarrier();
    for (var base = 0u; base < n; base += LANES) {
        let vertex = base + lane;
        let edge = edge_of(min(vertex, n - 1u));
        let inner = field[slots[0] * 512u + edge.z * 64u + edge.bit];
        let drop = inner - density_beyond(edge);
        let t = clamp((inner - params.isovalue) / drop, EDGE_MARGIN, 1.0 - EDGE_MARGIN);
        let along = select(vec3<f32>(0.0), vec3<f32>(t), vec3<u32>(0u, 1u, 2u) == vec3<u32>(edge.axis));
        let p = vec3<f32>(vec3<u32>(edge.bit & 7u, edge.bit >> 3u, edge.z)) + along;
        var gradient = vec3<f32>(0.0);
        var nearest = 3.402823e38;
        var source = 0u;
        for (var start = 0u; start < head.z; start += PIECE) {
            let in_piece = min(PIECE, head.z - start);
            if (base == 0u || head.z > PIECE) {
                workgroupBarrier();
                for (var i = lane; i < in_piece; i += LANES) {
                    let atom = atoms[lists[head.x + start + i]];
                    staged[i] = vec4<f32>(vec3<f32>(atom.cell - origin) + atom.frac, atom.inv_length2);
                    if (NEAREST) {
                        staged_source[i] = atom.source;
                    }
                }
                workgroupBarrier();
            }
            for (var i = 0u; i < in_piece; i++) {
                let a = staged[i];
                let d = p - a.xyz;
                let d2 = dot(d, d);
                let u = d2 * a.w;
                if (u < params.support) {
                    gradient += slope(u, params.u_min * a.w) * a.w * d;
                }
                if (NEAREST && d2 < nearest) {
                    nearest = d2;
                    source = staged_source[i];
                }
            }
        }
        // Below this, single precision has no direction left.
        let length2 = dot(gradient, gradient);
        let usable = length2 > 1e-14;
        let normal = gradient * select(0.0, inverseSqrt(length2), usable);
        let mine = vertex < n;
        if (mine && !usable) {
            atomicAdd(&tally.flat, 1u);
        }
        if (NEAREST && mine) {
            sources[first + vertex] = source;
        }
        // Whole steps are exact; the fraction is added before the one multiplication.
        let position = (vec3<f32>(origin - params.centre) + p) * params.spacing;
        let words = 3u * min(LANES, n - base);
        workgroupBarrier();
        written[3u * lane] = position.x;
        written[3u * lane + 1u] = position.y;
        written[3u * lane + 2u] = position.z;
        workgroupBarrier();
        for (var i = lane; i < words; i += LANES) {
            positions[3u * (first + base) + i] = written[i];
        }
        workgroupBarrier();
        written[3u * lane] = normal.x;
        written[3u * lane + 1u] = normal.y;
        written[3u * lane + 2u] = normal.z;
        workgroupBarrier();
        for (var i = lane; i < words; i += LANES) {
            normals[3u * (first + base) + i] = written[i];
        }
    }
}
