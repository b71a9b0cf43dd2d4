// Stage `bin`: candidate atoms of every brick, in canonical order, and for a boundary of spheres its candidate arcs.
// One workgroup per brick and kind of candidate: atoms, then arcs. All tables have the arcs after the atoms.
//
// Atoms are sorted by tile and brick, so the atoms of a run of bricks along x within a tile are one range. Each lane
// looks up one range. Then the lanes divide the atoms of 64 ranges evenly and keep those in reach, in order.
#include shared/params.wgsl
#include shared/atom.wgsl
#include shared/bits.wgsl
#include shared/tiles.wgsl
#include shared/chunk.wgsl
#include shared/counters.wgsl

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> atoms: array<Atom>;
@group(0) @binding(2) var<storage, read> reaches: array<f32>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> bricks: array<u32>;
@group(0) @binding(5) var<storage, read> first_atoms: array<u32>;
@group(0) @binding(6) var<storage, read> halo: array<u32>;
@group(0) @binding(7) var<storage, read_write> lists: array<u32>;
@group(0) @binding(8) var<storage, read_write> heads: array<vec4<u32>>;
@group(0) @binding(9) var<storage, read_write> counters: Counters;

const LANES: u32 = 64u;
// Maximum length of a list in workgroup memory. Longer lists, of fine grids, take a second pass.
const STAGED: u32 = 256u;

// First atom of each range, and inclusive sums of their lengths. The scan alternates between two arrays of sums.
var<workgroup> range_start: array<u32, 64>;
var<workgroup> range_end: array<u32, 64>;
var<workgroup> range_sum: array<u32, 64>;
// For each of three steps, the bits of the 64 lanes whose atom reaches a grid point (words 0 and 1), or only the gap
// behind the grid points (words 2 and 3).
var<workgroup> hits: array<atomic<u32>, 12>;
var<workgroup> staged: array<u32, 256>;
var<workgroup> list_start: u32;

// Returns `v`. The compiler does not know that `zero` is 0, so it cannot fuse the product `v` into a sum. The
// comparison below must have the same result as on the host.
fn rounded(v: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(v) | params.zero);
}

fn square(v: vec3<f32>) -> vec3<f32> {
    let s = v * v;
    return vec3<f32>(rounded(s.x), rounded(s.y), rounded(s.z));
}

// Index of the tile at `coord`: by table if it is adjacent to tile `tile_from`, else by binary search.
fn tile_at(tile_from: u32, coord: vec3<i32>) -> u32 {
    let step = coord - tiles[tile_from].coord;
    if (all(abs(step) <= vec3<i32>(1))) {
        return tiles[tile_from].around[u32(13 + 9 * step.z + 3 * step.y + step.x)];
    }
    var lo = 0u;
    var hi = params.n_tiles;
    while (lo < hi) {
        let mid = (lo + hi) / 2u;
        let c = tiles[mid].coord;
        let less = c.z < coord.z || (c.z == coord.z && (c.y < coord.y || (c.y == coord.y && c.x < coord.x)));
        if (less) { lo = mid + 1u; } else { hi = mid; }
    }
    if (lo < params.n_tiles && all(tiles[lo].coord == coord)) {
        return lo;
    }
    return NONE;
}

// Intersection of [lo, hi] with tile coordinate t, as first and count.
fn part(lo: i32, hi: i32, t: i32) -> vec2<i32> {
    let first = max(lo, 8 * t);
    return vec2<i32>(first, min(hi, 8 * t + 7) - first + 1);
}

// Atoms or arcs.
struct Candidates {
    // Maximum reach.
    reach: f32,
    // Number of bricks before and behind a brick, per axis, whose atoms may reach it.
    back: i32,
    ahead: i32,
    // First entry in `first_atoms`.
    first: u32,
}

// Minimum gap along one axis, in spacings, between a brick and the atoms of a brick `step` bricks away. Atoms lie up to
// half a spacing before the grid points of their brick, arcs up to a spacing behind them.
fn brick_gap(step: i32) -> f32 {
    return max(max(f32(8 * step) - 8.5, f32(-8 * step) - 8.0), 0.0);
}

