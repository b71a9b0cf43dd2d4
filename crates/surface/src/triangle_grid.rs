//! Uniform grid of cells, which finds the triangle that is nearest to a point, and triangles that intersect.

use super::groups::{GroupCounts, Groups};
use super::triangle::{Corners, Vector, bounds, floor, segment_intersects};
use super::vector::{dot, map_components, sub};

/// Largest number of cells per axis.
const MAX_CELLS: f32 = 64.0;

/// Triangles by the cells that their bounding boxes overlap.
pub struct TriangleGrid {
    /// Lowest corner, Å.
    low: [f32; 3],
    /// Edge length of a cell, Å.
    cell: f32,
    /// Number of cells along each axis.
    size: [i32; 3],
    /// Numbers of the triangles of each cell.
    entries: Groups,
    triangles: Vec<Corners>,
    /// Bounding boxes of the triangles, Å.
    boxes: Vec<[Vector; 2]>,
}

impl TriangleGrid {
    /// Sorts triangles into cells with an edge length of about `cell`, Å.
    pub fn new(triangles: Vec<Corners>, cell: f32) -> Self {
        let boxes: Vec<[Vector; 2]> = triangles.iter().map(|corners| bounds(*corners)).collect();
        let low = boxes.iter().fold([f32::INFINITY; 3], |all, [low, _]| map_components(all, *low, f32::min));
        let high = boxes.iter().fold([f32::NEG_INFINITY; 3], |all, [_, high]| map_components(all, *high, f32::max));
        let extent = (0..3).map(|k| high[k] - low[k]).fold(0.0, f32::max);
        let cell = cell.max(extent / MAX_CELLS);
        let size = std::array::from_fn(|k| floor((high[k] - low[k]) / cell) + 1);
        let n_cells = size.iter().map(|n| usize::try_from(*n).unwrap_or(0)).product::<usize>();
        let grid = Self { low, cell, size, entries: Groups::default(), triangles, boxes };
        let cells: Vec<[[i32; 3]; 2]> = grid.boxes.iter().map(|ends| ends.map(|end| grid.cell_of(end))).collect();
        let mut counts = GroupCounts::new(n_cells);
        for [low, high] in &cells {
            grid.for_each_cell(*low, *high, |cell| counts.add(cell));
        }
        let mut entries = counts.groups();
        for (number, [low, high]) in (0..).zip(&cells) {
            grid.for_each_cell(*low, *high, |cell| entries.push(cell, number));
        }
        Self { entries, ..grid }
    }

    /// Calls `each` for the indices of the cells from `low` to `high` within the grid.
    fn for_each_cell(&self, low: [i32; 3], high: [i32; 3], mut each: impl FnMut(usize)) {
        let within = |k: usize| low[k].max(0)..=high[k].min(self.size[k] - 1);
        for z in within(2) {
            for y in within(1) {
                within(0).filter_map(|x| self.index([x, y, z])).for_each(&mut each);
            }
        }
    }

    fn cell_of(&self, point: Vector) -> [i32; 3] {
        std::array::from_fn(|k| floor((point[k] - self.low[k]) / self.cell))
    }

    /// Returns the index of a cell within the grid.
    fn index(&self, [x, y, z]: [i32; 3]) -> Option<usize> {
        usize::try_from((z * self.size[1] + y) * self.size[0] + x).ok()
    }

    /// Returns the pairs of triangles that intersect, of which at least one is `changed`. `rows` are the triangles as
    /// vertex numbers. Triangles with a common edge never count: their fold is checked otherwise.
    #[must_use]
    pub fn intersections(&self, rows: &[[u32; 3]], changed: &[bool]) -> Vec<[usize; 2]> {
        let mut found = Vec::new();
        for i in (0..rows.len()).filter(|i| changed[*i]) {
            let [low, high] = self.boxes[i];
            let [first, last] = [low, high].map(|end| self.cell_of(end));
            self.for_each_cell(first, last, |cell| {
                for j in self.entries.get(cell).iter().map(|j| *j as usize) {
                    // A pair of changed triangles counts once.
                    if j == i || changed[j] && j < i {
                        continue;
                    }
                    let [other_low, other_high] = self.boxes[j];
                    let overlap = (0..3).all(|k| low[k] <= other_high[k] && other_low[k] <= high[k]);
                    // A pair has several common cells; the first of them counts.
                    let is_first = || self.index(self.cell_of(map_components(low, other_low, f32::max))) == Some(cell);
                    if overlap && is_first() && self.intersect(rows, i, j) {
                        found.push([i.min(j), i.max(j)]);
                    }
                }
            });
        }
        found
    }

    /// Returns true if two triangles without a common edge intersect.
    fn intersect(&self, rows: &[[u32; 3]], i: usize, j: usize) -> bool {
        let one_way = |i: usize, j: usize| {
            let (own, corners, other) = (rows[i], &self.triangles[i], &self.triangles[j]);
            [(0, 1), (1, 2), (2, 0)].into_iter().any(|(p, q)| {
                let has_common = rows[j].contains(&own[p]) || rows[j].contains(&own[q]);
                !has_common && segment_intersects(corners[p], corners[q], other)
            })
        };
        let n_common = rows[i].iter().filter(|v| rows[j].contains(v)).count();
        n_common < 2 && (one_way(i, j) || one_way(j, i))
    }

