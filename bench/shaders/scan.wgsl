// The 2010 program, step 3 of 6: exclusive prefix sums of blocks of 512 values in place, and the sums of the blocks.

@group(0) @binding(0) var<storage, read_write> values: array<vec2<u32>>;
@group(0) @binding(1) var<storage, read_write> sums: array<vec2<u32>>;

var<workgroup> part: array<vec2<u32>, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) workgroup: vec3<u32>, @builtin(num_workgroups) workgroups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let block = workgroup_number(workgroup, workgroups);
    let at = block * 512u + 2u * lane;
    let n = arrayLength(&values);
    var first = vec2<u32>(0u);
    var second = vec2<u32>(0u);
    if (at < n) {
        first = values[at];
    }
    if (at + 1u < n) {
        second = values[at + 1u];
    }
    let mine = first + second;
    var sum = mine;
    part[lane] = sum;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step <<= 1u) {
        var before = vec2<u32>(0u);
        if (lane >= step) {
            before = part[lane - step];
        }
        workgroupBarrier();
        sum += before;
        part[lane] = sum;
        workgroupBarrier();
    }
    if (at < n) {
        values[at] = sum - mine;
    }
    if (at + 1u < n) {
        values[at + 1u] = sum - second;
    }
    if (lane == 255u && block < arrayLength(&sums)) {
        sums[block] = sum;
    }
}
