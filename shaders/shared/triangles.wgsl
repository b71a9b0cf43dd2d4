// Triangles of a brick, listed in workgroup memory by 64 lanes. Requires `params`, `inside`, `cases`, `records`,
// shared/bits and shared/record.
//
// Each edge of a cell is owned by a grid point of the brick or of one of its seven neighbours towards +x, +y and +z.
// The brick and its neighbours are combined into one block of 9 × 9 × 9 grid points, so that look-ups need not
// distinguish owners.

const LANES: u32 = 64u;
// Number of triangles listed at once.
const WINDOW: u32 = 256u;
// Offsets in the case table, in pairs of words: triangle counts with eight cases per word, followed by the edges of a
// cell; triangle corners of the cases, four bits each.
const PACKED_COUNTS: u32 = 128u;
const CORNERS: u32 = 152u;

// Inside bits of the rows of nine grid points along x: row 9·z + y.
var<workgroup> rows: array<u32, 81>;
// Crossing edges of the block as words of 4 rows, each with the index of its first vertex. Words are ordered by axis, z
// and y; grid points with x < 8 come first.
var<workgroup> edges: array<vec2<u32>, 162>;
// Triangle counts of eight cases per word; from 32 on, the edges of a cell as offsets from the cell's grid point.
var<workgroup> packed_counts: array<u32, 48>;
// Triangles: cell, and corners from bit 12 on. Holds sums over lanes before the triangles are listed.
var<workgroup> listed: array<u32, 256>;

// Row of eight cells: the cases of four cells per word, the first cell, and the number of triangles.
struct Row {
    low: u32,
    high: u32,
    cell: u32,
    n: u32,
}

// Inside bits of row (y, z) of the block of brick `id`.
fn row_at(id: u32, y: u32, z: u32) -> u32 {
    let n = (y >> 3u) << 1u | (z >> 3u) << 2u;
    let brick = records[id].neighbours[n];
    let next = records[id].neighbours[n + 1u];
    let at = 2u * (z & 7u) + (y >> 2u & 1u);
    let shift = 8u * (y & 3u);
    var row = 0u;
    // A brick that does not exist is out of reach of all atoms, so no grid point of it is inside.
    if (brick != NONE) {
        row = inside[brick * 16u + at] >> shift & 255u;
    }
    if (next != NONE) {
        row |= (inside[next * 16u + at] >> shift & 1u) << 8u;
    }
    return row;
}

// Loads the rows of the block of brick `id` and the part of the case table that is read often.
fn load_rows(id: u32, lane: u32) {
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

// Row of cells of a lane. Rows are in the order of cells.
fn row_of(lane: u32) -> Row {
    let y = lane & 7u;
    let z = lane >> 3u;
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
    let n = triangles_of(low, 0u) + triangles_of(low, 1u) + triangles_of(low, 2u) + triangles_of(low, 3u)
        + triangles_of(high, 0u) + triangles_of(high, 1u) + triangles_of(high, 2u) + triangles_of(high, 3u);
    return Row(low, high, (y & 3u) << 4u | (3u * z + (y >> 2u)) << 6u, n);
}

// Sum of `own` over this lane and those before. The total is in the last lane. Ends with a barrier.
fn scan_lanes(lane: u32, own: u32) -> u32 {
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
    workgroupBarrier();
    return sum;
}

// Lists the triangles of a cell from `at` on, as far as they lie in the window. Returns the index of the next triangle.
fn list_cell(at: u32, cell: u32, quad: u32, i: u32) -> u32 {
    let n = triangles_of(quad, i);
    if (n == 0u) {
        return at;
    }
    let row = cases[CORNERS + (quad >> (8u * i) & 255u)];
    if (at < WINDOW) { listed[at] = cell | row.x << 12u; }
    if (n > 1u && at + 1u < WINDOW) { listed[at + 1u] = cell | (row.x & 0xfff000u); }
    if (n > 2u && at + 2u < WINDOW) { listed[at + 2u] = cell | row.x >> 24u << 12u | row.y << 20u; }
    if (n > 3u && at + 3u < WINDOW) { listed[at + 3u] = cell | row.y >> 4u << 12u; }
    if (n > 4u && at + 4u < WINDOW) { listed[at + 4u] = cell | row.y >> 16u << 12u; }
    return at + n;
}

// Lists the triangles of a row, of which the first is at `start`, as far as they lie in the window.
fn list_row(row: Row, start: u32) {
    if (row.n == 0u) {
        return;
    }
    var at = list_cell(start, row.cell, row.low, 0u);
    at = list_cell(at, row.cell + 1u, row.low, 1u);
    at = list_cell(at, row.cell + 2u, row.low, 2u);
    at = list_cell(at, row.cell + 3u, row.low, 3u);
    at = list_cell(at, row.cell + 4u, row.high, 0u);
    at = list_cell(at, row.cell + 5u, row.high, 1u);
    at = list_cell(at, row.cell + 6u, row.high, 2u);
    at = list_cell(at, row.cell + 7u, row.high, 3u);
}

// Edge at corner `k` of a listed triangle: the sum of a cell and an offset is a grid point, with x from bit 0 on, y
// from bit 4 on, and one word per four rows.
fn edge_at(triangle: u32, k: u32) -> u32 {
    let code = listed[triangle];
    return (code & 0xfffu) + packed_counts[32u + (code >> (12u + 4u * k) & 15u)];
}

// Index of the vertex on an edge.
fn vertex_on(edge: u32) -> u32 {
    let word = edges[(edge >> 6u) + 81u * (edge >> 3u & 1u)];
    let bit = (edge >> 1u & 24u) | (edge & 7u);
    return word.y + countOneBits(word.x & below(bit));
}
