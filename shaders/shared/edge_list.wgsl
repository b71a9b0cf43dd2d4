// Crossing edges of the brick in a slot, listed in workgroup memory by 64 lanes, and the values at their ends. Requires
// `params`, `bricks`, `halo`, `inside`, `field`, shared/tiles, shared/chunk, shared/corners and shared/crossing.

const LANES: u32 = 64u;

// Edges in any order: grid point (3 bits each of x, y and z), and axis from bit 9 on.
var<workgroup> edges: array<u32, 1536>;
var<workgroup> n_edges: atomic<u32>;
// The brick and its neighbours towards +x (bit 0), +y (bit 1) and +z (bit 2), or NONE.
var<workgroup> near: array<u32, 8>;
// Slots of the brick and of its neighbours towards +x, +y and +z, or NONE.
var<workgroup> slots: array<u32, 4>;

// Returns false for a brick beyond the halo: it exists, but has no values. No cell of the chunk uses edges to it.
fn has_values(brick: u32) -> bool {
    return brick == NONE || slot_of(brick) != NONE;
}

// Lists the crossing edges of brick `id`. Ends with a barrier.
fn list_edges(lane: u32, id: u32, slot: u32) {
    if (lane < 8u) {
        near[lane] = neighbour(bricks[id] >> 9u, bricks[id] & 511u, lane);
    } else if (lane == 8u) {
        atomicStore(&n_edges, 0u);
    }
    workgroupBarrier();
    if (lane < 16u) {
        let z = lane >> 1u;
        let half = lane & 1u;
        let here = vec4<u32>(near[0], near[1], near[2], near[3]);
        let above = vec4<u32>(near[4], near[5], near[6], near[7]);
        let c = corners_of(here, above, z, half);
        var crossing = vec3<u32>(c.low.x) ^ vec3<u32>(c.low.y, c.low.z, c.high.x);
        let last = vec3<u32>(
            FIRST_COLUMN << 7u,
            select(0u, 0xff000000u, half == 1u),
            select(0u, 0xffffffffu, z == 7u),
        );
        let exists = vec3<bool>(has_values(near[1]), has_values(near[2]), has_values(near[4]));
        crossing &= select(~last, vec3<u32>(0xffffffffu), exists);
        let n = countOneBits(crossing);
        var at = atomicAdd(&n_edges, n.x + n.y + n.z);
        for (var axis = 0u; axis < 3u; axis++) {
            for (var rest = crossing[axis]; rest != 0u; rest &= rest - 1u) {
                edges[at] = axis << 9u | z << 6u | half << 5u | firstTrailingBit(rest);
                at += 1u;
            }
        }
    } else if (lane < 20u) {
        slots[lane - 16u] = select(slot_of(near[(1u << (lane - 16u)) >> 1u]), slot, lane == 16u);
    }
    workgroupBarrier();
}

// First grid point of a listed edge.
fn first_point(edge: u32) -> vec3<u32> {
    return vec3<u32>(edge, edge >> 3u, edge >> 6u) & vec3<u32>(7u);
}

// Unit vector along a listed edge.
fn along(edge: u32) -> vec3<f32> {
    return select(vec3<f32>(0.0), vec3<f32>(1.0), vec3<u32>(0u, 1u, 2u) == vec3<u32>(edge >> 9u));
}

// Value at the first grid point of a listed edge.
fn first_value(edge: u32) -> f32 {
    return field[slots[0] * 512u + (edge & 511u)];
}

// Value at the second grid point of a listed edge; 0 in a brick out of reach of all atoms.
fn second_value(edge: u32) -> f32 {
    let axis = edge >> 9u;
    let next = first_point(edge) + vec3<u32>(vec3<u32>(0u, 1u, 2u) == vec3<u32>(axis));
    let beyond = (next.x | next.y | next.z) > 7u;
    let slot = slots[select(0u, axis + 1u, beyond)];
    if (slot == NONE) {
        return 0.0;
    }
    let point = next & vec3<u32>(7u);
    return field[slot * 512u + point.z * 64u + point.y * 8u + point.x];
}

// Index of the parameter of a listed edge in `crossings`.
fn crossing_index(edge: u32) -> u32 {
    return 3u * (slots[0] * 512u + (edge & 511u)) + (edge >> 9u);
}
