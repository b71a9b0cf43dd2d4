// Stage `measure`: sums over the sheets of a brick, which are the connected parts of its triangles. One workgroup per
// brick. The vertices that the brick's cells use are numbered and joined along the triangles.
//
// A brick writes one block of words: brick, number of sheets and of shared vertices (16 bits each), origin; for each
// sheet its numbers of triangles and vertices (16 bits each), the neighbours above and below that share vertices
// (8 bits each), and ten sums; and with several sheets, for each shared vertex its owner (3 bits), key (11 bits) and
// sheet.
#include shared/params.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/record.wgsl
#include shared/counters.wgsl
#include shared/quantize.wgsl
#include shared/crossing.wgsl
#include shared/triangles.wgsl
#include shared/sheets.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> bricks: array<u32>;
@group(0) @binding(3) var<storage, read> halo: array<u32>;
@group(0) @binding(4) var<storage, read> field: array<f32>;
@group(0) @binding(5) var<storage, read> inside: array<u32>;
@group(0) @binding(6) var<storage, read> cases: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> records: array<Record>;
@group(0) @binding(8) var<storage, read> counts: array<u32>;
@group(0) @binding(9) var<storage, read_write> sheets: array<u32>;
@group(0) @binding(10) var<storage, read_write> counters: Counters;

// Words of a block before its sheets, and words of a sheet.
const HEADER: u32 = 5u;
const SHEET: u32 = 12u;
// Number of samples of the block.
const BLOCK: u32 = 729u;

// Slots of the brick and of its neighbours.
var<workgroup> slots: array<u32, 8>;
// Densities of the block.
var<workgroup> samples: array<f32, 729>;
// Value that one lane passes to all others.
var<workgroup> passed: u32;
// Triangles, vertices and neighbours of a sheet.
var<workgroup> counted: array<atomic<u32>, 3>;
// Sums of half of the lanes: twice the area and the vector; the product and the moment.
var<workgroup> halves: array<vec4<f32>, 32>;
var<workgroup> more_halves: array<vec4<f32>, 32>;
var<workgroup> last_halves: array<vec2<f32>, 32>;

// Sums over triangles.
struct Sums {
    // Twice the area, and the normals.
    area: vec4<f32>,
    product: vec3<f32>,
    moment: vec3<f32>,
}

// A word of `edges`: the neighbour that owns it, and its place in the block.
struct Word {
    owner: u32,
    axis: u32,
    z: u32,
    // Every fourth y.
    quarter: u32,
}

// Word `3·lane + quarter`.
fn word_of(lane: u32, quarter: u32) -> Word {
    let z = lane % 9u;
    let owner = lane / 27u | select(0u, 2u, quarter == 2u) | select(0u, 4u, z == 8u);
    return Word(owner, lane / 9u % 3u, z, quarter);
}

// Crossing edges of a word within the block. They follow from the inside bits: the records of later bricks may not
// exist yet.
fn crossing_edges(word: Word) -> u32 {
    var crossing = 0u;
    if ((word.owner >> word.axis & 1u) == 1u) {
        return crossing;
    }
    for (var i = 0u; i < select(4u, 1u, word.quarter == 2u); i++) {
        let at = 9u * word.z + 4u * word.quarter + i;
        var next = rows[at] >> 1u;
        if (word.axis > 0u) {
            next = rows[at + select(9u, 1u, word.axis == 1u)];
        }
        let row = (rows[at] ^ next) & 511u;
        crossing |= select(row & 255u, row >> 8u, (word.owner & 1u) == 1u) << (8u * i);
    }
    return crossing;
}

// Edges of a word whose vertices other bricks use too.
fn shared_edges(word: Word, crossing: u32) -> u32 {
    if (word.owner > 0u) {
        return crossing;
    }
    let first_x = select(0u, 0x01010101u, word.axis != 0u);
    let first_y = select(0u, 0xffu, word.axis != 1u && word.quarter == 0u);
    let first_z = select(0u, 0xffffffffu, word.axis != 2u && word.z == 0u);
    return crossing & (first_x | first_y | first_z);
}

// Rounded position in steps; the last sample of `p` is 8 along each axis.
fn steps_at(first: vec3<i32>, p: vec3<f32>) -> vec3<i32> {
    return steps_of(quantized_position((vec3<f32>(first) + p) * params.spacing * params.steps_per_angstrom));
}

// Position of the vertex on an edge, relative to `origin`. `first` is the brick's first sample, relative to the centre.
fn position_on(edge: u32, first: vec3<i32>, origin: vec3<i32>) -> vec3<f32> {
    let word = edge >> 6u;
    let axis = word / 27u;
    let at = vec3<u32>(edge & 15u, 4u * (word % 3u) + (edge >> 4u & 3u), word / 3u % 9u);
    let sample = 81u * at.z + 9u * at.y + at.x;
    let t = crossing_at(samples[sample], samples[sample + select(select(81u, 9u, axis == 1u), 1u, axis == 0u)]);
    let p = vec3<f32>(at) + select(vec3<f32>(0.0), vec3<f32>(t), vec3<u32>(0u, 1u, 2u) == vec3<u32>(axis));
    if (params.steps_per_angstrom > 0.0) {
        return vec3<f32>(steps_at(first, p) - origin);
    }
    return p;
}

