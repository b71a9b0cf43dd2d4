// The numbers that a picture is finished with.

// Deeper than anything: nothing is seen.
const NOTHING: f32 = 3.0e38;

struct Numbers {
    color: vec4<f32>,
    behind: vec4<f32>,
    size: vec2<u32>,
    n_taps: u32,
    line: i32,
    falloff: f32,
    bias: f32,
    strength: f32,
    darkest: f32,
    step_from: f32,
    step_to: f32,
    ink: f32,
    pad: f32,
}
