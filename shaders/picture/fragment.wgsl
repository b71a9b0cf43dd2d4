// Writes the interpolated values of a sample.

struct Sample {
    @location(0) shade: vec4<f32>,
    @location(1) depth: f32,
    @location(2) tint: vec4<f32>,
}

@fragment
fn main(
    @location(0) @interpolate(linear) shade: vec4<f32>,
    @location(1) @interpolate(linear) depth: f32,
    @location(2) @interpolate(linear) tint: vec4<f32>,
) -> Sample {
    return Sample(shade, depth, tint);
}
