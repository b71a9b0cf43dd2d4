// Stage `measure`: sums over the sheets of a brick, which are the connected parts of its triangles. One workgroup per
// brick. The vertices that the brick's cells use are numbered and joined along the triangles.
//
// The output begins with a table of offsets: for each brick of the piece the offset of its block of words, or NONE if
// it has no triangles. A block has:
// - the number of the brick, the numbers of its sheets and of its shared vertices (16 bits each), and the origin;
// - for each sheet, its numbers of triangles and vertices (16 bits each), the neighbours above and below that share
//   vertices (8 bits each), and ten sums;
// - if there are several sheets, for each shared vertex its owner (3 bits), key (11 bits) and sheet.
#include shared/params.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/record.wgsl
#include shared/counters.wgsl
#include shared/triangles.wgsl
#include shared/block.wgsl
#include shared/sheets.wgsl
#include shared/edge_offsets.wgsl
#include shared/sums.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> bricks: array<u32>;
@group(0) @binding(3) var<storage, read> halo: array<u32>;
@group(0) @binding(4) var<storage, read> crossings: array<f32>;
@group(0) @binding(5) var<storage, read> inside: array<u32>;
@group(0) @binding(6) var<storage, read> cases: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> records: array<BrickRecord>;
@group(0) @binding(8) var<storage, read> counts: array<u32>;
@group(0) @binding(9) var<storage, read_write> sheets: array<u32>;
@group(0) @binding(10) var<storage, read_write> counters: Counters;

// Words of a block before its sheets, and words of a sheet.
const HEADER: u32 = 5u;
const SHEET: u32 = 12u;

// Value that one lane passes to all others.
var<workgroup> passed: u32;
// Offset of the block of the brick, or NONE if it does not fit.
var<workgroup> block: u32;
// Number of vertices that the brick shares with other bricks.
var<workgroup> all_shared: atomic<u32>;
// Number of the brick's own vertices, shifted by 16, and the neighbours that use any, as in `users`.
var<workgroup> all_counts: atomic<u32>;
// Number of triangles of a sheet.
var<workgroup> counted: atomic<u32>;

// Triangles of a brick: their number, and the lane's row with the number of triangles before it.
struct Triangles {
    n: u32,
    row: Row,
    start: u32,
}

// First triangle of the window that a pass visits as number `k`. Passes alternate between ascending and descending
// order, so each pass but the first begins with the window that is still listed.
fn window_at(pass_: u32, k: u32, n: u32) -> u32 {
    return WINDOW * select(k, (n - 1u) / WINDOW - k, (pass_ & 1u) == 1u);
}

// Lists the triangles of a window. Starts and ends with a barrier.
fn list_window(t: Triangles, window: u32) {
    workgroupBarrier();
    list_row(t.row, t.start - window);
    workgroupBarrier();
}

// Joins the vertices along all triangles. Returns the number of sheets. Starts and ends with a barrier.
fn join_vertices(lane: u32, t: Triangles, n_vertices: u32) -> u32 {
    for (var k = 0u; k * WINDOW < t.n; k++) {
        let window = window_at(0u, k, t.n);
        list_window(t, window);
        for (var i = lane; i < min(WINDOW, t.n - window); i += LANES) {
            label_corners(i);
        }
    }
    workgroupBarrier();
    follow_labels(lane, n_vertices);
    workgroupBarrier();
    for (var k = 0u; k * WINDOW < t.n; k++) {
        let window = window_at(1u, k, t.n);
        if (k > 0u) {
            list_window(t, window);
        }
        for (var i = lane; i < min(WINDOW, t.n - window); i += LANES) {
            let v = vertices_on(edges_of(i));
            join(v.x, v.y);
            join(v.x, v.z);
        }
    }
    workgroupBarrier();
    follow_labels(lane, n_vertices);
    count_names(lane, n_vertices);
    workgroupBarrier();
    if (lane == 0u) {
        passed = atomicLoad(&n_sheets);
    }
    return workgroupUniformLoad(&passed);
}