// First atom and number of atoms of range `index` of those that may hold candidates of `brick`. Ranges are in the order
// of the atoms: by tile, and by row within a tile.
fn range_at(kind: Candidates, tile: u32, brick: vec3<i32>, index: u32) -> vec2<u32> {
    let lo = brick - vec3<i32>(kind.back);
    let hi = brick + vec3<i32>(kind.ahead);
    let first = lo >> vec3<u32>(3u);
    let n_x = (hi.x >> 3u) - first.x + 1;
    let n_y = hi.y - lo.y + 1;
    var left = i32(index);
    var t = first;
    var z = part(lo.z, hi.z, t.z);
    while (left >= z.y * n_y * n_x) {
        left -= z.y * n_y * n_x;
        t.z += 1;
        z = part(lo.z, hi.z, t.z);
    }
    var y = part(lo.y, hi.y, t.y);
    while (left >= z.y * y.y * n_x) {
        left -= z.y * y.y * n_x;
        t.y += 1;
        y = part(lo.y, hi.y, t.y);
    }
    t.x += left / (z.y * y.y);
    left = left % (z.y * y.y);
    let row = vec2<i32>(y.x + left % y.y, z.x + left / y.y);
    // Maximum extent of the reach along x in this row.
    let gap = vec2<f32>(brick_gap(row.x - brick.y), brick_gap(row.y - brick.z));
    let rest = kind.reach * kind.reach - dot(gap, gap);
    if (rest < 0.0) {
        return vec2<u32>(0u);
    }
    let far = sqrt(rest) + 0.01;
    let x_lo = max(max(lo.x, 8 * t.x), brick.x - i32(floor((far + 8.0) / 8.0)));
    let x_hi = min(min(hi.x, 8 * t.x + 7), brick.x + i32(floor((far + 8.5) / 8.0)));
    if (x_lo > x_hi) {
        return vec2<u32>(0u);
    }
    let at = tile_at(tile, t);
    if (at == NONE) {
        return vec2<u32>(0u);
    }
    let base = u32(row.y & 7) << 6u | u32(row.x & 7) << 3u;
    let start = first_atoms[kind.first + bricks_before(at, base | u32(x_lo & 7))];
    let last = base | u32(x_hi & 7);
    let end = first_atoms[kind.first + bricks_before(at, last) + select(0u, 1u, brick_exists(at, last))];
    return vec2<u32>(start, end - start);
}

