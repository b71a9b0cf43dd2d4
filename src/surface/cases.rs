//! The 256 cases of marching cubes, generated from the topology of the cube.
//!
//! Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2 & 1)`; bit `c` of a case is set where that corner is
//! inside. Edge `e = 4·axis + k` runs along `axis` (0 x, 1 y, 2 z) from the corner whose two other coordinates
//! are the bits of `k`, lower axis first.
//!
//! On each face the surface's outline is traced with the inside on its right (seen from outside the cell). Where
//! a face's diagonal corners are inside, each is cut off by itself: a rule that looks at nothing but the face's
//! four signs, so the two cells that share a face always agree. The outlines close into loops; each loop is
//! triangulated without a diagonal that lies in a face, so no edge of the mesh gets a third triangle. The tests
//! prove both for every case and for every pair of cases that can share a face.

use std::sync::LazyLock;

/// Most triangles that a case has.
pub const MAX_TRIANGLES: usize = 5;

/// The table of all cases.
pub static CASES: LazyLock<Cases> = LazyLock::new(Cases::generate);

/// One edge of a cell: the corner that owns it, as an offset from the cell's corner 0, and its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellEdge {
    /// Offset of the owning sample, 0 or 1 per axis.
    pub offset: [u8; 3],
    /// 0 x, 1 y, 2 z.
    pub axis: u8,
}

/// All cases: how many triangles each has, and their corners as cell edges.
#[derive(Debug, Clone)]
pub struct Cases {
    /// Triangles per case.
    pub count: [u8; 256],
    /// Triangles per case as cell edges, counter-clockwise seen from outside the surface.
    pub triangles: [[[u8; 3]; MAX_TRIANGLES]; 256],
}

/// The cell edge with index `e`.
#[must_use]
pub const fn cell_edge(e: u8) -> CellEdge {
    let (axis, k) = (e / 4, e % 4);
    let (lo, hi) = (k & 1, k >> 1);
    let offset = match axis {
        0 => [0, lo, hi],
        1 => [lo, 0, hi],
        _ => [lo, hi, 0],
    };
    CellEdge { offset, axis }
}

/// Edge between two adjacent corners.
fn edge_between(a: u8, b: u8) -> u8 {
    let (low, axis) = (a & b, (a ^ b).trailing_zeros());
    let bit = |axis: u8| low >> axis & 1;
    match axis {
        0 => bit(1) | bit(2) << 1,
        1 => 4 + (bit(0) | bit(2) << 1),
        _ => 8 + (bit(0) | bit(1) << 1),
    }
}

/// The four corners of each face, counter-clockwise seen from outside the cell.
const FACES: [[u8; 4]; 6] = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// For a case and a face: the outline's segments on it as (from edge, to edge).
fn face_segments(case: u8, face: &[u8; 4]) -> Vec<(u8, u8)> {
    let inside = |i: usize| case >> face[i % 4] & 1 == 1;
    let edge = |i: usize| edge_between(face[i % 4], face[(i + 1) % 4]);
    (0..4)
        .filter(|&i| !inside(i) && inside(i + 1))
        .filter_map(|enter| {
            let leave = (enter + 1..enter + 4).find(|&i| inside(i) && !inside(i + 1))?;
            Some((edge(enter), edge(leave)))
        })
        .collect()
}

/// Bit mask of the two faces that an edge belongs to.
fn faces_of(edge: u8) -> u8 {
    (0..6)
        .filter(|&f| (0..4).any(|i| edge_between(FACES[f][i], FACES[f][(i + 1) % 4]) == edge))
        .fold(0, |m, f| m | 1 << f)
}

/// The loops of a case's outline, each a cycle of cell edges.
fn loops(case: u8) -> Vec<Vec<u8>> {
    let mut next = [None; 12];
    for (from, to) in FACES.iter().flat_map(|face| face_segments(case, face)) {
        next[usize::from(from)] = Some(to);
    }
    let mut found = Vec::new();
    for start in 0..12_u8 {
        let mut cycle = Vec::new();
        let mut at = start;
        while let Some(to) = next[usize::from(at)].take() {
            cycle.push(at);
            at = to;
        }
        if !cycle.is_empty() {
            found.push(cycle);
        }
    }
    found
}

/// Twice the midpoint of an edge, for lengths of diagonals.
fn midpoint2(edge: u8) -> [i32; 3] {
    let CellEdge { offset, axis } = cell_edge(edge);
    std::array::from_fn(|k| if k == usize::from(axis) { 1 } else { 2 * i32::from(offset[k]) })
}

