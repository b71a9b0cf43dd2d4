// Checksum of directed edges, equal to that of `surface/sums.rs`. 64-bit integers are pairs, lower half first.

fn add64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.x + b.x;
    return vec2<u32>(low, a.y + b.y + select(0u, 1u, low < a.x));
}

fn multiply64(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let p = vec2<u32>(a.x & 0xffffu, a.x >> 16u);
    let q = vec2<u32>(b.x & 0xffffu, b.x >> 16u);
    let middle = p.y * q.x + (p.x * q.x >> 16u);
    let carry = p.x * q.y + (middle & 0xffffu);
    let high = p.y * q.y + (middle >> 16u) + (carry >> 16u);
    return vec2<u32>(a.x * b.x, high + a.x * b.y + a.y * b.x);
}

// Share of a directed edge. The two directions of an edge have opposite shares.
fn edge_share(origin: u32, end: u32) -> vec2<u32> {
    var key = multiply64(vec2<u32>(max(origin, end), min(origin, end)), vec2<u32>(0x7f4a7c15u, 0x9e3779b9u));
    key.x ^= key.y;
    key = multiply64(key, vec2<u32>(0x6659fd93u, 0xd6e8feb8u));
    key.x ^= key.y;
    return select(add64(~key, vec2<u32>(1u, 0u)), key, origin < end);
}
