// Shading of resolved pixels, as in `picture/finish.rs`.

const STEPS: f32 = 8192.0;

#include shared/picture.wgsl

struct TapUniform {
    pixels: vec2<i32>,
    length: vec2<f32>,
}

@group(0) @binding(0) var<uniform> params: FinishParams;
@group(0) @binding(1) var<storage, read> seen: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> normals: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> taps: array<TapUniform>;
// sRGB levels of linear light, by steps.
@group(0) @binding(4) var<storage, read> levels: array<u32>;
@group(0) @binding(5) var<storage, read_write> pixels: array<u32>;

// Index of the pixel at offset `by`, or the number of pixels if it lies outside.
fn neighbour(at: vec2<i32>, by: vec2<i32>) -> u32 {
    let size = vec2<i32>(params.size);
    let to = at + by;
    if any(to < vec2(0)) || any(to >= size) {
        return params.size.x * params.size.y;
    }
    return u32(to.y) * params.size.x + u32(to.x);
}

// Share of the light that is not occluded by neighbours, 0 to 1.
fn unoccluded(at: vec2<i32>, i: u32) -> f32 {
    let n = params.size.x * params.size.y;
    let depth = seen[i].x;
    let normal = normals[i].xyz;
    var shade = 0.0;
    for (var t = 0u; t < params.n_taps; t++) {
        let tap = taps[t];
        let other = neighbour(at, tap.pixels);
        if other == n {
            continue;
        }
        let there = seen[other].x;
        if there >= 0.5 * NOTHING {
            continue;
        }
        let way = vec3(tap.length, depth - there);
        let square = dot(way, way);
        let sine = dot(normal, way) / sqrt(square) - params.bias;
        shade += select(0.0, sine / (1.0 + square * params.falloff), sine > 0.0);
    }
    return max(1.0 - shade * params.strength / f32(params.n_taps), params.min_light);
}

// Strength of the outline at a pixel, 0 to 1.
fn outline(at: vec2<i32>, i: u32) -> f32 {
    let n = params.size.x * params.size.y;
    let depth = seen[i].x;
    var step = 0.0;
    var rim = 0.0;
    for (var k = 0u; k < 4u; k++) {
        var by = vec2(params.line_width, 0);
        if k == 1u {
            by = vec2(0, params.line_width);
        } else if k == 2u {
            by = vec2(params.line_width, params.line_width);
        } else if k == 3u {
            by = vec2(params.line_width, -params.line_width);
        }
        var sum = 0.0;
        var whole = true;
        for (var end = 0u; end < 2u; end++) {
            let other = neighbour(at, select(-by, by, end == 0u));
            // The border of the picture is not an outline.
            if other == n {
                whole = false;
                continue;
            }
            rim = max(rim, 1.0 - seen[other].z);
            if seen[other].x < 0.5 * NOTHING {
                sum += seen[other].x;
            } else {
                whole = false;
            }
        }
        if whole {
            step = max(step, sum - 2.0 * depth);
        }
    }
    let part = clamp((step - params.step_min) / (params.step_max - params.step_min), 0.0, 1.0);
    return max(part * part * (3.0 - 2.0 * part), rim);
}

fn level(light: f32) -> u32 {
    return levels[u32(clamp(light, 0.0, 1.0) * STEPS + 0.5)];
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= params.size.x || id.y >= params.size.y {
        return;
    }
    let i = id.y * params.size.x + id.x;
    let at = vec2<i32>(id.xy);
    let share = seen[i].z;
    var light = seen[i].y;
    if share > 0.0 {
        if params.n_taps > 0u {
            light *= unoccluded(at, i);
        }
        if params.line_width > 0 {
            light *= 1.0 - params.line_strength * outline(at, i);
        }
    }
    let alpha = share + params.background.w * (1.0 - share);
    if alpha <= 0.0 {
        pixels[i] = 0u;
        return;
    }
    let tint = unpacked_tint(vec2(seen[i].w, normals[i].w));
    let surface = select(params.color.xyz, tint, params.color.w > 0.0);
    let color = (surface * light * share + params.background.xyz * (1.0 - share)) / alpha;
    let a = u32(min(alpha, 1.0) * 255.0 + 0.5);
    pixels[i] = level(color.x) | (level(color.y) << 8u) | (level(color.z) << 16u) | (a << 24u);
}