/// Every triangulation of a polygon with its cost: (diagonals within a face, sum of squared diagonals).
fn best_triangulation(polygon: &[u8]) -> ((usize, i32), Vec<[u8; 3]>) {
    if polygon.len() < 3 {
        return ((0, 0), Vec::new());
    }
    let (first, last) = (polygon[0], polygon[polygon.len() - 1]);
    let diagonal = |a: u8, b: u8| {
        let length2: i32 = midpoint2(a).iter().zip(midpoint2(b)).map(|(p, q)| (p - q).pow(2)).sum();
        (usize::from(faces_of(a) & faces_of(b) != 0), length2)
    };
    // The edge (last, first) belongs to exactly one triangle: try every apex.
    (1..polygon.len() - 1)
        .map(|apex| {
            let (left_cost, left) = best_triangulation(&polygon[..=apex]);
            let (right_cost, right) = best_triangulation(&polygon[apex..]);
            let mut cost = (left_cost.0 + right_cost.0, left_cost.1 + right_cost.1);
            let sides = [(apex > 1, first, polygon[apex]), (apex + 2 < polygon.len(), polygon[apex], last)];
            for (_, a, b) in sides.into_iter().filter(|side| side.0) {
                let (in_face, length2) = diagonal(a, b);
                cost = (cost.0 + in_face, cost.1 + length2);
            }
            let triangles = [vec![[first, polygon[apex], last]], left, right].concat();
            (cost, triangles)
        })
        .min_by_key(|(cost, _)| *cost)
        .unwrap_or_default()
}

impl Cases {
    fn generate() -> Self {
        let mut table = Self { count: [0; 256], triangles: [[[0; 3]; MAX_TRIANGLES]; 256] };
        for case in 0..=255_u8 {
            let triangles: Vec<_> = loops(case).iter().flat_map(|l| best_triangulation(l).1).collect();
            let row = usize::from(case);
            for (slot, triangle) in table.triangles[row].iter_mut().zip(&triangles) {
                *slot = *triangle;
                table.count[row] += 1;
            }
        }
        table
    }

