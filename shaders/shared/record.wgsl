// What `classify` keeps of a brick. Needs shared/bits.
struct Record {
    // Crossing edges: half-word 2·(3·z + axis) + half. Vertices are numbered in this order.
    crossing: array<u32, 48>,
    // Per layer the vertices before it (16 bits), and those of its x and y edges (8 bits each).
    layers: array<u32, 8>,
    // The brick and its neighbours, or NONE: bit 0 is a step along x, 1 y, 2 z.
    near: array<u32, 8>,
}

// Vertices of a brick before the word of `axis` in a layer.
fn before_word(layer: u32, axis: u32) -> u32 {
    let x = layer >> 16u & 255u;
    return (layer & 0xffffu) + select(0u, x, axis > 0u) + select(0u, layer >> 24u, axis > 1u);
}
