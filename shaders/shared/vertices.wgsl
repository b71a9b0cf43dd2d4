// Vertices of a brick in workgroup memory, and their output. Requires `params`, `records`, `positions`, `normals`,
// `counters`, `crossings`, shared/record and shared/quantize.

const LANES: u32 = 128u;

var<workgroup> crossing: array<u32, 48>;
var<workgroup> layers: array<u32, 8>;
// Slot of the brick in the chunk.
var<workgroup> slot: u32;
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

// Loads the crossing edges of brick `id`. Needs a barrier afterwards.
fn load_brick(lane: u32, id: u32) {
    if (lane < 48u) {
        crossing[lane] = records[id].crossing[lane];
    } else if (lane < 56u) {
        layers[lane - 48u] = records[id].layers[lane - 48u];
    } else if (lane == 56u) {
        slot = id - params.first_brick;
    } else if (lane < 63u) {
        atomicStore(&bounds[lane - 57u], atomicLoad(&counters.bounds[lane - 57u]));
    }
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

// First grid point of an edge.
fn first_point(edge: Edge) -> vec3<u32> {
    return vec3<u32>(edge.bit & 7u, edge.bit >> 3u, edge.z);
}

// Point of the surface on an edge, relative to the first grid point of the brick.
fn vertex_of(edge: Edge) -> vec3<f32> {
    let t = crossings[3u * (slot * 512u + edge.z * 64u + edge.bit) + edge.axis];
    let axis = vec3<u32>(0u, 1u, 2u) == vec3<u32>(edge.axis);
    return vec3<f32>(first_point(edge)) + select(vec3<f32>(0.0), vec3<f32>(t), axis);
}

// Writes vertex `at` with the position `p`, relative to the grid point `origin`, and a normal along `outward`.
fn write_vertex(at: u32, origin: vec3<i32>, p: vec3<f32>, outward: vec3<f32>) {
    // A shorter vector has no significant direction in single precision.
    let length2 = dot(outward, outward);
    let usable = length2 > 1e-14;
    let normal = outward * select(0.0, inverseSqrt(length2), usable);
    if (!usable) {
        atomicAdd(&counters.flat, 1u);
    }
    // Whole cells are exact; the fraction is added before the only multiplication.
    let position = (vec3<f32>(origin - params.centre) + p) * params.spacing;
    if (params.steps_per_angstrom > 0.0) {
        let rounded = quantized_position(position * params.steps_per_angstrom);
        positions[2u * at] = rounded.x;
        positions[2u * at + 1u] = rounded.y;
        raise_bounds(vec3<f32>(steps_of(rounded)));
        normals[at] = quantized_normal(normal);
    } else {
        let words = bitcast<vec3<u32>>(position);
        let unit = bitcast<vec3<u32>>(normal);
        positions[3u * at] = words.x;
        positions[3u * at + 1u] = words.y;
        positions[3u * at + 2u] = words.z;
        raise_bounds(position);
        normals[3u * at] = unit.x;
        normals[3u * at + 1u] = unit.y;
        normals[3u * at + 2u] = unit.z;
    }
}

// Adds the bounds of the brick to those of the job. Needs a barrier before.
fn add_bounds(lane: u32) {
    if (lane < 6u && atomicLoad(&bounds[lane]) > atomicLoad(&counters.bounds[lane])) {
        atomicMax(&counters.bounds[lane], atomicLoad(&bounds[lane]));
    }
}
