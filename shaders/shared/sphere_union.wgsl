// Signed distance to the boundary of a union of spheres, in spacings and positive inside, as in
// `surface/sphere_union/distance.rs`. Requires `params`, `atoms`, `lists`, `heads` and `boundary`.
//
// The rows of `boundary` begin with one per sphere and arc: the first of its own rows, and for a sphere the one after
// the last. An arc has four rows: centre and radius, axis and cosine of the half-angle, middle and sine of the
// half-angle, side. A sphere has eight rows for each group of eight caps: two each of axis x, y, z and height.

// Range of rows of a sphere without a face.
const COVERED: u32 = 0xffffffffu;
// Distance beyond the surface up to which distances are exact.
const MARGIN: f32 = 0.05;

// Candidates of a brick and its first grid point.
struct Around {
    spheres: vec4<u32>,
    arcs: vec4<u32>,
    origin: vec3<i32>,
}

// Boundary point that is nearest to a point.
struct Nearest {
    distance: f32,
    // Sphere in which the point lies deepest.
    sphere: u32,
    // Nearest arc, or NONE for a point of the sphere.
    arc: u32,
}

// Centre and radius of an entry of the lists, relative to `origin`.
fn sphere_at(index: u32, origin: vec3<i32>) -> vec4<f32> {
    let atom = atoms[index];
    return vec4<f32>(vec3<f32>(atom.cell - origin) + atom.frac, inverseSqrt(atom.inv_length2));
}

// Candidates of the brick in a slot.
fn around_slot(slot: u32, origin: vec3<i32>) -> Around {
    var arcs = vec4<u32>(0u);
    if (params.n_kinds == 2u) {
        arcs = heads[params.n_own + params.n_halo + slot];
    }
    return Around(heads[slot], arcs, origin);
}

// Returns true if the point of a sphere in the direction `n`, a unit vector, lies in no other sphere.
fn is_exposed(sphere: u32, n: vec3<f32>) -> bool {
    let rows = boundary[sphere];
    if (rows.x == COVERED) {
        return false;
    }
    for (var i = rows.x; i < rows.y; i += 8u) {
        if (is_covered(n, i) || is_covered(n, i + 1u)) {
            return false;
        }
    }
    return true;
}

// Returns true if one of four caps of a group, whose columns begin at row `first`, covers a direction.
fn is_covered(n: vec3<f32>, first: u32) -> bool {
    let x = bitcast<vec4<f32>>(boundary[first]);
    let y = bitcast<vec4<f32>>(boundary[first + 2u]);
    let z = bitcast<vec4<f32>>(boundary[first + 4u]);
    let height = bitcast<vec4<f32>>(boundary[first + 6u]);
    return any(n.x * x + n.y * y + n.z * z > height);
}

// Arc relative to the first grid point of a brick.
struct Arc {
    centre: vec3<f32>,
    axis: vec3<f32>,
    middle: vec3<f32>,
    side: vec3<f32>,
    radius: f32,
    // Cosine and sine of the half-angle.
    half: vec2<f32>,
}

fn arc_at(index: u32, origin: vec3<i32>) -> Arc {
    let row = boundary[index].x;
    let centre = bitcast<vec4<f32>>(boundary[row]);
    let axis = bitcast<vec4<f32>>(boundary[row + 1u]);
    let middle = bitcast<vec4<f32>>(boundary[row + 2u]);
    let side = bitcast<vec4<f32>>(boundary[row + 3u]);
    let place = vec3<f32>(atoms[index].cell - origin) + centre.xyz;
    return Arc(place, axis.xyz, middle.xyz, side.xyz, centre.w, vec2<f32>(axis.w, middle.w));
}

// Squared distance of a point from an arc.
fn distance2_to(arc: Arc, x: vec3<f32>) -> f32 {
    let w = x - arc.centre;
    let p = dot(w, arc.middle);
    let q = dot(w, arc.side);
    let z = dot(w, arc.axis);
    let s = sqrt(p * p + q * q);
    let to_end = vec2<f32>(p, abs(q)) - arc.radius * arc.half;
    let circle = (s - arc.radius) * (s - arc.radius);
    return z * z + select(dot(to_end, to_end), circle, p >= s * arc.half.x);
}

// Vector from a point to the nearest point of an arc.
fn toward(arc: Arc, x: vec3<f32>) -> vec3<f32> {
    let w = x - arc.centre;
    let p = dot(w, arc.middle);
    let q = dot(w, arc.side);
    let s = sqrt(p * p + q * q);
    var direction = vec2<f32>(arc.half.x, select(arc.half.y, -arc.half.y, q < 0.0));
    if (p >= s * arc.half.x && s > 0.0) {
        direction = vec2<f32>(p, q) / s;
    }
    return (arc.centre - x) + arc.radius * (direction.x * arc.middle + direction.y * arc.side);
}

// Depth of a point in the sphere in which it lies deepest.
fn deepest_at(around: Around, x: vec3<f32>) -> Nearest {
    var found = Nearest(-3.0e38, 0u, NONE);
    for (var i = 0u; i < around.spheres.z; i++) {
        let index = lists[around.spheres.x + i];
        let sphere = sphere_at(index, around.origin);
        let depth = sphere.w - length(x - sphere.xyz);
        if (depth > found.distance) {
            found.distance = depth;
            found.sphere = index;
        }
    }
    return found;
}

// Returns true if the boundary point nearest to `x` may lie on an arc: the nearest point of the sphere in which `x`
// lies deepest is covered. Deep points need no exact distance.
fn needs_arcs(around: Around, x: vec3<f32>, found: Nearest) -> bool {
    if (params.n_kinds < 2u || found.distance <= 0.0 || found.distance >= params.level + MARGIN) {
        return false;
    }
    let sphere = sphere_at(found.sphere, around.origin);
    return !is_exposed(found.sphere, normalize(x - sphere.xyz));
}

// Nearest boundary point of a point. The distance is exact between 0 and the level; elsewhere only its comparisons with
// both are.
fn nearest_at(around: Around, x: vec3<f32>) -> Nearest {
    var found = deepest_at(around, x);
    if (needs_arcs(around, x, found)) {
        let most = params.level + 1.0;
        var least = most * most;
        for (var i = 0u; i < around.arcs.z; i++) {
            let index = lists[around.arcs.x + i];
            let distance2 = distance2_to(arc_at(index, around.origin), x);
            if (distance2 < least) {
                least = distance2;
                found.arc = index;
            }
        }
        found.distance = sqrt(least);
    }
    return found;
}

// Outward vector at a point of the surface.
fn outward_at(around: Around, x: vec3<f32>, found: Nearest) -> vec3<f32> {
    if (found.arc == NONE) {
        return x - sphere_at(found.sphere, around.origin).xyz;
    }
    return toward(arc_at(found.arc, around.origin), x);
}
