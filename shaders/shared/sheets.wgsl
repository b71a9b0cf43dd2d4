// Sheets of a brick: sets of vertices, joined along triangles and numbered by 64 lanes. Requires shared/bits and
// shared/triangles.

// Marks the final label of a vertex that named its set before.
const NUMBERED: u32 = 0x80000000u;

// Per vertex another vertex of the same sheet, at most as high; later the sheet. A block has at most 1944 vertices.
var<workgroup> labels: array<atomic<u32>, 1944>;
// Bits of the vertices that name a sheet.
var<workgroup> names: array<atomic<u32>, 61>;
var<workgroup> n_sheets: atomic<u32>;

// Joins the sets of two vertices. The lowest vertex names a set.
fn join(a: u32, b: u32) {
    var high = atomicLoad(&labels[a]);
    var low = atomicLoad(&labels[b]);
    while (high != low) {
        let top = max(high, low);
        let other = min(high, low);
        let label = atomicMin(&labels[top], other);
        if (label == top) {
            return;
        }
        high = label;
        low = other;
    }
}

// Replaces labels by the number of the sheet. Starts and ends with a barrier.
fn number_sheets(lane: u32, n: u32) {
    workgroupBarrier();
    for (var v = lane; v < n; v += LANES) {
        var name = v;
        var label = atomicLoad(&labels[v]);
        while (label != name) {
            name = label;
            label = atomicLoad(&labels[name]);
        }
        atomicStore(&labels[v], name);
        if (name == v) {
            atomicAdd(&n_sheets, 1u);
            atomicOr(&names[v >> 5u], 1u << (v & 31u));
        }
    }
    workgroupBarrier();
    // With one sheet, all labels are 0 already.
    if (atomicLoad(&n_sheets) > 1u) {
        for (var v = lane; v < n; v += LANES) {
            if (atomicLoad(&labels[v]) == v) {
                var number = countOneBits(atomicLoad(&names[v >> 5u]) & below(v & 31u));
                for (var i = 0u; i < (v >> 5u); i++) {
                    number += countOneBits(atomicLoad(&names[i]));
                }
                atomicStore(&labels[v], number | NUMBERED);
            }
        }
    }
    workgroupBarrier();
    if (atomicLoad(&n_sheets) > 1u) {
        for (var v = lane; v < n; v += LANES) {
            let name = atomicLoad(&labels[v]);
            if ((name & NUMBERED) == 0u) {
                atomicStore(&labels[v], atomicLoad(&labels[name]));
            }
        }
    }
    workgroupBarrier();
}

// Sheet of a vertex.
fn sheet_of(vertex: u32) -> u32 {
    return atomicLoad(&labels[vertex]) & ~NUMBERED;
}
