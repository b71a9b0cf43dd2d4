// Offsets of vertices along their edges, as integers of `32 - sheet_bits` bits. Requires `params`, `crossings`,
// shared/bits and shared/sheets.
//
// For rounded positions, the offset is the coordinate along the edge in steps, relative to an origin. Otherwise it is
// the parameter of the crossing in units of `offset_unit`.

// 2^-(32 - sheet_bits), set by the stage.
var<private> offset_unit: f32;
// Slots of the brick and of its neighbours.
var<workgroup> slots: array<u32, 8>;

// First grid point of an edge in the block.
fn first_point(edge: u32) -> vec3<u32> {
    let word = edge >> 6u;
    return vec3<u32>(edge & 15u, 4u * (word % 3u) + (edge >> 4u & 3u), word / 3u % 9u);
}

// Axis of an edge, as a mask.
fn axis_of(edge: u32) -> vec3<bool> {
    return vec3<u32>(0u, 1u, 2u) == vec3<u32>((edge >> 6u) / 27u);
}

// Parameter of the vertex on an edge.
fn parameter_on(edge: u32) -> f32 {
    let at = first_point(edge);
    let slot = slots[at.x >> 3u | at.y >> 3u << 1u | at.z >> 3u << 2u];
    let point = at & vec3<u32>(7u);
    return crossings[3u * (slot * 512u + point.z * 64u + point.y * 8u + point.x) + (edge >> 6u) / 27u];
}

// Rounded position of a point, in steps relative to the centre. `p` is relative to the brick's first grid point, and
// `first` is that grid point relative to the centre, both in spacings. Equal to the position that `interpolate` writes.
fn steps_at(first: vec3<f32>, p: vec3<f32>) -> vec3<f32> {
    return round((first + p) * params.spacing * params.steps_per_angstrom);
}

// Offset of the vertex on an edge.
fn offset_on(edge: u32, first: vec3<f32>, origin: vec3<f32>) -> u32 {
    let at = first_point(edge);
    let axis = axis_of(edge);
    let t = parameter_on(edge);
    if (params.steps_per_angstrom > 0.0) {
        let p = steps_at(first, vec3<f32>(at) + vec3<f32>(axis) * t) - origin;
        return bitcast<u32>(i32(select(select(p.z, p.y, axis.y), p.x, axis.x)));
    }
    return u32(round(ldexp(t, 32 - i32(sheet_bits))));
}

// Position of a vertex relative to `origin`, by its edge and its word.
fn position_of(edge: u32, word: u32, first: vec3<f32>, origin: vec3<f32>) -> vec3<f32> {
    let at = vec3<f32>(first_point(edge));
    if (params.steps_per_angstrom > 0.0) {
        let along = vec3<f32>(f32(bitcast<i32>(word) >> sheet_bits));
        return select(steps_at(first, at) - origin, along, axis_of(edge));
    }
    return at + vec3<f32>(axis_of(edge)) * f32(word >> sheet_bits) * offset_unit;
}
