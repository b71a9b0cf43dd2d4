// Vertices as small integers, equal to those of `surface/quantize.rs` for the same single-precision values.

// Bits of 32,767.5. Smaller absolute values round to a 16-bit integer.
const TOO_LARGE: u32 = 0x46ffff00u;
// Marks a coordinate that does not fit or is not a number.
const BEYOND: u32 = 0x8000u;
// Maximum squared length of a normal in units of 1/127.
const NORMAL_MAX_SQUARE: i32 = 16347;

// Nearest integer, ties to even. Absolute values are compared as bits, because comparisons with NaN may be optimized
// away.
fn rounded_coordinate(v: f32) -> u32 {
    let fits = (bitcast<u32>(v) & 0x7fffffffu) < TOO_LARGE;
    return select(BEYOND, bitcast<u32>(i32(round(v))) & 0xffffu, fits);
}

// Position in steps as four 16-bit integers; the last is 0.
fn quantized_position(steps: vec3<f32>) -> vec2<u32> {
    return vec2<u32>(
        rounded_coordinate(steps.x) | rounded_coordinate(steps.y) << 16u,
        rounded_coordinate(steps.z),
    );
}

// Integers of a quantized position.
fn steps_of(rounded: vec2<u32>) -> vec3<i32> {
    let words = bitcast<vec2<i32>>(rounded);
    return vec3<i32>(words.x << 16u, words.x, words.y << 16u) >> vec3<u32>(16u);
}

// Unit normal, or zero, as four 8-bit integers; the last is 0.
fn quantized_normal(normal: vec3<f32>) -> u32 {
    var n = vec3<i32>(round(clamp(normal * 127.0, vec3<f32>(-127.0), vec3<f32>(127.0))));
    if (n.x * n.x + n.y * n.y + n.z * n.z > NORMAL_MAX_SQUARE) {
        // Rounding made the normal too long: decrements the largest component, the first of equals.
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
