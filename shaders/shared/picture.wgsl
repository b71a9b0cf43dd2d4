// Parameters of shading; see `Finish` in `picture/finish.rs`.

// Depth of pixels without a surface.
const NOTHING: f32 = 3.0e38;

struct FinishParams {
    // Colour of a surface without vertex colours; the fourth component is 1 for a surface with vertex colours.
    color: vec4<f32>,
    background: vec4<f32>,
    size: vec2<u32>,
    n_taps: u32,
    line_width: i32,
    falloff: f32,
    bias: f32,
    strength: f32,
    min_light: f32,
    step_min: f32,
    step_max: f32,
    line_strength: f32,
    pad: f32,
}

// Highest level of a packed colour component. Two components form an integer below 2^24, which is exact.
const TINTS: f32 = 4095.0;

// Packs a linear colour into two numbers. Square roots preserve dark tones.
fn packed_tint(color: vec3<f32>) -> vec2<f32> {
    let level = floor(sqrt(clamp(color, vec3(0.0), vec3(1.0))) * TINTS + 0.5);
    return vec2(level.x + (TINTS + 1.0) * level.y, level.z);
}

fn unpacked_tint(packed: vec2<f32>) -> vec3<f32> {
    let green = floor(packed.x / (TINTS + 1.0));
    let level = vec3(packed.x - (TINTS + 1.0) * green, green, packed.y) / TINTS;
    return level * level;
}
