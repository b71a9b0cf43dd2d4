// Sheets of a brick: sets of vertices, joined along triangles and numbered by 64 lanes. Requires shared/bits and
// shared/triangles.
//
// Each vertex has one word. While sheets are joined, the word holds the vertex's edge and a label: the number of a
// vertex of the same sheet that is not higher than its own. After that, the word holds the vertex's offset (see
// shared/edge_offsets) and the number of its sheet.

// Mask of a label, and index of the first bit of an edge.
const LABEL: u32 = 2047u;
const EDGE_BIT: u32 = 11u;
// Marks a vertex whose label was replaced by the number of its sheet: the lowest vertex of the sheet.
const NUMBERED: u32 = 0x80000000u;

// Number of low bits of a word that hold the number of the sheet, at most 9. Each sheet separates grid points. It has
// three vertices if it separates one of the 8 corners of the block, four if it separates one of the 84 other grid
// points on the edges of the block, and otherwise at least five. So the number of sheets is at most
// 8 + 84 + (1944 - 24 - 336) / 5 = 408.
var<private> sheet_bits: u32;

// Words of the vertices. A block has at most 1944.
var<workgroup> vertices: array<atomic<u32>, 1944>;
// Words that have a bit for each vertex.
const N_NAMES: u32 = 61u;
// Bit set of the vertices that name a sheet, the lowest of each; later the counts of this number of sheets.
var<workgroup> names: array<atomic<u32>, 61>;
var<workgroup> n_sheets: atomic<u32>;

// Edges of the corners of a listed triangle.
fn edges_of(triangle: u32) -> vec3<u32> {
    return vec3<u32>(edge_at(triangle, 0u), edge_at(triangle, 1u), edge_at(triangle, 2u));
}

// Vertices on three edges.
fn vertices_on(e: vec3<u32>) -> vec3<u32> {
    return vec3<u32>(vertex_on(e.x), vertex_on(e.y), vertex_on(e.z));
}

// Stores the edges of the corners of a triangle, and labels the corners with the lowest of them.
fn label_corners(triangle: u32) {
    let e = edges_of(triangle);
    let v = vertices_on(e);
    let words = e << vec3<u32>(EDGE_BIT) | vec3<u32>(min(min(v.x, v.y), v.z));
    // Words of one vertex differ in the label only, so the lowest label remains.
    atomicMin(&vertices[v.x], words.x);
    atomicMin(&vertices[v.y], words.y);
    atomicMin(&vertices[v.z], words.z);
}

fn label_of(vertex: u32) -> u32 {
    return atomicLoad(&vertices[vertex]) & LABEL;
}

// Joins the sets of two vertices. The lowest vertex names a set.
fn join(a: u32, b: u32) {
    var high = label_of(a);
    var low = label_of(b);
    while (high != low) {
        let top = max(high, low);
        let other = min(high, low);
        let edge = atomicLoad(&vertices[top]) & ~LABEL;
        let label = atomicMin(&vertices[top], edge | other) & LABEL;
        if (label == top) {
            return;
        }
        high = label;
        low = other;
    }
}

// Replaces each label by the last vertex of its chain of labels. No other lane may change labels meanwhile.
fn follow_labels(lane: u32, n: u32) {
    for (var v = lane; v < n; v += LANES) {
        let word = atomicLoad(&vertices[v]);
        var name = word & LABEL;
        var label = label_of(name);
        while (label != name) {
            name = label;
            label = label_of(name);
        }
        atomicStore(&vertices[v], (word & ~LABEL) | name);
    }
}

// Counts the vertices that name a sheet, after their labels were followed.
fn count_names(lane: u32, n: u32) {
    for (var v = lane; v < n; v += LANES) {
        if (label_of(v) == v) {
            atomicAdd(&n_sheets, 1u);
            atomicOr(&names[v >> 5u], 1u << (v & 31u));
        }
    }
}

// Numbers the vertices that name a sheet. A single sheet has the number 0 already, because vertex 0 names it.
fn number_names(lane: u32, n: u32) {
    for (var v = lane; v < n; v += LANES) {
        let word = atomicLoad(&vertices[v]);
        if ((word & LABEL) == v) {
            var number = countOneBits(atomicLoad(&names[v >> 5u]) & below(v & 31u));
            for (var i = 0u; i < (v >> 5u); i++) {
                number += countOneBits(atomicLoad(&names[i]));
            }
            atomicStore(&vertices[v], NUMBERED | (word & ~LABEL) | number);
        }
    }
}

// Number of the sheet of a vertex by its word, which still has its label or is marked. The word of the vertex that
// names the sheet may hold its offset already.
fn number_of(word: u32) -> u32 {
    if ((word & NUMBERED) != 0u) {
        return word & below(sheet_bits);
    }
    return atomicLoad(&vertices[word & LABEL]) & below(sheet_bits);
}

// Number of the sheet of a vertex whose word holds its offset.
fn sheet_of(vertex: u32) -> u32 {
    return atomicLoad(&vertices[vertex]) & below(sheet_bits);
}