// Adds up the lane's triangles of a sheet, and counts them.
fn sum_triangles(lane: u32, t: Triangles, sheet: u32, first: vec3<f32>, origin: vec3<f32>) -> Sums {
    var sums = Sums(vec4<f32>(0.0), vec3<f32>(0.0), vec3<f32>(0.0));
    var n_own = 0u;
    for (var k = 0u; k * WINDOW < t.n; k++) {
        let window = window_at(sheet, k, t.n);
        if (k > 0u) {
            list_window(t, window);
        }
        for (var i = lane; i < min(WINDOW, t.n - window); i += LANES) {
            let e = edges_of(i);
            let word = atomicLoad(&vertices[vertex_on(e.x)]);
            if ((word & below(sheet_bits)) == sheet) {
                let a = position_of(e.x, word, first, origin);
                let b = position_of(e.y, atomicLoad(&vertices[vertex_on(e.y)]), first, origin);
                let c = position_of(e.z, atomicLoad(&vertices[vertex_on(e.z)]), first, origin);
                sums = with_triangle(sums, a, b, c);
                n_own += 1u;
            }
        }
    }
    atomicAdd(&counted, n_own);
    return sums;
}

// Adds the sums of all lanes and the number of triangles to a sheet at `at`, which has its counts, unless it is NONE.
// Clears the number.
fn write_sheet(lane: u32, at: u32) {
    if (lane < N_SUMS && at != NONE) {
        sheets[at + 2u + lane] = bitcast<u32>(sum_at(lane));
    }
    if (lane == N_SUMS) {
        let n = atomicExchange(&counted, 0u);
        if (at != NONE) {
            sheets[at] |= n;
        }
    }
}

// Writes the numbers of own vertices and the neighbours of all sheets, whose first word is at `at` unless it is NONE.
// The vertices still have their edges. Contains barriers.
fn write_counts(lane: u32, at: u32, n_found: u32, n_vertices: u32) {
    if (n_found == 1u) {
        if (lane == 0u && at != NONE) {
            let counts = atomicLoad(&all_counts);
            sheets[at] = counts & 0xffff0000u;
            sheets[at + 1u] = counts & 0xffffu;
        }
        return;
    }
    // The names are not needed any more. Almost all bricks have fewer sheets than one pass counts.
    for (var first = 0u; first < n_found; first += N_NAMES) {
        if (lane < N_NAMES) {
            atomicStore(&names[lane], 0u);
        }
        workgroupBarrier();
        for (var v = lane; v < n_vertices; v += LANES) {
            let word = atomicLoad(&vertices[v]);
            let sheet = number_of(word) - first;
            let edge = (word & ~NUMBERED) >> EDGE_BIT;
            let counts = counts_of(first_point(edge), axis_of(edge));
            if (sheet < N_NAMES && counts != 0u) {
                atomicAdd(&names[sheet], counts & 0xffff0000u);
                atomicOr(&names[sheet], counts & 0xffffu);
            }
        }
        workgroupBarrier();
        if (lane < min(N_NAMES, n_found - first) && at != NONE) {
            let counts = atomicLoad(&names[lane]);
            sheets[at + SHEET * (first + lane)] = counts & 0xffff0000u;
            sheets[at + SHEET * (first + lane) + 1u] = counts & 0xffffu;
        }
    }
}

// Own vertices and neighbours that use any, of some edges of a word.
fn counts_on(word: Word, on: u32) -> u32 {
    return select(0u, countOneBits(on) << 16u, word.owner == 0u) | users(word, on);
}