    /// The triangles of a case as cell edges.
    #[must_use]
    pub fn of(&self, case: u8) -> &[[u8; 3]] {
        &self.triangles[usize::from(case)][..usize::from(self.count[usize::from(case)])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// Directed edges of a case's triangles with their multiplicities.
    fn half_edges(triangles: &[[u8; 3]]) -> BTreeMap<(u8, u8), i32> {
        let mut count = BTreeMap::new();
        for t in triangles {
            for k in 0..3 {
                *count.entry((t[k], t[(k + 1) % 3])).or_insert(0) += 1;
            }
        }
        count
    }

    /// Half edges without their opposite: the outline.
    fn outline(triangles: &[[u8; 3]]) -> Vec<(u8, u8)> {
        let all = half_edges(triangles);
        all.keys().filter(|(a, b)| !all.contains_key(&(*b, *a))).copied().collect()
    }

    #[test]
    fn edges_join_adjacent_corners() {
        for e in 0..12 {
            let CellEdge { offset, axis } = cell_edge(e);
            let low = offset[0] | offset[1] << 1 | offset[2] << 2;
            assert_eq!(edge_between(low, low | 1 << axis), e);
            assert_eq!(faces_of(e).count_ones(), 2);
        }
    }

    #[test]
    fn every_case_is_a_set_of_oriented_discs_with_its_faces_segments_as_outline() {
        for case in 0..=255_u8 {
            let triangles = CASES.of(case);
            assert_eq!(
                triangles.len(),
                loops(case).iter().map(|l| l.len() - 2).sum::<usize>(),
                "nothing cut off: {case}"
            );
            assert!(half_edges(triangles).values().all(|&n| n == 1), "case {case}");
            let mut segments: Vec<_> = FACES.iter().flat_map(|f| face_segments(case, f)).collect();
            segments.sort_unstable();
            assert_eq!(outline(triangles), segments, "case {case}");
            // Exactly the edges whose ends differ carry vertices.
            let mut used: Vec<u8> = triangles.iter().flatten().copied().collect();
            used.sort_unstable();
            used.dedup();
            let crossing: Vec<u8> = (0..12)
                .filter(|&e| {
                    let CellEdge { offset, axis } = cell_edge(e);
                    let low = offset[0] | offset[1] << 1 | offset[2] << 2;
                    (case >> low ^ case >> (low | 1 << axis)) & 1 == 1
                })
                .collect();
            assert_eq!(used, crossing, "case {case}");
        }
    }

    /// Around each vertex the triangles of one cell form one fan from one face to the other, so the four cells
    /// around a grid edge close into one cycle.
    #[test]
    fn triangles_around_a_vertex_form_one_fan_in_every_case() {
        for case in 0..=255_u8 {
            for v in 0..12_u8 {
                let mut link: BTreeMap<u8, u8> = BTreeMap::new();
                for t in CASES.of(case) {
                    for k in 0..3 {
                        if t[k] == v {
                            assert!(link.insert(t[(k + 1) % 3], t[(k + 2) % 3]).is_none(), "case {case}");
                        }
                    }
                }
                let n = link.len();
                let starts: Vec<u8> = link.keys().filter(|k| !link.values().any(|v| v == *k)).copied().collect();
                if n > 0 {
                    assert_eq!(starts.len(), 1, "case {case} edge {v}");
                    let mut at = starts[0];
                    let mut steps = 0;
                    while let Some(&to) = link.get(&at) {
                        at = to;
                        steps += 1;
                    }
                    assert_eq!(steps, n, "case {case} edge {v}");
                }
            }
        }
    }

    /// All 3 × 2^12 pairs of cases of face-adjacent cells: the shared face's half edges cancel, and no edge that
    /// lies in the face is used by more than one triangle of each cell.
    #[test]
    fn adjacent_cells_agree_on_their_face_in_all_12288_pairs() {
        let mut pairs = 0;
        for axis in 0..3_u8 {
            // Faces in the order -x +x -y +y -z +z; corners of the low cell's far face match the high cell's near one.
            let (far, near) = (2 * axis + 1, 2 * axis);
            for low in 0..=255_u8 {
                for free in 0..16_u8 {
                    let (mut high, mut bit) = (0_u8, 0);
                    for corner in 0..8_u8 {
                        let is_far = corner >> axis & 1 == 1;
                        if is_far {
                            high |= (free >> bit & 1) << corner;
                            bit += 1;
                        } else {
                            high |= (low >> (corner | 1 << axis) & 1) << corner;
                        }
                    }
                    pairs += 1;
                    let in_face =
                        |edges: (u8, u8), face: u8| faces_of(edges.0) & faces_of(edges.1) >> 0 & 1 << face != 0;
                    let shift = |e: u8| {
                        let CellEdge { offset, axis: a } = cell_edge(e);
                        let mut corner = offset[0] | offset[1] << 1 | offset[2] << 2;
                        corner |= 1 << axis;
                        edge_between(corner, corner | 1 << a)
                    };
                    let mine: Vec<_> =
                        half_edges(CASES.of(low)).into_iter().filter(|(e, _)| in_face(*e, far)).collect();
                    let theirs: Vec<_> =
                        half_edges(CASES.of(high)).into_iter().filter(|(e, _)| in_face(*e, near)).collect();
                    let mut opposite: Vec<_> = theirs.iter().map(|((a, b), n)| ((shift(*b), shift(*a)), *n)).collect();
                    opposite.sort_unstable();
                    assert_eq!(mine, opposite, "axis {axis} low {low} high {high}");
                }
            }
        }
        assert_eq!(pairs, 12_288);
    }

    #[test]
    fn a_lone_inside_corner_faces_outwards() {
        // Corner 0 inside: the triangle's normal points away from it.
        let [t] = CASES.of(1) else { panic!("one triangle") };
        let p: Vec<[i32; 3]> = t.iter().map(|&e| midpoint2(e)).collect();
        let d = |a: usize, b: usize| [0, 1, 2].map(|k| p[b][k] - p[a][k]);
        let (a, b) = (d(0, 1), d(0, 2));
        let n = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        assert!(n.iter().all(|&c| c > 0), "{n:?}");
    }

    /// The proof above must be able to fail: joining instead of separating on one side only breaks it.
    #[test]
    fn a_wrong_table_is_caught() {
        let mut triangles = CASES.of(0b0110_1001).to_vec();
        triangles[0].swap(0, 1);
        let segments: Vec<_> = FACES.iter().flat_map(|f| face_segments(0b0110_1001, f)).collect();
        assert_ne!(outline(&triangles), segments);
    }
}
