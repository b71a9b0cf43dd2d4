//! Patch: the triangles of a cube, with the operations that improve their shapes.

use crate::lattice::to_u32;
use crate::triangle::{Corners, Vector, centroid, tan_smallest_angle};
use crate::vector::{area_vector, dot, length, sub};

/// Smallest angle, as a tangent, at which a triangle needs no improvement: 35°.
const GOOD: f32 = 0.7;
/// Smallest angle, as a tangent, that a collapse or a move may leave where it does not improve the smallest one: 30°.
const FAIR: f32 = 0.577;
/// Length below which an edge is a candidate for a collapse, spacings.
const SHORT: f32 = 0.5;
/// Maximum length of new edges, spacings. The edges of marching cubes are at most √3 spacings long.
const LONG: f32 = 1.5;
/// Cosine between a triangle and the normals of its vertices that needs no improvement.
const FLAT: f32 = 0.45;

/// Triangles of a cube. Vertices and triangles have numbers of their own.
pub(super) struct Patch {
    /// Positions, Å.
    pub(super) points: Vec<Vector>,
    /// Outward unit normals of the surface.
    pub(super) normals: Vec<Vector>,
    /// True for vertices that may be moved or removed.
    free: Vec<bool>,
    /// True for vertices that were moved.
    pub(super) is_moved: Vec<bool>,
    /// Triangles: those that may change, then their surroundings. Removed ones are `None`.
    pub(super) triangles: Vec<Option<[u32; 3]>>,
    /// Number of triangles that may change.
    n_own: usize,
    /// Triangles around each vertex.
    around: Vec<Vec<u32>>,
    /// Grid spacing, Å.
    spacing: f32,
}

impl Patch {
    pub(super) fn new(
        points: Vec<Vector>,
        normals: Vec<Vector>,
        free: Vec<bool>,
        triangles: Vec<[u32; 3]>,
        n_own: usize,
        spacing: f32,
    ) -> Self {
        let mut around = vec![Vec::new(); points.len()];
        for (t, row) in (0_u32..).zip(&triangles) {
            for v in row {
                around[*v as usize].push(t);
            }
        }
        let triangles = triangles.into_iter().map(Some).collect();
        let is_moved = vec![false; points.len()];
        Self { points, normals, free, is_moved, triangles, n_own, around, spacing }
    }

    fn corners(&self, row: [u32; 3]) -> Corners {
        row.map(|v| self.points[v as usize])
    }

