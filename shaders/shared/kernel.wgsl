// Densities of the three kernels as functions of u = d²/ρ². Requires `params`.
override KERNEL: u32 = 0u;

const GAUSSIAN: u32 = 0u;
const SOFT_OBJECT: u32 = 1u;
const INVERSE_SQUARE: u32 = 2u;

// Terms of the density along one axis, for four distances: the exponential and the linear term of the cut-off for the
// Gaussian, u for the other kernels.
struct Axis {
    e: vec4<f32>,
    w: vec4<f32>,
}

fn z_axis(u: vec4<f32>) -> Axis {
    if (KERNEL == GAUSSIAN) {
        return Axis(exp2(params.share - params.rate * u), params.tail_share + params.tail_rate * u);
    }
    return Axis(vec4<f32>(0.0), u);
}

// Terms of the density of a column of grid points.
struct Column {
    e: f32,
    w: f32,
}

fn column(u: f32) -> Column {
    if (KERNEL == GAUSSIAN) {
        return Column(exp2(2.0 * params.share - params.rate * u), 2.0 * params.tail_share + params.tail_rate * u);
    }
    return Column(0.0, u);
}

// Density at four grid points of a column. Exactly 0 beyond the support, so additional candidates do not change the
// sum.
fn density(c: Column, z: Axis, u_min: f32) -> vec4<f32> {
    if (KERNEL == GAUSSIAN) {
        let tail = c.w + z.w;
        return select(vec4<f32>(0.0), fma(vec4<f32>(c.e), z.e, tail), tail < vec4<f32>(params.tail_end));
    }
    let u = c.w + z.w;
    let t = max(1.0 - u, vec4<f32>(0.0));
    let t2 = t * t * params.amplitude;
    if (KERNEL == SOFT_OBJECT) {
        return t2 * fma(u, vec4<f32>(-4.0 / 9.0), vec4<f32>(1.0));
    }
    return t2 / max(u, vec4<f32>(u_min));
}

// Density at u.
fn density_at(u: f32, u_min: f32) -> f32 {
    return density(column(u), z_axis(vec4<f32>(0.0)), u_min).x;
}

// -dF/du up to the factor `slope_scale`, which all atoms have in common.
fn slope(u: f32, u_min: f32) -> f32 {
    if (KERNEL == GAUSSIAN) {
        return exp2(params.slope_offset - params.rate * u) - params.slope_tail;
    }
    if (KERNEL == SOFT_OBJECT) {
        return (1.0 - u) * fma(u, -6.0, 11.0);
    }
    let v = max(u, u_min);
    return (1.0 - v * v) / (v * v);
}
