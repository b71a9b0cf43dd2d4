// Stage `emit`: triangle indices. One workgroup per brick. A lane lists the triangles of a row of eight cells; then
// each lane writes single indices, so that memory accesses are contiguous.
//
// Each edge of a cell is owned by a sample of the brick or of one of its seven neighbours towards +x, +y and +z. The
// index of a vertex is the rank of its edge among the crossing edges of the owner's brick. The brick and its neighbours
// are combined into one block of 9 × 9 × 9 samples, so that look-ups need not distinguish owners.
#include shared/params.wgsl
#include shared/bits.wgsl
#include shared/record.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> inside: array<u32>;
@group(0) @binding(2) var<storage, read> cases: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> records: array<Record>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read> offsets: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> triangles: array<u32>;

const LANES: u32 = 64u;
const NONE: u32 = 0xffffffffu;
// Number of triangles listed at once.
const WINDOW: u32 = 256u;
// Offsets in the case table, in pairs of words: triangle counts with eight cases per word, followed by the edges of a
// cell; triangle corners of the cases, four bits each.
const PACKED_COUNTS: u32 = 128u;
const CORNERS: u32 = 152u;

// Inside bits of the rows of nine samples along x: row 9·z + y.
var<workgroup> rows: array<u32, 81>;
// Crossing edges of the block as words of 4 rows, each with the index of its first vertex: by axis, z and every fourth
// y; samples with x < 8 first.
var<workgroup> edges: array<vec2<u32>, 162>;
// Triangle counts of eight cases per word; from 32 on, the edges of a cell as offsets from the cell's sample.
var<workgroup> packed_counts: array<u32, 48>;
// Triangles: cell, and corners from bit 12 on. Used for the sums of rows before.
var<workgroup> listed: array<u32, 256>;

// Inside bits of row (y, z) of the block of brick `id`.
fn row_at(id: u32, y: u32, z: u32) -> u32 {
    let n = (y >> 3u) << 1u | (z >> 3u) << 2u;
    let brick = records[id].neighbours[n];
    let next = records[id].neighbours[n + 1u];
    let at = 2u * (z & 7u) + (y >> 2u & 1u);
    let shift = 8u * (y & 3u);
    var row = 0u;
    // A brick that does not exist is out of reach of all atoms, so no sample of it is inside.
    if (brick != NONE) {
        row = inside[brick * 16u + at] >> shift & 255u;
    }
    if (next != NONE) {
        row |= (inside[next * 16u + at] >> shift & 1u) << 8u;
    }
    return row;
}

// Moves four bits to four bytes.
fn bits_to_bytes(bits: u32) -> u32 {
    return ((bits & 15u) * 0x00204081u) & 0x01010101u;
}

// Number of triangles of the case in byte `i` of `quad`.
fn triangles_of(quad: u32, i: u32) -> u32 {
    let case_ = quad >> (8u * i);
    return packed_counts[case_ >> 3u & 31u] >> (4u * (case_ & 7u)) & 7u;
}

// Lists the `n` triangles of a cell from `at` on, as far as they lie in the window.
fn list_cell(at: u32, cell: u32, quad: u32, i: u32, n: u32) {
    if (n == 0u) {
        return;
    }
    let row = cases[CORNERS + (quad >> (8u * i) & 255u)];
    if (at < WINDOW) { listed[at] = cell | row.x << 12u; }
    if (n > 1u && at + 1u < WINDOW) { listed[at + 1u] = cell | (row.x & 0xfff000u); }
    if (n > 2u && at + 2u < WINDOW) { listed[at + 2u] = cell | row.x >> 24u << 12u | row.y << 20u; }
    if (n > 3u && at + 3u < WINDOW) { listed[at + 3u] = cell | row.y >> 4u << 12u; }
    if (n > 4u && at + 4u < WINDOW) { listed[at + 4u] = cell | row.y >> 16u << 12u; }
}