    /// Returns the triangles around a vertex.
    fn fan(&self, v: u32) -> impl Iterator<Item = [u32; 3]> + '_ {
        self.around[v as usize].iter().filter_map(|t| self.triangles[*t as usize])
    }

    /// Returns the neighbours of a vertex.
    fn neighbours(&self, v: u32) -> impl Iterator<Item = u32> + '_ {
        self.fan(v).map(move |row| after(row, v))
    }

    /// Returns the smallest angle of triangles, as a tangent, and the smallest cosine between a triangle and the
    /// normals of its vertices.
    fn worst(&self, rows: impl Iterator<Item = [u32; 3]>) -> Worst {
        rows.fold(Worst { angle: f32::INFINITY, cosine: 1.0 }, |worst, row| {
            let corners = self.corners(row);
            let normal = area_vector(corners);
            let along = row.map(|v| dot(normal, self.normals[v as usize])).into_iter().fold(f32::INFINITY, f32::min);
            let cosine = along / length(normal).max(f32::MIN_POSITIVE);
            Worst { angle: worst.angle.min(tan_smallest_angle(corners)), cosine: worst.cosine.min(cosine) }
        })
    }

    fn distance(&self, a: u32, b: u32) -> f32 {
        length(sub(self.points[a as usize], self.points[b as usize]))
    }

    /// Collapses short edges, and edges of triangles with small angles. The smallest angle around the removed vertex
    /// must improve or remain fair.
    pub(super) fn collapse(&mut self) {
        let mut edges = Vec::new();
        for row in self.triangles[..self.n_own].iter().flatten() {
            let bad = tan_smallest_angle(self.corners(*row)) < FAIR;
            for k in 0..3 {
                let (a, b) = (row[k], row[(k + 1) % 3]);
                let length = self.distance(a, b);
                if length < SHORT * self.spacing || bad {
                    edges.push((length, a.min(b), a.max(b)));
                }
            }
        }
        edges.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        edges.dedup();
        for (_, a, b) in edges {
            let best =
                [(a, b), (b, a)].into_iter().filter_map(|(from, to)| Some((self.collapsed(from, to)?, from, to)));
            if let Some((_, from, to)) = best.reduce(|best, other| if other.0 > best.0 { other } else { best }) {
                self.apply_collapse(from, to);
            }
        }
    }

    /// Returns the smallest angle around `from` after it has been moved to `to` and removed, as a tangent; `None` if
    /// that is not permitted or no improvement.
    fn collapsed(&self, from: u32, to: u32) -> Option<f32> {
        if !self.free[from as usize] {
            return None;
        }
        let (mut common, mut adjacent) = (0, false);
        for v in self.neighbours(from) {
            adjacent |= v == to;
            if self.neighbours(to).any(|other| other == v) {
                common += 1;
                // The collapse takes a triangle from each of the two vertices opposite to the edge.
                if self.around[v as usize].len() <= 4 {
                    return None;
                }
            } else if v != to && self.distance(v, to) > LONG * self.spacing {
                return None;
            }
        }
        if !adjacent || common != 2 {
            return None;
        }
        let before = self.worst(self.fan(from));
        let moved = self.fan(from).filter(|row| !row.contains(&to)).map(|row| renamed(row, from, to));
        let after = self.worst(moved);
        (after.is_permitted_after(before) && (after.angle > before.angle || after.angle > FAIR)).then_some(after.angle)
    }

    fn apply_collapse(&mut self, from: u32, to: u32) {
        for t in std::mem::take(&mut self.around[from as usize]) {
            let Some(row) = self.triangles[t as usize] else { continue };
            if row.contains(&to) {
                self.triangles[t as usize] = None;
                for v in row {
                    self.around[v as usize].retain(|other| *other != t);
                }
            } else {
                self.triangles[t as usize] = Some(renamed(row, from, to));
                self.around[to as usize].push(t);
            }
        }
    }

    /// Flips edges where that improves the smaller angle of both triangles.
    pub(super) fn flip(&mut self) {
        for t in 0..self.n_own {
            for k in 0..3 {
                let Some(row) = self.triangles[t] else { break };
                if tan_smallest_angle(self.corners(row)) >= GOOD {
                    break;
                }
                let (a, b, c) = (row[k], row[(k + 1) % 3], row[(k + 2) % 3]);
                self.flip_edge(t, [a, b, c]);
            }
        }
    }

    /// Flips the edge between `a` and `b` of triangle `t` if that is an improvement.
    fn flip_edge(&mut self, t: usize, [a, b, c]: [u32; 3]) {
        let is_other = |row: &[u32; 3]| row.contains(&a) && row.contains(&b) && !row.contains(&c);
        let of_edge = |other: &&u32| self.triangles[**other as usize].is_some_and(|row| is_other(&row));
        let Some(&other) = self.around[a as usize].iter().find(of_edge) else { return };
        let Some(row) = self.triangles[other as usize] else { return };
        let d = after(row, a);
        let keeps_fans = [a, b].iter().all(|v| self.around[*v as usize].len() > 3);
        // A triangle with a free vertex may change.
        let is_free = |row: [u32; 3]| row.iter().any(|v| self.free[*v as usize]);
        if !is_free([a, b, c])
            || !is_free(row)
            || !keeps_fans
            || self.distance(c, d) > LONG * self.spacing
            || self.neighbours(c).any(|v| v == d)
        {
            return;
        }
        let (old, new) = ([[a, b, c], row], [[c, a, d], [d, b, c]]);
        let (before, after) = (self.worst(old.into_iter()), self.worst(new.into_iter()));
        if before.angle < GOOD && after.angle > before.angle && after.is_permitted_after(before) {
            self.triangles[t] = Some(new[0]);
            self.triangles[other as usize] = Some(new[1]);
            let t = to_u32(t);
            self.around[a as usize].retain(|around| *around != other);
            self.around[b as usize].retain(|around| *around != t);
            self.around[c as usize].push(other);
            self.around[d as usize].push(t);
        }
    }

    /// Returns the free vertices around which the smallest angle is not good, and a better position for each: the mean
    /// of the centroids of its triangles, weighted by area, in the tangent plane.
    pub(super) fn smoothed(&self) -> (Vec<u32>, Vec<Vector>) {
        let free = (0_u32..).zip(&self.free).filter(|(_, free)| **free).map(|(v, _)| v);
        let is_bad = |row: [u32; 3]| tan_smallest_angle(self.corners(row)) < GOOD;
        free.filter(|v| self.fan(*v).any(is_bad)).map(|v| (v, self.centred(v))).unzip()
    }

    fn centred(&self, v: u32) -> Vector {
        let (p, normal) = (self.points[v as usize], self.normals[v as usize]);
        let (mut sum, mut total) = ([0.0; 3], 0.0);
        for row in self.fan(v) {
            let corners = self.corners(row);
            let weight = length(area_vector(corners));
            let step = sub(centroid(corners), p);
            sum = std::array::from_fn(|k| sum[k] + weight * step[k]);
            total += weight;
        }
        let step = sum.map(|c| c / total.max(f32::MIN_POSITIVE));
        let along = dot(step, normal);
        std::array::from_fn(|k| p[k] + (step[k] - along * normal[k]))
    }

    /// Moves a vertex if the smallest angle around it improves or remains fair.
    pub(super) fn move_vertex(&mut self, v: u32, position: Vector, normal: Vector) {
        let before = self.worst(self.fan(v));
        let old = (self.points[v as usize], self.normals[v as usize]);
        (self.points[v as usize], self.normals[v as usize]) = (position, normal);
        let after = self.worst(self.fan(v));
        let too_long = self.neighbours(v).any(|other| self.distance(v, other) > LONG * self.spacing);
        let worse = after.angle < before.angle && after.angle < FAIR;
        if worse || too_long || !after.is_permitted_after(before) {
            (self.points[v as usize], self.normals[v as usize]) = old;
        } else {
            self.is_moved[v as usize] = true;
        }
    }
}

/// Worst shape of several triangles.
#[derive(Clone, Copy)]
struct Worst {
    /// Tangent of the smallest angle.
    angle: f32,
    /// Smallest cosine between a triangle and the normals of its vertices.
    cosine: f32,
}

impl Worst {
    /// Returns true if no triangle is turned away from the surface, or at most as far as `before`.
    fn is_permitted_after(self, before: Self) -> bool {
        self.cosine >= FLAT || (self.cosine >= before.cosine && self.cosine > 0.0)
    }
}

/// Returns the vertex that follows `v` in a triangle.
fn after(row: [u32; 3], v: u32) -> u32 {
    let k = row.iter().position(|other| *other == v).unwrap_or_default();
    row[(k + 1) % 3]
}

/// Returns a triangle with `to` in place of `from`.
fn renamed(row: [u32; 3], from: u32, to: u32) -> [u32; 3] {
    row.map(|v| if v == from { to } else { v })
}
