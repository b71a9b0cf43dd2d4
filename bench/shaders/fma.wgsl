// Runs fused multiply-adds in eight independent chains per thread, 8 · STEPS in all, to measure the rate of arithmetic.

@group(0) @binding(0) var<storage, read> source: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> goal: array<vec4<f32>>;

const STEPS: u32 = 1024u;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32) {
    // Read from a buffer, so that the compiler cannot fold them.
    let factor = source[0];
    let term = source[1];
    let i = (group.y * groups.x + group.x) * 256u + thread;
    var a = term + f32(thread);
    var b = term - f32(thread);
    for (var step = 0u; step < STEPS; step += 8u) {
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
        a = fma(a, factor, term);
        b = fma(b, factor, term);
    }
    goal[i % arrayLength(&goal)] = a + b;
}
