// Parameters of shading; see `Finish` in `picture/finish.rs`.

// Depth of pixels without a surface.
const NOTHING: f32 = 3.0e38;

struct FinishParams {
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