    /// Returns true if a point is at most `limit`, Å, from a triangle. `near` is the number of a triangle that may be
    /// near, and becomes that of one that is.
    pub fn is_within(&self, point: Vector, limit: f32, near: &mut u32) -> bool {
        let limit2 = limit * limit;
        let is_near = |number: u32| {
            let corners = self.triangles.get(number as usize);
            corners.is_some_and(|corners| distance2(point, *corners) <= limit2)
        };
        if is_near(*near) {
            return true;
        }
        let [low, high] = [-limit, limit].map(|by| self.cell_of(point.map(|c| c + by)));
        let mut found = None;
        self.for_each_cell(low, high, |cell| {
            let mut entries = self.entries.get(cell).iter().copied();
            found = found.or_else(|| {
                entries.find(|number| gap2(point, &self.boxes[*number as usize]) <= limit2 && is_near(*number))
            });
        });
        *near = found.unwrap_or(*near);
        found.is_some()
    }

    /// Returns the distance of a point from the nearest triangle, Å; infinity if there is no triangle. `nearest` is the
    /// number of a triangle that may be near, and becomes that of the nearest one.
    pub fn distance(&self, point: Vector, nearest: &mut u32) -> f32 {
        let known = self.triangles.get(*nearest as usize);
        let mut nearest2 = known.map_or(f32::INFINITY, |corners| distance2(point, *corners));
        // Most points are near a triangle. A triangle that is nearer than the nearest one so far has a part within its
        // distance. The margin is for rounding.
        let mut radius = (1.01 * nearest2.sqrt()).min(self.cell / 8.0);
        loop {
            let [low, high] = [-radius, radius].map(|by| self.cell_of(point.map(|c| c + by)));
            self.for_each_cell(low, high, |at| {
                for number in self.entries.get(at) {
                    if gap2(point, &self.boxes[*number as usize]) < nearest2 {
                        let found2 = distance2(point, self.triangles[*number as usize]);
                        if found2 < nearest2 {
                            (nearest2, *nearest) = (found2, *number);
                        }
                    }
                }
            });
            let is_all = (0..3).all(|k| low[k] <= 0 && high[k] >= self.size[k] - 1);
            if nearest2 <= radius * radius || is_all {
                return nearest2.sqrt();
            }
            radius = if nearest2.is_finite() { 1.01 * nearest2.sqrt() } else { 4.0 * radius };
        }
    }
}

/// Returns the squared distance of a point from a box.
fn gap2(p: Vector, [low, high]: &[Vector; 2]) -> f32 {
    let gaps = std::array::from_fn(|k| (low[k] - p[k]).max(p[k] - high[k]).max(0.0));
    dot(gaps, gaps)
}

/// Returns the squared distance of a point from a triangle.
fn distance2(p: [f32; 3], [a, b, c]: Corners) -> f32 {
    let (u, v, w) = (sub(b, a), sub(c, a), sub(p, a));
    let [uu, uv, vv] = [dot(u, u), dot(u, v), dot(v, v)];
    let (wu, wv) = (dot(w, u), dot(w, v));
    let area = uu * vv - uv * uv;
    if area > 0.0 {
        let (s, t) = ((vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area);
        if s >= 0.0 && t >= 0.0 && s + t <= 1.0 {
            let off: [f32; 3] = std::array::from_fn(|k| w[k] - s * u[k] - t * v[k]);
            return dot(off, off);
        }
    }
    [(a, b), (b, c), (c, a)].map(|(from, to)| to_segment2(p, from, to)).into_iter().fold(f32::INFINITY, f32::min)
}

/// Returns the squared distance of a point from a line segment.
fn to_segment2(p: [f32; 3], from: [f32; 3], to: [f32; 3]) -> f32 {
    let (along, w) = (sub(to, from), sub(p, from));
    let length2 = dot(along, along);
    let t = if length2 > 0.0 { (dot(w, along) / length2).clamp(0.0, 1.0) } else { 0.0 };
    let off: [f32; 3] = std::array::from_fn(|k| w[k] - t * along[k]);
    dot(off, off)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(points: &[Vector], rows: &[[u32; 3]]) -> TriangleGrid {
        TriangleGrid::new(rows.iter().map(|row| row.map(|v| points[v as usize])).collect(), 1.0)
    }

    #[test]
    fn intersections_of_two_triangles() {
        // A triangle in z = 0, and one that stands on it.
        let below = |z: f32| {
            [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [1.0, 1.0, z], [1.5, 1.0, 2.0], [1.0, 1.5, 2.0]]
        };
        let rows = [[0, 1, 2], [3, 4, 5]];
        for (z, changed, found) in [
            (-1.0, [true, false], vec![[0, 1]]),
            (-1.0, [false, true], vec![[0, 1]]),
            (-1.0, [true; 2], vec![[0, 1]]),
            (-1.0, [false; 2], vec![]),
            (1.0, [true; 2], vec![]),
        ] {
            assert_eq!(grid(&below(z), &rows).intersections(&rows, &changed), found, "{z} {changed:?}");
        }
        // With a common vertex, the edge opposite to it decides.
        for (z, found) in [(-1.0, vec![[0, 1]]), (1.0, vec![])] {
            let points = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [1.0, 1.0, z], [1.0, 1.0, 2.0]];
            let rows = [[0, 1, 2], [0, 3, 4]];
            assert_eq!(grid(&points, &rows).intersections(&rows, &[true; 2]), found, "{z}");
        }
    }
}
