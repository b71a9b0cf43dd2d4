// Stage `field`: density at the 8 × 8 × 8 grid points of every brick, and the bits of the grid points inside the
// surface. One workgroup per brick, one lane per column of grid points along z.
//
// Each grid point has one owner. A halo brick is computed by the same instructions from the same list, so neighbours
// always agree on a sign. Candidates are staged in workgroup memory in pieces; terms that depend on z are computed once
// for all 64 columns.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/kernel.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> tiles: array<Tile>;
@group(0) @binding(3) var<storage, read> bricks: array<u32>;
@group(0) @binding(4) var<storage, read> lists: array<u32>;
@group(0) @binding(5) var<storage, read> heads: array<vec4<u32>>;
@group(0) @binding(6) var<storage, read_write> field: array<f32>;
@group(0) @binding(7) var<storage, read_write> inside: array<u32>;

// Number of candidates staged at once, by two lanes each. A larger number would reduce the number of concurrent
// workgroups.
const PIECE: u32 = 24u;

struct Staged {
    // Whole cells from the atom to the first grid point of the brick, and fraction of the atom: x, y.
    whole: vec2<f32>,
    frac: vec2<f32>,
    inv_length2: f32,
    // Minimum u along z in the lower and the upper half of the brick.
    nearest: vec2<f32>,
}

var<workgroup> staged: array<Staged, 24>;
var<workgroup> z_e: array<vec4<f32>, 48>;
var<workgroup> z_w: array<vec4<f32>, 48>;
// Inside bits of four columns each.
var<workgroup> columns: array<vec4<u32>, 16>;

// Inside bits of four columns in layer z.
fn four_bits(at: u32, z: u32) -> u32 {
    let bits = columns[at] >> vec4<u32>(z) & vec4<u32>(1u);
    return bits.x | bits.y << 1u | bits.z << 2u | bits.w << 3u;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let slot = workgroup_number(workgroup, workgroups);
    if (slot >= params.n_own + params.n_halo) {
        return;
    }
    let head = heads[slot];
    let id = head.w;
    let tile = bricks[id] >> 9u;
    let origin = tiles[tile].coord * 64 + local_brick(bricks[id] & 511u) * 8;
    let x = f32(lane & 7u);
    let y = f32(lane >> 3u);
    var low = vec4<f32>(0.0);
    var high = vec4<f32>(0.0);
    for (var first = 0u; first < head.y; first += PIECE) {
        let n = min(PIECE, head.y - first);
        let mine = lane >> 1u;
        let half = lane & 1u;
        workgroupBarrier();
        if (mine < n) {
            let atom = atoms[lists[head.x + first + mine]];
            // Whole numbers are exact, so each distance is rounded once.
            let whole = vec3<f32>(origin - atom.cell);
            let start = whole.z + f32(4u * half);
            let d = (vec4<f32>(start) + vec4<f32>(0.0, 1.0, 2.0, 3.0)) - atom.frac.z;
            let u = d * d * atom.inv_length2;
            let axis = z_axis(u);
            z_e[lane] = axis.e;
            z_w[lane] = axis.w;
            let nearest = min(min(u.x, u.y), min(u.z, u.w));
            if (half == 0u) {
                staged[mine].whole = whole.xy;
                staged[mine].frac = atom.frac.xy;
                staged[mine].inv_length2 = atom.inv_length2;
                staged[mine].nearest.x = nearest;
            } else {
                staged[mine].nearest.y = nearest;
            }
        }
        workgroupBarrier();
        for (var i = 0u; i < n; i++) {
            let a = staged[i];
            let dx = (a.whole.x + x) - a.frac.x;
            let dy = (a.whole.y + y) - a.frac.y;
            let u = (dx * dx + dy * dy) * a.inv_length2;
            if (u + min(a.nearest.x, a.nearest.y) < params.support) {
                let c = column(u);
                let u_min = params.u_min * a.inv_length2;
                // Most candidates reach only one half of the brick.
                if (u + a.nearest.x < params.support) {
                    low += density(c, Axis(z_e[2u * i], z_w[2u * i]), u_min);
                }
                if (u + a.nearest.y < params.support) {
                    high += density(c, Axis(z_e[2u * i + 1u], z_w[2u * i + 1u]), u_min);
                }
            }
        }
    }
    let at = slot * 512u + lane;
    field[at] = low.x;
    field[at + 64u] = low.y;
    field[at + 128u] = low.z;
    field[at + 192u] = low.w;
    field[at + 256u] = high.x;
    field[at + 320u] = high.y;
    field[at + 384u] = high.z;
    field[at + 448u] = high.w;
    let weights = vec4<u32>(1u, 2u, 4u, 8u);
    let iso = vec4<f32>(params.isovalue);
    let low_bits = select(vec4<u32>(0u), weights, low >= iso);
    let high_bits = select(vec4<u32>(0u), weights, high >= iso);
    let bits = low_bits.x + low_bits.y + low_bits.z + low_bits.w;
    columns[lane >> 2u][lane & 3u] = bits | (high_bits.x + high_bits.y + high_bits.z + high_bits.w) << 4u;
    workgroupBarrier();
    if (lane < 16u) {
        let z = lane >> 1u;
        let start = 8u * (lane & 1u);
        let word = four_bits(start, z) | four_bits(start + 1u, z) << 4u | four_bits(start + 2u, z) << 8u
            | four_bits(start + 3u, z) << 12u | four_bits(start + 4u, z) << 16u | four_bits(start + 5u, z) << 20u
            | four_bits(start + 6u, z) << 24u | four_bits(start + 7u, z) << 28u;
        inside[id * 16u + lane] = word;
    }
}