// Writes the owner, key and sheet of each shared vertex of a word from `at` on. The word's first vertex is `first`. A
// key has the layer (3 bits), axis (2 bits) and bit (6 bits) of an edge in its own brick, so keys are in the order of
// the brick's vertices.
fn write_vertices(at: u32, word: Word, crossing: u32, first: u32) {
    let layer = (word.z & 7u) << 8u | word.axis << 6u | (word.quarter & 1u) << 5u;
    var next = at;
    for (var rest = shared_edges(word, crossing); rest != 0u; rest &= rest - 1u) {
        let bit = firstTrailingBit(rest);
        let vertex = first + countOneBits(crossing & below(bit));
        sheets[next] = word.owner | (layer | bit) << 3u | sheet_of(vertex) << 14u;
        next += 1u;
    }
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
    if (n == 0u) {
        if (lane == 0u) {
            sheets[number] = NONE;
        }
        return;
    }
    let first = vec3<f32>(
        tiles[bricks[id] >> 9u].coord * 64 + local_brick(bricks[id] & 511u) * 8 - params.centre,
    );
    var origin = first;
    if (params.steps_per_angstrom > 0.0) {
        origin = steps_at(first, vec3<f32>(4.0));
    }
    load_rows(id, lane);
    if (lane < N_NAMES) {
        atomicStore(&names[lane], 0u);
    }
    if (lane < 8u) {
        slots[lane] = slot_of(records[id].neighbours[lane]);
    } else if (lane == 8u) {
        atomicStore(&n_sheets, 0u);
        atomicStore(&counted, 0u);
    } else if (lane == 9u) {
        atomicStore(&all_shared, 0u);
        atomicStore(&all_counts, 0u);
    }
    workgroupBarrier();
    let row = row_of(lane);
    // Crossing edges of the lane's words, and how many of them are shared.
    var used = vec3<u32>(0u);
    var n_shared = vec3<u32>(0u);
    let w0 = word_of(lane, 0u);
    let w1 = word_of(lane, 1u);
    let w2 = word_of(lane, 2u);
    if (lane < 54u) {
        used = vec3<u32>(crossing_edges(w0), crossing_edges(w1), crossing_edges(w2));
        n_shared = countOneBits(
            vec3<u32>(shared_edges(w0, used.x), shared_edges(w1, used.y), shared_edges(w2, used.z)),
        );
    }
    let own_shared = n_shared.x + n_shared.y + n_shared.z;
    if ((used.x | used.y | used.z) != 0u) {
        let counts = vec3<u32>(counts_on(w0, used.x), counts_on(w1, used.y), counts_on(w2, used.z));
        let n_own = counts >> vec3<u32>(16u);
        atomicAdd(&all_shared, own_shared);
        atomicAdd(&all_counts, (n_own.x + n_own.y + n_own.z) << 16u);
        atomicOr(&all_counts, (counts.x | counts.y | counts.z) & 0xffffu);
    }
    let n_used = countOneBits(used);
    // Number of triangles, and number of vertices shifted by 16.
    let own = row.n | (n_used.x + n_used.y + n_used.z) << 16u;
    let sum = scan_lanes(lane, own);
    let n_vertices = listed[LANES - 1u] >> 16u;
    let start = (sum - own) & 0xffffu;
    // Number of vertices before each word.
    let before = vec3<u32>((sum - own) >> 16u) + vec3<u32>(0u, n_used.x, n_used.x + n_used.y);
    if (lane < 54u) {
        edges[3u * lane] = vec2<u32>(used.x, before.x);
        edges[3u * lane + 1u] = vec2<u32>(used.y, before.y);
        edges[3u * lane + 2u] = vec2<u32>(used.z, before.z);
    }
    for (var v = lane; v < n_vertices; v += LANES) {
        atomicStore(&vertices[v], ~LABEL | v);
    }
    let triangles = Triangles(n, row, start);
    let n_found = join_vertices(lane, triangles, n_vertices);
    let n_written = select(0u, atomicLoad(&all_shared), n_found > 1u);
    if (lane == 0u) {
        let n_words = HEADER + SHEET * n_found + n_written;
        let reserved = params.piece_bricks + atomicAdd(&counters.sheet_words, n_words);
        // A block beyond the capacity is not written. The host detects it by the counter.
        let fits = reserved + n_words <= params.sheet_capacity;
        block = select(NONE, reserved, fits);
        sheets[number] = block;
        if (fits) {
            sheets[reserved] = id;
            sheets[reserved + 1u] = n_found | n_written << 16u;
            let words = bitcast<vec3<u32>>(vec3<i32>(origin));
            sheets[reserved + 2u] = words.x;
            sheets[reserved + 3u] = words.y;
            sheets[reserved + 4u] = words.z;
        }
    }
    sheet_bits = 32u - countLeadingZeros(n_found - 1u);
    offset_unit = ldexp(1.0, i32(sheet_bits) - 32);
    if (n_found > 1u) {
        number_names(lane, n_vertices);
    }
    let first_sheet = workgroupUniformLoad(&block) + HEADER;
    write_counts(lane, select(first_sheet, NONE, first_sheet < HEADER), n_found, n_vertices);
    for (var v = lane; v < n_vertices; v += LANES) {
        let word = atomicLoad(&vertices[v]);
        let offset = offset_on((word & ~NUMBERED) >> EDGE_BIT, first, origin);
        atomicStore(&vertices[v], offset << sheet_bits | number_of(word));
    }
    storageBarrier();
    for (var sheet = 0u; sheet < n_found; sheet++) {
        workgroupBarrier();
        let sums = sum_triangles(lane, triangles, sheet, first, origin);
        sum_lanes(lane, sums);
        write_sheet(lane, select(block + HEADER + SHEET * sheet, NONE, block == NONE));
    }
    if (n_found > 1u) {
        let start = scan_lanes(lane, own_shared) - own_shared;
        if (block != NONE) {
            let at = block + HEADER + SHEET * n_found + start;
            write_vertices(at, w0, used.x, before.x);
            write_vertices(at + n_shared.x, w1, used.y, before.y);
            write_vertices(at + n_shared.x + n_shared.y, w2, used.z, before.z);
        }
    }
}
