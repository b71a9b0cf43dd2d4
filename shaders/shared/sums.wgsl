// Sums over triangles, added up by 64 lanes.

// Sums over triangles.
struct Sums {
    // Twice the area, and the normals.
    area: vec4<f32>,
    product: vec3<f32>,
    moment: vec3<f32>,
}

const N_SUMS: u32 = 10u;

// Each sum of half of the lanes: entry 32·sum + lane.
var<workgroup> partial: array<f32, 320>;

// Adds a triangle.
fn with_triangle(sums: Sums, a: vec3<f32>, b: vec3<f32>, c: vec3<f32>) -> Sums {
    let n = cross(b - a, c - a);
    let sum = a + b + c;
    return Sums(
        sums.area + vec4<f32>(length(n), n),
        sums.product + n * sum,
        sums.moment + n * (a * sum + b * (b + c) + c * c),
    );
}

fn store_sums(at: u32, sums: Sums) {
    partial[at] = sums.area.x;
    partial[at + 32u] = sums.area.y;
    partial[at + 64u] = sums.area.z;
    partial[at + 96u] = sums.area.w;
    partial[at + 128u] = sums.product.x;
    partial[at + 160u] = sums.product.y;
    partial[at + 192u] = sums.product.z;
    partial[at + 224u] = sums.moment.x;
    partial[at + 256u] = sums.moment.y;
    partial[at + 288u] = sums.moment.z;
}

fn stored_sums(at: u32) -> Sums {
    return Sums(
        vec4<f32>(partial[at], partial[at + 32u], partial[at + 64u], partial[at + 96u]),
        vec3<f32>(partial[at + 128u], partial[at + 160u], partial[at + 192u]),
        vec3<f32>(partial[at + 224u], partial[at + 256u], partial[at + 288u]),
    );
}

// Adds up the sums of all lanes. Contains and ends with barriers. After it, `sum_at` returns them.
fn sum_lanes(lane: u32, own: Sums) {
    if (lane >= 32u) {
        store_sums(lane - 32u, own);
    }
    workgroupBarrier();
    if (lane < 32u) {
        let other = stored_sums(lane);
        store_sums(lane, Sums(own.area + other.area, own.product + other.product, own.moment + other.moment));
    }
    workgroupBarrier();
    // Each lane adds eight entries of one sum. Lanes begin at different entries, so that they use different banks.
    if (lane < 4u * N_SUMS) {
        let at = 8u * lane;
        let start = lane >> 2u;
        var sum = 0.0;
        for (var i = 0u; i < 8u; i++) {
            sum += partial[at + ((start + i) & 7u)];
        }
        partial[at] = sum;
    }
    workgroupBarrier();
}

// Sum `k` over all lanes.
fn sum_at(k: u32) -> f32 {
    let at = 32u * k;
    return (partial[at] + partial[at + 8u]) + (partial[at + 16u] + partial[at + 24u]);
}
