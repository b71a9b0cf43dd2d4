//! Distances of points from the nearest of many triangles, which a uniform grid of cells finds.

use crate::surface::triangle::{Corners, dot, floor, sub};

/// Largest number of cells per axis.
const MAX_CELLS: f32 = 64.0;

/// Triangles by the cells that their bounding boxes overlap.
pub(super) struct TriangleGrid {
    /// Lowest corner, Å.
    low: [f32; 3],
    /// Edge length of a cell, Å.
    cell: f32,
    /// Number of cells along each axis.
    size: [i32; 3],
    /// First entry of each cell; the last element is the number of entries.
    starts: Vec<u32>,
    /// Numbers of the triangles of each cell.
    entries: Vec<u32>,
    triangles: Vec<Corners>,
}

impl TriangleGrid {
    /// Sorts triangles into cells with an edge length of about `cell`, Å.
    pub(super) fn new(triangles: Vec<Corners>, cell: f32) -> Self {
        let corners = || triangles.iter().flatten();
        let bound = |k: usize, sign: f32| corners().map(|p| sign * p[k]).fold(f32::NEG_INFINITY, f32::max);
        let low: [f32; 3] = std::array::from_fn(|k| -bound(k, -1.0));
        let extent = (0..3).map(|k| bound(k, 1.0) - low[k]).fold(0.0, f32::max);
        let cell = cell.max(extent / MAX_CELLS);
        let size = std::array::from_fn(|k| floor((bound(k, 1.0) - low[k]) / cell) + 1);
        let n_cells = size.iter().map(|n| usize::try_from(*n).unwrap_or(0)).product::<usize>();
        let mut grid =
            Self { low, cell, size, starts: vec![0; n_cells + 1], entries: Vec::new(), triangles: Vec::new() };
        let mut starts = std::mem::take(&mut grid.starts);
        for triangle in &triangles {
            let [low, high] = grid.cells_of(triangle);
            grid.for_each_cell(low, high, |at| starts[at + 1] += 1);
        }
        for at in 0..n_cells {
            starts[at + 1] += starts[at];
        }
        let mut next = starts.clone();
        let mut entries = vec![0; starts[n_cells] as usize];
        for (number, triangle) in (0..).zip(&triangles) {
            let [low, high] = grid.cells_of(triangle);
            grid.for_each_cell(low, high, |at| {
                entries[next[at] as usize] = number;
                next[at] += 1;
            });
        }
        Self { starts, entries, triangles, ..grid }
    }

    /// Returns the first and the last cell that the bounding box of a triangle overlaps, per axis.
    fn cells_of(&self, [a, b, c]: &Corners) -> [[i32; 3]; 2] {
        [
            self.cell_of(std::array::from_fn(|k| a[k].min(b[k]).min(c[k]))),
            self.cell_of(std::array::from_fn(|k| a[k].max(b[k]).max(c[k]))),
        ]
    }

    /// Calls `each` for the indices of the cells from `low` to `high` within the grid.
    fn for_each_cell(&self, low: [i32; 3], high: [i32; 3], mut each: impl FnMut(usize)) {
        let within = |k: usize| low[k].max(0)..=high[k].min(self.size[k] - 1);
        for z in within(2) {
            for y in within(1) {
                let row = (z * self.size[1] + y) * self.size[0];
                within(0).filter_map(|x| usize::try_from(row + x).ok()).for_each(&mut each);
            }
        }
    }

    fn cell_of(&self, point: [f32; 3]) -> [i32; 3] {
        std::array::from_fn(|k| floor((point[k] - self.low[k]) / self.cell))
    }

    /// Returns the distance of a point from the nearest triangle, Å; infinity if there is no triangle.
    pub(super) fn distance(&self, point: [f32; 3]) -> f32 {
        let mut nearest2 = f32::INFINITY;
        // Most points are near a triangle.
        let mut radius = self.cell / 8.0;
        loop {
            let [low, high] = [-radius, radius].map(|by| self.cell_of(point.map(|c| c + by)));
            self.for_each_cell(low, high, |at| {
                for number in &self.entries[self.starts[at] as usize..self.starts[at + 1] as usize] {
                    let corners = self.triangles[*number as usize];
                    if box_distance2(point, corners) < nearest2 {
                        nearest2 = nearest2.min(distance2(point, corners));
                    }
                }
            });
            let is_all = (0..3).all(|k| low[k] <= 0 && high[k] >= self.size[k] - 1);
            if nearest2 <= radius * radius || is_all {
                return nearest2.sqrt();
            }
            // A triangle that is nearer than the nearest one so far has a part within its distance. The margin is for
            // rounding.
            radius = if nearest2.is_finite() { 1.01 * nearest2.sqrt() } else { 4.0 * radius };
        }
    }
}

/// Returns the squared distance of a point from the bounding box of a triangle.
fn box_distance2(p: [f32; 3], [a, b, c]: Corners) -> f32 {
    let gap = |k: usize| {
        let (low, high) = (a[k].min(b[k]).min(c[k]), a[k].max(b[k]).max(c[k]));
        (low - p[k]).max(p[k] - high).max(0.0)
    };
    let gaps = std::array::from_fn(gap);
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
