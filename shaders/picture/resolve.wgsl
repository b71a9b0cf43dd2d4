// Resolves four samples to a pixel: minimum depth, mean light, normal and colour, and coverage.

const SAMPLES: i32 = 4;

#include shared/picture.wgsl

@group(0) @binding(0) var<uniform> params: FinishParams;
@group(0) @binding(1) var shades: texture_2d_array<f32>;
@group(0) @binding(2) var depths: texture_2d_array<f32>;
// Depth, light, coverage, and red and green.
@group(0) @binding(3) var<storage, read_write> seen: array<vec4<f32>>;
// Normal, and blue.
@group(0) @binding(4) var<storage, read_write> normals: array<vec4<f32>>;
@group(0) @binding(5) var tints: texture_2d_array<f32>;

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= params.size.x || id.y >= params.size.y {
        return;
    }
    var depth = NOTHING;
    var sum = vec4(0.0);
    var tint = vec3(0.0);
    var covered = 0.0;
    for (var s = 0; s < SAMPLES; s++) {
        let at = textureLoad(depths, vec2<i32>(id.xy), s, 0).x;
        if at < 0.5 * NOTHING {
            depth = min(depth, at);
            sum += textureLoad(shades, vec2<i32>(id.xy), s, 0);
            tint += textureLoad(tints, vec2<i32>(id.xy), s, 0).xyz;
            covered += 1.0;
        }
    }
    let length = sqrt(dot(sum.xyz, sum.xyz));
    let normal = select(vec3(0.0, 0.0, 1.0), sum.xyz / max(length, 1e-20), length > 0.0);
    let i = id.y * params.size.x + id.x;
    let packed = packed_tint(tint / max(covered, 1.0));
    seen[i] = vec4(depth, sum.w / max(covered, 1.0), covered / f32(SAMPLES), packed.x);
    normals[i] = vec4(normal, packed.y);
}
