// Vertices as small integers: what `surface/quantize.rs` makes of the same single-precision numbers.

// The bits of 32,767.5: what is smaller is rounded to a 16-bit integer of either sign.
const TOO_LARGE: u32 = 0x46ffff00u;
// Stands for a coordinate that no integer is near, or that is no number.
const BEYOND: u32 = 0x8000u;
// The largest square of a normal's length, in units of 1/127, that passes for 1.
const NORMAL_MAX_SQUARE: i32 = 16347;

// The nearest integer, ties to even. Sizes are compared as bits: comparisons of what is no number may be left out.
fn rounded_coordinate(v: f32) -> u32 {
    let held = (bitcast<u32>(v) & 0x7fffffffu) < TOO_LARGE;
    return select(BEYOND, bitcast<u32>(i32(round(v))) & 0xffffu, held);
}

// A position in steps as four 16-bit integers, the last one 0.
fn quantized_position(steps: vec3<f32>) -> vec2<u32> {
    return vec2<u32>(
        rounded_coordinate(steps.x) | rounded_coordinate(steps.y) << 16u,
        rounded_coordinate(steps.z),
    );
}

// A unit normal, or a zero one, as four 8-bit integers, the last one 0.
fn quantized_normal(normal: vec3<f32>) -> u32 {
    var n = vec3<i32>(round(clamp(normal * 127.0, vec3<f32>(-127.0), vec3<f32>(127.0))));
    if (n.x * n.x + n.y * n.y + n.z * n.z > NORMAL_MAX_SQUARE) {
        // Too long by a hair: the largest component, the first of equals, is moved towards zero.
        let size = abs(n);
        if (size.x >= size.y && size.x >= size.z) {
            n.x -= sign(n.x);
        } else if (size.y >= size.z) {
            n.y -= sign(n.y);
        } else {
            n.z -= sign(n.z);
        }
    }
    let bytes = bitcast<vec3<u32>>(n) & vec3<u32>(0xffu);
    return bytes.x | bytes.y << 8u | bytes.z << 16u;
}