// Adds a triangle.
fn with_triangle(sums: Sums, a: vec3<f32>, b: vec3<f32>, c: vec3<f32>) -> Sums {
    let n = cross(b - a, c - a);
    let sum = a + b + c;
    return Sums(
        sums.area + vec4<f32>(length(n), n),
        sums.product + n * sum,
        sums.moment + n * (a * sum + b * (b + c) + c * c),
    );
}

// Sums over all lanes, in the first lane. Starts and ends with a barrier.
fn sum_lanes(lane: u32, own: Sums) -> Sums {
    var sums = own;
    for (var half = 32u; half > 0u; half = half >> 1u) {
        workgroupBarrier();
        if (lane >= half && lane < 2u * half) {
            halves[lane - half] = sums.area;
            more_halves[lane - half] = vec4<f32>(sums.product, sums.moment.x);
            last_halves[lane - half] = sums.moment.yz;
        }
        workgroupBarrier();
        if (lane < half) {
            sums.area += halves[lane];
            sums.product += more_halves[lane].xyz;
            sums.moment += vec3<f32>(more_halves[lane].w, last_halves[lane]);
        }
    }
    return sums;
}

// Vertices of a word that are on `sheet`.
fn edges_on(used: u32, before: u32, sheet: u32, only: bool) -> u32 {
    if (only) {
        return used;
    }
    var on = 0u;
    var vertex = before;
    for (var rest = used; rest != 0u; rest &= rest - 1u) {
        on |= select(0u, rest & ~(rest - 1u), sheet_of(vertex) == sheet);
        vertex += 1u;
    }
    return on;
}

// Neighbours below that use vertices of the brick itself: bit n for the brick that has this one as neighbour n.
fn users(word: Word, on: u32) -> u32 {
    var mask = 0u;
    for (var n = 1u; n < 7u; n++) {
        let used = on & select(0xffffffffu, 0x01010101u, (n & 1u) == 1u)
            & select(0xffffffffu, select(0u, 0xffu, word.quarter == 0u), (n & 2u) == 2u)
            & select(0xffffffffu, 0u, (n & 4u) == 4u && word.z > 0u);
        mask |= select(0u, 1u << n, used != 0u && (n >> word.axis & 1u) == 0u);
    }
    return mask;
}

