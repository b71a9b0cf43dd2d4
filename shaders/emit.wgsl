// Stage `emit`: triangle indices. One workgroup a brick; a lane writes single indices, so that what is written together
// lies together.
//
// A cell's edge belongs to one of the samples around it, in the brick or in one of its seven neighbours towards +x, +y,
// +z; the vertex's number is the rank of the edge among its brick's crossing edges.
#include shared/params.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/corners.wgsl
#include shared/record.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> bricks: array<u32>;
@group(0) @binding(3) var<storage, read> inside: array<u32>;
// Triangles of each case; then five triangles each, every corner four bits.
@group(0) @binding(4) var<storage, read> cases: array<u32>;
@group(0) @binding(5) var<storage, read> records: array<Record>;
@group(0) @binding(6) var<storage, read> counts: array<u32>;
@group(0) @binding(7) var<storage, read> offsets: array<vec2<u32>>;
@group(0) @binding(8) var<storage, read_write> triangles: array<u32>;

const LANES: u32 = 64u;
// Triangles listed at once.
const WINDOW: u32 = 512u;

var<workgroup> near: array<u32, 8>;
var<workgroup> first_vertex: array<u32, 8>;
// Crossing words of the brick and its neighbours in the same layer of bricks, 48 each; then the x and y words of the
// lowest layer of those above, 6 each.
var<workgroup> crossing: array<u32, 216>;
var<workgroup> layers: array<u32, 36>;
// Corners of the cells of each half layer.
var<workgroup> low: array<vec4<u32>, 16>;
var<workgroup> high: array<vec4<u32>, 16>;
// Numbers of triangles of the cells of each layer as bits of weight 1, 2, 4: two halves each.
var<workgroup> weights: array<atomic<u32>, 48>;
var<workgroup> layer_start: array<u32, 9>;
// Triangles as cell, case and number within the case.
var<workgroup> listed: array<u32, 512>;

fn ones(word: u32, lane: u32, half: u32) -> u32 {
    return countOneBits(word & select(select(0u, below(lane & 31u), lane >> 5u == half), 0xffffffffu, lane >> 5u > half));
}

// Triangles of the cells before `lane` in layer z.
fn triangles_before(z: u32, lane: u32) -> u32 {
    var n = 0u;
    for (var half = 0u; half < 2u; half++) {
        let at = 6u * z + half;
        n += ones(atomicLoad(&weights[at]), lane, half);
        n += 2u * ones(atomicLoad(&weights[at + 2u]), lane, half);
        n += 4u * ones(atomicLoad(&weights[at + 4u]), lane, half);
    }
    return n;
}

// Vertex on edge `e` of a cell.
fn vertex_of(cell: u32, e: u32) -> u32 {
    let axis = e >> 2u;
    let lo = e & 1u;
    let hi = e >> 1u & 1u;
    let x = (cell & 7u) + select(lo, 0u, axis == 0u);
    let y = (cell >> 3u & 7u) + select(select(hi, 0u, axis == 1u), lo, axis == 0u);
    let z = (cell >> 6u) + select(hi, 0u, axis == 2u);
    let n = x >> 3u | (y >> 3u) << 1u | (z >> 3u) << 2u;
    let layer = z & 7u;
    let half = y >> 2u & 1u;
    let bit = (y & 3u) << 3u | (x & 7u);
    let word = select(192u + 6u * (n & 3u), 48u * n, n < 4u) + 2u * (3u * layer + axis);
    let start = before_word(layers[select(28u + n, 8u * n + layer, n < 4u)], axis);
    let whole = select(0u, countOneBits(crossing[word]), half == 1u);
    return first_vertex[n] + start + whole + countOneBits(crossing[word + half] & below(bit));
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
    let n = counts[id] >> 16u;
    let first = offsets[id].y - params.piece_triangle;
    if (n == 0u || first + n > params.triangle_capacity) {
        return;
    }
    if (lane < 8u) {
        let brick = neighbour(bricks[id] >> 9u, bricks[id] & 511u, lane);
        near[lane] = brick;
        first_vertex[lane] = offsets[min(brick, params.n_bricks - 1u)].x;
    } else if (lane >= 16u) {
        atomicStore(&weights[lane - 16u], 0u);
    }
    workgroupBarrier();
    for (var i = lane; i < 252u; i += LANES) {
        if (i < 216u) {
            let above = i - 192u;
            let brick = near[select(4u + above / 6u, i / 48u, i < 192u)];
            if (brick != NONE) {
                crossing[i] = records[brick].crossing[select(above % 6u, i % 48u, i < 192u)];
            }
        } else {
            let at = i - 216u;
            let brick = near[select(at - 28u, at >> 3u, at < 32u)];
            if (brick != NONE) {
                layers[at] = records[brick].layers[select(0u, at & 7u, at < 32u)];
            }
        }
    }
    if (lane < 16u) {
        let here = vec4<u32>(near[0], near[1], near[2], near[3]);
        let above = vec4<u32>(near[4], near[5], near[6], near[7]);
        let c = corners_of(here, above, lane >> 1u, lane & 1u);
        low[lane] = c.low;
        high[lane] = c.high;
    }
    workgroupBarrier();
    // A lane's cells are the column above its bit.
    let half = lane >> 5u;
    let bit = lane & 31u;
    for (var z = 0u; z < 8u; z++) {
        let count = cases[case_at(Corners(low[2u * z + half], high[2u * z + half]), bit)];
        for (var weight = 0u; weight < 3u; weight++) {
            if ((count >> weight & 1u) == 1u) {
                atomicOr(&weights[6u * z + 2u * weight + half], 1u << bit);
            }
        }
    }
    workgroupBarrier();
    if (lane < 9u) {
        var start = 0u;
        for (var z = 0u; z < lane; z++) {
            for (var i = 0u; i < 6u; i++) {
                start += countOneBits(atomicLoad(&weights[6u * z + i])) << (i >> 1u);
            }
        }
        layer_start[lane] = start;
    }
    workgroupBarrier();
    for (var window = 0u; window < n; window += WINDOW) {
        let end = min(n, window + WINDOW);
        for (var z = 0u; z < 8u; z++) {
            if (layer_start[z + 1u] <= window || layer_start[z] >= end) {
                continue;
            }
            let case_ = case_at(Corners(low[2u * z + half], high[2u * z + half]), bit);
            let count = cases[case_];
            if (count == 0u) {
                continue;
            }
            let at = layer_start[z] + triangles_before(z, lane);
            for (var k = 0u; k < count; k++) {
                if (at + k >= window && at + k < end) {
                    listed[at + k - window] = z << 6u | lane | case_ << 9u | k << 17u;
                }
            }
        }
        workgroupBarrier();
        for (var i = lane; i < 3u * (end - window); i += LANES) {
            let triangle = listed[i / 3u];
            let row = cases[256u + 5u * (triangle >> 9u & 255u) + (triangle >> 17u)];
            triangles[3u * (first + window) + i] = vertex_of(triangle & 511u, row >> (4u * (i % 3u)) & 15u);
        }
        workgroupBarrier();
    }
}
