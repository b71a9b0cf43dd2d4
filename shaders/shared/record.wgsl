// Result of `classify` for a brick. Requires shared/bits.
struct BrickRecord {
    // Crossing edges: half-word 2·(3·z + axis) + half. Vertices are numbered in this order.
    crossing: array<u32, 48>,
    // Per layer: number of vertices before it (16 bits), on its x edges (8 bits) and on its y edges (8 bits).
    layers: array<u32, 8>,
    // Brick and its neighbours towards +x (bit 0), +y (bit 1) and +z (bit 2), or NONE.
    neighbours: array<u32, 8>,
}

// Number of vertices of a brick before the word of `axis` in a layer.
fn before_word(layer: u32, axis: u32) -> u32 {
    let x = layer >> 16u & 255u;
    return (layer & 0xffffu) + select(0u, x, axis > 0u) + select(0u, layer >> 24u, axis > 1u);
}
