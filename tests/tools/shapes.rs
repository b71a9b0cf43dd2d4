//! Meshes of known area, volume and topology for tests of writers and checkers, and random spheres.

#![allow(clippy::cast_possible_truncation, reason = "meshes are single precision")]

use std::collections::HashMap;
use std::f64::consts::PI;

use molmesh::surface::Mesh;

/// Centre far from the origin that is not representable in single precision.
pub const FAR: [f64; 3] = [123.456_789, -78.9, 1000.25];

/// Returns a sphere of 20 · 4^`level` triangles around `at` with normals outwards or, for a void, inwards.
pub fn icosphere(level: u32, radius: f64, at: [f64; 3], inwards: bool) -> Mesh {
    let t = f64::midpoint(1.0, 5.0_f64.sqrt());
    let mut unit: Vec<[f64; 3]> = Vec::new();
    for (a, b) in [(1.0, t), (-1.0, t), (1.0, -t), (-1.0, -t)] {
        unit.extend([[a, b, 0.0], [0.0, a, b], [b, 0.0, a]]);
    }
    let unitise = |p: [f64; 3]| p.map(|v| v / (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt());
    for p in &mut unit {
        *p = unitise(*p);
    }
    // The faces of the icosahedron are the triples of vertices at edge distance from each other.
    let edge = 2.0 / (1.0 + t * t).sqrt();
    let near = |a: usize, b: usize| {
        let d2: f64 = (0..3).map(|k| (unit[a][k] - unit[b][k]).powi(2)).sum();
        (d2.sqrt() - edge).abs() < 1e-9
    };
    let mut faces: Vec<[u32; 3]> = Vec::new();
    for (a, b, c) in (0..12).flat_map(|a| (a + 1..12).flat_map(move |b| (b + 1..12).map(move |c| (a, b, c)))) {
        if near(a, b) && near(b, c) && near(a, c) {
            let outwards = triple(unit[a], unit[b], unit[c]) > 0.0;
            faces.push(
                [a, if outwards { b } else { c }, if outwards { c } else { b }].map(|v| u32::try_from(v).unwrap()),
            );
        }
    }
    for _ in 0..level {
        let mut halves: HashMap<(u32, u32), u32> = HashMap::new();
        let mut half = |a: u32, b: u32| {
            *halves.entry((a.min(b), a.max(b))).or_insert_with(|| {
                let (p, q) = (unit[a as usize], unit[b as usize]);
                unit.push(unitise(std::array::from_fn(|k| p[k] + q[k])));
                u32::try_from(unit.len() - 1).unwrap()
            })
        };
        let split = |[a, b, c]: [u32; 3]| {
            let (ab, bc, ca) = (half(a, b), half(b, c), half(c, a));
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        faces = faces.into_iter().flat_map(split).collect();
    }
    let sign = if inwards { -1.0 } else { 1.0 };
    Mesh {
        positions: unit.iter().map(|p| std::array::from_fn(|k| (at[k] + radius * p[k]) as f32)).collect(),
        normals: unit.iter().map(|p| p.map(|v| (sign * v) as f32)).collect(),
        triangles: faces.into_iter().map(|[a, b, c]| if inwards { [a, c, b] } else { [a, b, c] }).collect(),
        ..Mesh::default()
    }
}

/// Returns a torus of `around` · `across` vertices and twice as many triangles with radii of 5 and 2 Å.
pub fn torus(around: u32, across: u32) -> Mesh {
    let mut mesh = Mesh::default();
    for (i, j) in (0..around).flat_map(|i| (0..across).map(move |j| (i, j))) {
        let (u, v) = (2.0 * PI * f64::from(i) / f64::from(around), 2.0 * PI * f64::from(j) / f64::from(across));
        let normal = [v.cos() * u.cos(), v.cos() * u.sin(), v.sin()];
        let centre = [5.0 * u.cos(), 5.0 * u.sin(), 0.0];
        mesh.positions.edit().push(std::array::from_fn(|k| (centre[k] + 2.0 * normal[k]) as f32));
        mesh.normals.edit().push(normal.map(|v| v as f32));
        let at = |i: u32, j: u32| (i % around) * across + j % across;
        let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
        mesh.triangles.edit().extend([[a, b, c], [a, c, d]]);
    }
    mesh
}

/// Joins two meshes.
pub fn union(a: &Mesh, b: &Mesh) -> Mesh {
    let shift = u32::try_from(a.n_vertices()).unwrap();
    let mut mesh = a.clone();
    mesh.positions.edit().extend_from_slice(&b.positions);
    mesh.normals.edit().extend_from_slice(&b.normals);
    mesh.triangles.edit().extend(b.triangles.iter().map(|t| t.map(|v| v + shift)));
    mesh
}

/// Returns two separate spheres.
pub fn two_spheres() -> Mesh {
    union(&icosphere(3, 3.0, [-5.0, 0.0, 0.0], false), &icosphere(2, 2.0, [5.0, 0.0, 0.0], false))
}

/// Returns a ball of radius 4 Å with a void of radius 2 Å.
pub fn sphere_with_cavity() -> Mesh {
    union(&icosphere(4, 4.0, [0.0; 3], false), &icosphere(3, 2.0, [0.5, 0.0, 0.0], true))
}

/// Returns one triangle, which has a boundary.
pub fn triangle() -> Mesh {
    Mesh {
        positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]].into(),
        normals: vec![[0.0, 0.0, 1.0]; 3].into(),
        triangles: vec![[0, 1, 2]].into(),
        ..Mesh::default()
    }
}

/// Adds a colour per vertex and atom indices that increase from 0 to `max_atom`.
pub fn dressed(mut mesh: Mesh, max_atom: u32) -> Mesh {
    let n = u32::try_from(mesh.n_vertices()).unwrap();
    let last = u64::from(n.max(2) - 1);
    mesh.atom_ids = Some((0..n).map(|i| u32::try_from(u64::from(i) * u64::from(max_atom) / last).unwrap()).collect());
    mesh.colors = Some((0..n).map(|i| [i.to_le_bytes()[0], i.to_le_bytes()[1], 128, 255]).collect());
    mesh
}

/// Returns area and signed volume in double precision.
pub fn area_and_volume(mesh: &Mesh) -> (f64, f64) {
    let mut sums = (0.0, 0.0);
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|v| mesh.positions[v as usize].map(f64::from));
        let (u, v): ([f64; 3], [f64; 3]) = (std::array::from_fn(|k| b[k] - a[k]), std::array::from_fn(|k| c[k] - a[k]));
        let n = cross(u, v);
        sums.0 += 0.5 * (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
        sums.1 += triple(a, b, c) / 6.0;
    }
    sums
}

fn cross(u: [f64; 3], v: [f64; 3]) -> [f64; 3] {
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

fn triple(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> f64 {
    let n = cross(b, c);
    a[0] * n[0] + a[1] * n[1] + a[2] * n[2]
}

/// Deterministic random number generator with its state.
pub struct Random(pub u64);

impl Random {
    /// Returns a number from 0 to 1.
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Returns `n` spheres with radii from 1.2 to 1.9 Å in a cube, as centre and radius.
    pub fn cloud(&mut self, n: usize, side: f64) -> Vec<[f64; 4]> {
        (0..n).map(|_| [self.next() * side, self.next() * side, self.next() * side, 1.2 + 0.7 * self.next()]).collect()
    }
}
