// Sphere on the lattice.
struct Atom {
    // Grid point nearest to the centre.
    cell: vec3<i32>,
    inv_length2: f32,
    // Offset of the centre from `cell`.
    frac: vec3<f32>,
    // Index in the caller's input.
    source: u32,
}
