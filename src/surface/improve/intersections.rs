//! Search for triangles that intersect each other.

use rustc_hash::FxHashMap;

use crate::surface::triangle::{Corners, Vector, floor, segment_intersects};

/// Returns the pairs of triangles that intersect, of which at least one is `changed`, as indices of `rows`. Triangles
/// with a common edge never count: their fold is checked otherwise. `cell` is about the length of an edge, Å.
pub(super) fn intersections(points: &[Vector], rows: &[[u32; 3]], changed: &[bool], cell: f32) -> Vec<[usize; 2]> {
    let boxes: Vec<[Vector; 2]> = rows.iter().map(|row| bounds(row.map(|v| points[v as usize]))).collect();
    let cell_of = |p: Vector| p.map(|c| floor(c / cell));
    let mut cells: FxHashMap<[i32; 3], Vec<usize>> = FxHashMap::default();
    let mut found = Vec::new();
    for (i, [low, high]) in boxes.iter().enumerate() {
        let [first, last] = [cell_of(*low), cell_of(*high)];
        let range = |k: usize| first[k]..=last[k];
        for at in range(2).flat_map(|z| range(1).flat_map(move |y| range(0).map(move |x| [x, y, z]))) {
            let others = cells.entry(at).or_default();
            for &j in others.iter().filter(|j| changed[i] || changed[**j]) {
                let [other_low, other_high] = &boxes[j];
                let overlap = (0..3).all(|k| low[k] <= other_high[k] && other_low[k] <= high[k]);
                // A pair has several common cells; the first of them counts.
                let is_first = || cell_of(std::array::from_fn(|k| low[k].max(other_low[k]))) == at;
                if overlap && is_first() && intersect(points, rows[i], rows[j]) {
                    found.push([j, i]);
                }
            }
            others.push(i);
        }
    }
    found
}

/// Returns true if two triangles without a common edge intersect.
fn intersect(points: &[Vector], a: [u32; 3], b: [u32; 3]) -> bool {
    let corners = |row: [u32; 3]| -> Corners { row.map(|v| points[v as usize]) };
    let one_way = |from: [u32; 3], to: [u32; 3]| {
        let triangle = corners(to);
        (0..3).any(|k| {
            let [p, q] = [from[k], from[(k + 1) % 3]];
            !to.contains(&p)
                && !to.contains(&q)
                && segment_intersects(points[p as usize], points[q as usize], &triangle)
        })
    };
    let n_common = a.iter().filter(|v| b.contains(v)).count();
    n_common < 2 && (one_way(a, b) || one_way(b, a))
}

fn bounds([a, b, c]: Corners) -> [Vector; 2] {
    [std::array::from_fn(|k| a[k].min(b[k]).min(c[k])), std::array::from_fn(|k| a[k].max(b[k]).max(c[k]))]
}

#[cfg(test)]
mod tests {
    use super::*;

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
            assert_eq!(intersections(&below(z), &rows, &changed, 1.0), found, "{z} {changed:?}");
        }
        // With a common vertex, the edge opposite to it decides.
        for (z, found) in [(-1.0, vec![[0, 1]]), (1.0, vec![])] {
            let points = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [1.0, 1.0, z], [1.0, 1.0, 2.0]];
            assert_eq!(intersections(&points, &[[0, 1, 2], [0, 3, 4]], &[true; 2], 1.0), found, "{z}");
        }
    }
}
