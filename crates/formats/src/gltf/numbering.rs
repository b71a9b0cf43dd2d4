//! Numbering of the vertices of a piece by their first use. This makes files small: the index codec does not store the
//! number of a vertex at its first use, and consecutive vertices differ little.

use rustc_hash::FxHashMap;

/// Marker of a vertex without a number.
const NONE: u32 = u32::MAX;

/// Triangles of a piece that refer to its own vertices.
pub(super) struct Numbering {
    /// Vertices of the mesh in the order of their numbers.
    pub(super) vertices: Vec<u32>,
    /// Triangles, as indices of `vertices`.
    pub(super) triangles: Vec<[u32; 3]>,
}

impl Numbering {
    /// Memory per triangle, bytes: three numbers, two entries of the table, and three vertices at most.
    pub(super) const TRIANGLE_BYTES: u64 = 12 + 8 + 12;

    /// Numbers the vertices of `triangles`.
    pub(super) fn new(triangles: &[[u32; 3]]) -> Self {
        let n = triangles.len();
        // Most vertices of a run of triangles are consecutive, about half as many as triangles. A table finds these. A
        // hash map finds the others, which belong to earlier or later runs.
        let middle = triangles.get(n / 2).map_or(0, |triangle| triangle[0] as usize);
        let first = middle.saturating_sub(n);
        let (mut near, mut far) = (vec![NONE; 2 * n], FxHashMap::default());
        let mut vertices = Vec::with_capacity(n);
        let mut number = |vertex: u32| {
            let entry = match near.get_mut((vertex as usize).wrapping_sub(first)) {
                Some(entry) => entry,
                None => far.entry(vertex).or_insert(NONE),
            };
            if *entry == NONE {
                // No piece has 2³² vertices.
                *entry = u32::try_from(vertices.len()).unwrap_or(NONE);
                vertices.push(vertex);
            }
            *entry
        };
        let triangles = triangles.iter().map(|triangle| triangle.map(&mut number)).collect();
        Self { vertices, triangles }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_and_far_vertices_are_numbered_by_first_use() {
        for far in [0, 7, 1_000, u32::MAX - 1] {
            let triangles = [[500, 502, 501], [501, 502, far], [far, 500, 501]];
            let Numbering { vertices, triangles } = Numbering::new(&triangles);
            assert_eq!(vertices, [500, 502, 501, far]);
            assert_eq!(triangles, [[0, 1, 2], [2, 1, 3], [3, 0, 2]]);
        }
        assert!(Numbering::new(&[]).vertices.is_empty());
    }
}