// Writes the owner, key and sheet of each shared vertex of a word from `at` on. The word's first vertex is `first`. A
// key has the layer (3 bits), axis (2 bits) and bit (6 bits) of an edge in its own brick, so keys are in the order of
// the brick's vertices.
fn write_vertices(at: u32, word: Word, crossing: u32, first: u32) {
    let layer = (word.z & 7u) << 8u | word.axis << 6u | (word.quarter & 1u) << 5u;
    var place = at;
    for (var rest = shared_edges(word, crossing); rest != 0u; rest &= rest - 1u) {
        let bit = firstTrailingBit(rest);
        let vertex = first + countOneBits(crossing & below(bit));
        sheets[place] = word.owner | (layer | bit) << 3u | sheet_of(vertex) << 14u;
        place += 1u;
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
        return;
    }
    let first = tiles[bricks[id] >> 9u].coord * 64 + local_brick(bricks[id] & 511u) * 8 - params.centre;
    var origin = first;
    if (params.steps_per_angstrom > 0.0) {
        origin = steps_at(first, vec3<f32>(4.0));
    }
    load_rows(id, lane);
    if (lane < 61u) {
        atomicStore(&names[lane], 0u);
    } else if (lane == 61u) {
        atomicStore(&n_sheets, 0u);
    }
    if (lane < 8u) {
        slots[lane] = slot_of(records[id].neighbours[lane]);
    }
    workgroupBarrier();
    for (var i = lane; i < BLOCK; i += LANES) {
        let at = vec3<u32>(i % 9u, i / 9u % 9u, i / 81u);
        let slot = slots[at.x >> 3u | at.y >> 3u << 1u | at.z >> 3u << 2u];
        var density = 0.0;
        if (slot != NONE) {
            density = field[slot * 512u + (at.z & 7u) * 64u + (at.y & 7u) * 8u + (at.x & 7u)];
        }
        samples[i] = density;
    }
    let row = row_of(lane);
    // Crossing edges of the lane's words, and how many of them are shared.
    var used = vec3<u32>(0u);
    var n_shared = vec3<u32>(0u);
    if (lane < 54u) {
        for (var j = 0u; j < 3u; j++) {
            let word = word_of(lane, j);
            used[j] = crossing_edges(word);
            n_shared[j] = countOneBits(shared_edges(word, used[j]));
        }
    }
    let n_used = countOneBits(used);
    // Number of triangles, and number of vertices shifted by 16.
    let own = row.n | (n_used.x + n_used.y + n_used.z) << 16u;
    let sum = scan_lanes(lane, own);
    let start = (sum - own) & 0xffffu;
    // Number of vertices before each word.
    let place = vec3<u32>((sum - own) >> 16u) + vec3<u32>(0u, n_used.x, n_used.x + n_used.y);
    if (lane < 54u) {
        edges[3u * lane] = vec2<u32>(used.x, place.x);
        edges[3u * lane + 1u] = vec2<u32>(used.y, place.y);
        edges[3u * lane + 2u] = vec2<u32>(used.z, place.z);
    }
    if (lane == LANES - 1u) {
        passed = sum >> 16u;
    }
    let n_vertices = workgroupUniformLoad(&passed);
    let own_shared = n_shared.x + n_shared.y + n_shared.z;
    let shared_sum = scan_lanes(lane, own_shared);
    if (lane == LANES - 1u) {
        passed = shared_sum;
    }
    let all_shared = workgroupUniformLoad(&passed);
    for (var v = lane; v < n_vertices; v += LANES) {
        atomicStore(&labels[v], v);
    }
    for (var window = 0u; window < n; window += WINDOW) {
        workgroupBarrier();
        list_row(row, start - window);
        workgroupBarrier();
        for (var i = lane; i < min(WINDOW, n - window); i += LANES) {
            let vertex = vertex_on(edge_at(i, 1u));
            join(vertex_on(edge_at(i, 0u)), vertex);
            join(vertex_on(edge_at(i, 2u)), vertex);
        }
    }
    number_sheets(lane, n_vertices);
    if (lane == 0u) {
        passed = atomicLoad(&n_sheets);
    }
    let n_found = workgroupUniformLoad(&passed);
    let n_written = select(0u, all_shared, n_found > 1u);
    let size = HEADER + SHEET * n_found + n_written;
    if (lane == 0u) {
        passed = atomicAdd(&counters.sheet_words, size);
    }
    let block = workgroupUniformLoad(&passed);
    // A block beyond the capacity is not written. The host detects it by the counter.
    if (block + size > params.sheet_capacity) {
        return;
    }
    if (lane == 0u) {
        sheets[block] = id;
        sheets[block + 1u] = n_found | n_written << 16u;
        let words = bitcast<vec3<u32>>(origin);
        sheets[block + 2u] = words.x;
        sheets[block + 3u] = words.y;
        sheets[block + 4u] = words.z;
    }
    if (n_found > 1u && lane < 54u) {
        var at = block + HEADER + SHEET * n_found + shared_sum - own_shared;
        for (var j = 0u; j < 3u; j++) {
            write_vertices(at, word_of(lane, j), used[j], place[j]);
            at += n_shared[j];
        }
    }
    for (var sheet = 0u; sheet < n_found; sheet++) {
        if (lane < 3u) {
            atomicStore(&counted[lane], 0u);
        }
        var sums = Sums(vec4<f32>(0.0), vec3<f32>(0.0), vec3<f32>(0.0));
        var n_own = 0u;
        for (var window = 0u; window < n; window += WINDOW) {
            workgroupBarrier();
            // If all triangles fit one window, they are still listed.
            if (n > WINDOW) {
                list_row(row, start - window);
            }
            workgroupBarrier();
            for (var i = lane; i < min(WINDOW, n - window); i += LANES) {
                let a = edge_at(i, 0u);
                if (n_found == 1u || sheet_of(vertex_on(a)) == sheet) {
                    let b = position_on(edge_at(i, 1u), first, origin);
                    let c = position_on(edge_at(i, 2u), first, origin);
                    sums = with_triangle(sums, position_on(a, first, origin), b, c);
                    n_own += 1u;
                }
            }
        }
        var n_on = 0u;
        // Neighbours above, and neighbours below shifted by 8.
        var near = 0u;
        if (lane < 54u) {
            for (var j = 0u; j < 3u; j++) {
                let word = word_of(lane, j);
                let on = edges_on(used[j], place[j], sheet, n_found == 1u);
                if (word.owner == 0u) {
                    n_on += countOneBits(on);
                    near |= users(word, on) << 8u;
                } else {
                    near |= select(0u, 1u << word.owner, on != 0u);
                }
            }
        }
        atomicAdd(&counted[0], n_own);
        atomicAdd(&counted[1], n_on);
        atomicOr(&counted[2], near);
        let all = sum_lanes(lane, sums);
        if (lane == 0u) {
            let at = block + HEADER + SHEET * sheet;
            sheets[at] = atomicLoad(&counted[0]) | atomicLoad(&counted[1]) << 16u;
            sheets[at + 1u] = atomicLoad(&counted[2]);
            let area = bitcast<vec4<u32>>(all.area);
            let product = bitcast<vec3<u32>>(all.product);
            let moment = bitcast<vec3<u32>>(all.moment);
            for (var k = 0u; k < 4u; k++) {
                sheets[at + 2u + k] = area[k];
            }
            for (var k = 0u; k < 3u; k++) {
                sheets[at + 6u + k] = product[k];
                sheets[at + 9u + k] = moment[k];
            }
        }
        workgroupBarrier();
    }
}
