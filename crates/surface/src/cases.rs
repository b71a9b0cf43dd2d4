//! The 256 cases of marching cubes, generated from the topology of the cube.
//!
//! Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2 & 1)`; bit `c` of a case is set where that corner is
//! inside. Edge `e = 4·axis + k` runs along `axis` (0 x, 1 y, 2 z) from the corner whose two other coordinates
//! are the bits of `k`, lower axis first.
//!
//! On each face the outline of the surface is traced with the inside on its right (seen from outside the cell). If
//! diagonal corners of a face are inside, the outline separates each of them. This rule depends only on the face's four
//! signs, so two cells that share a face always agree. The outlines close into loops. Each loop is triangulated without
//! a diagonal within a face, so no edge of the mesh gets a third triangle.
//!
//! The tests verify these properties for every case and for every pair of cases that can share a face. They also verify
//! that the table below follows from the rule.

/// Maximum number of triangles of a case.
pub const MAX_TRIANGLES: usize = 5;

/// Table of all cases, parsed at compile time.
pub static CASES: Cases = Cases::parse(ROWS);

/// The triangles of cases 0 to 255: each digit is a cell edge (hexadecimal), three make a triangle, `.` is none.
#[rustfmt::skip]
const ROWS: &str = "
. 048 095 485895 1a4 0181a8 0951a4 1a5a85895 15b 04815b 0919b1 14b49b489 45a5ba 0585a85ba 0949b4ba4 89a9ba 286
042462 095286 296946954 1a4286 0a201aa62 0951a4286 1a5a25a62295 15b286 04246215b 0919b1286 14b46b62b29b
28645a5ba 0525b2ba2a62 0949b4ba4286 2969b6ba6 279 048279 025275 278758548 1a4279 0181a8279 0252751a4
1a5a85825275 15b279 04815b279 0710277b1 14b42b48227b 27945a5ba 0585a85ba279 0242b427bba4 2787a87ba 678798
049469679 085875867 465675 1a4678798 0191691a6679 0858758671a4 1a5a75a67 15b678798 04946967915b 0818616717b1
14b46b67b 45a5ba678798 0690b605bba6679 0b406b08667bba4 67a7ba 36a 04836a 09536a 36a485895 134364 018138368
095134364 135385368895 15b36a 04815b36a 0919b136a 14b49b48936a 36b64b45b 0585385b3368 0949b4b34364 36b69b689
2838a3 0424a2a32 0952838a3 2939535434a3 134324284 012132 095134324284 135325295 15b2838a3 0424a2a3215b
0919b12838a3 14b42b4a2a3229b 2838434535b3 0525b2b32 0949b4b34324284 2939b3 27936a 04827936a 02527536a
27875854836a 134364279 018138368279 025275134364 135385368825275 15b27936a 04815b27936a 0710277b136a
14b42b48227b36a 27936b64b45b 0585385b3368279 0242b427bb34364 2787b8b38368 37a78a798 0494394a3379 0858a5a35375
37a75a54a 134394379984 019139379 085835843413375 135375 15b37a78a798 0494394a337915b 0818718a7a377b1
14b47b4a7a37 34b39437998445b 0390535b3379 08437b 37b 3b7 0483b7 0953b7 3b7485895 1a43b7 0181a83b7 0951a43b7
1a5a858953b7 153573 048153573 091971731 143483893973 3a7a57a45 0585787383a8 0949349733a4 3a7a87897 2863b7
0424623b7 0952863b7 2969469543b7 1a42863b7 0a201aa623b7 0951a42863b7 1a5a25a622953b7 153573286 042462153573
091971731286 143493469629973 2863a7a57a45 0525a257a73aa62 0949349733a4286 2969a697a73a 2393b9 0482393b9
0252353b5 2383583b5548 1a42393b9 0181a82393b9 0252353b51a4 1a5a858252353b5 153593923 048153593923 021231
143483823 2393493a4459 0585385939233a8 0242343a4 2383a8 3b6b96986 0494696393b9 0858358633b5 3b6b46b54
1a43b6b96986 0191691a66393b9 0858358633b51a4 1a5a656353b5 153593983863 049469639319159 081861631 143463
3963493a4459986 0593a6 0340838633a4 3a6 6a7ab7 0486a7ab7 0956a7ab7 4858956a7ab7 1b4b64b76 0181781b7768
0951b4b64b76 1851781b7768895 15a57a76a 04815a57a76a 0919717616a1 17a18714889776a 456576 058578768 094964976
687897 2878a7ab7 0424a2ab2b72 0952878a7ab7 2a725a29554aab7 1b4b24b72284 0b201bb72 0951b4b24b72284 1251b2b72295
15a57a72a28a 0424a2a52a15572 0919717817288a1 14a297 287857845 052572 094974724284 297 2696b96ab 0482696b96ab
0252a526aab5 2582a526aab5548 1b4b94924264 0181681b6b96926 0252b526b64b41b 1b5268 15a52a59226a 04815a52a59226a
0610266a1 12a14248226a 269649459 058568596926 024264 268 8a9ab9 0494b94ab 0858a5ab5 4a5ab5 1b4b94984 0191b9
0858b584b41b 1b5 15a58a598 0494a9a19159 0818a1 14a 458598 059 084 .
";

