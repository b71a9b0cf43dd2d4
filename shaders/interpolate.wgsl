// Stage `interpolate`: vertex positions on crossing edges, analytic normals, and nearest atoms if requested. One
// workgroup per brick; a lane finds the edge of its vertex by rank among the crossing edges.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/kernel.wgsl
#include shared/record.wgsl
#include shared/quantize.wgsl
#include shared/crossing.wgsl
#include shared/counters.wgsl

// Computes the nearest atom of each vertex if true.
override NEAREST: bool = false;

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> tiles: array<Tile>;
@group(0) @binding(3) var<storage, read> bricks: array<u32>;
@group(0) @binding(4) var<storage, read> halo: array<u32>;
@group(0) @binding(5) var<storage, read> lists: array<u32>;
@group(0) @binding(6) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read> field: array<f32>;
@group(0) @binding(8) var<storage, read> records: array<BrickRecord>;
@group(0) @binding(9) var<storage, read> counts: array<u32>;
@group(0) @binding(10) var<storage, read> offsets: array<vec2<u32>>;
// Words of the requested vertex layout: three per position and normal, or two per position and one per normal.
@group(0) @binding(11) var<storage, read_write> positions: array<u32>;
@group(0) @binding(12) var<storage, read_write> normals: array<u32>;
@group(0) @binding(13) var<storage, read_write> sources: array<u32>;
@group(0) @binding(14) var<storage, read_write> counters: Counters;

const LANES: u32 = 128u;
// Number of candidates staged at once.
const PIECE: u32 = 128u;

var<workgroup> crossing: array<u32, 48>;
var<workgroup> layers: array<u32, 8>;
// Slots of the brick and of its neighbours towards +x, +y and +z.
var<workgroup> slots: array<u32, 4>;
// Centre relative to the first grid point of the brick, and 1/ρ².
var<workgroup> staged: array<vec4<f32>, 128>;

// Keys of the highest position per axis so far, and of the highest negative position.
var<workgroup> bounds: array<atomic<u32>, 6>;

// Integer with the order of the floating-point number; more than 0 for every number.
fn order_key(v: f32) -> u32 {
    let bits = bitcast<u32>(v);
    return bits ^ select(0x80000000u, 0xffffffffu, bits >> 31u == 1u);
}

fn raise_bound(i: u32, v: f32) {
    let key = order_key(v);
    if (key > atomicLoad(&bounds[i])) {
        atomicMax(&bounds[i], key);
    }
}

// Extends the bounds by a position.
fn raise_bounds(p: vec3<f32>) {
    raise_bound(0u, p.x);
    raise_bound(1u, p.y);
    raise_bound(2u, p.z);
    raise_bound(3u, -p.x);
    raise_bound(4u, -p.y);
    raise_bound(5u, -p.z);
}

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

// Crossing edge: bit and layer of its owner, and axis.
struct Edge {
    bit: u32,
    z: u32,
    axis: u32,
}

fn edge_of(vertex: u32) -> Edge {
    var z = select(0u, 4u, (layers[4] & 0xffffu) <= vertex);
    z += select(0u, 2u, (layers[z + 2u] & 0xffffu) <= vertex);
    z += select(0u, 1u, (layers[z + 1u] & 0xffffu) <= vertex);
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

// Density at the second grid point of an edge.
fn density_beyond(edge: Edge) -> f32 {
    let at = vec3<u32>(edge.bit & 7u, edge.bit >> 3u, edge.z);
    let along = vec3<u32>(vec3<u32>(0u, 1u, 2u) == vec3<u32>(edge.axis));
    let next = at + along;
    let beyond = (next.x | next.y | next.z) > 7u;
    let slot = slots[select(0u, edge.axis + 1u, beyond)];
    if (slot == NONE) {
        // A brick out of reach of all atoms.
        return 0.0;
    }
    let point = next & vec3<u32>(7u);
    return field[slot * 512u + point.z * 64u + point.y * 8u + point.x];
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
    if (lane < 48u) {
        crossing[lane] = records[id].crossing[lane];
    } else if (lane < 56u) {
        layers[lane - 48u] = records[id].layers[lane - 48u];
    } else if (lane < 59u) {
        slots[lane - 55u] = slot_of(records[id].neighbours[1u << (lane - 56u)]);
    } else if (lane == 59u) {
        slots[0] = id - params.first_brick;
    } else if (lane < 66u) {
        atomicStore(&bounds[lane - 60u], atomicLoad(&counters.bounds[lane - 60u]));
    }
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
            if (mine && start == 0u) {
                let edge = edge_of(vertex);
                let inner = field[slots[0] * 512u + edge.z * 64u + edge.bit];
                let t = crossing_at(inner, density_beyond(edge));
                let along = select(vec3<f32>(0.0), vec3<f32>(t), vec3<u32>(0u, 1u, 2u) == vec3<u32>(edge.axis));
                p = vec3<f32>(vec3<u32>(edge.bit & 7u, edge.bit >> 3u, edge.z)) + along;
            }
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
            // A shorter gradient has no significant direction in single precision.
            let length2 = dot(gradient, gradient);
            let usable = length2 > 1e-14;
            let normal = gradient * select(0.0, inverseSqrt(length2), usable);
            if (!usable) {
                atomicAdd(&counters.flat, 1u);
            }
            if (NEAREST) {
                sources[first + vertex] = atoms[lists[head.x + source]].source;
            }
            // Whole cells are exact; the fraction is added before the only multiplication.
            let position = (vec3<f32>(origin - params.centre) + p) * params.spacing;
            if (params.steps_per_angstrom > 0.0) {
                let at = first + vertex;
                let rounded = quantized_position(position * params.steps_per_angstrom);
                positions[2u * at] = rounded.x;
                positions[2u * at + 1u] = rounded.y;
                raise_bounds(vec3<f32>(steps_of(rounded)));
                normals[at] = quantized_normal(normal);
            } else {
                let at = 3u * (first + vertex);
                let words = bitcast<vec3<u32>>(position);
                let unit = bitcast<vec3<u32>>(normal);
                positions[at] = words.x;
                positions[at + 1u] = words.y;
                positions[at + 2u] = words.z;
                raise_bounds(position);
                normals[at] = unit.x;
                normals[at + 1u] = unit.y;
                normals[at + 2u] = unit.z;
            }
        }
    }
    workgroupBarrier();
    if (lane < 6u && atomicLoad(&bounds[lane]) > atomicLoad(&counters.bounds[lane])) {
        atomicMax(&counters.bounds[lane], atomicLoad(&bounds[lane]));
    }
}
