// A sphere on the lattice.
struct Atom {
    // The sample nearest to the centre.
    cell: vec3<i32>,
    inv_length2: f32,
    // The centre's offset from `cell`.
    frac: vec3<f32>,
    // Index in the caller's input.
    source: u32,
}