// Index of the vertex at corner `k` of a listed triangle.
fn vertex_at(triangle: u32, k: u32) -> u32 {
    let code = listed[triangle];
    // The sum of a cell and an offset is a sample: x from bit 0 on, y from bit 4 on, and one word per four rows.
    let edge = (code & 0xfffu) + packed_counts[32u + (code >> (12u + 4u * k) & 15u)];
    let word = edges[(edge >> 6u) + 81u * (edge >> 3u & 1u)];
    let bit = (edge >> 1u & 24u) | (edge & 7u);
    return word.y + countOneBits(word.x & below(bit));
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
    if (lane >= 40u) {
        let pair = lane - 40u;
        let words = cases[PACKED_COUNTS + pair];
        packed_counts[2u * pair] = words.x;
        packed_counts[2u * pair + 1u] = words.y;
    }
    let y = lane & 7u;
    let z = lane >> 3u;
    rows[9u * z + y] = row_at(id, y, z);
    if (lane >= 47u) {
        // Nine rows of the neighbours along z, and eight of those along y.
        let i = lane - 47u;
        let at = select(vec2<u32>(i - 9u, 8u), vec2<u32>(8u, i), i < 9u);
        rows[9u * at.y + at.x] = row_at(id, at.x, at.y);
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
            // Of a neighbour along y, only the lowest rows are needed, and there is space for no others.
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
    // Corners of eight cells: the bits of four rows, interleaved to one byte per cell.
    let r0 = rows[9u * z + y];
    let r1 = rows[9u * z + y + 1u];
    let r2 = rows[9u * z + y + 9u];
    let r3 = rows[9u * z + y + 10u];
    let near_x = bits_to_bytes(r0) | bits_to_bytes(r1) << 2u | bits_to_bytes(r2) << 4u | bits_to_bytes(r3) << 6u;
    let far_x = bits_to_bytes(r0 >> 4u) | bits_to_bytes(r1 >> 4u) << 2u
        | bits_to_bytes(r2 >> 4u) << 4u | bits_to_bytes(r3 >> 4u) << 6u;
    let last_x = r0 >> 8u | r1 >> 8u << 2u | r2 >> 8u << 4u | r3 >> 8u << 6u;
    let low = near_x | (near_x >> 8u | far_x << 24u) << 1u;
    let high = far_x | (far_x >> 8u | last_x << 24u) << 1u;
    let n0 = triangles_of(low, 0u);
    let n1 = triangles_of(low, 1u);
    let n2 = triangles_of(low, 2u);
    let n3 = triangles_of(low, 3u);
    let n4 = triangles_of(high, 0u);
    let n5 = triangles_of(high, 1u);
    let n6 = triangles_of(high, 2u);
    let n7 = triangles_of(high, 3u);
    let own = n0 + n1 + n2 + n3 + n4 + n5 + n6 + n7;
    // Rows are in the order of cells.
    var sum = own;
    var side = 0u;
    listed[lane] = sum;
    for (var step = 1u; step < LANES; step = step << 1u) {
        workgroupBarrier();
        if (lane >= step) {
            sum += listed[side + lane - step];
        }
        side = 64u - side;
        listed[side + lane] = sum;
    }
    let start = sum - own;
    workgroupBarrier();
    let cell = (y & 3u) << 4u | (3u * z + (y >> 2u)) << 6u;
    let t0 = lane / 3u;
    let k0 = lane - 3u * t0;
    let t1 = (lane + 64u) / 3u;
    let k1 = lane + 64u - 3u * t1;
    let t2 = (lane + 128u) / 3u;
    let k2 = lane + 128u - 3u * t2;
    for (var window = 0u; window < n; window += WINDOW) {
        if (own != 0u) {
            var at = start - window;
            list_cell(at, cell, low, 0u, n0);
            at += n0;
            list_cell(at, cell + 1u, low, 1u, n1);
            at += n1;
            list_cell(at, cell + 2u, low, 2u, n2);
            at += n2;
            list_cell(at, cell + 3u, low, 3u, n3);
            at += n3;
            list_cell(at, cell + 4u, high, 0u, n4);
            at += n4;
            list_cell(at, cell + 5u, high, 1u, n5);
            at += n5;
            list_cell(at, cell + 6u, high, 2u, n6);
            at += n6;
            list_cell(at, cell + 7u, high, 3u, n7);
        }
        workgroupBarrier();
        let words = 3u * min(WINDOW, n - window);
        let base = 3u * (first + window);
        // 192 indices are 64 triangles, so a lane writes the same corners of every 64th triangle.
        var i = lane;
        for (var at = 0u; i < words; at += LANES) {
            triangles[base + i] = vertex_at(at + t0, k0);
            if (i + 64u < words) { triangles[base + i + 64u] = vertex_at(at + t1, k1); }
            if (i + 128u < words) { triangles[base + i + 128u] = vertex_at(at + t2, k2); }
            i += 192u;
        }
        workgroupBarrier();
    }
}
