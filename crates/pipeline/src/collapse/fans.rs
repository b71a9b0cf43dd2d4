//! Topology of a piece of a mesh.

use molmesh_surface::lattice::to_u32;
use rustc_hash::{FxHashMap, FxHashSet};

/// Fans of triangles around the vertices of the boundary. The key is the edge with which a fan begins, as its boundary
/// vertex and its other end. The value is the other end of the edge with which the fan ends.
pub(super) type BoundaryFans = FxHashMap<[u32; 2], u32>;

/// Topology of an oriented manifold with a boundary. In a closed manifold mesh, a piece can be replaced by another one
/// with equal boundary fans, unless one of its chords is also an edge of another piece.
#[derive(Debug, PartialEq)]
pub(super) struct Topology {
    pub(super) fans: BoundaryFans,
    /// Chords: inner edges that join two vertices of the boundary. The lower vertex is the first.
    pub(super) chords: Vec<[u32; 2]>,
    /// Twice the number of vertices, less the number of triangles: with the same boundary, it changes with the Euler
    /// characteristic, so that a component or a handle that disappears alone is found.
    pub(super) euler: i64,
}

/// Returns the topology of triangles; `None` if they are not an oriented manifold with a boundary. A vertex of the
/// boundary may have several fans, because other pieces join them.
pub(super) fn topology(triangles: &[[u32; 3]]) -> Option<Topology> {
    // Third vertex of the triangle of each directed edge.
    let mut third: FxHashMap<[u32; 2], u32> = FxHashMap::default();
    third.reserve(3 * triangles.len());
    let n_vertices = triangles.iter().flatten().max().map_or(0, |most| *most as usize + 1);
    // Triangles at each vertex that no fan contains yet.
    let mut left = vec![0_u32; n_vertices];
    for &[a, b, c] in triangles {
        if a == b || b == c || c == a {
            return None;
        }
        for (from, to, other) in [(a, b, c), (b, c, a), (c, a, b)] {
            if third.insert([from, to], other).is_some() {
                return None;
            }
            left[from as usize] += 1;
        }
    }
    let edges = || triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]);
    let is_inner = |[v, w]: [u32; 2]| third.contains_key(&[w, v]);
    let mut fans = BoundaryFans::default();
    let mut on_boundary = vec![false; n_vertices];
    for [v, first] in edges().filter(|edge| !is_inner(*edge)) {
        let mut last = first;
        while let Some(next) = third.get(&[v, last]) {
            left[v as usize] = left[v as usize].checked_sub(1)?;
            last = *next;
        }
        fans.insert([v, first], last);
        on_boundary[v as usize] = true;
    }
    // The other vertices have one closed fan each.
    for [v, first] in edges() {
        if left[v as usize] == 0 {
            continue;
        }
        let (mut last, mut n) = (first, 0);
        loop {
            last = *third.get(&[v, last])?;
            n += 1;
            if last == first {
                break;
            }
        }
        if n < 3 || n != left[v as usize] || on_boundary[v as usize] {
            return None;
        }
        left[v as usize] = 0;
    }
    let joins_boundary = |[v, w]: [u32; 2]| on_boundary[v as usize] && on_boundary[w as usize];
    let chords = edges().filter(|edge| edge[0] < edge[1] && joins_boundary(*edge) && is_inner(*edge)).collect();
    let used: FxHashSet<u32> = triangles.iter().flatten().copied().collect();
    let [n_vertices, n_triangles] = [used.len(), triangles.len()].map(|n| i64::from(to_u32(n)));
    Some(Topology { fans, chords, euler: 2 * n_vertices - n_triangles })
}