// Returns 1 if the atom reaches a grid point of the brick, 2 if it reaches only the gap up to the first grid points of
// the neighbours, else 0.
fn reach_of(atom: u32, tile_origin: vec3<i32>, lo: vec3<f32>) -> u32 {
    let local = vec3<f32>(atoms[atom].cell - tile_origin) + atoms[atom].frac;
    let reach = reaches[atom];
    let gap = max(max(lo - local, local - (lo + vec3<f32>(7.0))), vec3<f32>(0.0));
    let closed_gap = max(max(lo - local, local - (lo + vec3<f32>(8.0))), vec3<f32>(0.0));
    let reach2 = rounded(reach * reach);
    let closed = square(closed_gap);
    if (any(closed_gap > vec3<f32>(reach)) || (closed.y + closed.z) + closed.x > reach2) {
        return 0u;
    }
    let points = square(gap);
    return select(2u, 1u, (points.y + points.z) + points.x <= reach2);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    let n_slots = params.n_own + params.n_halo;
    if (number >= params.n_kinds * n_slots) {
        return;
    }
    var kind = Candidates(params.reach, i32(params.back), i32(params.ahead), 0u);
    var slot = number;
    if (number >= n_slots) {
        kind = Candidates(params.arc_reach, i32(params.arc_back), i32(params.arc_ahead), params.n_bricks + 1u);
        slot = number - n_slots;
    }
    let id = brick_in(slot);
    let tile = bricks[id] >> 9u;
    let within = local_brick(bricks[id] & 511u);
    let brick = tiles[tile].coord * 8 + within;
    let tile_origin = tiles[tile].coord * 64;
    let lo = vec3<f32>(within * 8);
    let span = kind.back + kind.ahead + 1;
    let n_x = ((brick.x + kind.ahead) >> 3u) - ((brick.x - kind.back) >> 3u) + 1;
    let n_ranges = u32(span * span * n_x);
    if (lane < 12u) {
        atomicStore(&hits[lane], 0u);
    }
    // Number of atoms that reach a grid point, and number of those that reach the gap only.
    var n = vec2<u32>(0u);
    var start = 0u;
    // Index of the current hits; the second pass continues with the index at which the first ended.
    var phase = 0u;
    for (var pass_number = 0u; pass_number < 2u; pass_number++) {
        var kept = vec2<u32>(0u);
        for (var first = 0u; first < n_ranges; first += LANES) {
            var range = vec2<u32>(0u);
            if (first + lane < n_ranges) {
                range = range_at(kind, tile, brick, first + lane);
            }
            workgroupBarrier();
            range_start[lane] = range.x;
            range_end[lane] = range.y;
            // Inclusive scan between two arrays. After six steps the result is in the first.
            var end = range.y;
            workgroupBarrier();
            end += select(0u, range_end[(lane - 1u) & 63u], lane >= 1u);
            range_sum[lane] = end;
            workgroupBarrier();
            end += select(0u, range_sum[(lane - 2u) & 63u], lane >= 2u);
            range_end[lane] = end;
            workgroupBarrier();
            end += select(0u, range_end[(lane - 4u) & 63u], lane >= 4u);
            range_sum[lane] = end;
            workgroupBarrier();
            end += select(0u, range_sum[(lane - 8u) & 63u], lane >= 8u);
            range_end[lane] = end;
            workgroupBarrier();
            end += select(0u, range_end[(lane - 16u) & 63u], lane >= 16u);
            range_sum[lane] = end;
            workgroupBarrier();
            end += select(0u, range_sum[(lane - 32u) & 63u], lane >= 32u);
            range_end[lane] = end;
            let total = workgroupUniformLoad(&range_end[63]);
            for (var at = 0u; at < total; at += LANES) {
                let index = at + lane;
                var reaches_it = 0u;
                var atom = 0u;
                if (index < total) {
                    // First range that ends behind the index.
                    var r = select(0u, 32u, range_end[31] <= index);
                    r += select(0u, 16u, range_end[r + 15u] <= index);
                    r += select(0u, 8u, range_end[r + 7u] <= index);
                    r += select(0u, 4u, range_end[r + 3u] <= index);
                    r += select(0u, 2u, range_end[r + 1u] <= index);
                    r += select(0u, 1u, range_end[r] <= index);
                    let before = select(0u, range_end[(r - 1u) & 63u], r > 0u);
                    atom = range_start[r] + (index - before);
                    reaches_it = reach_of(atom, tile_origin, lo);
                }
                let hit = 4u * phase;
                phase = select(phase + 1u, 0u, phase == 2u);
                if (lane < 4u) {
                    // Cleared for the next step; last read two steps ago.
                    atomicStore(&hits[4u * phase + lane], 0u);
                }
                let half = lane >> 5u;
                if (reaches_it != 0u) {
                    atomicOr(&hits[hit + 2u * (reaches_it - 1u) + half], 1u << (lane & 31u));
                }
                workgroupBarrier();
                let near = vec2<u32>(atomicLoad(&hits[hit]), atomicLoad(&hits[hit + 1u]));
                let gap = vec2<u32>(atomicLoad(&hits[hit + 2u]), atomicLoad(&hits[hit + 3u]));
                let mine = select(gap, near, reaches_it == 1u);
                let earlier = below(lane & 31u);
                let low = countOneBits(select(mine.x & earlier, mine.x, half == 1u));
                let ahead = low + countOneBits(select(0u, mine.y & earlier, half == 1u));
                if (reaches_it != 0u) {
                    let rank = ahead + select(kept.y, kept.x, reaches_it == 1u);
                    if (pass_number == 1u) {
                        lists[start + rank + select(n.x, 0u, reaches_it == 1u)] = atom;
                    } else if (rank < STAGED) {
                        staged[select(STAGED - 1u - rank, rank, reaches_it == 1u)] = atom;
                    }
                }
                kept += vec2<u32>(
                    countOneBits(near.x) + countOneBits(near.y),
                    countOneBits(gap.x) + countOneBits(gap.y),
                );
            }
        }
        if (pass_number == 1u) {
            break;
        }
        n = kept;
        let entries = n.x + n.y;
        if (lane == 0u) {
            list_start = atomicAdd(&counters.list_end, entries);
        }
        start = workgroupUniformLoad(&list_start);
        // A list that does not fit is not written. The host detects it by the counter.
        if (start + entries > params.list_capacity) {
            n = vec2<u32>(0u);
        }
        if (lane == 0u) {
            heads[number] = vec4<u32>(start, n.x, n.x + n.y, id);
        }
        if (n.x + n.y <= STAGED) {
            for (var i = lane; i < n.x + n.y; i += LANES) {
                lists[start + i] = staged[select(STAGED - 1u - (i - n.x), i, i < n.x)];
            }
            break;
        }
    }
}
