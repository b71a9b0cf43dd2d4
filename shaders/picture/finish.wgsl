// From what is seen to pixels, as src/picture/finish.rs says.

const STEPS: f32 = 8192.0;

#include shared/picture.wgsl

struct Tap {
    pixels: vec2<i32>,
    length: vec2<f32>,
}

@group(0) @binding(0) var<uniform> numbers: Numbers;
@group(0) @binding(1) var<storage, read> seen: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> normals: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> taps: array<Tap>;
// sRGB levels of linear light, in steps.
@group(0) @binding(4) var<storage, read> levels: array<u32>;
@group(0) @binding(5) var<storage, read_write> pixels: array<u32>;

// The pixel that lies so far away, or the number of pixels.
fn neighbour(at: vec2<i32>, by: vec2<i32>) -> u32 {
    let size = vec2<i32>(numbers.size);
    let to = at + by;
    if any(to < vec2(0)) || any(to >= size) {
        return numbers.size.x * numbers.size.y;
    }
    return u32(to.y) * numbers.size.x + u32(to.x);
}

// How much light reaches a pixel past its neighbours, 0 to 1.
fn open(at: vec2<i32>, i: u32) -> f32 {
    let n = numbers.size.x * numbers.size.y;
    let depth = seen[i].x;
    let normal = normals[i].xyz;
    var shade = 0.0;
    for (var t = 0u; t < numbers.n_taps; t++) {
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
        let sine = dot(normal, way) / sqrt(square) - numbers.bias;
        shade += select(0.0, sine / (1.0 + square * numbers.falloff), sine > 0.0);
    }
    return max(1.0 - shade * numbers.strength / f32(numbers.n_taps), numbers.darkest);
}

// How much of a line a pixel is, 0 to 1.
fn line(at: vec2<i32>, i: u32) -> f32 {
    let n = numbers.size.x * numbers.size.y;
    let depth = seen[i].x;
    var step = 0.0;
    var rim = 0.0;
    for (var k = 0u; k < 4u; k++) {
        var by = vec2(numbers.line, 0);
        if k == 1u {
            by = vec2(0, numbers.line);
        } else if k == 2u {
            by = vec2(numbers.line, numbers.line);
        } else if k == 3u {
            by = vec2(numbers.line, -numbers.line);
        }
        var sum = 0.0;
        var whole = true;
        for (var end = 0u; end < 2u; end++) {
            let other = neighbour(at, select(-by, by, end == 0u));
            // The picture's border is no rim.
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
    let part = clamp((step - numbers.step_from) / (numbers.step_to - numbers.step_from), 0.0, 1.0);
    return max(part * part * (3.0 - 2.0 * part), rim);
}

fn level(light: f32) -> u32 {
    return levels[u32(clamp(light, 0.0, 1.0) * STEPS + 0.5)];
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= numbers.size.x || id.y >= numbers.size.y {
        return;
    }
    let i = id.y * numbers.size.x + id.x;
    let at = vec2<i32>(id.xy);
    let share = seen[i].z;
    var light = seen[i].y;
    if share > 0.0 {
        if numbers.n_taps > 0u {
            light *= open(at, i);
        }
        if numbers.line > 0 {
            light *= 1.0 - numbers.ink * line(at, i);
        }
    }
    let alpha = share + numbers.behind.w * (1.0 - share);
    if alpha <= 0.0 {
        pixels[i] = 0u;
        return;
    }
    let color = (numbers.color.xyz * light * share + numbers.behind.xyz * (1.0 - share)) / alpha;
    let a = u32(min(alpha, 1.0) * 255.0 + 0.5);
    pixels[i] = level(color.x) | (level(color.y) << 8u) | (level(color.z) << 16u) | (a << 24u);
}