/// One edge of a cell: the corner that owns it, as an offset from the cell's corner 0, and its axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellEdge {
    /// Offset of the owning grid point, 0 or 1 per axis.
    pub offset: [u8; 3],
    /// 0 x, 1 y, 2 z.
    pub axis: u8,
}

/// Table of all cases: the triangles and loops of each.
#[derive(Debug, Clone)]
pub struct Cases {
    /// Number of triangles per case.
    pub count: [u8; 256],
    /// Number of closed loops in the outline of each case. Each loop bounds a separate disc.
    pub loops: [u8; 256],
    /// Triangles per case as cell edges, counter-clockwise seen from outside the surface.
    pub triangles: [[[u8; 3]; MAX_TRIANGLES]; 256],
}

/// Returns the cell edge with index `e`.
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

impl Cases {
    /// Reads the table, at compile time.
    const fn parse(rows: &str) -> Self {
        let text = rows.as_bytes();
        let mut table = Self { count: [0; 256], loops: [0; 256], triangles: [[[0; 3]; MAX_TRIANGLES]; 256] };
        let (mut at, mut case, mut corner) = (0, 0, 0);
        // Edges of the case so far, and those of the current triangle.
        let (mut seen, mut own) = (0_u16, 0_u16);
        while at < text.len() {
            let digit = match text[at] {
                c @ b'0'..=b'9' => Some(c - b'0'),
                c @ b'a'..=b'b' => Some(c - b'a' + 10),
                _ => None,
            };
            if let Some(edge) = digit {
                table.triangles[case][corner / 3][corner % 3] = edge;
                own |= 1 << edge;
                corner += 1;
                if corner % 3 == 0 {
                    table.count[case] += 1;
                    // The triangles of a loop are consecutive. Each but the first shares a corner with an earlier one.
                    if seen & own == 0 {
                        table.loops[case] += 1;
                    }
                    (seen, own) = (seen | own, 0);
                }
            } else if text[at] == b' ' || text[at] == b'\n' {
                // A row ends where white space follows something.
                if at > 0 && text[at - 1] != b' ' && text[at - 1] != b'\n' {
                    (case, corner, seen) = (case + 1, 0, 0);
                }
            }
            at += 1;
        }
        table
    }

    /// Returns the triangles of a case as cell edges.
    #[must_use]
    pub fn of(&self, case: u8) -> &[[u8; 3]] {
        &self.triangles[usize::from(case)][..usize::from(self.count[usize::from(case)])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// Returns the edge between two adjacent corners.
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
    fn face_segments(case: u8, face: [u8; 4]) -> Vec<(u8, u8)> {
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
        for (from, to) in FACES.iter().flat_map(|face| face_segments(case, *face)) {
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

    #[test]
    fn the_table_matches_the_generated_cases() {
        for case in 0..=255_u8 {
            let triangles: Vec<_> = loops(case).iter().flat_map(|l| best_triangulation(l).1).collect();
            assert_eq!(CASES.of(case), triangles, "case {case}");
        }
        assert_eq!(CASES.count.iter().max(), Some(&5));
    }

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
            assert_eq!(usize::from(CASES.loops[usize::from(case)]), loops(case).len(), "case {case}");
            let mut segments: Vec<_> = FACES.iter().flat_map(|f| face_segments(case, *f)).collect();
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
                    let in_face = |edges: (u8, u8), face: u8| faces_of(edges.0) & faces_of(edges.1) & 1 << face != 0;
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

    /// Negative control for the tests above: joining instead of separating on one side only breaks the table.
    #[test]
    fn a_wrong_table_is_caught() {
        let mut triangles = CASES.of(0b0110_1001).to_vec();
        triangles[0].swap(0, 1);
        let segments: Vec<_> = FACES.iter().flat_map(|f| face_segments(0b0110_1001, *f)).collect();
        assert_ne!(outline(&triangles), segments);
    }
}
