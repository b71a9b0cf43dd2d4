// The 2010 program, step 3 of 6, continued: adds to each block of 512 values the sum of the blocks before it.

@group(0) @binding(0) var<storage, read_write> values: array<vec2<u32>>;
@group(0) @binding(1) var<storage, read> sums: array<vec2<u32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(num_workgroups) workgroups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = workgroup_number(workgroup, workgroups) * 256u + lane;
    if (i < arrayLength(&values)) {
        values[i] += sums[i / 512u];
    }
}
