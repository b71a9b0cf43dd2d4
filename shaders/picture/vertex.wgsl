// Transforms a vertex: screen position, depth, normal in view space, and light.

struct ViewUniform {
    // Axes of the view: right, up, towards the viewer. The fourth component is the offset of the projection.
    right: vec4<f32>,
    up: vec4<f32>,
    toward: vec4<f32>,
    // Direction of the light in view space; the fourth component is the ambient light.
    light: vec4<f32>,
    // Size of the picture in pixels, and position of the sample within a pixel.
    size: vec2<f32>,
    offset: vec2<f32>,
    // Pixels per Å, maximum depth, and diffuse light.
    scale: f32,
    reach: f32,
    diffuse: f32,
    pad: f32,
}

struct Corner {
    @builtin(position) position: vec4<f32>,
    // Normal in view space, and light.
    @location(0) @interpolate(linear) shade: vec4<f32>,
    @location(1) @interpolate(linear) depth: f32,
    // Linear colour.
    @location(2) @interpolate(linear) tint: vec4<f32>,
}

@group(0) @binding(0) var<uniform> view: ViewUniform;

// Converts sRGB to linear light, like `light::linear`.
fn linear(level: vec3<f32>) -> vec3<f32> {
    return select(pow((level + 0.055) / 1.055, vec3(2.4)), level / 12.92, level <= vec3(0.04045));
}

@vertex
fn main(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) color: vec4<f32>,
) -> Corner {
    let right = dot(view.right.xyz, position) + view.right.w;
    let up = dot(view.up.xyz, position) + view.up.w;
    let depth = view.toward.w - dot(view.toward.xyz, position);
    // The device samples pixel centres, so the position is shifted by the offset of the sample.
    let pixel = vec2(right, -up) * view.scale + 0.5 * view.size + (vec2(0.5, 0.5) - view.offset);
    let clip = vec2(pixel.x / view.size.x, 1.0 - pixel.y / view.size.y) * 2.0 - 1.0;
    let seen = vec3(dot(view.right.xyz, normal), dot(view.up.xyz, normal), dot(view.toward.xyz, normal));
    let light = view.light.w + view.diffuse * max(dot(seen, view.light.xyz), 0.0);
    // The margin keeps rounding from clipping the nearest and the farthest point.
    let z = 0.0005 + 0.999 * depth / max(view.reach, 1e-6);
    return Corner(vec4(clip, z, 1.0), vec4(seen, light), depth, vec4(linear(color.xyz), 1.0));
}
